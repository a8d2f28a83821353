"""Which output of the autopilot drives which thruster of which vehicle."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from ...models.config.errors import UserError
from ...models.recordings.checks.finding import Finding
from ...models.recordings.outputs import in_words
from ...models.vehicles.vehicle import load_vehicle
from ..mavlink.codec import (
    FRAME_THRUSTERS,
    MOTOR_FUNCTIONS,
    PASS_THROUGH_FUNCTIONS,
    THRUSTER_INPUTS,
    thruster_pwm,
)
from .drives import CHANGED, SETTLING_S, Drive, drive_findings, drives
from .frame import frame_findings, frame_in_words, moves, outvoted
from .signals import Parameter, Series, Spans, series

PRESETS, _USUAL = {6: "bluerov2", 8: "bluerov2_heavy"}, 8
_OFF = 0  # SERVOn_FUNCTION of an output that the autopilot leaves to DO_SET_SERVO


@dataclass(frozen=True)
class Wiring:
    """Thrusters of a vehicle as a log's outputs drive them.

    Attributes:
        vehicle: preset or file.
        drives: output and direction of each thruster, by time.
        spans: of reassigned outputs.
        frame: FRAME_CONFIG, if the log has it, or the frame that the autopilot named.
        frame_source: where the log has the frame, in words.
        said: the frame that the autopilot named, by its FRAME_CONFIG.
        motors: motor of each output channel (from 1) that has one.
    """

    vehicle: str
    drives: tuple[Drive, ...]
    spans: Spans
    notes: tuple[str, ...]
    frame: int | None = None
    frame_source: str = ""
    said: int | None = None
    motors: Mapping[int, int] = field(default_factory=dict)

    @property
    def cuts(self) -> tuple[tuple[float, str], ...]:
        """Times (s) at which an output or a direction changed, and what it was."""
        return tuple((t, CHANGED) for drive in self.drives for t in drive.cuts)

    @property
    def channels(self) -> tuple[int, ...]:
        """Output (from 1) of each thruster, 0 where none drives it; empty if it changed."""
        every = {drive.channels for drive in self.drives}
        return self.drives[0].channels if len(every) == 1 else ()

    @property
    def outputs(self) -> set[int]:
        """All outputs that ever drove a thruster."""
        return {channel for drive in self.drives for channel in drive.channels if channel}

    @property
    def turned(self) -> tuple[int, ...]:
        """Thrusters (from 1) whose output ever had SERVOn_REVERSED."""
        return tuple(sorted({k for drive in self.drives for k in drive.turned}))

    def of_signals(self) -> dict[str, Any]:
        """The attributes of `Signals` that the wiring determines."""
        return {
            "vehicle": self.vehicle,
            "turned": self.turned,
            "turned_since": tuple((drive.since, drive.turned) for drive in self.drives),
            "channels": self.channels,
        }

    def frame_findings(self, outputs_us: Float[np.ndarray, "32 n"], named: bool) -> list[Finding]:
        """Contradictions of the frame; `named` tells whether the user named a vehicle."""
        given = self.frame, self.frame_source, self.said
        return frame_findings(*given, self.motors, outputs_us, named)


def wiring(
    parameters: Sequence[Parameter],
    first: float,
    last: float,
    vehicle: str | None = None,
    said: int | None = None,
    pulses: Float[np.ndarray, "c n"] | None = None,
) -> Wiring:
    """Read frame and thruster wiring from the parameters as they were during the log.

    A channel that ever had motor function 33 … 40 drives that thruster, even while it is set to
    pass-through (1, 51 … 66) or off. Without a named `vehicle` it is the preset with the frame's
    number of thrusters. `said` is the frame that the autopilot named, which counts where the log
    lacks FRAME_CONFIG. Where the log has neither a frame nor functions of outputs 7 and 8, those
    that move in `pulses` (µs) tell the number (`moving_thrusters`), and the report says so.

    Raises:
        UserError: the log's frame has another number of thrusters than the named vehicle.
    """
    functions, frame = _parsed(parameters)
    motor_of = {
        channel: next((f - 32 for _, f in history if f in MOTOR_FUNCTIONS), None)
        for channel, history in sorted(functions.items())
    }
    channel_of = {motor: channel for channel, motor in motor_of.items() if motor is not None}
    source = f"FRAME_CONFIG {frame}"
    if frame is None and said is not None:
        frame, source = said, frame_in_words(said)
    name, notes = _vehicle(vehicle, frame, source, channel_of, functions, pulses)
    motors = {channel: motor for channel, motor in motor_of.items() if motor is not None}
    if said is not None and outvoted(frame, said, motors):
        notes.append(
            f"{source} and SERVOn_FUNCTION agree and count, though the autopilot started as "
            f"{frame_in_words(said)}."
        )
    mounts = load_vehicle(name).propulsion.mounts
    _, told = _channels(len(mounts), channel_of, functions)
    if not any(re.fullmatch(r"MOT_[1-8]_DIRECTION", p.name) for p in parameters):
        told.append("No MOT_n_DIRECTION in the log: all directions are taken as +1.")
    changes = _label_changes({c: functions[c] for c in channel_of.values()})
    return Wiring(
        name,
        drives(
            parameters,
            [mount.motor for mount in mounts],
            lambda channel_of: _channels(len(mounts), channel_of, functions)[0],
        ),
        _settled(changes, first, last),
        (*notes, *told),
        frame,
        source,
        said,
        motors,
    )


def _parsed(
    parameters: Sequence[Parameter],
) -> tuple[dict[int, list[tuple[float, int]]], int | None]:
    """Functions of outputs by time, and the frame."""
    functions: dict[int, list[tuple[float, int]]] = {}
    frame = None
    for p in parameters:
        servo = re.fullmatch(r"SERVO([1-9]|[12][0-9]|3[0-2])_FUNCTION", p.name)
        if servo:
            functions.setdefault(int(servo[1]), []).append((p.t, round(p.value)))
        elif p.name == "FRAME_CONFIG":
            frame = round(p.value)
    return functions, frame


_Functions = Mapping[int, Sequence[tuple[float, int]]]


def _vehicle(
    named: str | None,
    frame: int | None,
    source: str,
    channel_of: Mapping[int, int],
    functions: _Functions,
    pulses: np.ndarray | None,
) -> tuple[str, list[str]]:
    """The vehicle's name, and a sentence if it is not the usual one, or the log does not tell."""
    count, told = FRAME_THRUSTERS.get(-1 if frame is None else frame), source
    six = set(channel_of) == set(range(1, 7)) and functions.keys() >= {7, 8}
    if count is None and six and not _drives(functions[7]) and not _drives(functions[8]):
        count, told = 6, "SERVOn_FUNCTION"
    if named is None and count is None:
        name, why = _by_outputs(channel_of, functions, pulses)
        said = f"Frame not in the log: read as {name}{why} (--vehicle names another)."
        return name, [said, *([] if name == PRESETS[_USUAL] else [load_vehicle(name).limitation()])]
    if named is None:
        name = PRESETS[count or _USUAL]
        said = f"{told}: {count} thrusters, read as those of {name} (--vehicle names another)."
        more = load_vehicle(name).limitation()
        return name, [] if count in (None, _USUAL) else [said, more]
    own = len(load_vehicle(named).propulsion.mounts)
    if count not in (None, own):
        raise UserError(
            f"{told} is that of a vehicle with {count} thrusters, and {named} has {own}; leave the "
            f"vehicle out, or name one with {count} (--vehicle {PRESETS[count]})"
        )
    return named, []


