"""Whether the commands belong to the motion: order and signs of columns, thrusters, lag, silence.

Each hypothesis on the commands (a column of another axis, a reversed thruster, …) is a set of
weights that turns the recorded columns into the six forces. `response.py` says what share of these
forces the motion accounts for. A hypothesis is named if it leaves less than half of what the
recorded order leaves unaccounted for, on evidence that chance does not give.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.optimize import linear_sum_assignment

from ...vehicles.vehicle import Vehicle
from ..outputs import outputs_of
from ..store import Recording
from .columns import columns_of
from .command_words import (
    dead_thruster,
    exchanged_columns,
    exchanged_thrusters,
    mirrored,
    no_answer,
    no_commands,
    reversed_axes,
    reversed_thruster,
    shifted,
    shifted_apart,
    silent,
    turned_heading,
)
from .finding import Finding
from .heading import heading_offset, mirrored_plane
from .held_columns import held_column
from .held_outputs import held_throughout
from .hypotheses import ALL, CAUSAL, EVIDENCE, MOST, PLAUSIBLE, Driven, driven_by, named
from .lengths import length_findings
from .response import LAGS_S, responses

_DEAD = 0.15
_STRONG = 0.04
"""Share of a thruster's largest thrust: that of a fifth of its command, 80 µs, if thrust is
quadratic in it. A dead band takes 25 to 30 µs of them."""
_CONTRARY = 3.0
"""Nats that an axis may lose by chance under a hypothesis that is true: less than 1 in 20."""
_NO_FORCE = 1e-3
"""N or N·m below which nothing is driven; pulses in a thruster's dead band give up to 1e-6 N."""
_FACTORS = np.round(np.arange(-1.5, 1.51, 0.05), 2)
_LEAST_COUNT = 20.0
"""Independent windows below which nothing is said of an axis."""
_MAIN = 0.7
"""Share of the largest lever on an axis from which on a thruster mainly drives it."""
_LINEAR, _ANGULAR = (0, 1, 2), (3, 4, 5)
_APART_S = 0.25
"""s by which the answers of velocities and of rates may differ: thrusters give both the same lag,
which is known to a step of `LAGS_S` in each."""


def command_findings(recording: Recording, vehicle: Vehicle | None) -> list[Finding]:
    """What is wrong between commands and motion; thrusters only if their vehicle is known."""
    columns = columns_of(recording, vehicle)
    if columns is None:
        return []
    forces, weights, names = columns
    mask = recording.mask
    if not np.abs(forces[mask]).max(initial=0.0) > _NO_FORCE:
        return [no_commands(recording)]
    if found := held_throughout(recording, vehicle, forces):
        return found
    axes = {
        i: r
        for i, r in responses(recording, forces, recording.command_period).items()
        if r.count >= _LEAST_COUNT
    }
    data = driven_by(axes, weights, names, vehicle)
    judged = () if vehicle is None else _strong(forces[mask], vehicle)
    data = replace(data, outputs=outputs_of(recording.dataset), judged=judged)
    # an axis without a command tells nothing of the order of columns
    driven = replace(data, axes={i: r for i, r in axes.items() if data.given[i] > 0})
    if not driven.axes:
        return []
    wrench = recording.thrust_from == "F_Bo_B"
    nats, found = _orders(driven, wrench)
    if not wrench:
        held = held_column(recording, vehicle, driven)
        for more, thrusters in (_thrusters(driven), held):
            nats, found = (more, thrusters) if more > nats else (nats, found)
    offset = heading_offset(recording, forces, driven)
    if offset is not None and offset[0] > nats:
        nats, found = offset[0], [turned_heading(offset[1])]
    mirror = mirrored_plane(recording, forces, driven)
    if mirror is not None and mirror[0] > nats:
        found = [mirrored(mirror[1])]
    if found:
        return found
    unanswered = [i for i in driven.axes if data.unanswered(i)]
    if unanswered and not any(data.answered(i) for i in driven.axes):
        return [no_answer(data, unanswered)]
    told = [silent(data, i) for i in unanswered] + _lags(driven)
    return told + length_findings(driven, vehicle)


def _strong(forces: np.ndarray, vehicle: Vehicle) -> tuple[int, ...]:
    """Thrusters whose thrust was often large enough to be judged.

    Near the dead band the curve of a thruster is uncertain by factors.
    """
    low, high = (np.asarray(limit) for limit in vehicle.thrusters().force_limits())
    if forces.shape[-1] != len(low):
        return ()
    often = np.percentile(np.abs(forces), 95, axis=0)
    return tuple(np.flatnonzero(often > _STRONG * np.minimum(-low, high)).tolist())


def _orders(data: Driven, wrench: bool) -> tuple[float, list[Finding]]:
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


