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

from ...se3 import AXES, WRENCH
from ...vehicles.vehicle import Vehicle
from ..commands import voltage_of
from ..store import Recording
from .command_sentences import (
    dead_thruster,
    exchanged_columns,
    exchanged_thrusters,
    no_answer,
    no_commands,
    reversed_axes,
    reversed_thruster,
    silent_axis,
)
from .finding import Finding
from .hypotheses import ALL, CAUSAL, PLAUSIBLE, Driven
from .response import LAGS_S, AxisResponse, responses

_EVIDENCE = 12.0
"""Nats by which a named hypothesis is more likely than the recorded order: 6e-6 by chance, some
hundred hypotheses together 1e-3."""
_MAINLY = 0.75
"""Share of the largest effect of a change, from which on an axis is one that it acts on mainly."""
_CONTRARY = 3.0
"""Nats that an axis may lose by chance under a hypothesis that is true: less than 1 in 20."""
_MOST = 0.5
"""Share that a named hypothesis accounts for, and most of the rest that it leaves."""
_HARDLY, _SURE = 10.0, 0.9
"""Commanded force over the force that the motion shows, above which no vehicle's numbers explain
it; the largest share of a force that a command is expected to make up."""
_DEAD = 0.15
_STRONG = 0.04
"""Share of a thruster's largest thrust, that of a fifth of its command: four to six times what its
dead band takes."""
_NO_FORCE = 1e-3
"""N or N·m below which nothing is driven; pulses in a thruster's dead band give up to 1e-6 N."""
_FACTORS = np.round(np.arange(-1.5, 1.51, 0.05), 2)
_LEAST_COUNT = 20.0
"""Independent windows below which nothing is said of an axis."""


def command_findings(recording: Recording, vehicle: Vehicle | None) -> list[Finding]:
    """What is wrong between commands and motion; thrusters only if their vehicle is known."""
    columns = _columns(recording, vehicle)
    if columns is None:
        return []
    forces, weights, names = columns
    mask = recording.mask
    if not np.abs(forces[mask]).max(initial=0.0) > _NO_FORCE:
        return [no_commands(recording)]
    axes = {
        i: r
        for i, r in responses(recording, forces, recording.command_period).items()
        if r.count >= _LEAST_COUNT
    }
    data = _data(axes, weights, names, vehicle)
    if vehicle is not None:
        data = replace(data, driven=_strong(forces[mask], vehicle))
    # an axis without a command tells nothing of the order of columns
    driven = replace(data, axes={i: r for i, r in axes.items() if data.given[i] > 0})
    if not driven.axes:
        return []
    wrench = recording.thrust_from == "F_Bo_B"
    nats, found = _orders(driven, wrench)
    if not wrench:
        more, thrusters = _thrusters(driven)
        found = thrusters if more > nats else found
    if found:
        return found
    silent = [i for i in driven.axes if _unanswered(data, i)]
    if silent and not any(_answered(data, i) for i in driven.axes):
        return [no_answer(data, silent)]
    return [silent_axis(data, i) for i in silent] + _lag(driven)


def _columns(
    recording: Recording, vehicle: Vehicle | None
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]] | None:
    """Forces (J, K, N, m), their weights in the wrench (6, m), and the columns' names."""
    name = recording.thrust_from
    values = recording.dataset[name].to_numpy()
    if name == "F_Bo_B":
        return values, np.eye(6), WRENCH
    if vehicle is None or values.shape[-1] != len(vehicle.propulsion.mounts):
        return None
    thrusters = vehicle.thrusters()
    names = tuple(f"{'pwm' if name == 'pwm' else 'f'}{k + 1}" for k in range(values.shape[-1]))
    if name == "pwm":
        pulses = np.nan_to_num(values, nan=1500.0)
        mirrored = 1500 + np.asarray(thrusters.motor_directions) * (pulses - 1500)
        volts = voltage_of(recording.dataset, thrusters)[..., None]
        values = thrusters.curve.steady(mirrored, volts)
    return values, np.asarray(thrusters.allocation), names


