"""Commands that wait for the vehicle's answer: mode, arming, message rates.

They take up to seconds, so they belong before and after a dive, not in its loop.
"""

import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

from ...models.config.errors import UserError
from .codec import ARMED_FLAG, MODES
from .dialect import Message, mavlink
from .link import Link, Peer

RESULTS = {number: entry.name for number, entry in mavlink.enums["MAV_RESULT"].items()}
_ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
_INTERVAL = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
FORCED_DISARM = 21196.0
"""Parameter 2 of a disarming that is not refused (ArduPilot's magic number)."""
_SPOKEN = 0.3  # s to wait for the text that gives the reason of a refusal
_STATE = 3.0  # s in which a heartbeat shows what was accepted
_AGAIN = 0.5  # s after which a heartbeat is asked for again
_WARNING = mavlink.MAV_SEVERITY_WARNING


class VehicleRefused(UserError):
    """The vehicle did not do what it was asked; the sentence has its reason."""


def command_long(vehicle: Peer, number: int, *parameters: float, attempt: int = 0) -> Message:
    """COMMAND_LONG with up to seven parameters; the others are zero."""
    values = (*parameters, *(0.0,) * (7 - len(parameters)))
    return mavlink.MAVLink_command_long_message(*vehicle, number, attempt, *values)


def command(
    link: Link, number: int, *parameters: float, timeout: float = 0.5, attempts: int = 6
) -> int | None:
    """Send COMMAND_LONG until it is acknowledged: its MAV_RESULT, None without an answer.

    Raises:
        UserError: there is no vehicle.
    """
    vehicle = link.find_vehicle()

    def answers(message: Message) -> bool:
        return message.command == number and message.result != mavlink.MAV_RESULT_IN_PROGRESS

    for attempt in range(attempts):
        started = time.monotonic()
        link.send(command_long(vehicle, number, *parameters, attempt=attempt))
        found = link.wait_for("COMMAND_ACK", timeout, answers, started)
        if found is not None:
            return int(found.message.result)
    return None


class Identity(NamedTuple):
    """What AUTOPILOT_VERSION tells."""

    serial_number: str = ""
    """`uid2`, or `uid`, in hexadecimal; empty if it has none."""
    version: tuple[int, int] | None = None
    """Of the firmware, such as (4, 5); None if it is not told."""


def identity(link: Link, timeout: float = 0.5, attempts: int = 4) -> Identity:
    """Which autopilot it is; empty if it does not answer.

    Raises:
        UserError: there is no vehicle.
    """
    vehicle = link.find_vehicle()
    number = float(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
    for attempt in range(attempts):
        started = time.monotonic()
        request = mavlink.MAV_CMD_REQUEST_MESSAGE
        link.send(command_long(vehicle, request, number, attempt=attempt))
        found = link.wait_for(
            "AUTOPILOT_VERSION",
            timeout,
            lambda message: message.get_srcComponent() == vehicle.component,
            started,
        )
        if found is not None:
            told, long = found.message, bytes(found.message.uid2)
            short = f"{told.uid:x}" if told.uid else ""
            version = int(told.flight_sw_version)
            numbers = (version >> 24, version >> 16 & 0xFF) if version else None
            return Identity(long.hex() if any(long) else short, numbers)
    return Identity()


def mode_of(heartbeat: Message) -> int:
    """The mode's number (`codec.MODES`)."""
    return int(heartbeat.custom_mode)


def is_armed(heartbeat: Message) -> bool:
    """Whether the motors are armed."""
    return bool(heartbeat.base_mode & ARMED_FLAG)


def mode_number(name: str) -> int:
    """The number of a mode.

    Raises:
        UserError: there is no such mode.
    """
    number = next((n for n, known in MODES.items() if known == name), None)
    if number is None:
        raise UserError(f"mode `{name}` is unknown; take one of {', '.join(MODES.values())}")
    return number


def set_mode(link: Link, name: str) -> None:
    """Change the flight mode and see it in a heartbeat.

    Raises:
        VehicleRefused: it refused, did not answer, or stayed in another mode.
        UserError: there is no such mode, or no vehicle.
    """
    number = mode_number(name)
    enabled = float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
    _until_seen(
        link,
        f"mode {name}",
        lambda: command(link, mavlink.MAV_CMD_DO_SET_MODE, enabled, float(number)),
        lambda heartbeat: mode_of(heartbeat) == number,
    )


def arm(link: Link) -> None:
    """Arm; the vehicle makes its own checks.

    Raises:
        VehicleRefused: it refused, did not answer, or did not get armed.
    """
    number = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
    _until_seen(link, "arming", lambda: command(link, number, 1.0), is_armed)


def disarm(link: Link, force: bool = True) -> None:
    """Disarm; by `force` also where the autopilot would wait.

    Raises:
        VehicleRefused: it refused, did not answer, or stayed armed.
    """
    number, magic = mavlink.MAV_CMD_COMPONENT_ARM_DISARM, FORCED_DISARM if force else 0.0
    _until_seen(
        link,
        "disarming",
        lambda: command(link, number, 0.0, magic),
        lambda heartbeat: not is_armed(heartbeat),
    )


def request_rates(link: Link, rates: Mapping[str, float]) -> dict[str, str]:
    """Ask for messages at rates (Hz); what was refused, with the vehicle's answer.

    Whether a rate is kept shows in `link.statistics().rates`: a serial line may be too slow. When
    the vehicle boots anew they are asked for again.
    """
    refused, asked = {}, []
    for name, rate in rates.items():
        number = float(getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))
        interval = 1e6 / rate if rate > 0 else -1.0
        result = command(link, _INTERVAL, number, interval)
        if result != _ACCEPTED:
            refused[name] = _answer(result)
        else:
            asked.append(command_long(link.find_vehicle(), _INTERVAL, number, interval))
    link.when_booted(lambda: [link.send(message) for message in asked])
    return refused


def _until_seen(
    link: Link, what: str, act: Callable[[], int | None], shows: Callable[[Message], bool]
) -> None:
    """Act, and wait for a heartbeat that shows the effect: an acknowledgement is not the state."""
    started = time.monotonic()
    result = act()
    if result != _ACCEPTED:
        raise VehicleRefused(f"{what}: {_answer(result)}{_reason(link, started, _SPOKEN)}")
    vehicle = link.find_vehicle()
    heartbeat = float(mavlink.MAVLINK_MSG_ID_HEARTBEAT)  # without waiting for the next second's
    for _ in range(round(_STATE / _AGAIN)):
        link.send(command_long(vehicle, mavlink.MAV_CMD_REQUEST_MESSAGE, heartbeat))
        if link.wait_for("HEARTBEAT", _AGAIN, shows, started) is not None:
            return
    raise VehicleRefused(
        f"{what}: accepted, and not seen in {_STATE:g} s of heartbeats{_reason(link, started, 0.0)}"
    )


def _answer(result: int | None) -> str:
    if result is None:
        return (
            "the vehicle does not answer; check the link, and that our system id is its SYSID_MYGCS"
        )
    return f"the vehicle refuses ({RESULTS.get(result, str(result))})"


def _reason(link: Link, since: float, wait: float) -> str:
    """The warnings that the vehicle has spoken since, as the end of a sentence."""
    end = time.monotonic() + wait
    while True:
        said = [text for _, severity, text in link.texts(since) if severity <= _WARNING]
        if said or time.monotonic() >= end:
            return f": {'; '.join(dict.fromkeys(said))}" if said else ""
        time.sleep(0.02)
