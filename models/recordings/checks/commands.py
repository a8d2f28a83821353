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
from .finding import Finding
from .hypotheses import ALL, CAUSAL, PLAUSIBLE, Driven
from .response import LAGS_S, AxisResponse, responses

_EVIDENCE = 12.0
"""Nats by which a named hypothesis is more likely than the recorded order: 6e-6 by chance, some
hundred hypotheses together 1e-3."""
_MOST = 0.5
"""Share that a named hypothesis accounts for, and most of the rest that it leaves."""
_HARDLY, _SURE = 10.0, 0.9
"""Commanded force over the force that the motion shows, above which no vehicle's numbers explain
it; the largest share of a force that a command is expected to make up."""
_DEAD = 0.15
_NO_FORCE = 1e-3
"""N or N·m below which nothing is driven; pulses in a thruster's dead band give up to 1e-6 N."""
_FACTORS = np.round(np.arange(-1.5, 1.51, 0.05), 2)
_LEAST_COUNT = 20.0
"""Independent windows below which nothing is said of an axis."""
_ORDERS = {
    "in ArduSub's order of RC channels (pitch, roll, heave, yaw, surge, sway)": (4, 3, 2, 5, 0, 1),
    "torque first (K,M,N,X,Y,Z), as Drake's spatial forces": (3, 4, 5, 0, 1, 2),
}
_RIGHT_DOWN = np.array([1, -1, -1, 1, -1, -1])


def command_findings(recording: Recording, vehicle: Vehicle | None) -> list[Finding]:
    """What is wrong between commands and motion; thrusters only if their vehicle is known."""
    columns = _columns(recording, vehicle)
    if columns is None:
        return []
    forces, weights, names = columns
    mask = recording.mask
    if not np.abs(forces[mask]).max(initial=0.0) > _NO_FORCE:
        return [_no_commands(recording)]
    axes = {
        i: r
        for i, r in responses(recording, forces, recording.command_period).items()
        if r.count >= _LEAST_COUNT
    }
    data = _data(axes, weights, names, vehicle)
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
        return [_no_answer(data, silent)]
    return [_silent(data, i) for i in silent] + _lag(driven)


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
        return worth, [_exchanged(moved)]
    return worth, [_reversed_axes(data, moved, wrench)]


def _named(usual: float, share: float, count: float) -> bool:
    """Whether a hypothesis on one axis is clearly better than the recorded order."""
    rest = (1 - share) / (1 - usual)
    return share >= _MOST and rest < _MOST and bool(-0.5 * count * np.log(rest) > _EVIDENCE)


def _thrusters(data: Driven) -> tuple[float, list[Finding]]:
    """Thrusters that push the other way, are exchanged or dead; as `_orders` returns them."""
    m = len(data.columns)
    flips = [("reversed", k, k) for k in range(m)]
    swaps = [("exchanged", a, b) for a, b in combinations(range(m), 2)]
    usual, first, _ = data.best(data.weights[..., None], PLAUSIBLE)
    chains = [_chain(data, options) for options in (flips, swaps, flips + swaps)]
    worth, weights, changes = max(chains, key=lambda chain: chain[0])
    _, last, lags = data.best(weights[..., None], PLAUSIBLE)
    if not any(
        _named(float(first[i][0]), float(last[i][0]), r.count) for i, r in data.axes.items()
    ):
        worth, weights, changes, last = float(usual[0]), data.weights, [], first
    dead = [k for k in range(m) if _is_dead(data, weights, k, last, int(lags[0]))]
    found = [
        _reversed_thruster(data, a) if kind == "reversed" else _swapped(data, a, b)
        for kind, a, b in sorted(changes)
        if a not in dead
    ]
    found += [_dead(data, k) for k in dead]
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
        now, weights = float(nats[at]) - _EVIDENCE, tried[..., at]
        changes.append(options[at])
    return now, weights, changes


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
    return bool(abs(_FACTORS[at]) <= _DEAD) and any(
        _named(float(usual[i][0]), float(shares[i][at]), r.count) for i, r in data.axes.items()
    )


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