def _strong(forces: np.ndarray, vehicle: Vehicle) -> tuple[int, ...]:
    """Thrusters that for a while gave enough thrust to be judged: near its dead band, a thruster's
    curve does not tell its thrust to a factor.
    """
    low, high = (np.asarray(limit) for limit in vehicle.thrusters().force_limits())
    if forces.shape[-1] != len(vehicle.propulsion.mounts):
        return ()
    often = np.percentile(np.abs(forces), 95, axis=0)
    return tuple(np.flatnonzero(often > _STRONG * np.minimum(-low, high)).tolist())


def _data(
    axes: dict[int, AxisResponse],
    weights: np.ndarray,
    names: tuple[str, ...],
    vehicle: Vehicle | None,
) -> Driven:
    zero = int(np.argmin(np.abs(LAGS_S)))
    given, needed, masses = {}, {}, {}
    for i, r in axes.items():
        given[i] = float(np.sqrt(max(weights[i] @ r.CC[zero] @ weights[i], 0.0) / r.windows))
        if given[i] < 1e-6:  # what rounding leaves of an axis that thrusters can't actuate
            given[i] = 0.0
        if vehicle is None:
            needed[i], masses[i] = np.inf, 0.0
            continue
        rigid = (vehicle.mass,) * 3 + vehicle.inertia
        c = np.array([
            rigid[i] + vehicle.added_mass[i],
            vehicle.linear_damping[i],
            vehicle.quadratic_damping[i],
        ])  # fmt: skip
        masses[i] = float(c[0])
        needed[i] = float(np.sqrt(max(c @ r.RR @ c, 0.0) / r.windows))
    return Driven(axes, weights, names, needed, given, masses)


def _nats(data: Driven, axis: int) -> float:
    """Evidence for any relation of an axis' motion to its command, of either sign and any lag."""
    r = data.axes[axis]
    shares = [r.fit(s * data.weights[axis], lag)[0] for lag in ALL for s in (1, -1)]
    return float(-0.5 * r.count * np.log1p(-np.max(shares)))


def _answered(data: Driven, axis: int) -> bool:
    return _nats(data, axis) > _EVIDENCE and data.given[axis] < _HARDLY * data.needed[axis]


def _unanswered(data: Driven, axis: int) -> bool:
    """Whether the motion of an axis follows its command not at all, or hardly.

    Of a command that makes up a share ρ² of the force shown, n windows give -n/2 log(1 - ρ²) nats.
    """
    times = data.given[axis] / max(data.needed[axis], 1e-12)
    expected = -0.5 * data.axes[axis].count * np.log1p(-min(times**2, _SURE))
    return times > _HARDLY or bool(expected > 3 * _EVIDENCE and _nats(data, axis) < _EVIDENCE)


