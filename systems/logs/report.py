"""The report of an import: what a log contains and lacks, in sentences."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...models.recordings.build import Trajectory
from ...models.recordings.kinematics import agreement
from ...models.se3 import TWIST
from .fuse import slower
from .signals import Series, Signals
from .vertical import read_throughout

_SLOW_OUTPUTS_HZ, _SLOW_STATE_HZ = 25.0, 10.0
_STILL = 0.03
_CONSISTENT = 0.9
_SILENT = 0.02
"""Share of the time of which a pause of a sensor is said."""


@dataclass(frozen=True)
class ImportReport:
    """Sentences for the user; also kept in the recording's notes.

    Attributes:
        source: the file.
        segments: the stretches that were kept, one line each.
        has: what the log contains.
        lacks: what it lacks, and what can't be learned from it for that reason.
        done: how the data were processed.
        dropped: what was left out, and why.
    """

    source: str
    segments: tuple[str, ...]
    has: tuple[str, ...]
    lacks: tuple[str, ...]
    done: tuple[str, ...]
    dropped: tuple[str, ...]

    def text(self) -> str:
        """Return the report as lines."""
        parts = (
            ("Kept", self.segments),
            ("There", self.has),
            ("Lacking", self.lacks),
            ("Done", self.done),
            ("Left out", self.dropped),
        )
        lines = [self.source]
        for title, sentences in parts:
            if sentences:
                lines.append(f"{title}:")
                lines.extend(f"  {sentence}" for sentence in sentences)
        return "\n".join(lines)

    __str__ = text

    def notes(self) -> tuple[str, ...]:
        """Return the sentences that are stored with the data."""
        return (*self.has, *self.lacks, *self.done, *self.dropped)


def tell(
    signals: Signals,
    source: str,
    kept: Sequence[Trajectory],
    lines: Sequence[str],
    dropped: Sequence[str],
    dt: float,
) -> ImportReport:
    """Write the report of one import."""
    good, bad = _consistency(kept, dt)
    has = [
        f"Attitude from {_at(signals.attitude)}, body rates from {_at(signals.rates)}.",
        f"Thruster outputs from {_at(signals.outputs)}.",
        *_motion(signals),
        *signals.has,
        *_battery(signals),
        *good,
    ]
    return ImportReport(
        source,
        tuple(lines),
        tuple(has),
        (*bad, *_lacking(signals), *_unread(signals, kept, dt), *_unexcited(kept), *signals.lacks),
        (*_smoothed(signals, kept, dt), *signals.notes, *_left_out(signals)),
        tuple(dropped),
    )


def _smoothed(signals: Signals, kept: Sequence[Trajectory], dt: float) -> list[str]:
    """A sentence on stretches whose height and climb are from pressure and accelerometer."""
    unaided = [k for k in kept if "vertical_velocity" in k.sensors and np.isnan(k.X_WB[:, 4]).all()]
    times = [k.start + dt * np.arange(len(k)) for k in unaided]
    seconds = sum(dt * t.size for t in times if read_throughout(signals, t) is not None)
    if not seconds:
        return []
    return [
        f"In {seconds:.0f} s without a horizontal estimate height and climb are smoothed from "
        "pressure and accelerometer, which errs less than the autopilot's climb."
    ]


def _left_out(signals: Signals) -> list[str]:
    """A sentence on each signal with samples that were left out."""
    found = [value for value in vars(signals).values() if isinstance(value, Series)]
    return [
        f"{one.source}: {one.left_out} sample{'s' * (one.left_out > 1)} left out that "
        "were no numbers, or beyond what a vehicle does."
        for one in found
        if one.left_out
    ]


def _at(series: Series) -> str:
    rate = series.rate
    return f"{series.source} at {rate:.0f} Hz" if rate >= 3 else f"{series.source} at {rate:.1f} Hz"


def _motion(signals: Signals) -> list[str]:
    told = []
    p = signals.position
    if p is not None:
        whose = "" if p.source.startswith("/") else " (the autopilot's estimate)"  # a ROS topic
        told.append(f"{_what(signals, p)} from {_at(p)}{whose}.")
        if _climbs_apart(signals):
            assert signals.velocity is not None
            told.append(f"Climb from {_at(signals.velocity)}.")
    depth = signals.pressure_depth
    if depth is not None:
        told.append(f"Depth by pressure from {_at(depth)}.")
    if p is not None and depth is not None:
        there = (depth.t >= p.t[0]) & (depth.t <= p.t[-1])
        below = depth.x[there]
        estimated = -np.interp(depth.t[there], p.t, p.x[2])
        if below.size > 10 and np.std(below) > 0.2:
            slope, offset = np.polyfit(below, estimated, 1)
            told.append(
                f"Estimated depth is {slope:.3f} × depth by pressure {offset:+.2f} m. The "
                "autopilot takes 9800 Pa/m unless BARO_SPEC_GRAV says otherwise: in sea water "
                "depths are then 2.5 % too large (--water-density corrects them)."
            )
    return told


def _what(signals: Signals, p: Series) -> str:
    if np.isfinite(p.x[0]).any():
        return "Position and velocity"
    if _moves_ahead(signals):
        return "Velocity"
    return "Height" if _climbs_apart(signals) else "Height and climb"


def _climbs_apart(signals: Signals) -> bool:
    """Whether the climb is from another message than the height."""
    p, v = signals.position, signals.velocity
    if p is None or v is None or _moves_ahead(signals):
        return False
    return not v.source.startswith(p.source)  # "…, differentiated" is the height's own


def _moves_ahead(signals: Signals) -> bool:
    """Whether there is a horizontal velocity."""
    return signals.velocity is not None and bool(np.isfinite(signals.velocity.x[0]).any())


def _battery(signals: Signals) -> list[str]:
    if signals.voltage is None:
        return []
    v = signals.voltage.x
    return [f"Battery {v.min():.1f} to {v.max():.1f} V from {_at(signals.voltage)}."]


def _consistency(kept: Sequence[Trajectory], dt: float) -> tuple[list[str], list[str]]:
    """Sentences on the agreement of velocities with poses: on good agreement, on poor agreement."""
    long = [k for k in kept if len(k) > 2]
    found = [agreement(dt * np.arange(len(k)), k.X_WB.T, k.V_WB_B.T) for k in long]
    sizes = np.array([len(k) for k in long])
    good, bad = [], []
    for part, what in ((0, "the body velocity"), (1, "the body rates")):
        explained = np.array([f[part].explained for f in found])
        known = np.isfinite(explained)
        if not known.any():
            continue
        mean = max(float(np.average(explained[known], weights=sizes[known])), 0.0)
        sentence = f"The integral of {what} explains {100 * mean:.1f} % of the change of pose"
        if mean > _CONSISTENT:
            good.append(f"{sentence}.")
        else:
            bad.append(f"{sentence} only: the estimate is poor here.")
    return good, bad


def _lacking(signals: Signals) -> list[str]:
    told = []
    p = signals.position
    if p is None:
        told.append(
            "No position or velocity at all: rotations are learned from data, the rest as far as "
            "pressure and the accelerometer tell; stream LOCAL_POSITION_NED or GLOBAL_POSITION_INT."
        )
    elif not _moves_ahead(signals):
        told.append(
            "No horizontal estimate: surge and sway velocity and position are missing. They are "
            "inferred from commands, model and accelerometer, and are not judged; heave is that of "
            "the vertical velocity. A DVL or GPS and an EKF origin measure them."
        )
    elif p.rate < _SLOW_STATE_HZ:
        told.append(
            f"Position and velocity at {p.rate:.1f} Hz only: motion faster than about "
            f"{p.rate / 4:.1f} Hz is not seen; log {p.source} at 20 Hz or more."
        )
    if signals.attitude.rate < _SLOW_STATE_HZ:
        told.append(f"Attitude at {signals.attitude.rate:.1f} Hz only: fast turns are smoothed.")
    rate = signals.outputs.measured or signals.outputs.rate
    if rate < _SLOW_OUTPUTS_HZ and not signals.held:
        told.append(
            f"Thruster outputs at {rate:.1f} Hz: thruster lag and delays below about "
            f"{2 / rate:.1f} s can't be learned, and commands between samples are unknown; log "
            f"{signals.outputs.source} at 50 Hz or more."
        )
    if signals.voltage is None:
        told.append("No battery voltage: thrust is that of the nominal voltage.")
    if signals.pressure_depth is None:
        told.append("No pressure: depth is the estimator's alone.")
    if signals.specific_force is None:
        told.append("No accelerometer: without a DVL, surge and sway are the preset's.")
    return told


def _unread(signals: Signals, kept: Sequence[Trajectory], dt: float) -> list[str]:
    """Sentences on sensors without a reading at some samples: they are slow, or were silent."""
    told = []
    whole = dt * sum(len(k) for k in kept)
    for series in (signals.specific_force, signals.pressure_depth):
        if series is None or not kept:
            continue
        if slower(series, dt):
            told.append(
                f"{_at(series)} is slower than the recording ({1 / dt:g} Hz): its readings stand "
                "at the samples nearest to them, and the other samples have none."
            )
        silent = sum(_silence(series, k, dt) for k in kept)
        if silent > _SILENT * whole:
            told.append(f"{series.source} is silent for {silent:.1f} s of {whole:.1f} s.")
    return told


def _silence(series: Series, k: Trajectory, dt: float) -> float:
    """Time (s) of a trajectory in pauses of a sensor that are longer than one lost sample makes."""
    start, stop = k.start, k.start + dt * (len(k) - 1)
    inside = series.t[(series.t > start) & (series.t < stop)]
    pauses = np.diff(np.concatenate([[start], inside, [stop]]))
    return float(pauses[pauses > 2 * max(dt, 1 / series.rate)].sum())


def _unexcited(kept: Sequence[Trajectory]) -> list[str]:
    if not kept:
        return []
    V = np.concatenate([k.V_WB_B for k in kept])
    still = [
        TWIST[i]
        for i in range(6)
        if np.isfinite(V[:, i]).any()
        and np.nanpercentile(np.abs(V[:, i] - np.nanmedian(V[:, i])), 95) < _STILL
    ]
    if not still:
        return []
    return [
        f"Hardly any motion in {', '.join(still)} (below {_STILL} m/s or rad/s): "
        "what acts along these axes can't be learned."
    ]
