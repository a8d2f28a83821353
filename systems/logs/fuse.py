"""Cuts and resamples a log's signals to one uniform grid: the trajectories of a recording.

Attitude is interpolated along the gyro and velocity along the accelerometer (`between.py`),
position by the Hermite cubic with the estimated velocity as its slope; rates and IMU are means
about each instant (`models/recordings/resample.py`). Without a horizontal estimate height and climb
are those of `vertical.py`. Accelerometer and pressure are measurements: they have a value where
there was a sample, and are NaN elsewhere. Commands of the steps are those of `commanded.py`.
"""

from itertools import pairwise

import numpy as np

from ...models.recordings.build import Trajectory
from ...models.recordings.resample import (
    grid,
    hermite,
    hold,
    linear,
    mean,
    rotations,
)
from .between import attitude_at, velocity_at
from .commanded import over_steps
from .segments import Segment, segments
from .signals import Series, Signals
from .streams import DEAD_RECKONING, UNAIDED
from .vertical import vertical

FAST_HZ = 200.0
"""Rate above which inertial sensors are averaged over `_MEAN_S` about each instant."""
_MEAN_S = 0.01
_LONGEST_S = 300.0
_EQUAL = 0.95
"""Samples in a step of the grid from which on a signal counts as no slower than it."""
_STATES = {
    "disarmed": "disarmed",
    "pass-through": "passthrough",
    "outputs off": "outputs-off",
    DEAD_RECKONING: DEAD_RECKONING,
}


def fuse(
    signals: Signals, *, rate: float, minimum: float, gap: float, disarmed: bool
) -> tuple[list[Trajectory], list[str], list[str]]:
    """Return trajectories at `rate` (Hz), a line on each, and sentences on the omitted parts.

    Stretches shorter than `minimum` (s) are dropped, and so are disarmed ones unless wanted or
    unless there are no others.
    """
    found, dropped = wanted(signals, minimum, gap, disarmed)
    long = [s for s in found if s.duration >= minimum]
    short = [s for s in found if s.duration < minimum]
    if sum(s.duration for s in short) > 0.5:
        dropped.append(
            f"{len(short)} stretch{'es' * (len(short) > 1)} shorter than {minimum:g} s "
            f"({sum(s.duration for s in short):.1f} s together) were left out."
        )
    if any(s.duration > _LONGEST_S for s in long):
        dropped.append(f"Stretches longer than {_LONGEST_S:g} s were cut into equal parts.")
    long = [part for s in long for part in _parts(s)]
    trajectories, lines = [], []
    for number, segment in enumerate(long, 1):
        trajectory = resample(signals, segment, number, 1.0 / rate)
        trajectories.append(trajectory)
        lines.append(
            f"{trajectory.scenario}: {segment.duration:.1f} s "
            f"from {segment.start:.1f} s on the vehicle's clock"
        )
    return trajectories, lines, dropped


def wanted(
    signals: Signals, minimum: float, gap: float, disarmed: bool
) -> tuple[list[Segment], list[str]]:
    """Stretches of a log that are armed, if any of `minimum` (s) is or `disarmed` ones are wanted.

    The second result are sentences on the cuts and on what was left out.
    """
    found, told = segments(signals, gap)
    dropped = [f"Cut at {', '.join(told)}."] if told else []
    if disarmed:
        return found, dropped
    armed = [s for s in found if "disarmed" not in s.labels]
    if any(s.duration >= minimum for s in armed):
        idle = sum(s.duration for s in found) - sum(s.duration for s in armed)
        if idle > 0:
            dropped.append(f"{idle:.1f} s disarmed were left out.")
        return armed, dropped
    if any(s.duration >= minimum for s in found):
        dropped.append(
            "The vehicle was never armed for long: the disarmed time was kept, which tells "
            "nothing about thrusters."
        )
    return found, dropped


def _parts(segment: Segment) -> list[Segment]:
    """Equal parts of at most `_LONGEST_S`, because a recording pads all runs to the longest one."""
    count = int(np.ceil(segment.duration / _LONGEST_S))
    edges = np.linspace(segment.start, segment.stop, count + 1).tolist()
    return [Segment(a, b, segment.labels) for a, b in pairwise(edges)]


def name_of(segment: Segment, number: int) -> str:
    """Scenario name: running number, mode, and special states."""
    words = [_STATES.get(label, label) for label in segment.labels if label != UNAIDED]
    modes = [word for word in words if word not in _STATES.values()]
    special = [word for word in words if word in _STATES.values()]
    return "_".join([f"{number:02d}", *modes, *special])


