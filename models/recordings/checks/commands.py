"""Whether the commands belong to the motion: order and signs of columns, thrusters, lag, silence.

Each hypothesis on the commands (a column of another axis, a reversed thruster, …) is a set of
weights that turns the recorded columns into the six forces. `response.py` says what share of these
forces the motion accounts for. A hypothesis is named if it leaves less than half of what the
recorded order leaves unaccounted for, on evidence that chance does not give.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...vehicles.vehicle import Vehicle
from ..outputs import outputs_of
from ..store import Recording
from .columns import columns_of
from .command_words import (
    mirrored,
    no_answer,
    no_commands,
    shifted,
    shifted_apart,
    silent,
    turned_heading,
)
from .finding import Finding
from .heading import heading_offset, mirrored_plane
from .held_columns import held_column
from .held_outputs import held_throughout
from .hypotheses import ALL, EVIDENCE, LEAST_COUNT, MOST, PLAUSIBLE, Driven, driven_by
from .lengths import length_findings
from .midway import ORDERS, changed_midway
from .orders import orders, thrusters
from .response import LAGS_S, responses

_STRONG = 0.04
"""Share of a thruster's largest thrust: that of a fifth of its command, 80 µs, if thrust is
quadratic in it. A dead band takes 25 to 30 µs of them."""
_NO_FORCE = 1e-3
"""N or N·m below which nothing is driven; pulses in a thruster's dead band give up to 1e-6 N."""
_LINEAR, _ANGULAR = (0, 1, 2), (3, 4, 5)
_APART_S = 0.25
"""s by which the answers of velocities and of rates may differ: thrusters give both the same lag,
which is known to a step of `LAGS_S` in each."""


def command_findings(recording: Recording, vehicle: Vehicle | None) -> list[Finding]:
    """What is wrong between commands and motion; thrusters only if their vehicle is known.

    Where columns or directions change in the record, only a part of it is wrong.
    """
    found, driven = _throughout(recording, vehicle)
    if driven is None or any(f.severity == "severe" and f.word not in ORDERS for f in found):
        return found
    parts = changed_midway(recording, vehicle, driven)
    if parts is None:
        return found
    early, late = (
        [f for f in _throughout(part, vehicle)[0] if f.word in ORDERS] for part in parts.halves
    )
    if bool(early) == bool(late):
        return found
    return [parts.placed(f, late=bool(late)) for f in early or late]


def _throughout(
    recording: Recording, vehicle: Vehicle | None
) -> tuple[list[Finding], Driven | None]:
    """Findings that hold throughout a recording, and its responses; None if they tell nothing."""
    columns = columns_of(recording, vehicle)
    if columns is None:
        return [], None
    forces, weights, names = columns
    mask = recording.mask
    if not np.abs(forces[mask]).max(initial=0.0) > _NO_FORCE:
        return [no_commands(recording)], None
    if found := held_throughout(recording, vehicle, forces):
        return found, None
    axes = {
        i: r
        for i, r in responses(recording, forces, recording.command_period).items()
        if r.count >= LEAST_COUNT
    }
    data = driven_by(axes, weights, names, vehicle)
    judged = () if vehicle is None else _strong(forces[mask], vehicle)
    data = replace(data, outputs=outputs_of(recording.dataset), judged=judged)
    # an axis without a command tells nothing of the order of columns
    driven = replace(data, axes={i: r for i, r in axes.items() if data.given[i] > 0})
    if not driven.axes:
        return [], None
    wrench = recording.thrust_from == "F_Bo_B"
    nats, found = orders(driven, wrench)
    if not wrench:
        held = held_column(recording, vehicle, driven)
        for more, told in (thrusters(driven), held):
            nats, found = (more, told) if more > nats else (nats, found)
    offset = heading_offset(recording, forces, driven)
    if offset is not None and offset[0] > nats:
        nats, found = offset[0], [turned_heading(offset[1])]
    mirror = mirrored_plane(recording, forces, driven)
    if mirror is not None and mirror[0] > nats:
        found = [mirrored(mirror[1])]
    if found:
        return found, driven
    unanswered = [i for i in driven.axes if data.unanswered(i)]
    if unanswered and not any(data.answered(i) for i in driven.axes):
        return [no_answer(data, unanswered)], None
    told = [silent(data, i) for i in unanswered] + _lags(driven)
    return told + length_findings(driven, vehicle), driven


def _strong(forces: np.ndarray, vehicle: Vehicle) -> tuple[int, ...]:
    """Thrusters whose thrust was often large enough to be judged.

    Near the dead band the curve of a thruster is uncertain by factors.
    """
    low, high = (np.asarray(limit) for limit in vehicle.thrusters().force_limits())
    if forces.shape[-1] != len(low):
        return ()
    often = np.percentile(np.abs(forces), 95, axis=0)
    return tuple(np.flatnonzero(often > _STRONG * np.minimum(-low, high)).tolist())


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
