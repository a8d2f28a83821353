"""Which output of the autopilot drives which thruster of which vehicle."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ...models.config.errors import UserError
from ...models.recordings.checks.finding import Finding
from ...models.vehicles.vehicle import load_vehicle
from ..mavlink.codec import (
    FRAME_THRUSTERS,
    MOTOR_FUNCTIONS,
    PASS_THROUGH_FUNCTIONS,
    THRUSTER_INPUTS,
    thruster_pwm,
)
from .frame import frame_findings, frame_in_words, moves
from .signals import Parameter, Series, Spans, series

PRESETS, _USUAL = {6: "bluerov2", 8: "bluerov2_heavy"}, 8
_OFF = 0  # SERVOn_FUNCTION of an output that the autopilot leaves to DO_SET_SERVO


@dataclass(frozen=True)
class Wiring:
    """Thrusters of a vehicle as a log's outputs drive them.

    Attributes:
        vehicle: preset or file.
        channels: output of each thruster (1-based), 0 where none drives it.
        mirrored: those that turn the other way than in the vehicle's file, by time: from each
            time on (s).
        spans: of reassigned outputs.
        frame: FRAME_CONFIG, if the log has it, or the frame that the autopilot named.
        frame_source: where the log has the frame, in words.
        said: the frame that the autopilot named, by its FRAME_CONFIG.
        motors: motor of each output channel (from 1) that has one.
        turned: thrusters (from 1) whose output has SERVOn_REVERSED.
    """

    vehicle: str
    channels: tuple[int, ...]
    mirrored: tuple[tuple[float, tuple[bool, ...]], ...]
    spans: Spans
    notes: tuple[str, ...]
    frame: int | None = None
    frame_source: str = ""
    said: int | None = None
    motors: Mapping[int, int] = field(default_factory=dict)
    turned: tuple[int, ...] = ()

    @property
    def changes(self) -> tuple[float, ...]:
        """Times (s) at which a thruster's direction changed."""
        return tuple(t for t, _ in self.mirrored[1:])

    def frame_findings(self, outputs_us: Float[np.ndarray, "32 n"], named: bool) -> list[Finding]:
        """Contradictions of the frame; `named` tells whether the user named a vehicle."""
        given = self.frame, self.frame_source, self.said
        return frame_findings(*given, self.motors, outputs_us, named)


DIRECTION_CHANGED = "change of a thruster's direction"
_SETTLING_S = 1.3  # an output's new function is in force by then


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
    functions, directions, reverse, frame = _parsed(parameters)
    motor_of = {
        channel: next((f - 32 for _, f in history if f in MOTOR_FUNCTIONS), None)
        for channel, history in sorted(functions.items())
    }
    channel_of = {motor: channel for channel, motor in motor_of.items() if motor is not None}
    source = f"FRAME_CONFIG {frame}"
    if frame is None and said is not None:
        frame, source = said, frame_in_words(said)
    name, notes = _vehicle(vehicle, frame, source, channel_of, functions, pulses)
    mounts = load_vehicle(name).propulsion.mounts
    channels, told = _channels(len(mounts), channel_of, functions)
    if not directions:
        told.append("No MOT_n_DIRECTION in the log: all directions are taken as +1.")
    changes = _label_changes({c: functions[c] for c in channel_of.values()})
    motors = {channel: motor for channel, motor in motor_of.items() if motor is not None}
    turned = tuple(k for k, c in enumerate(channels, 1) if c in motors and reverse.get(c, False))
    own = [(mount.motor < 0) != (k in turned) for k, mount in enumerate(mounts, 1)]
    return Wiring(
        name,
        tuple(channels),
        _mirrored(own, directions),
        _settled(changes, first, last),
        (*notes, *told),
        frame,
        source,
        said,
        motors,
        turned,
    )


