"""Brings a log to the samples and the world frame of another recording of the same dive.

What flew is logged by the station; the autopilot's own log of the dive is fetched later. Both have
the times of the vehicle's boot clock, and the body rates tell whether they are of one dive, and how
far their clocks are apart where they are not of one clock.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.signal import correlate
from scipy.spatial.transform import Rotation

from ...models.config.errors import UserError
from ...models.recordings.build import Trajectory
from ...models.recordings.resample import continuous, linear
from ...models.recordings.store import Recording
from .fuse import at_instants, wanted
from .segments import Segment
from .signals import Series, Signals

_NEAR = 0.5
"""s: times on one clock differ by less: delays of filters, and of the link."""
_ALIKE = 0.7
"""Correlation of body rates from which on two records are of one motion, wherever it is."""
_FITTING = 0.3
"""The same where they fit best at the time that the clocks tell: small rates are noisy."""
_STILL = 0.02
"""rad/s: root mean square below which body rates are noise of the gyroscopes."""
_LEAST = 5.0
"""s that both must have in common."""


@dataclass(frozen=True)
class Offset:
    """How a log's clock lies to that of a recording.

    Attributes:
        seconds: to add to times of the recording to get those of the log.
        lag: by which the log's rates then follow those of the recording (s); NaN if unknown.
        correlation: of their body rates, NaN if the vehicle hardly turned.
    """

    seconds: float
    lag: float
    correlation: float

    def sentence(self) -> str:
        """How the log was aligned."""
        if np.isnan(self.correlation):
            return (
                "Aligned by the vehicle's clock alone: it hardly turned, so nothing checks that "
                "both are of one dive."
            )
        moved = "" if not self.seconds else f", its clock being {self.seconds:+.3f} s off"
        return (
            f"Aligned with the other recording{moved}: their body rates correlate by "
            f"{self.correlation:.3f}, those of the log are {1e3 * self.lag:.0f} ms late."
        )


def reference(path: Path) -> Recording:
    """The recording to align with: a file, or that of a run's folder.

    Raises:
        UserError: there is none.
    """
    file = path / "log.nc" if path.is_dir() else path
    if path.is_dir() and not file.exists():
        raise UserError(f"{path}: has no log.nc; give the folder of a run, or a recording (.nc)")
    return Recording.load(file)


def offset(rates: Series, other: Recording) -> Offset:
    """Find the recording's motion in a log's body rates.

    Where the start times of the recording fit, they are taken as they are; else the log is searched
    for the place where the rates fit.

    Raises:
        UserError: the rates fit nowhere.
    """
    dt, runs = other.dt, _runs(other)
    starts = [run.start for run in runs]
    ends = [run.start + dt * len(run) for run in runs]
    order = np.argsort(starts)
    if not all(starts[b] >= ends[a] - dt / 2 for a, b in pairwise(order)):
        raise UserError(
            "the recording to align with does not say when its runs were; give the folder of the "
            "dive"
        )
    zero = min(starts)
    sought = np.zeros((3, 1 + max(round((end - zero) / dt) for end in ends)))
    for run in runs:
        first = round((run.start - zero) / dt)
        sought[:, first : first + len(run)] = np.nan_to_num(run.V_WB_B[:, 3:].T)
    turning = np.sum(sought**2, axis=0)
    if np.sqrt(np.sum(turning) / max(np.count_nonzero(turning), 1)) < _STILL:
        return Offset(0.0, np.nan, np.nan)
    begins, likeness = _likeness(rates, sought, dt)
    lags = begins - zero
    best = int(np.argmax(likeness))
    near = np.flatnonzero(np.abs(lags) <= _NEAR)
    here = int(near[np.argmax(likeness[near])]) if near.size else -1
    same_clock = best == here or (near.size > 0 and likeness[here] >= _ALIKE)
    best = here if same_clock else best
    if likeness[best] < (_FITTING if same_clock else _ALIKE):
        raise UserError(
            f"its motion is not that of the recording to align with: their body rates correlate by "
            f"{likeness[best]:.2f} at best; give the log of the same dive"
        )
    lag = _vertex(lags, likeness, best)
    correlation = float(likeness[best])
    return Offset(0.0, lag, correlation) if same_clock else Offset(lag, 0.0, correlation)


def _runs(other: Recording) -> list[Trajectory]:
    """The recording's runs; a single one of unknown begin begins at 0."""
    runs = list(other.trajectories())
    if len(runs) == 1 and not np.isfinite(runs[0].start):
        return [replace(runs[0], start=0.0)]
    return runs