# sentences


def _no_commands(recording: Recording) -> Finding:
    rates = recording.dataset["V_WB_B"].to_numpy()[recording.mask][:, 3:]
    turned = bool(np.nanmax(np.abs(rates), initial=0.0) > 0.2)
    told = "the vehicle was turned by hand or drifted" if turned else "nothing was driven"
    return Finding(
        "no-commands",
        ", ".join(recording.commands),
        f"no command ever differs from zero: {told}, and nothing tells how it answers thrusters",
        "record a dive with the thrusters driven",
    )


def _no_answer(data: Driven, silent: Sequence[int]) -> Finding:
    axes = ", ".join(AXES[i] for i in silent)
    times = min(data.given[i] / max(data.needed[i], 1e-12) for i in silent)
    return Finding(
        "no-answer",
        axes,
        f"the motion follows no command, though those of {axes} are {times:.1g} times the force "
        "that the motion shows: a bench test, thrusters without power, or commands of another run",
        "give a dive, with the commands that made it",
    )


def _silent(data: Driven, axis: int) -> Finding:
    times = data.given[axis] / max(data.needed[axis], 1e-12)
    return Finding(
        "axis-silent",
        AXES[axis],
        f"{AXES[axis]} never or hardly answers its command, which is {times:.1g} times the force "
        "that the motion shows",
        f"check the thrusters that act in {AXES[axis]}",
    )


def _exchanged(moved: Sequence[tuple[int, int, int]]) -> Finding:
    names = [n for n, order in _ORDERS.items() if all(order[j] == i for i, j, _ in moved)]
    parts = [f"`{WRENCH[j]}` drives {AXES[i]}{' backwards' * (s < 0)}" for i, j, s in moved]
    look = f": columns X…N stand {names[0]}" if names else ""
    return Finding(
        "columns-exchanged",
        "columns X,Y,Z,K,M,N",
        f"the motion says that {', '.join(parts)}{look}",
        "give X,Y,Z,K,M,N in this order, forces first",
    )


def _reversed_axes(data: Driven, moved: Sequence[tuple[int, int, int]], wrench: bool) -> Finding:
    axes = [i for i, _, _ in moved]
    right_down = [i for i in data.axes if _RIGHT_DOWN[i] < 0]
    frd = wrench and set(axes) == set(right_down)
    told = ": they look like forward-right-down" if frd else ""
    names = ", ".join(WRENCH[i] if wrench else AXES[i] for i in axes)
    return Finding(
        "axis-reversed",
        f"column{'s' * (len(axes) > 1)} {names}" if wrench else names,
        f"the motion goes against the command of {', '.join(AXES[i] for i in axes)}{told}",
        "give forward, left and up as positive, or `frames: NED/FRD` for all of the files"
        if wrench
        else "check the directions of the thrusters (MOT_n_DIRECTION) and the vehicle's file",
    )


def _reversed_thruster(data: Driven, k: int) -> Finding:
    return Finding(
        "thruster-reversed",
        f"column {data.columns[k]}",
        f"thruster {k + 1} pushes the other way: MOT_{k + 1}_DIRECTION, or SERVOn_REVERSED of the "
        "output n that drives it",
        f"correct the parameter, or the sign of {data.columns[k]}",
    )


def _swapped(data: Driven, a: int, b: int) -> Finding:
    return Finding(
        "thruster-exchanged",
        f"columns {data.columns[a]}, {data.columns[b]}",
        f"thrusters {a + 1} and {b + 1} look exchanged",
        "give the columns in the order of the vehicle's file",
    )


def _dead(data: Driven, k: int) -> Finding:
    return Finding(
        "thruster-dead",
        f"column {data.columns[k]}",
        f"thruster {k + 1} has no effect on the motion",
        "check its power and propeller",
    )
