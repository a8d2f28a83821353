"""Commands that all stand still in the record while the motion shows that they did not.

A body under a constant force shows a constant sum of inertia and drag. Where this sum varies as
with varying commands, the commands were not recorded.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import nnls
from scipy.stats import chi2

from ...se3 import AXES
from ...vehicles.vehicle import Vehicle
from ..store import Recording
from .finding import Finding
from .hypotheses import LEAST_COUNT, MOST
from .response import HALF_WIDTH_S, LAGS_S, AxisResponse, Piece, filtered, responses

HELD_S = 2.0
"""s for which a value must stand still: longer than any answer of a thruster."""
_USUAL_HOLDS = 10.0
"""And longer than so many of the record's usual holds: commands may be rare."""
_ROUNDING = 1e-6
"""Of a value: what resampling makes of a constant."""
VARIES = 0.25
"""Part of the usual spread of a force, or of its variance, that counts as varying."""
_FEWEST, _TOGETHER, _CHANCE = 10, 4, 6e-6
"""Windows of a stretch; overlapping windows for one independent one; probability by chance of the
variance that the motion shows, that of `EVIDENCE`."""
_ANSWER_S = 0.45
"""s in which a thruster has answered."""
_FREE = (0, 1, 5)
"""Surge, sway and yaw: roll and pitch swing by themselves, and buoyancy changes at the surface."""
_SWINGS, _AMPLITUDE, _LARGE = 4, 0.1, 0.1
"""Turning points, and m/s or rad/s between them, that no constant force gives; and the share of the
thrusters' largest force above which water does not make them."""


@dataclass(frozen=True)
class Held:
    """A stretch of a run in which all commands stand still and the motion does not."""

    run: int
    samples: Bool[np.ndarray, " N"]
    finding: Finding


def stands(values: Float[np.ndarray, "N m"], dt: float) -> Bool[np.ndarray, " N"]:
    """Samples in stretches in which no column changes, much longer than the usual ones."""
    values = np.nan_to_num(values)
    same = (np.abs(np.diff(values, axis=0)) <= _ROUNDING * np.abs(values[:-1])).all(axis=1)
    edges = np.concatenate([[0], np.flatnonzero(~same) + 1, [len(values)]])
    lengths = np.diff(edges)
    usual = float(np.median(lengths)) if lengths.size > 2 else 0.0
    least = max(HELD_S / dt, _USUAL_HOLDS * usual if usual * dt < HELD_S else 0.0)
    held = np.zeros(len(values), bool)
    for start, stop in pairwise(edges.tolist()):
        held[start:stop] = stop - start > least
    return held


def seconds(recording: Recording, j: int, r: int, samples: np.ndarray) -> str:
    """From the first to the last of some samples of a run, in words."""
    start = float(recording.dataset["start_time"].to_numpy()[j, r])
    start = start if np.isfinite(start) else 0.0
    at = np.flatnonzero(samples)
    return f"{start + at[0] * recording.dt:.1f} to {start + at[-1] * recording.dt:.1f} s"


def all_held(
    recording: Recording, forces: Float[np.ndarray, "J K N m"], weights: Float[np.ndarray, "6 m"]
) -> list[Held]:
    """Stretches in which every command stands still while the force of the motion varies."""
    if recording.uneven:
        return []
    at = np.argwhere(recording.lengths > 0).tolist()
    stretches = [_stretches(recording, j, r) for j, r in at]
    if not any(stretches):
        return []
    runs = [_run(recording, forces, j, r, own) for (j, r), own in zip(at, stretches, strict=True)]
    laws = {i: law for i in _FREE if (law := _law(runs, weights[i], i)) is not None}
    found = []
    for number, run in enumerate(runs):
        for start, stop in run.stretches:
            axes = [AXES[i] for i, law in laws.items() if _varies(run, start, stop, law, i)]
            if axes:
                samples = np.zeros(run.size, bool)
                samples[start:stop] = True
                place = f"{run.name}, {seconds(recording, *run.at, samples)}"
                found.append(Held(number, samples, _all_finding(place, axes)))
    return found


def held_throughout(
    recording: Recording,
    vehicle: Vehicle | None,
    forces: Float[np.ndarray, "J K N m"],
) -> list[Finding]:
    """A finding where no command ever changes, and the vehicle speeds up and slows down again.

    The force that this takes must be large against what its thrusters have.
    """
    raw = recording.dataset[recording.thrust_from].to_numpy()[recording.mask]
    driven = np.any(forces[recording.mask])
    if vehicle is None or not driven or not stands(raw, recording.dt).all():
        return []
    shown = responses(recording, forces, recording.command_period)
    limits = np.min(np.abs(vehicle.thrusters().force_limits()), axis=0)
    whole = np.abs(np.asarray(vehicle.thrusters().allocation)) @ limits
    swings = [
        AXES[i]
        for i in _FREE
        if i in shown
        and _needed(shown[i], vehicle, i) > _LARGE * whole[i]
        and any(_turning_points(run.V_WB_B[:, i]) >= _SWINGS for run in recording.trajectories())
    ]
    if not swings:
        return []
    return [
        Finding(
            "output-held",
            ", ".join(recording.commands),
            f"no command ever changes, while the motion in {', '.join(swings)} goes up and down "
            "again and again: the outputs were not recorded",
            "record the outputs that drive the thrusters",
        )
    ]


