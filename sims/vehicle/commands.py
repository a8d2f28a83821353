"""MAV_CMD: what the vehicle does on command, and its acknowledgement."""

from collections.abc import Callable
from typing import Any

from ...systems.mavlink.dialect import Message, mavlink
from .autopilot.autopilot import FORCE_ARM
from .autopilot.modes import POSHOLD, SURFACE
from .telemetry.messages import KNOWN, make
from .telemetry.streams import Streams
from .vehicle import Vehicle

ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4
_INFO = 6
_VERSION_MESSAGE = 148
_CUSTOM_MODE = 1

Params = tuple[float, ...]


class Commands:
    """The commands of one port; what they send goes into `outbox`."""

    def __init__(self, vehicle: Vehicle, outbox: list[Message], streams: Streams):
        self.vehicle = vehicle
        self.streams = streams
        self._outbox = outbox
        self._by_number: dict[int, Callable[[Params], int]] = {
            17: lambda p: self._mode(POSHOLD),
            21: lambda p: self._mode(SURFACE),
            176: self._set_mode,
            183: lambda p: self._result(self.vehicle.autopilot.set_servo(int(p[0]), int(p[1]))),
            185: self._terminate,
            209: lambda p: self._result(self.vehicle.autopilot.test_motor(p)),
            241: lambda p: FAILED if self.vehicle.autopilot.armed else ACCEPTED,
            246: self._reboot,
            300: lambda p: FAILED,  # there is no mission
            400: self._arm,
            401: lambda p: ACCEPTED,
            410: lambda p: self._send(242),
            510: self._tell_interval,
            511: self._set_interval,
            512: lambda p: self._send(int(p[0])),
            520: lambda p: self._send(_VERSION_MESSAGE) if p[0] == 1 else DENIED,
            42428: self._banner,
        }

    def long(self, m: Any) -> None:
        """Take COMMAND_LONG."""
        params = tuple(getattr(m, f"param{i}") for i in range(1, 8))
        self._acknowledge(m, params)

    def integer(self, m: Any) -> None:
        """Take COMMAND_INT."""
        params = (m.param1, m.param2, m.param3, m.param4, float(m.x), float(m.y), m.z)
        self._acknowledge(m, params)

    def _acknowledge(self, m: Any, params: Params) -> None:
        act = self._by_number.get(m.command)
        # a parameter that the command has no use for may be NaN; those in use are finite
        finite = tuple(0.0 if p != p or abs(p) > 1e18 else p for p in params)
        result = UNSUPPORTED if act is None else act(finite)
        self._outbox.append(
            mavlink.MAVLink_command_ack_message(
                m.command, result, 0, 0, m.get_srcSystem(), m.get_srcComponent()
            )
        )

    @staticmethod
    def _result(done: bool) -> int:
        return ACCEPTED if done else FAILED

    def _mode(self, mode: int) -> int:
        return self._result(self.vehicle.autopilot.set_mode(mode))

    def _set_mode(self, p: Params) -> int:
        return self._mode(int(p[1])) if int(p[0]) & _CUSTOM_MODE else DENIED

    def _arm(self, p: Params) -> int:
        autopilot = self.vehicle.autopilot
        if p[0] == 1:
            return self._result(autopilot.arm(force=p[1] == FORCE_ARM))
        if p[0] == 0:
            autopilot.disarm()
            return ACCEPTED
        return UNSUPPORTED

    def _terminate(self, p: Params) -> int:
        if p[0] <= 0.5:
            return FAILED
        self.vehicle.autopilot.disarm()
        return ACCEPTED

    def _reboot(self, p: Params) -> int:
        if p[0] not in (1, 3):
            return UNSUPPORTED
        if self.vehicle.autopilot.armed:
            return FAILED
        self.vehicle.reboot()
        return ACCEPTED

    def _send(self, message: int) -> int:
        if message not in KNOWN:
            return FAILED
        made = make(message, self.vehicle)
        self._outbox.extend(made)
        return ACCEPTED if made else FAILED

    def _tell_interval(self, p: Params) -> int:
        message = int(p[0])
        interval = self.streams.interval(message)
        self._outbox.append(mavlink.MAVLink_message_interval_message(message & 0xFFFF, interval))
        return ACCEPTED

    def _set_interval(self, p: Params) -> int:
        result = self.streams.request(int(p[0]), p[1])
        if result == DENIED and int(p[0]) not in KNOWN:
            text = f"No ap_message for mavlink id ({int(p[0])})"
            self._outbox.append(mavlink.MAVLink_statustext_message(_INFO, text.encode()))
        return result

    def _banner(self, p: Params) -> int:
        del p
        frame = {0: "BLUEROV1", 1: "VECTORED", 2: "VECTORED_6DOF"}[self.vehicle.autopilot.frame]
        for text in ("ArduSub V4.5.6 (simulated)", f"Frame: {frame}"):
            self._outbox.append(mavlink.MAVLink_statustext_message(_INFO, text.encode()))
        return ACCEPTED
