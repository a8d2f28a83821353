"""Which output drives which thruster, and which way, from when on: parameters change in a log."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ...models.recordings.checks.finding import Finding
from ..mavlink.codec import MOTOR_FUNCTIONS
from .signals import Parameter

CHANGED = "change of a thruster's direction or output"
SETTLING_S = 1.3  # an output's new function is in force by then


@dataclass(frozen=True)
class Drive:
    """The outputs from a time on.

    Attributes:
        since: s on the vehicle's clock; -inf for the first.
        channels: output (from 1) of each thruster, 0 where none drives it.
        mirrored: thrusters that turn the other way than in the vehicle's file.
        turned: thrusters (from 1) whose output has SERVOn_REVERSED.
        parameter: whose change began this, if one did.
    """

    since: float
    channels: tuple[int, ...]
    mirrored: tuple[bool, ...]
    turned: tuple[int, ...]
    parameter: str = ""

    @property
    def cuts(self) -> tuple[float, ...]:
        """Times (s) at which a stretch ends: a function is in force only some time after."""
        if not np.isfinite(self.since):
            return ()
        late = self.parameter.endswith("_FUNCTION")
        return (self.since, self.since + SETTLING_S) if late else (self.since,)


@dataclass
class _State:
    """Values as they are known; the first report of a parameter holds before it too."""

    motors: dict[int, int] = field(default_factory=dict)
    signs: dict[int, int] = field(default_factory=dict)
    reverse: dict[int, bool] = field(default_factory=dict)

    def take(self, p: Parameter, first: bool) -> None:
        """Take a reported value: only a new one if `first`."""
        servo = re.fullmatch(r"SERVO([1-9]|[12][0-9]|3[0-2])_(FUNCTION|REVERSED)", p.name)
        motor = re.fullmatch(r"MOT_([1-8])_DIRECTION", p.name)
        if servo and servo[2] == "FUNCTION" and round(p.value) in MOTOR_FUNCTIONS:
            table, key, value = self.motors, int(servo[1]), round(p.value) - 32
        elif servo and servo[2] == "REVERSED":
            table, key, value = self.reverse, int(servo[1]), p.value > 0
        elif motor:
            table, key, value = self.signs, int(motor[1]), -1 if p.value < 0 else 1
        else:
            return
        if not first or key not in table:
            table[key] = value  # pyright: ignore[reportArgumentType]


def drives(
    parameters: Sequence[Parameter],
    motors: Sequence[float],
    channels: Callable[[Mapping[int, int]], Sequence[int]],
) -> tuple[Drive, ...]:
    """The outputs by time.

    Args:
        parameters: in the order of time.
        motors: MOT_n_DIRECTION of each thruster in the vehicle's file.
        channels: output of each thruster, from those of the motors that have one.
    """
    state = _State()
    for p in parameters:
        state.take(p, first=True)
    found = [_drive(state, motors, channels, -np.inf, "")]
    for p in parameters:
        state.take(p, first=False)
        now = _drive(state, motors, channels, p.t, p.name)
        if (now.channels, now.mirrored) != (found[-1].channels, found[-1].mirrored):
            found.append(now)
    return tuple(found)


def _drive(
    state: _State,
    motors: Sequence[float],
    channels: Callable[[Mapping[int, int]], Sequence[int]],
    since: float,
    parameter: str,
) -> Drive:
    channel_of = {motor: channel for channel, motor in sorted(state.motors.items())}
    own = tuple(channels(channel_of))
    turned = tuple(
        k
        for k, channel in enumerate(own, 1)
        if channel in state.motors and state.reverse.get(channel, False)
    )
    mirrored = tuple(
        (sign < 0) ^ (k in turned) ^ (state.signs.get(k, 1) < 0) for k, sign in enumerate(motors, 1)
    )
    return Drive(since, own, mirrored, turned, parameter)


def drive_findings(found: Sequence[Drive]) -> list[Finding]:
    """A finding for each change during the log."""
    return [
        Finding(
            "output-direction",
            f"{drive.since:.1f} s on the vehicle's clock",
            f"{drive.parameter} changed: the log is cut there, and each part has its own outputs "
            "and signs",
            "leave the parameter alone during a dive",
        )
        for drive in found[1:]
    ]
