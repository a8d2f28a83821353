"""A case as a telemetry log (.tlog): one dive of an ArduSub, MAVLink 2 packed by hand.

Message numbers, fields and CRC_EXTRA: MAVLink's common.xml and ardupilotmega.xml. The runs of a
case are the armed stretches of the dive, each in a mode of its own; between them the link is silent
but for the heartbeat of a disarmed vehicle.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .rotations import to_world
from .scenarios import pulses
from .simulator import Truth, streams
from .vehicle import GRAVITY, WATER

EPOCH = 1_700_000_000.0  # s, when the vehicle booted
BOOT = 60.0  # s from boot to the first stretch
GAP = 6.0  # s between stretches
LATE = 0.004  # s from the vehicle to the recorder
MODES = (19, 0, 2, 16)  # MANUAL, STABILIZE, ALT_HOLD, POSHOLD
SURFACE = 101_325.0  # Pa
_EXTRA = {0: 50, 22: 220, 30: 39, 32: 185, 36: 222, 137: 195, 147: 154, 193: 71}


@dataclass(frozen=True)
class Streams:
    """Samples from message to message: attitude and rates, position and velocity, outputs."""

    attitude: int = 4
    position: int = 8
    outputs: int = 8

    @staticmethod
    def draw(seed: int) -> "Streams":
        """Of 200 samples a second: 25 or 50, 10 or 25, and 10 to 50 Hz."""
        rng = streams(seed, 8)
        return Streams(*(int(rng.choice(of)) for of in ((4, 8), (8, 20), (4, 8, 20))))


class Log:
    """Packets with the time (s since boot) at which the recorder got them."""

    def __init__(self):
        self.records: list[tuple[float, bytes]] = []
        self.count = 0

    def send(self, t: float, number: int, form: str, *values) -> None:
        """One message; `form` has the fields in the order of the wire."""
        payload = struct.pack("<" + form, *values).rstrip(b"\0") or b"\0"
        head = struct.pack("<BBBBBB", len(payload), 0, 0, self.count % 256, 1, 1)
        body = head + number.to_bytes(3, "little") + payload
        self.count += 1
        check = crc(body + bytes([_EXTRA[number]]))
        self.records.append((t + LATE, b"\xfd" + body + struct.pack("<H", check)))

    def write(self, path: Path) -> None:
        """In the order of time, each behind its stamp."""
        ordered = sorted(self.records, key=lambda record: record[0])
        stamps = (struct.pack(">Q", round((EPOCH + t) * 1e6)) + packet for t, packet in ordered)
        path.write_bytes(b"".join(stamps))


def crc(data: bytes) -> int:
    """CRC-16/MCRF4XX, as MAVLink has it."""
    c = 0xFFFF
    for byte in data:
        t = (byte ^ c) & 0xFF
        t ^= (t << 4) & 0xFF
        c = (c >> 8) ^ (t << 8) ^ (t << 3) ^ (t >> 4)
    return c


def write_tlog(path: Path, truth: Truth, sent: Streams, rate_filter: float) -> None:
    """Write all runs of a simulation as the stretches of one dive; outputs are whole µs."""
    log = Log()
    _parameters(log, rate_filter)
    begin = BOOT
    for b in range(truth.t.shape[1]):
        t = begin + truth.t[:, b]
        pose, twist = truth.X[:, :, b], truth.V[:, :, b]
        pwm = pulses(truth.forces[:, :, b : b + 1], truth.voltage[b : b + 1])[..., 0]
        _heartbeat(log, begin - 2.0, False, MODES[b % 4])
        _stretch(log, t, pose, twist, pwm, float(truth.voltage[b]), sent)
        for second in np.arange(begin, t[-1], 1.0):
            _heartbeat(log, second, True, MODES[b % 4])
        _heartbeat(log, t[-1] + 0.01, False, MODES[b % 4])
        begin = float(np.ceil(t[-1] + GAP))
    path.parent.mkdir(parents=True, exist_ok=True)
    log.write(path)


def _parameters(log: Log, rate_filter: float) -> None:
    told = {f"SERVO{n}_FUNCTION": 32.0 + n for n in range(1, 9)}
    told |= {f"MOT_{n}_DIRECTION": 1.0 for n in range(1, 9)}
    told |= {"FRAME_CONFIG": 2.0, "INS_GYRO_FILTER": rate_filter}
    told |= {"BARO_SPEC_GRAV": WATER / 1000, "BARO2_GND_PRESS": SURFACE}
    for i, (name, number) in enumerate(told.items()):
        fields = (number, len(told), i, name.encode().ljust(16, b"\0"), 9)
        log.send(1.0 + 0.01 * i, 22, "fHH16sB", *fields)


def _heartbeat(log: Log, t: float, armed: bool, mode: int) -> None:
    log.send(t, 0, "IBBBBB", mode, 12, 3, 81 + 128 * armed, 4, 3)  # a submarine, of ArduPilot


def _stretch(
    log: Log,
    t: np.ndarray,
    pose: np.ndarray,
    twist: np.ndarray,
    pwm: np.ndarray,
    volts: float,
    sent: Streams,
) -> None:
    q, p = pose[:, :4].T, pose[:, 4:].T
    v = to_world(q, twist[:, :3].T)
    ned = [np.stack([a[1], a[0], -a[2]]) for a in (p, v)]
    roll, pitch, yaw = _angles(q)
    p_, q_, r_ = twist[:, 3:].T
    for n in range(0, len(t), sent.attitude):
        fields = (roll[n], pitch[n], yaw[n], p_[n], -q_[n], -r_[n])
        log.send(t[n], 30, "I6f", round(t[n] * 1e3), *fields)
    for n in range(0, len(t), sent.position):
        fields = (*ned[0][:, n], *ned[1][:, n])
        log.send(t[n], 32, "I6f", round(t[n] * 1e3), *fields)
        pressure = SURFACE + WATER * GRAVITY * ned[0][2, n]
        log.send(t[n], 137, "Iffh", round(t[n] * 1e3), pressure / 100, 0.0, 1000)
    for n in range(0, len(t), sent.outputs):
        us = [int(x) for x in pwm[n]]
        log.send(t[n], 36, "I8HB8H", round(t[n] * 1e6) % 2**32, *us, 0, *[0] * 8)
    for second in np.arange(t[0], t[-1], 0.5):
        cells = (round(volts * 1e3), *[65535] * 9)
        log.send(second, 147, "iih10HhBBBb", 0, 0, 32767, *cells, 0, 0, 0, 0, 50)
        log.send(second, 193, "5fH", 0, 0, 0, 0, 0, 831)


def _angles(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Roll, pitch and yaw of FRD in NED, of quaternions from FLU to ENU."""
    forward, left, up = (
        to_world(q, np.eye(3)[:, i : i + 1] + np.zeros((3, q.shape[1]))) for i in range(3)
    )
    yaw = np.arctan2(forward[0], forward[1])  # from north to east
    pitch = np.arcsin(np.clip(forward[2], -1, 1))
    roll = np.arctan2(left[2], up[2])
    return roll, pitch, yaw
