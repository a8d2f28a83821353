"""Signals of a log of either kind, in the frames and units of `models/se3.py`, at their own times.

Readers fill `Signals`; `segments.py` and `fuse.py`, which cut and resample, use no message names.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ...models.recordings.schema import LIMITS
from ..mavlink.codec import MOTOR_FUNCTIONS, PASS_THROUGH_FUNCTIONS, filter_delay, thruster_pwm


@dataclass(frozen=True)
class Series:
    """Samples x (*components, n) at strictly increasing times t (n,), and their source."""

    t: np.ndarray
    x: np.ndarray
    source: str
    left_out: int = 0
    """Number of samples that were not finite or beyond the `LIMITS` of the quantity."""

    @property
    def rate(self) -> float:
        """Mean rate without gaps (Hz)."""
        steps = np.diff(self.t)
        return 1.0 / float(np.mean(steps[steps <= 5 * np.median(steps)])) if steps.size else 0.0


@dataclass(frozen=True)
class Spans:
    """Intervals [start, stop] (s) in which a state is known to hold, with the state's label."""

    start: np.ndarray
    stop: np.ndarray
    label: tuple[str, ...]


@dataclass(frozen=True)
class Signals:
    """One log, converted. Absent signals are None; `position` and `velocity` come together.

    Attributes:
        attitude: q_WB.
        position: p_WB (m); NaN in x, y where the autopilot had no horizontal estimate.
        velocity: of Bo in W, expressed in W (m/s); NaN likewise.
        rates: ω of B in W, in B (rad/s).
        specific_force: in B (m/s²).
        pressure_depth: m, positive down.
        outputs: PWM (µs) of thrusters 1 … 8, direction normalised.
        spans: armed, mode, aiding, wiring: the states that are constant within a segment.
        cuts: times at which a segment must end: resets, reboots.
    """

    attitude: Series
    rates: Series
    outputs: Series
    position: Series | None = None
    velocity: Series | None = None
    specific_force: Series | None = None
    pressure_depth: Series | None = None
    voltage: Series | None = None
    rc: Series | None = None
    spans: Mapping[str, Spans] = field(default_factory=dict)
    cuts: tuple[tuple[float, str], ...] = ()
    has: tuple[str, ...] = ()
    lacks: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def series(t: np.ndarray, x: np.ndarray, source: str, quantity: str) -> Series | None:
    """Make a series: sorted, without repeated times; None if fewer than two samples are left.

    Samples are left out if they are beyond the `LIMITS` of the quantity, or if a component that has
    finite values elsewhere is not finite.
    """
    t, x = np.asarray(t, np.float64), np.asarray(x, np.float64)
    if not t.size:
        return None
    low, high = LIMITS[quantity]
    known = ((x >= low) & (x <= high)).reshape(-1, t.size)
    good = np.isfinite(t) & (known | ~known.any(axis=1, keepdims=True)).all(axis=0)
    t, x = t[good], x[..., good]
    order = np.argsort(t, kind="stable")
    t = t[order]
    new = np.concatenate([[True], np.diff(t) > 1e-6])[: t.size]
    if np.count_nonzero(new) < 2:
        return None
    return Series(t[new], x[..., order][..., new], source, int(np.count_nonzero(~good)))


def sampled_spans(t: np.ndarray, labels: Sequence[str]) -> Spans:
    """Spans of a state reported periodically (heartbeats): from first to last equal report.

    Between two differing reports the state is unknown, so that time belongs to no span.
    """
    names = np.asarray(labels, dtype=object)
    change = np.flatnonzero(np.concatenate([[True], names[1:] != names[:-1]]))
    last = np.concatenate([change[1:] - 1, [len(names) - 1]])
    return Spans(t[change], t[last], tuple(str(names[i]) for i in change))


def event_spans(t: np.ndarray, labels: Sequence[str], first: float, last: float) -> Spans:
    """Spans of a state whose every change is logged; the first label also holds before it."""
    names = np.asarray(labels, dtype=object)
    change = np.flatnonzero(np.concatenate([[True], names[1:] != names[:-1]]))
    start = np.concatenate([[min(first, t[0])], t[change[1:]]])
    stop = np.concatenate([t[change[1:]], [max(last, t[-1])]])
    return Spans(start, stop, tuple(str(names[i]) for i in change))


def undelayed(one: Series, known: Mapping[str, float], parameter: str) -> tuple[Series, list[str]]:
    """Subtract the delay of the autopilot's low-pass from the times of an inertial signal."""
    cutoff = known.get(parameter, 0.0)
    if not 1.0 <= cutoff <= 500.0:
        return one, []
    delay = filter_delay(cutoff)
    return replace(one, t=one.t - delay), [
        f"{one.source}: times moved back by {1e3 * delay:.0f} ms, the delay of {parameter} "
        f"{cutoff:g} Hz."
    ]


# which output drives which thruster


@dataclass(frozen=True)
class Parameter:
    """One parameter value as the autopilot reported it."""

    t: float
    name: str
    value: float


_RANGES = (
    (r"SERVO\d+_FUNCTION", -1.0, 255.0),
    (r"MOT_\d+_DIRECTION", -1.0, 1.0),
    (r"INS_(GYRO|ACCEL)_FILTER", 0.0, 1000.0),
    (r"BARO_SPEC_GRAV", 0.9, 1.2),
    (r"BARO\d_GND_PRESS", 0.0, 2e5),
    (r"EK3_SRC1_POSZ", 0.0, 100.0),
    (r"EK3_(ACC_P|ALT_M)_NSE", 1e-3, 1e3),
)
"""Plausible ranges of the parameters in use, somewhat wider than the autopilot's."""