def _parsed(
    parameters: Sequence[Parameter],
) -> tuple[
    dict[int, list[tuple[float, int]]], list[tuple[float, int, int]], dict[int, bool], int | None
]:
    """Functions of outputs by time, directions of motors by time, reversed outputs, frame."""
    functions: dict[int, list[tuple[float, int]]] = {}
    directions: list[tuple[float, int, int]] = []
    reverse: dict[int, bool] = {}
    frame = None
    for p in parameters:
        servo = re.fullmatch(r"SERVO([1-9]|[12][0-9]|3[0-2])_FUNCTION", p.name)
        turned = re.fullmatch(r"SERVO([1-9]|[12][0-9]|3[0-2])_REVERSED", p.name)
        motor = re.fullmatch(r"MOT_([1-8])_DIRECTION", p.name)
        if servo:
            functions.setdefault(int(servo[1]), []).append((p.t, round(p.value)))
        elif motor:
            directions.append((p.t, int(motor[1]), -1 if p.value < 0 else 1))
        elif turned:
            reverse[int(turned[1])] = p.value > 0
        elif p.name == "FRAME_CONFIG":
            frame = round(p.value)
    return functions, directions, reverse, frame


def _mirrored(
    own: Sequence[bool], directions: Sequence[tuple[float, int, int]]
) -> tuple[tuple[float, tuple[bool, ...]], ...]:
    """Which thrusters are mirrored from when on; a value's first report holds before it too."""
    now: dict[int, int] = {}
    for _, motor, sign in directions:
        now.setdefault(motor, sign)
    found = [(-np.inf, now.copy())]
    for t, motor, sign in directions:
        if now[motor] != sign:
            now[motor] = sign
            found.append((t, now.copy()))
    return tuple(
        (t, tuple(is_ != (signs.get(k, 1) < 0) for k, is_ in enumerate(own, 1)))
        for t, signs in found
    )


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
    why = ", as outputs 7 and 8 stand still while the others move" if count != _USUAL else ""
    return PRESETS[count], why


def moving_thrusters(pulses: Float[np.ndarray, "c n"]) -> int:
    """Thrusters that outputs (µs) drive: six if 7 and 8 stand still while the others move."""
    driven = [moves(x) for x in pulses[:_USUAL]]
    return 6 if len(driven) >= 6 and all(driven[:6]) and not any(driven[6:]) else _USUAL


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
    """A finding for each change of MOT_n_DIRECTION during the log."""
    return [
        Finding(
            "output-direction",
            f"{t:.1f} s on the vehicle's clock",
            "MOT_n_DIRECTION changed: the log is cut there, and each part has its own signs",
            "leave the parameter alone during a dive",
        )
        for t in wired.changes
    ]


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
    t: np.ndarray, channels_us: np.ndarray, wired: Wiring, source: str
) -> tuple[Series | None, list[str]]:
    """PWM of the thrusters from output channels (32, n), with the signs of the vehicle's file.

    Where the log's MOT_n_DIRECTION differs from it, the value is mirrored about 1500.
    """
    notes = []
    index = np.array(wired.channels)[:, None]
    raw = np.where(index > 0, channels_us[index[:, 0] - 1], 0)
    since = np.searchsorted([start for start, _ in wired.mirrored[1:]], t, side="right")
    mirrored = np.array([signs for _, signs in wired.mirrored])[since].T
    by_direction = mirrored[:, -1:] if t.size else mirrored
    named = [i for i in np.flatnonzero(by_direction) if i + 1 not in wired.turned]
    if named:
        which = ", ".join(str(i + 1) for i in named)
        notes.append(
            f"Thrusters {which} run the other way than in the vehicle's description "
            "(MOT_n_DIRECTION); their PWM is mirrored about 1500."
        )
    dead = (raw == 0).all(axis=1) & (index[:, 0] > 0)
    if dead.any():
        which = ", ".join(str(i + 1) for i in np.flatnonzero(dead))
        notes.append(f"Thrusters {which} never got a pulse; they are taken as stopped.")
    signs = np.where(mirrored, -1, 1)
    return series(t, thruster_pwm(raw, signs), source, "pwm"), notes