def _likeness(
    rates: Series, sought: Float[np.ndarray, "3 n"], dt: float
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Times of the log at which the wanted rates may begin, and the correlation there."""
    margin = sought.shape[1]  # the log may begin or end in mid-dive
    first = float(rates.t[0]) - margin * dt
    t = first + dt * np.arange(round((rates.t[-1] - first) / dt) + margin)
    inside = (t >= rates.t[0]) & (t <= rates.t[-1])
    there = np.where(inside, np.nan_to_num(linear(t, rates.t, rates.x)), 0.0)
    known, logged = np.any(sought != 0, axis=0).astype(float), inside.astype(float)
    likeness = [correlate(*pair, "valid") for pair in zip(there, sought, strict=True)]
    product = np.sum(likeness, axis=0)
    power = correlate(np.sum(there**2, axis=0), known, "valid")
    seen = correlate(logged, np.sum(sought**2, axis=0), "valid")
    common = correlate(logged, known, "valid")
    size = np.sqrt(np.maximum(power, 1e-12) * np.maximum(seen, 1e-12))
    enough = common * dt >= min(_LEAST, 0.5 * dt * margin)
    turned = power > _STILL**2 * common
    return t[: product.size], np.where(enough & turned, product / size, 0.0)


def _vertex(x: np.ndarray, y: np.ndarray, best: int) -> float:
    """Place of the maximum of the parabola through the best point and its neighbours."""
    if not 0 < best < len(y) - 1:
        return float(x[best])
    before, here, after = y[best - 1 : best + 2]
    bend = before - 2 * here + after
    part = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float(x[best] + part * (x[1] - x[0]))


@dataclass(frozen=True)
class _Part:
    """Samples of a segment of a log at which a run has its samples from `first` on."""

    segment: Segment
    t: Float[np.ndarray, " n"]
    name: str
    run: Trajectory
    first: int


def aligned(
    signals: Signals, other: Recording, minimum: float, gap: float, disarmed: bool
) -> tuple[list[Trajectory], list[str], list[str], str]:
    """Resample a log at the instants of a recording of the same dive, in its world frame.

    Returns trajectories with the names and times of the recording, a line on each, sentences on
    what was left out, and one on how the clocks lie.

    Raises:
        UserError: the log has another motion, or nothing of it lies in the recording's time.
    """
    lies = offset(signals.rates, other)
    found, dropped = wanted(signals, minimum, gap, disarmed)
    kept, lines = [], []
    for part in _parts(found, other, lies.seconds, minimum):
        trajectory = at_instants(signals, part.segment, part.t, part.name, other.dt)
        kept.append(_in_world(trajectory, part, other.dt))
        lines.append(
            f"{part.name}: {len(part.t) * other.dt:.1f} s "
            f"from {part.t[0]:.1f} s on the vehicle's clock"
        )
    if not kept:
        raise UserError(
            "nothing of it lies in the time of the recording to align with; give the log of the "
            "same dive, or a shorter minimum"
        )
    return kept, lines, dropped, lies.sentence()


def _parts(
    found: Sequence[Segment], other: Recording, seconds: float, minimum: float
) -> list[_Part]:
    """Samples of the recording that lie in the segments, in parts of at least `minimum` (s)."""
    dt, kept = other.dt, []
    for run in _runs(other):
        begin, parts = run.start + seconds, []
        for segment in found:
            low = max(int(np.ceil((segment.start - begin) / dt - 1e-6)), 0)
            last = int(np.floor((segment.stop - dt - begin) / dt + 1e-6))
            high = min(last, len(run) - 1)
            if (high - low) * dt >= min(minimum, dt * (len(run) - 1)):
                parts.append((segment, low, high))
        for number, (segment, low, high) in enumerate(parts, 1):
            name = run.scenario if len(parts) == 1 else f"{run.scenario}_{number}"
            t = begin + dt * np.arange(low, high + 1)
            kept.append(_Part(segment, t, name, run, low))
    return kept


def _in_world(trajectory: Trajectory, part: _Part, dt: float) -> Trajectory:
    """A trajectory in the world frame of the recording, with its times.

    It is turned about z by the mean difference of headings and moved in x and y so that it begins,
    for a second, where the recording does; heights are measured and stay.
    """
    other = part.run.X_WB[part.first : part.first + len(trajectory)]
    X = trajectory.X_WB.copy()
    own, theirs = (Rotation.from_quat(q[:, :4], scalar_first=True) for q in (X, other))
    between = (theirs * own.inv()).as_matrix()
    yaw = np.arctan2(
        np.mean(between[:, 1, 0] - between[:, 0, 1]), np.mean(between[:, 0, 0] + between[:, 1, 1])
    )
    turn = Rotation.from_euler("z", yaw)
    X[:, :4] = continuous((turn * own).as_quat(scalar_first=True).T).T
    moved = X[:, 4:6] @ turn.as_matrix()[:2, :2].T
    early = slice(max(1, round(1.0 / dt)))
    shift = np.nanmean(other[early, 4:6] - moved[early], axis=0) if _both(other, moved) else 0.0
    X[:, 4:6] = moved + shift
    start = part.run.start + dt * part.first
    return replace(trajectory, scenario=part.name, X_WB=X, start=start)


def _both(one: np.ndarray, two: np.ndarray) -> bool:
    """Whether both have horizontal places to compare at the begin."""
    return bool(np.isfinite(one[0, 4:6]).all() and np.isfinite(two[0]).all())