def _orders(data: Driven, wrench: bool) -> tuple[float, list[Finding]]:
    """Columns of a wrench in another order, and axes whose command has the other sign.

    Returns the evidence for it, less `_EVIDENCE` for each change, and the findings.
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
        if (i, 1) != (j, sign) and _named(float(kept[i][0]), float(share), data.axes[i].count)
    ]
    worth = best - float(usual[0]) - _EVIDENCE * len(moved)
    if not moved or worth < 0:
        return 0.0, []
    if any(i != j for i, j, _ in moved):
        return worth, [exchanged_columns(moved)]
    return worth, [reversed_axes(data, moved, wrench)]


def _named(usual: float, share: float, count: float) -> bool:
    """Whether a hypothesis on one axis is clearly better than the recorded order."""
    rest = (1 - share) / (1 - usual)
    return share >= _MOST and rest < _MOST and bool(-0.5 * count * np.log(rest) > _EVIDENCE)


def explains(
    data: Driven,
    weights: np.ndarray,
    usual: dict[int, float],
    shares: dict[int, float],
) -> bool:
    """Whether changed weights are clearly better on an axis, and on none of their own worse.

    Thrusters show where they act most. A gain elsewhere, or at the expense of such an axis, is a
    force that the vehicle's numbers lack, such as the pitch that thrust in surge makes.
    """
    largest = np.maximum(np.abs(data.weights).max(axis=1), 1e-12)
    change = np.abs(weights - data.weights).max(axis=1) / largest
    main = [i for i in data.axes if change[i] >= _MAINLY * change.max()]
    named = [_named(usual[i], shares[i], data.axes[i].count) for i in main]
    lost = [0.5 * data.axes[i].count * (np.log1p(-shares[i]) - np.log1p(-usual[i])) for i in main]
    return any(named) and bool(max(lost) < _CONTRARY)


def _thrusters(data: Driven) -> tuple[float, list[Finding]]:
    """Thrusters that push the other way, are exchanged or dead; as `_orders` returns them."""
    flips = [("reversed", k, k) for k in data.driven]
    swaps = [("exchanged", a, b) for a, b in combinations(data.driven, 2)]
    usual, first, _ = data.best(data.weights[..., None], PLAUSIBLE)
    chains = [_chain(data, options) for options in (flips, swaps, flips + swaps) if options]
    if not chains:
        return 0.0, []
    worth, weights, changes = max(chains, key=lambda chain: chain[0])
    _, last, lags = data.best(weights[..., None], PLAUSIBLE)
    before, after = ({i: float(s[0]) for i, s in shares.items()} for shares in (first, last))
    if changes and not explains(data, weights, before, after):
        worth, weights, changes, last = float(usual[0]), data.weights, [], first
    dead = [k for k in data.driven if _is_dead(data, weights, k, last, int(lags[0]))]
    found = [
        reversed_thruster(data, a) if kind == "reversed" else exchanged_thrusters(data, a, b)
        for kind, a, b in sorted(changes)
        if a not in dead
    ]
    found += [dead_thruster(data, k) for k in dead]
    return (worth - float(usual[0]) if changes else 0.5 * bool(dead)), found


_Change = tuple[str, int, int]


def _chain(data: Driven, options: Sequence[_Change]) -> tuple[float, np.ndarray, list[_Change]]:
    """The best change, then the next best, …: evidence less `_EVIDENCE` each, weights, changes."""
    nats, _, _ = data.best(data.weights[..., None], PLAUSIBLE)
    now, weights, changes = float(nats[0]), data.weights, []
    while len(changes) < len(data.columns):
        tried = np.stack([_changed(weights, *option) for option in options], axis=-1)
        nats, _, _ = data.best(tried, CAUSAL, strict=True)
        at = int(nats.argmax())
        if nats[at] - _EVIDENCE < now:
            break
        now, weights = float(nats[at]), tried[..., at]
        changes.append(options[at])
    return now - _EVIDENCE * len(changes), weights, changes


def _changed(weights: np.ndarray, kind: str, a: int, b: int) -> np.ndarray:
    changed = weights.copy()
    if kind == "reversed":
        changed[:, a] *= -1
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
    if abs(_FACTORS[at]) > _DEAD:
        return False
    before = {i: float(s[0]) for i, s in usual.items()}
    after = {i: float(s[at]) for i, s in shares.items()}
    without = weights.copy()
    without[:, k] = 0.0
    return explains(data, without, before, after)


def _lag(data: Driven) -> list[Finding]:
    weights = data.weights[..., None]
    nats, shares, lag = data.best(weights, ALL)
    usual, _, _ = data.best(weights, PLAUSIBLE)
    strong = [i for i in data.axes if shares[i][0] >= _MOST]
    if nats[0] - usual[0] < _EVIDENCE or not strong:
        return []
    seconds = float(LAGS_S[lag[0]])
    how = "after" if seconds > 0 else "before"
    return [
        Finding(
            "command-lag",
            f"commands of {', '.join(AXES[i] for i in strong)}",
            f"the motion comes {abs(seconds):.1f} s {how} its command",
            "align the clocks of commands and motion",
        )
    ]