def resample(signals: Signals, segment: Segment, number: int, dt: float) -> Trajectory:
    """Resample one segment to the grid of step `dt` (s)."""
    t = grid(_first(signals.rates, segment, dt), segment.stop - dt, dt)
    return at_instants(signals, segment, t, name_of(segment, number), dt)


def at_instants(
    signals: Signals, segment: Segment, t: np.ndarray, name: str, dt: float
) -> Trajectory:
    """What a log holds of a segment at the instants t (s) in it, `dt` apart."""
    q = attitude_at(signals, t)
    omega = _instants(signals.rates, t)
    aided = UNAIDED not in segment.labels
    p, v = np.full((2, 3, t.size), np.nan)
    sensors: dict[str, np.ndarray] = {}
    if signals.position is not None and signals.velocity is not None:
        slope = _at(signals.velocity, signals.position.t)
        p = hermite(t, signals.position.t, signals.position.x, slope)
        v_W = velocity_at(signals, t)
        sensors["vertical_velocity"] = v_W[2]
        if aided:
            v = rotations(q).inv().apply(v_W.T).T
        else:
            p[:2] = np.nan
            _vertical(signals, t, p, sensors)
            v[2] = sensors["vertical_velocity"] * rotations(q).as_matrix()[:, 2, 2]
    if signals.specific_force is not None:
        sensors["imu_specific_force"] = _readings(signals.specific_force, t, dt).T
    if signals.rates.source.startswith(("RAW_IMU", "SCALED_IMU", "IMU", "GYR")):
        sensors["imu_angular_rate"] = omega.T
    if signals.pressure_depth is not None:
        sensors["pressure_depth"] = _readings(signals.pressure_depth, t, dt)
    if signals.voltage is not None:
        sensors["voltage"] = linear(t, signals.voltage.t, signals.voltage.x)
    if signals.rc is not None:
        sensors["rc"] = hold(t, signals.rc.t, signals.rc.x, dt).T
    command, beside = over_steps(signals, t, dt)
    return Trajectory(
        name,
        np.concatenate([q, p]).T,
        np.concatenate([v, omega]).T,
        {signals.command: command},
        sensors | beside,
        float(t[0]),
    )


def _vertical(
    signals: Signals, t: np.ndarray, p: np.ndarray, sensors: dict[str, np.ndarray]
) -> None:
    """Height and climb by pressure and accelerometer, where they tell: they err less."""
    found = vertical(signals, t)
    if found is not None:
        p[2] = found.z + np.median(p[2] - found.z)
        sensors["vertical_velocity"] = found.w


def _first(rates: Series, segment: Segment, dt: float) -> float:
    """The first instant of a segment: that of a sample of the rates if they are as fast.

    At equal rates nothing is then interpolated: between two samples a motion faster than them is
    smoothed, and looks slower than it was.
    """
    following = rates.t[np.searchsorted(rates.t, segment.start) :]
    if slower(rates, dt) or not following.size:
        return segment.start
    first = float(following[0])
    return first if first < segment.start + dt else segment.start


def _at(series: Series, t: np.ndarray) -> np.ndarray:
    same = series.t.size == t.size and np.array_equal(series.t, t)
    return series.x if same else linear(t, series.t, series.x)


def _instants(series: Series, t: np.ndarray) -> np.ndarray:
    """Values at the instants t; the mean over 10 ms for sensors much faster than 100 Hz.

    A mean over half a step of 50 ms would attenuate accelerations at 5 Hz by 2 %.
    """
    if series.rate > FAST_HZ:
        return mean(t, series.t, series.x, _MEAN_S)
    return linear(t, series.t, series.x)


def _readings(series: Series, t: np.ndarray, dt: float) -> np.ndarray:
    """Readings of a sensor at the instants t; NaN where it gave none.

    A sample counts at the instant nearest to it. A sensor that is no slower than the grid also
    counts between samples of which at most one is lost.
    """
    known = np.zeros(t.size, bool)
    nearest = np.rint((series.t - t[0]) / dt)
    known[nearest[(nearest >= 0) & (nearest < t.size)].astype(int)] = True
    if not slower(series, dt):
        after = np.searchsorted(series.t, t, side="right")
        inside = (after > 0) & (after < series.t.size)
        pause = np.diff(series.t)[np.clip(after - 1, 0, series.t.size - 2)]
        known |= inside & (pause <= 2 * max(dt, 1 / series.rate))
    return np.where(known, _instants(series, t), np.nan)


def slower(series: Series, dt: float) -> bool:
    """Whether a stream has fewer samples than a grid of step `dt` (s)."""
    return series.rate * dt < _EQUAL