def _by_outputs(
    channel_of: Mapping[int, int], functions: _Functions, pulses: np.ndarray | None
) -> tuple[str, str]:
    """The preset with as many thrusters as outputs move, and the reason in words."""
    known = functions.keys() & {7, 8} or channel_of.keys() & {7, 8}
    if known or pulses is None:
        return PRESETS[_USUAL], ""
    rows = [channel_of.get(n, n) - 1 for n in range(1, _USUAL + 1)]
    count = moving_thrusters(pulses[[row for row in rows if row < len(pulses)]])
    why = ", as outputs 7 and 8 do not both move, while the others do" if count != _USUAL else ""
    return PRESETS[count], why


def moving_thrusters(pulses: Float[np.ndarray, "c n"]) -> int:
    """Thrusters that outputs (µs) drive: six if 7 and 8 don't both move while the others do.

    All eight of a Heavy are driven as soon as it holds its attitude; a camera's tilt or a lamp may
    move alone.
    """
    driven = [moves(x) for x in pulses[:_USUAL]]
    eight = len(driven) == _USUAL and all(driven[6:])
    return 6 if len(driven) >= 6 and all(driven[:6]) and not eight else _USUAL


def _drives(history: Sequence[tuple[float, int]]) -> bool:
    return any(f in (*MOTOR_FUNCTIONS, *THRUSTER_INPUTS) for _, f in history)


