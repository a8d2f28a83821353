"""MAVLink frames at both ends of a link: the vehicle's ports, and our link with its telemetry.

An input is twenty frames in a row. Both ends go on from input to input, as they do in a dive; now
and then they begin anew.
"""

import struct
import time
from pathlib import Path

from spinndrift.sims.vehicle.autopilot.autopilot import READY
from spinndrift.sims.vehicle.autopilot.navigation import Motion
from spinndrift.sims.vehicle.ports import Ports
from spinndrift.sims.vehicle.vehicle import Vehicle
from spinndrift.systems.mavlink import telemetry
from spinndrift.systems.mavlink.dialect import mavlink
from spinndrift.systems.mavlink.link import Link
from spinndrift.systems.mavlink.transport import Connection

from .harness import Kind
from .mutate import Rng, bytes_spoiled, packed_special, pick

_FRAMES = 20  # of an input
_CHUNK = 256  # bytes that arrive together
_ANEW = 100  # inputs after which both ends begin anew: a vehicle may be made deaf
_TICK = 0.02  # s of the vehicle's time for each input
_KINDS = [kind for kind in mavlink.mavlink_map.values() if hasattr(kind, "unpacker")]
_TAKEN = {
    "HEARTBEAT", "MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE", "COMMAND_LONG", "COMMAND_INT",
    "SET_MODE", "PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET", "REQUEST_DATA_STREAM",
    "TIMESYNC", "MISSION_COUNT", "SET_GPS_GLOBAL_ORIGIN", "VISION_POSITION_DELTA", "ODOMETRY",
    "VISION_POSITION_ESTIMATE", "ATTITUDE", "ATTITUDE_QUATERNION", "RAW_IMU", "SCALED_IMU2",
    "SCALED_PRESSURE", "SCALED_PRESSURE2", "LOCAL_POSITION_NED", "SERVO_OUTPUT_RAW",
    "BATTERY_STATUS", "SYS_STATUS", "NAMED_VALUE_FLOAT", "STATUSTEXT", "PARAM_VALUE",
    "COMMAND_ACK", "SYSTEM_TIME", "DISTANCE_SENSOR",
}  # fmt: skip
_READ = [kind for kind in _KINDS if kind.msgname in _TAKEN]
_COMMANDS = (
    16,
    17,
    21,
    176,
    183,
    185,
    209,
    241,
    246,
    300,
    400,
    401,
    410,
    510,
    511,
    512,
    520,
    42428,
)
_WORDS = (b"FS_PILOT_INPUT", b"SERVO7_FUNCTION", b"SYSID_MYGCS", b"PilotGain", b"\xff\xfe", b"")
_SENDERS = ((255, 190), (1, 1), (1, 197), (255, 1), (2, 1), (0, 0), (1, 0))


def framed(kind, payload: bytes, sequence: int, sender: tuple[int, int] = (255, 190)) -> bytes:
    """A sound packet of MAVLink 2 with any payload."""
    body = bytes(payload).rstrip(b"\0") or b"\0"
    head = bytes([len(body), 0, 0, sequence % 256, *sender]) + kind.id.to_bytes(3, "little")
    crc = mavlink.x25crc(head + body)
    crc.accumulate(bytes([kind.crc_extra]))
    return b"\xfd" + head + body + crc.crc.to_bytes(2, "little")


def _payload(rng: Rng, kind) -> bytes:
    """Fields that are zero, numbers that readers seldom meet, or noise."""
    parts = []
    for name, code in zip(kind.ordered_fieldnames, _codes(kind), strict=True):
        size, chance = struct.calcsize("<" + code), rng.random()
        if code.endswith("s"):
            part = pick(rng, _WORDS) if chance < 0.7 else rng.bytes(size)
        elif (name, code) == ("command", "H"):
            part = struct.pack("<H", pick(rng, _COMMANDS))
        elif chance < 0.3 or name.startswith("target"):
            part = b"\1" * (chance < 0.2)
        elif chance < 0.8:
            single = {"c": "B"}.get(code[-1], code[-1])
            part = b"".join(packed_special(rng, "<" + single) for _ in range(int(code[:-1] or 1)))
        else:
            part = rng.bytes(size)
        parts.append(part[:size].ljust(size, b"\0"))
    return b"".join(parts)


def _codes(kind) -> list[str]:
    """`struct` codes of the fields, each with its count."""
    found, count = [], ""
    for letter in kind.unpacker.format.lstrip("<"):
        if letter.isdigit():
            count += letter
        else:
            found.append(count + letter)
            count = ""
    return found


def _spoil(rng: Rng, folder: Path) -> Path:
    frames = []
    for number in range(_FRAMES):
        kind = pick(rng, _READ if rng.random() < 0.8 else _KINDS)
        frame = framed(kind, _payload(rng, kind), number, pick(rng, _SENDERS))
        frames.append(bytes_spoiled(rng, frame) if rng.random() < 0.3 else frame)
    path = folder / "frames.bin"
    path.write_bytes(b"".join(frames))
    return path


class _Ends:
    """The vehicle's ports and our link."""

    def __init__(self):
        self._vehicle = Vehicle()
        self._ports = Ports(self._vehicle, 2)
        self._link = Link(Connection.parse("udpin:127.0.0.1:0"))  # to which no one sends
        self._t = 0.0
        while self._t < READY:
            self.take(b"")
        self.left = _ANEW

    def close(self) -> None:
        self._link.close()

    def take(self, data: bytes) -> None:
        """Let both ends receive the bytes, and the link what the vehicle sends."""
        for start in range(0, max(len(data), 1), _CHUNK):
            chunk = data[start : start + _CHUNK]
            self._t += _TICK
            self._ports.receive(0, chunk)
            self._vehicle.step(self._t, Motion())
            self._receive(chunk)
            self._receive(b"".join(self._ports.step()[0]))
            self._look()
        self._link.statistics()

    def _look(self) -> None:
        """Read all telemetry, as a driver does in its loop."""
        link = self._link
        for read in (telemetry.attitude, telemetry.imu, telemetry.position, telemetry.battery):
            read(link)
        telemetry.depth(link, {}, 1025.0)
        telemetry.outputs(link, 8)
        telemetry.pilot_gain(link, {})
        telemetry.status(link, time.monotonic())

    def _receive(self, data: bytes) -> None:
        """What the link's thread does with bytes from its transport."""
        for message in self._link._parser.messages(data):
            self._link._take_in(message, time.monotonic())


_ends: list[_Ends] = []


def _read(path: Path) -> None:
    if _ends and _ends[0].left <= 0:
        _ends.pop().close()
    if not _ends:
        _ends.append(_Ends())
    _ends[0].left -= 1
    try:
        _ends[0].take(path.read_bytes())
    except BaseException:
        _ends.pop().close()  # the next input begins with sound ends
        raise


MAVLINK = Kind("mavlink", _spoil, _read, refuses=False)