def _thrusters(data: Driven) -> tuple[float, list[Finding]]:
    """Thrusters that push the other way, are exchanged or dead; as `_orders` returns them."""
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
    main = [i for i in data.axes if change[i] >= _MAIN * change.max()]
    lost = [0.5 * data.axes[i].count * (np.log1p(-shares[i]) - np.log1p(-usual[i])) for i in main]
    return bool(max(lost, default=0.0) > _CONTRARY)


_Change = tuple[str, int, int]


def _chain(data: Driven, options: Sequence[_Change]) -> tuple[float, np.ndarray, list[_Change]]:
    """The best change, then the next best, …: evidence less `EVIDENCE` each, weights, changes."""
    worth, changes = _worth(data, []), []
    while len(changes) < len(data.columns):
        tried = np.stack([_changed(data, [*changes, one]) for one in options], axis=-1)
        nats, _, _ = data.best(tried, CAUSAL, strict=True)
        net = nats - EVIDENCE * np.array([_cost([*changes, one]) for one in options])
        at = int(net.argmax())
        if net[at] < worth:
            break
        worth = float(net[at])
        changes.append(options[at])
    changes = _needed(data, changes)
    return _worth(data, changes), _changed(data, changes), changes


def _needed(data: Driven, changes: list[_Change]) -> list[_Change]:
    """The changes without any of which some axis would be left with twice as much, or more.

    The axis must be one that a changed thruster mainly drives. Small improvements of several axes
    together, and moments of small lever arms, tell of errors in the vehicle's file.
    """
    arms = np.abs(data.weights) / np.maximum(np.abs(data.weights).max(axis=1), 1e-9)[:, None]
    for one in reversed(changes):
        rest = [other for other in changes if other is not one]
        both = np.stack([_changed(data, rest), _changed(data, changes)], axis=-1)
        _, shares, _ = data.best(both, PLAUSIBLE)
        main = [i for i in data.axes if max(arms[i, one[1]], arms[i, one[2]]) >= _MAIN]
        if not any(
            named(float(shares[i][0]), float(shares[i][1]), data.axes[i].count) for i in main
        ):
            return _needed(data, rest)
    return changes


def _worth(data: Driven, changes: Sequence[_Change]) -> float:
    weights = _changed(data, changes)[..., None]
    nats, _, _ = data.best(weights, CAUSAL if changes else PLAUSIBLE, strict=bool(changes))
    return float(nats[0]) - EVIDENCE * _cost(changes)


def _cost(changes: Sequence[_Change]) -> int:
    """Changes; two thrusters that are reversed together are two: one alone may explain nothing."""
    return sum(2 if kind == "reversed" and a != b else 1 for kind, a, b in changes)


def _changed(data: Driven, changes: Sequence[_Change]) -> np.ndarray:
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


def _lags(data: Driven) -> list[Finding]:
    """Lags that neither thrusters nor clocks have: of all axes, or of velocities or rates alone."""
    groups = [_group(data, axes) for axes in (_LINEAR, _ANGULAR)]
    found = [one for group in groups if (one := _lag(group)) is not None]
    if len(found) == 2 and found[0][1] == found[1][1]:
        return [shifted(found[0][0] + found[1][0], found[0][1])]
    if found or not all(group.axes for group in groups):
        return [shifted(axes, seconds) for axes, seconds in found]
    _, shares, _ = data.best(data.weights[..., None], PLAUSIBLE)
    strong = [i for i, share in shares.items() if share[0] >= MOST]  # others have any lag
    groups = [_group(group, strong) for group in groups]
    if not all(group.axes for group in groups):
        return []
    best = [group.best(group.weights[..., None], PLAUSIBLE) for group in groups]
    at = [int(lags[0]) for _, _, lags in best]
    apart = float(LAGS_S[at[0]] - LAGS_S[at[1]])
    if abs(apart) < _APART_S:
        return []
    common = max(
        sum(float(g.best(g.weights[..., None], [one])[0][0]) for g in groups) for one in PLAUSIBLE
    )
    if sum(float(nats[0]) for nats, _, _ in best) - common < EVIDENCE:
        return []
    return [shifted_apart(apart)]


def _group(data: Driven, axes: Sequence[int]) -> Driven:
    return replace(data, axes={i: r for i, r in data.axes.items() if i in axes})


_Lag = tuple[tuple[int, ...], float]


def _lag(data: Driven) -> _Lag | None:
    """Axes with a strong answer, and the lag (s) at which it is, if that is not plausible."""
    if not data.axes:
        return None
    weights = data.weights[..., None]
    nats, shares, at = data.best(weights, ALL)
    usual, _, _ = data.best(weights, PLAUSIBLE)
    strong = tuple(i for i in data.axes if shares[i][0] >= MOST)
    if nats[0] - usual[0] < EVIDENCE or not strong:
        return None
    return strong, float(LAGS_S[at[0]])