def _needed(shown: AxisResponse, vehicle: Vehicle, axis: int) -> float:
    """Root mean square of the varying force that a motion takes, by the vehicle's numbers."""
    rigid = (vehicle.mass,) * 3 + vehicle.inertia
    drag = vehicle.linear_damping[axis], vehicle.quadratic_damping[axis]
    c = np.array([rigid[axis] + vehicle.added_mass[axis], *drag])
    return float(np.sqrt(max(c @ shown.RR @ c, 0.0) / shown.windows))


def _all_finding(place: str, axes: Sequence[str]) -> Finding:
    return Finding(
        "commands-held",
        place,
        f"every command stands still at one value, while the motion in {', '.join(axes)} shows "
        "forces that vary; the stretch is left out",
        "check what records the outputs",
    )


@dataclass(frozen=True)
class _Run:
    """A run's filtered windows, the middle sample of each, and where all commands stand still."""

    at: tuple[int, int]
    name: str
    size: int
    piece: Piece | None
    stretches: list[tuple[int, int]]
    dt: float

    def free(self) -> Bool[np.ndarray, " n"]:
        """Windows that no stretch reaches."""
        assert self.piece is not None
        kept = np.ones(len(self.piece.middle), bool)
        reach = self.piece.half + round(_ANSWER_S / self.dt)
        for start, stop in self.stretches:
            kept &= (self.piece.middle < start - reach) | (self.piece.middle > stop + reach)
        return kept


@dataclass(frozen=True)
class _Law:
    """Coefficients of v̇, v, |v| v, and the variances of the command and of what they leave."""

    coefficients: Float[np.ndarray, "3"]
    given: float
    left: float


def _stretches(recording: Recording, j: int, r: int) -> list[tuple[int, int]]:
    """First and last sample (exclusive) where no command of a run changes."""
    raw = recording.dataset[recording.thrust_from].to_numpy()[j, r, : recording.lengths[j, r]]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], stands(raw, recording.dt), [False]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _run(
    recording: Recording, forces: np.ndarray, j: int, r: int, stretches: list[tuple[int, int]]
) -> _Run:
    half = max(HALF_WIDTH_S, 1.5 * recording.command_period)
    piece = filtered(recording, j, r, forces, half)
    name, size = str(recording.scenarios[j]), int(recording.lengths[j, r])
    return _Run((j, r), name, size, piece, stretches, recording.dt)


def _law(runs: Sequence[_Run], weights: np.ndarray, axis: int) -> _Law | None:
    """The law of an axis where commands vary; None if they explain less than half of the force."""
    zero = int(np.argmin(np.abs(LAGS_S)))
    parts = [
        (_terms(run.piece, axis)[run.free()], (run.piece.commands[zero] @ weights)[run.free()])
        for run in runs
        if run.piece is not None and np.isfinite(run.piece.rate[:, axis]).all()
    ]
    R = np.concatenate([p for p, _ in parts]) if parts else np.zeros((0, 3))
    c = np.concatenate([q for _, q in parts]) if parts else np.zeros(0)
    if len(c) < LEAST_COUNT * _TOGETHER or not np.var(c) > 0:
        return None
    size = np.maximum(R.std(axis=0), 1e-12)
    theta = nnls(R / size, c)[0] / size
    given, left = float(np.var(c)), float(np.var(c - R @ theta))
    return _Law(theta, given, left) if left < (1 - MOST) * given else None


def _terms(piece: Piece, axis: int) -> np.ndarray:
    return np.stack([piece.rate[:, axis], piece.terms[:, axis], piece.terms[:, 6 + axis]], axis=1)


def _varies(run: _Run, start: int, stop: int, law: _Law, axis: int) -> bool:
    """Whether the force of the motion varies in a stretch by more than elsewhere is unexplained."""
    if run.piece is None or not np.isfinite(run.piece.rate[:, axis]).all():
        return False
    first = start + run.piece.half + round(_ANSWER_S / run.dt)
    inside = (run.piece.middle >= first) & (run.piece.middle < stop - run.piece.half)
    if np.count_nonzero(inside) < _FEWEST:
        return False
    shown = float(np.var(_terms(run.piece, axis)[inside] @ law.coefficients))
    count = np.count_nonzero(inside) / _TOGETHER
    chance = float(chi2.isf(_CHANCE, count)) / count
    return bool(shown > max(VARIES * law.given, chance * law.left))


def _turning_points(v: Float[np.ndarray, " N"]) -> int:
    """Extremes of a velocity that are at least `_AMPLITUDE` from the one before."""
    count, side, low, high = 0, 0, np.inf, -np.inf
    for x in v[np.isfinite(v)].tolist():
        low, high = min(low, x), max(high, x)
        if side <= 0 and x > low + _AMPLITUDE:
            count, side, high = count + 1, 1, x
        elif side >= 0 and x < high - _AMPLITUDE:
            count, side, low = count + 1, -1, x
    return count