def parameters_of(
    t: np.ndarray, names: np.ndarray, values: np.ndarray
) -> tuple[list[Parameter], list[str]]:
    """The parameters of a log, and a sentence on those left out as implausible."""
    found, strange = [], []
    for at, raw, value in zip(t.tolist(), names.tolist(), values.tolist(), strict=True):
        name = raw.decode("ascii", "replace")
        low, high = next(
            ((low, high) for form, low, high in _RANGES if re.fullmatch(form, name)),
            (-math.inf, math.inf),
        )
        if math.isfinite(value) and low <= value <= high:
            found.append(Parameter(at, name, value))
        elif math.isfinite(low) or not math.isfinite(value):
            strange.append(f"{name} {value:g}")
    said = [f"Parameters that can't be were left out: {', '.join(strange)}."] if strange else []
    return found, said


@dataclass(frozen=True)
class Wiring:
    """Output channels (1-based) and directions of thrusters 1 … 8; spans of reassigned outputs."""

    channels: tuple[int, ...]
    directions: tuple[int, ...]
    spans: Spans
    notes: tuple[str, ...]


_SETTLING_S = 1.3  # an output's new function is in force by then


def wiring(parameters: Sequence[Parameter], first: float, last: float) -> Wiring:
    """Read thruster wiring from SERVOn_FUNCTION and MOT_n_DIRECTION as they were during the log.

    A channel that ever had motor function 33 … 40 drives that thruster, even while it is set to
    pass-through (1, 51 … 66) or off.
    """
    functions: dict[int, list[tuple[float, int]]] = {}
    directions: dict[int, int] = {}
    notes = []
    for p in parameters:
        servo = re.fullmatch(r"SERVO([1-9]|1[0-6])_FUNCTION", p.name)
        motor = re.fullmatch(r"MOT_([1-8])_DIRECTION", p.name)
        if servo:
            functions.setdefault(int(servo[1]), []).append((p.t, round(p.value)))
        elif motor:
            directions[int(motor[1])] = -1 if p.value < 0 else 1
    motor_of = {
        channel: next((f - 32 for _, f in history if f in MOTOR_FUNCTIONS), None)
        for channel, history in sorted(functions.items())
    }
    channel_of = {motor: channel for channel, motor in motor_of.items() if motor is not None}
    if not channel_of:
        notes.append("No SERVOn_FUNCTION in the log: outputs 1–8 are taken as thrusters 1–8.")
    else:
        absent = [motor for motor in range(1, 9) if motor not in channel_of]
        if absent:
            notes.append(
                f"No output is assigned to thrusters {', '.join(map(str, absent))}; outputs of "
                "these numbers are taken."
            )
    if not directions:
        notes.append("No MOT_n_DIRECTION in the log: all directions are taken as +1.")
    channels = tuple(channel_of.get(motor, motor) for motor in range(1, 9))
    changes = _label_changes({c: functions[c] for c in channel_of.values()})
    return Wiring(
        channels,
        tuple(directions.get(motor, 1) for motor in range(1, 9)),
        _settled(changes, first, last),
        tuple(notes),
    )


def _label_changes(functions: Mapping[int, Sequence[tuple[float, int]]]) -> list[tuple[float, str]]:
    events = sorted((t, c, f) for c, history in functions.items() for t, f in history[1:])
    now = {c: history[0][1] for c, history in functions.items()}
    changes = [(-np.inf, _label(now))]
    for t, c, f in events:
        if now[c] != f:
            now[c] = f
            changes.append((t, _label(now)))
    return changes


def _label(functions: Mapping[int, int]) -> str:
    if all(f in MOTOR_FUNCTIONS for f in functions.values()):
        return ""
    if any(f in PASS_THROUGH_FUNCTIONS for f in functions.values()):
        return "pass-through"
    return "outputs off"


def _settled(changes: Sequence[tuple[float, str]], first: float, last: float) -> Spans:
    start, stop, labels = [], [], []
    times = [t for t, _ in changes[1:]] + [last]
    for (t, label), until in zip(changes, times, strict=True):
        begin = first if np.isinf(t) else t + _SETTLING_S
        if until > begin:
            start.append(begin)
            stop.append(until)
            labels.append(label)
    return Spans(np.array(start), np.array(stop), tuple(labels))


def thruster_outputs(
    t: np.ndarray, channels_us: np.ndarray, wired: Wiring, motors: Sequence[float], source: str
) -> tuple[Series | None, list[str]]:
    """PWM of thrusters 1 … 8 from output channels (16, n), with the signs of the vehicle's file.

    `motors` are the directions in the vehicle's description; where the log's MOT_n_DIRECTION
    differs, the value is mirrored about 1500.
    """
    notes = []
    index = np.array(wired.channels) - 1
    raw = channels_us[index]
    mirror = np.array(wired.directions) * np.asarray(motors)
    if (mirror < 0).any():
        which = ", ".join(str(i + 1) for i in np.flatnonzero(mirror < 0))
        notes.append(
            f"Thrusters {which} run the other way than in the vehicle's description "
            "(MOT_n_DIRECTION); their PWM is mirrored about 1500."
        )
    dead = (raw == 0).all(axis=1)
    if dead.any():
        which = ", ".join(str(i + 1) for i in np.flatnonzero(dead))
        notes.append(f"Thrusters {which} never got a pulse; they are taken as stopped.")
    return series(t, thruster_pwm(raw, mirror[:, None]), source, "pwm"), notes
