"""Signals of a log of either kind, in the frames and units of `models/se3.py`, at their own times.

Readers fill `Signals`; `segments.py` and `fuse.py`, which cut and resample, use no message names.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from ...models.recordings.checks.finding import Finding
from ...models.recordings.schema import LIMITS
from ..mavlink.codec import filter_delay

LONGEST_STEP_S = 60.0
"""s between samples that still describe a motion; longer steps are gaps."""
_SILENT_S, _SILENT_PERIODS = 2.0, 10.0
"""A stream that is silent for this long, and for this many of its periods, has stopped."""


@dataclass(frozen=True)
class Series:
    """Samples x (*components, n) at strictly increasing times t (n,), and their source."""

    t: np.ndarray
    x: np.ndarray
    source: str
    left_out: int = 0
    """Number of samples that were not finite or beyond the `LIMITS` of the quantity."""
    measured: float = 0.0
    """Rate (Hz) of the samples that were logged, where others between them are not certain."""

    @property
    def rate(self) -> float:
        """Mean rate without gaps (Hz)."""
        steps = np.diff(self.t)
        steps = steps[steps <= LONGEST_STEP_S]
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
        outputs: PWM (µs) of the vehicle's thrusters, direction normalised; or the `command`.
        command: variable of a recording that `outputs` are: pwm, thruster_force (N) or F_Bo_B.
        held: each of the outputs acts until the next; False if they are samples of a faster signal.
        vehicle: preset or file whose thrusters these are.
        spans: armed, mode, aiding, wiring: the states that are constant within a segment.
        cuts: times at which a segment must end: resets, reboots.
        findings: what is wrong with the log.
        turned: thrusters (from 1) whose output was mirrored for SERVOn_REVERSED.
        turned_since: those of them from each time (s) on, where it changed.
        estimated: whether attitude and velocity are known to be an autopilot's estimate.
        low_pass: cutoff (Hz) of the autopilot's low-pass that the rates went through; 0 for none.
        channels: output (from 1) of each thruster, 0 where none drives it; empty if unknown.
    """

    attitude: Series
    rates: Series
    outputs: Series
    command: str = "pwm"
    held: bool = False
    vehicle: str = ""
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
    findings: tuple[Finding, ...] = ()
    turned: tuple[int, ...] = ()
    turned_since: tuple[tuple[float, tuple[int, ...]], ...] = ()
    channels: tuple[int, ...] = ()
    estimated: bool = False
    low_pass: float = 0.0


def series(t: np.ndarray, x: ArrayLike, source: str, quantity: str) -> Series | None:
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


def witnessed_spans(t: np.ndarray, labels: Sequence[str]) -> Spans:
    """Spans of a state of which other streams tell as well: "" where its reports are silent.

    As `sampled_spans`, but no time is lost before the first report, after the last one and where
    they stop: a ground station may ask for them for a while only.
    """
    unreported = [(-np.inf, float(t[0])), *silences(t), (float(t[-1]), np.inf)]
    after = [0, *(int(np.searchsorted(t, a)) + 1 for a, _ in unreported[1:])]
    times = np.insert(t, np.repeat(after, 2), np.ravel(unreported))
    names = np.insert(np.asarray(labels, dtype=object), np.repeat(after, 2), "")
    return sampled_spans(times, names.tolist())


def silences(t: np.ndarray) -> list[tuple[float, float]]:
    """Spans between samples at times t (s, increasing) in which a stream has stopped."""
    steps = np.diff(t)
    if not steps.size:
        return []
    allowed = max(_SILENT_S, _SILENT_PERIODS * float(np.median(steps)))
    return [(float(t[i]), float(t[i + 1])) for i in np.flatnonzero(steps > allowed)]


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
    delay = filter_delay(cutoff)
    if not delay:
        return one, []
    return replace(one, t=one.t - delay), [
        f"{one.source}: times moved back by {1e3 * delay:.0f} ms, the delay of {parameter} "
        f"{cutoff:g} Hz."
    ]


# parameters


@dataclass(frozen=True)
class Parameter:
    """One parameter value as the autopilot reported it."""

    t: float
    name: str
    value: float


_RANGES = (
    (r"SERVO\d+_FUNCTION", -1.0, 255.0),
    (r"FRAME_CONFIG", 0.0, 20.0),
    (r"SERVO\d+_REVERSED", 0.0, 1.0),
    (r"MOT_\d+_DIRECTION", -1.0, 1.0),
    (r"INS_(GYRO|ACCEL)_FILTER", 0.0, 1000.0),
    (r"BARO_SPEC_GRAV", 0.9, 1.2),
    (r"BARO\d_GND_PRESS", 0.0, 2e5),
    (r"EK3_SRC1_POSZ", 0.0, 100.0),
    (r"EK3_(ACC_P|ALT_M)_NSE", 1e-3, 1e3),
)
"""Plausible ranges of the parameters in use, somewhat wider than the autopilot's."""


_FORMER = {
    "GND_SPEC_GRAV": "BARO_SPEC_GRAV",
    "GND_ABS_PRESS": "BARO1_GND_PRESS",
    "GND_ABS_PRESS2": "BARO2_GND_PRESS",
    "GND_ABS_PRESS3": "BARO3_GND_PRESS",
}
"""Names up to ArduSub 4.0, and those of today."""


def parameters_of(
    t: np.ndarray, names: np.ndarray, values: np.ndarray
) -> tuple[list[Parameter], list[str]]:
    """The parameters of a log by today's names, and a sentence on those left out as implausible."""
    found, strange = [], []
    for at, raw, value in zip(t.tolist(), names.tolist(), values.tolist(), strict=True):
        written: str = raw.decode("ascii", "replace")
        name = _FORMER.get(written, written)
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


def values_at(
    parameters: Sequence[Parameter], name: str, t: np.ndarray, otherwise: float
) -> np.ndarray:
    """A parameter at times t: each value from its report on, the first one before it too."""
    found = [(p.t, p.value) for p in parameters if p.name == name]
    if not found:
        return np.full(t.shape, otherwise)
    times, values = (np.array(column) for column in zip(*found, strict=True))
    return values[np.clip(np.searchsorted(times, t, side="right") - 1, 0, None)]
