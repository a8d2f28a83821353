"""Other orders and signs of the commands, and the one that the motion fits best."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.optimize import linear_sum_assignment

from .command_words import (
    dead_thruster,
    exchanged_columns,
    exchanged_thrusters,
    reversed_axes,
    reversed_thruster,
)
from .finding import Finding
from .hypotheses import CAUSAL, EVIDENCE, MAIN, PLAUSIBLE, Driven, named

_DEAD = 0.15
_CONTRARY = 3.0
"""Nats that an axis may lose by chance under a hypothesis that is true: less than 1 in 20."""
_FACTORS = np.round(np.arange(-1.5, 1.51, 0.05), 2)


def orders(data: Driven, wrench: bool) -> tuple[float, list[Finding]]:
    """Columns of a wrench in another order, and axes whose command has the other sign.

    Returns the evidence for it, less `EVIDENCE` for each change, and the findings.
    """
    pairs = np.moveaxis(np.stack([data.weights, -data.weights], axis=-1), 1, 0)  # m, column, sign
    own = sorted(data.axes)
    usual, kept, _ = data.best(data.weights[..., None], PLAUSIBLE)
    count = np.array([[data.axes[i].count] for i in own])
    best, moves = -np.inf, []
    every = np.broadcast_to(pairs, (6, *pairs.shape))
    for lag in CAUSAL:
        shares = data.shares(every, lag, strict=True)
        table = np.stack([shares[i] for i in own])
        both = table.max(axis=-1)  # (axis, column)
        nats = -0.5 * count * np.log1p(-both)
        if not wrench:
            nats = np.where(np.eye(6, dtype=bool)[own], nats, 0.0)
        rows, columns = linear_sum_assignment(-nats)
        if (total := float(nats[rows, columns].sum())) > best:
            signs = 1 - 2 * table[rows, columns].argmax(axis=-1)
            rows = [own[row] for row in rows]
            kept_ = both[np.arange(len(rows)), columns] if wrench else both[:, own].diagonal()
            best, moves = total, list(zip(rows, columns.tolist(), signs, kept_, strict=True))
    moved = [
        (i, j, int(sign))
        for i, j, sign, share in moves
        if (i, 1) != (j, sign) and named(float(kept[i][0]), float(share), data.axes[i].count)
    ]
    worth = best - float(usual[0]) - EVIDENCE * len(moved)
    if not moved or worth < 0:
        return 0.0, []
    if any(i != j for i, j, _ in moved):
        return worth, [exchanged_columns(moved)]
    return worth, [reversed_axes(data, moved, wrench)]


def thrusters(data: Driven) -> tuple[float, list[Finding]]:
    """Thrusters that push the other way, are exchanged or dead; as `orders` returns them."""
    if not data.judged:
        return 0.0, []
    flips = [("reversed", k, k) for k in data.judged]
    flips += [("reversed", a, b) for a, b in combinations(data.judged, 2)]
    swaps = [("exchanged", a, b) for a, b in combinations(data.judged, 2)]
    usual, first, _ = data.best(data.weights[..., None], PLAUSIBLE)
    chains = [_chain(data, options) for options in (flips, swaps, flips + swaps) if options]
    worth, weights, changes = max(chains, key=lambda chain: chain[0])
    _, last, lags = data.best(weights[..., None], PLAUSIBLE)
    before, after = ({i: float(s[0]) for i, s in shares.items()} for shares in (first, last))
    if changes and loses(data, weights, before, after):
        worth, weights, changes, last = float(usual[0]), data.weights, [], first
    dead = [k for k in data.judged if _is_dead(data, weights, k, last, int(lags[0]))]
    turned = {k for kind, a, b in changes if kind == "reversed" for k in (a, b)}
    found = [
        exchanged_thrusters(data, a, b) for kind, a, b in sorted(changes) if kind != "reversed"
    ]
    found += [reversed_thruster(data, k) for k in sorted(turned.difference(dead))]
    found += [dead_thruster(data, k) for k in dead]
    return (worth - float(usual[0]) if changes else 0.5 * bool(dead)), found


def loses(
    data: Driven, weights: np.ndarray, usual: dict[int, float], shares: dict[int, float]
) -> bool:
    """Whether an axis on which changed weights mainly act is explained worse by them.

    What is true explains each of them at least as well. A gain at the expense of such an axis is of
    a force that the vehicle's numbers lack, such as the pitch that thrust in surge makes.
    """
    largest = np.maximum(np.abs(data.weights).max(axis=1), 1e-12)
    change = np.abs(weights - data.weights).max(axis=1) / largest
    main = [i for i in data.axes if change[i] >= MAIN * change.max()]
    lost = [0.5 * data.axes[i].count * (np.log1p(-shares[i]) - np.log1p(-usual[i])) for i in main]
    return bool(max(lost, default=0.0) > _CONTRARY)


_Change = tuple[str, int, int]


def _chain(data: Driven, options: Sequence[_Change]) -> tuple[float, np.ndarray, list[_Change]]:
    """The best change, then the next best, …: evidence less `EVIDENCE` each, weights, changes."""
    worth, changes = _worth(data, []), []
    while len(changes) < len(data.columns):
        tried = np.stack([with_changes(data, [*changes, one]) for one in options], axis=-1)
        nats, _, _ = data.best(tried, CAUSAL, strict=True)
        net = nats - EVIDENCE * np.array([_cost([*changes, one]) for one in options])
        at = int(net.argmax())
        if net[at] < worth:
            break
        worth = float(net[at])
        changes.append(options[at])
    changes = _needed(data, changes)
    return _worth(data, changes), with_changes(data, changes), changes


def _needed(data: Driven, changes: list[_Change]) -> list[_Change]:
    """The changes without any of which some axis would be left with twice as much, or more.

    The axis must be one that a changed thruster mainly drives. Small improvements of several axes
    together, and moments of small lever arms, tell of errors in the vehicle's file.
    """
    arms = np.abs(data.weights) / np.maximum(np.abs(data.weights).max(axis=1), 1e-9)[:, None]
    for one in reversed(changes):
        rest = [other for other in changes if other is not one]
        both = np.stack([with_changes(data, rest), with_changes(data, changes)], axis=-1)
        _, shares, _ = data.best(both, PLAUSIBLE)
        main = [i for i in data.axes if max(arms[i, one[1]], arms[i, one[2]]) >= MAIN]
        if not any(
            named(float(shares[i][0]), float(shares[i][1]), data.axes[i].count) for i in main
        ):
            return _needed(data, rest)
    return changes


def _worth(data: Driven, changes: Sequence[_Change]) -> float:
    weights = with_changes(data, changes)[..., None]
    nats, _, _ = data.best(weights, CAUSAL if changes else PLAUSIBLE, strict=bool(changes))
    return float(nats[0]) - EVIDENCE * _cost(changes)


def _cost(changes: Sequence[_Change]) -> int:
    """Changes; two thrusters that are reversed together are two: one alone may explain nothing."""
    return sum(2 if kind == "reversed" and a != b else 1 for kind, a, b in changes)


def with_changes(data: Driven, changes: Sequence[_Change]) -> np.ndarray:
    """The weights after changes, one after another."""
    changed = data.weights.copy()
    for kind, a, b in changes:
        if kind == "reversed":
            changed[:, list({a, b})] *= -1
        else:
            changed[:, [a, b]] = changed[:, [b, a]]
    return changed


def _is_dead(
    data: Driven, weights: np.ndarray, k: int, usual: dict[int, np.ndarray], lag: int
) -> bool:
    """Whether the most likely factor on thruster k is 0, and clearly better than 1."""
    tried = np.repeat(weights[..., None], _FACTORS.size, axis=-1)
    tried[:, k] *= _FACTORS
    shares = data.shares(tried, lag)
    at = int(data.evidence(shares).argmax())
    return bool(abs(_FACTORS[at]) <= _DEAD) and any(
        named(float(usual[i][0]), float(shares[i][at]), r.count) for i, r in data.axes.items()
    )