def _used(history: Sequence[tuple[float, int]]) -> bool:
    return any(f != _OFF for _, f in history)


def _channels(
    count: int, channel_of: Mapping[int, int], functions: _Functions
) -> tuple[list[int], list[str]]:
    """The outputs of all thrusters; one without an own output has that of its number if free."""
    numbers = range(1, count + 1)
    assigned = bool(channel_of)  # then an output without a function is no thruster's
    other = {
        n
        for n, history in functions.items()
        if not _drives(history) and (assigned or _used(history))
    }
    free = set(numbers) - other - set(channel_of.values())
    channels = [channel_of.get(n, n if n in free else 0) for n in numbers]
    if not channel_of:
        return channels, [
            f"No SERVOn_FUNCTION in the log: outputs 1–{count} are taken as thrusters 1–{count}."
        ]
    notes = []
    words = {True: "outputs of these numbers are taken", False: "they are taken as stopped"}
    for taken, said in words.items():
        absent = [str(n) for n in numbers if n not in channel_of and (n in free) == taken]
        if absent:
            notes.append(f"No output is assigned to thrusters {', '.join(absent)}; {said}.")
    return channels, notes


def direction_findings(wired: Wiring) -> list[Finding]:
    """A finding for each change of an output or a direction during the log."""
    return drive_findings(wired.drives)


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
        begin = first if np.isinf(t) else t + SETTLING_S
        if until > begin:
            start.append(begin)
            stop.append(until)
            labels.append(label)
    return Spans(np.array(start), np.array(stop), tuple(labels))


def thruster_outputs(
    t: np.ndarray, channels_us: np.ndarray, wired: Wiring, source: str
) -> tuple[Series | None, list[str]]:
    """PWM of the thrusters from output channels (32, n), with the signs of the vehicle's file.

    Where the log's MOT_n_DIRECTION differs from it, the value is mirrored about 1500.
    """
    notes = []
    since = np.searchsorted([drive.since for drive in wired.drives[1:]], t, side="right")
    index = np.array([drive.channels for drive in wired.drives])[since].T
    mirrored = np.array([drive.mirrored for drive in wired.drives])[since].T
    raw = np.where(index > 0, np.take_along_axis(channels_us, np.maximum(index - 1, 0), 0), 0)
    by_direction = mirrored[:, -1:] if t.size else mirrored
    named = [i for i in np.flatnonzero(by_direction) if i + 1 not in wired.turned]
    if named:
        which = ", ".join(str(i + 1) for i in named)
        notes.append(
            f"Thrusters {which} run the other way than in the vehicle's description "
            "(MOT_n_DIRECTION); their PWM is mirrored about 1500."
        )
    dead = (raw == 0).all(axis=1) & (index > 0).all(axis=1)
    if dead.any():
        which = ", ".join(in_words(int(i) + 1, wired.channels)[9:] for i in np.flatnonzero(dead))
        notes.append(f"Thrusters {which} never got a pulse; they are taken as stopped.")
    if any(c not in (0, k) for k, c in enumerate(wired.channels, 1)):
        which = ", ".join(in_words(k, wired.channels)[9:] for k in range(1, len(index) + 1))
        notes.append(f"Thrusters by output: {which}.")
    signs = np.where(mirrored, -1, 1)
    return series(t, thruster_pwm(raw, signs), source, "pwm"), notes
