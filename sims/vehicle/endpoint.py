"""One MAVLink port of the vehicle: messages in, messages out, without sockets."""

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from ...models.frames import frd_to_flu
from ...systems.mavlink import codec
from ...systems.mavlink.dialect import Message, mavlink
from .autopilot.autopilot import READY
from .autopilot.pilot import Sticks
from .commands import Commands
from .telemetry.messages import KNOWN, make
from .telemetry.streams import Streams
from .vehicle import Vehicle

COMPONENT = 1
_LISTED_PER_STEP = 4  # parameters sent in one step while a list goes out
_TIMESYNC_PERIOD = 10.0  # s between requests of the vehicle's own
_LOCAL_FRD, _BODY_FRD = 20, 12
_NO_MISSION, _UNSUPPORTED = 0, 3


class Endpoint:
    """Handles what arrives at one port and collects in `outbox` what goes out there.

    A port has rates of its own. Parameters that change are told at every port.
    """

    def __init__(self, vehicle: Vehicle):
        self.vehicle = vehicle
        self.outbox: list[Message] = []
        self.streams = Streams(vehicle.parameters, KNOWN)
        self._commands = Commands(vehicle, self.outbox, self.streams)
        self._listing: deque[str] = deque()
        self._synced_at = 0.0
        self._boots = vehicle.boots
        self._handlers: dict[str, Callable[[Message], None]] = {
            "HEARTBEAT": self._heartbeat,
            "MANUAL_CONTROL": self._manual_control,
            "RC_CHANNELS_OVERRIDE": self._override,
            "COMMAND_LONG": self._commands.long,
            "COMMAND_INT": self._commands.integer,
            "SET_MODE": self._set_mode,
            "PARAM_REQUEST_LIST": self._list_parameters,
            "PARAM_REQUEST_READ": self._read_parameter,
            "PARAM_SET": self._set_parameter,
            "REQUEST_DATA_STREAM": self._request_stream,
            "TIMESYNC": self._timesync,
            "MISSION_REQUEST_LIST": self._count_mission,
            "MISSION_COUNT": self._refuse_mission,
            "MISSION_CLEAR_ALL": self._clear_mission,
            "SET_GPS_GLOBAL_ORIGIN": self._set_origin,
            "VISION_POSITION_DELTA": self._displaced,
            "ODOMETRY": self._odometry,
            "VISION_POSITION_ESTIMATE": self._placed,
        }

    def handle(self, message: Message) -> None:
        """Take a message; those of a kind or for a vehicle that is not this one are ignored."""
        if self.vehicle.autopilot.t < READY:  # still booting
            return
        handler = self._handlers.get(message.get_type())
        here = self.vehicle.parameters.integer("SYSID_THISMAV")
        target = getattr(message, "target_system", 0)
        if handler is not None and target in (0, here):
            handler(message)

    def step(self) -> None:
        """Put what is due now into `outbox`."""
        vehicle = self.vehicle
        t = vehicle.autopilot.t
        if vehicle.boots != self._boots:
            self._boots = vehicle.boots
            self.streams = Streams(vehicle.parameters, KNOWN)
            self._commands.streams = self.streams
            self._listing.clear()
            self._synced_at = 0.0
        if t < READY:
            return
        for message in self.streams.due(t):
            self.outbox.extend(make(message, vehicle))
        for _ in range(min(_LISTED_PER_STEP, len(self._listing))):
            name = self._listing.popleft()
            self._send_parameter(name, vehicle.parameters.index(name))
        if t - self._synced_at >= _TIMESYNC_PERIOD:
            self._synced_at = t
            self.outbox.append(mavlink.MAVLink_timesync_message(0, 1000 * vehicle.boot_us + 1))

    # ----------------------------------------------------------------------------- pilot

    def _heartbeat(self, message: Any) -> None:
        self.vehicle.autopilot.heard(message.get_srcSystem())

    def _manual_control(self, m: Any) -> None:
        sticks = Sticks(m.x, m.y, m.z, m.r, m.buttons, m.buttons2, m.s, m.t)
        self.vehicle.autopilot.manual_control(m.get_srcSystem(), m.target, sticks)

    def _override(self, m: Any) -> None:
        values = [getattr(m, f"chan{i}_raw") for i in range(1, 17)]
        self.vehicle.autopilot.override(m.get_srcSystem(), values)

    def _set_mode(self, m: Any) -> None:
        if m.base_mode & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            self.vehicle.autopilot.set_mode(m.custom_mode)

    # ------------------------------------------------------------------------ parameters

    def _list_parameters(self, m: Any) -> None:
        del m
        self._listing = deque(self.vehicle.parameters.names)

    def _read_parameter(self, m: Any) -> None:
        names = self.vehicle.parameters.names
        if 0 <= m.param_index < len(names):
            self._send_parameter(names[m.param_index], m.param_index)
        elif m.param_index == -1 and m.param_id in self.vehicle.parameters:
            self._send_parameter(m.param_id, 65535)

    def _set_parameter(self, m: Any) -> None:
        if self.vehicle.parameters.set(m.param_id, m.param_value):
            self.vehicle.broadcast.append(self._parameter(m.param_id, 65535))

    def _send_parameter(self, name: str, index: int) -> None:
        self.outbox.append(self._parameter(name, index))

    def _parameter(self, name: str, index: int) -> Message:
        p = self.vehicle.parameters
        return mavlink.MAVLink_param_value_message(
            name.encode(), p[name], p.type(name), len(p), index
        )

    # --------------------------------------------------------------------------- services

    def _request_stream(self, m: Any) -> None:
        self.streams.request_group(m.req_stream_id, m.req_message_rate if m.start_stop else 0)

    def _timesync(self, m: Any) -> None:
        if m.tc1 == 0:
            now = 1000 * self.vehicle.boot_us
            self.outbox.append(mavlink.MAVLink_timesync_message(now, m.ts1))

    def _count_mission(self, m: Any) -> None:
        kind = m.mission_type
        sender = (m.get_srcSystem(), m.get_srcComponent())
        self.outbox.append(mavlink.MAVLink_mission_count_message(*sender, _NO_MISSION, kind))

    def _refuse_mission(self, m: Any) -> None:
        self._answer_mission(m, _UNSUPPORTED)

    def _clear_mission(self, m: Any) -> None:
        self._answer_mission(m, 0)

    def _answer_mission(self, m: Any, result: int) -> None:
        sender = (m.get_srcSystem(), m.get_srcComponent())
        self.outbox.append(mavlink.MAVLink_mission_ack_message(*sender, result, m.mission_type))

    def _set_origin(self, m: Any) -> None:
        if self.vehicle.origin is None:
            self.vehicle.origin = (1e-7 * m.latitude, 1e-7 * m.longitude, 1e-3 * m.altitude)
            for message in (49, 242):
                self.vehicle.broadcast.extend(make(message, self.vehicle))

    # ------------------------------------------------------------------------- navigation

    def _displaced(self, m: Any) -> None:
        autopilot = self.vehicle.autopilot
        moved = codec.body_vector(*m.position_delta)
        dt = 1e-6 * m.time_delta_usec
        autopilot.aid.displaced(autopilot.t, dt, moved, float(m.confidence), autopilot.motion)

    def _odometry(self, m: Any) -> None:
        """Take a pose in the local FRD frame; others are ignored without a word."""
        if m.frame_id != _LOCAL_FRD or m.child_frame_id != _BODY_FRD:
            return
        autopilot = self.vehicle.autopilot
        w, x, y, z = m.q
        v_B = np.array([m.vx, m.vy, m.vz])
        u = np.array([x, y, z])
        v_N = v_B + 2 * np.cross(u, np.cross(u, v_B) + w * v_B)  # by the message's own attitude
        autopilot.aid.placed(
            autopilot.t, codec.world_vector(m.x, m.y, m.z), codec.world_vector(*v_N.tolist())
        )

    def _placed(self, m: Any) -> None:
        autopilot = self.vehicle.autopilot
        if all(math.isfinite(v) for v in (m.x, m.y, m.z)):
            autopilot.aid.placed(autopilot.t, codec.world_vector(m.x, m.y, m.z), None)


def dvl_messages(
    boot_us: int,
    dt: float,
    dp_B: np.ndarray,
    angle_B: np.ndarray,
    confidence: float,
    altitude: float,
) -> list[Message]:
    """VISION_POSITION_DELTA and DISTANCE_SENSOR of a DVL.

    Args:
        boot_us: time of the measurement on the boot clock.
        dt: duration of the displacement (s).
        dp_B: displacement (m).
        angle_B: rotation vector over that time (rad).
        confidence: in per cent.
        altitude: above the bed (m).
    """
    moved, turned = frd_to_flu(dp_B).tolist(), frd_to_flu(angle_B).tolist()
    cm = round(max(0.0, min(655.0, altitude)) * 100)
    return [
        mavlink.MAVLink_vision_position_delta_message(
            boot_us, round(1e6 * dt), turned, moved, confidence
        ),
        mavlink.MAVLink_distance_sensor_message(
            boot_us // 1000 % 2**32, 5, 5000, cm, 1, 0, 25, 255
        ),
    ]
