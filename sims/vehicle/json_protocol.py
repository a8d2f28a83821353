"""ArduPilot's JSON simulation interface, version of ArduPilot 4.7: its two packets and their order.

The autopilot sends one binary packet of servo outputs for each step of the physics and waits for
the state in answer, a line of JSON (ArduPilot, libraries/SITL/examples/JSON/readme.md). World is
north, east, down from the origin; body is forward, right, down.
"""

import json
import struct
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ...models.frames import frd_to_flu, ned_to_enu
from ...systems.mavlink import codec

_HEAD = struct.Struct("<HHI")
_OUTPUTS = {18458: 16, 29569: 32}
"""Number of outputs by the packet's first two bytes; 32 with SERVO_32_ENABLE."""
_COUNTS = 2**32


class Servos(NamedTuple):
    """A packet of the autopilot.

    Attributes:
        rate: steps per second that it proposes.
        frame: its count since it booted; a packet that it repeats has the same.
        us: pulse widths (µs), 0 for outputs without a signal.
    """

    rate: int
    frame: int
    us: tuple[int, ...]


def servos(data: bytes) -> Servos | None:
    """The packet in a datagram, None if it is another kind."""
    if len(data) < _HEAD.size:
        return None
    magic, rate, frame = _HEAD.unpack_from(data)
    count = _OUTPUTS.get(magic)
    if count is None or len(data) != _HEAD.size + 2 * count:
        return None
    return Servos(rate, frame, struct.unpack_from(f"<{count}H", data, _HEAD.size))


def state_line(
    timestamp: float,
    X_WB: Float[np.ndarray, "7"],
    v_W: Float[np.ndarray, "3"],
    omega_B: Float[np.ndarray, "3"],
    f_B: Float[np.ndarray, "3"],
    battery: tuple[float, float],
) -> bytes:
    """The state as the autopilot reads it: one line, which begins and ends with a line feed.

    Args:
        timestamp: time of the physics (s); it must grow by less than 0.1 s a step.
        X_WB: pose.
        v_W: velocity of Bo in W (m/s).
        omega_B: angular velocity (rad/s).
        f_B: specific force (m/s²), +9.8 along z at rest.
        battery: voltage under load (V) and current (A).
    """
    volts, amps = battery
    state = {
        "timestamp": timestamp,
        "imu": {"gyro": frd_to_flu(omega_B).tolist(), "accel_body": frd_to_flu(f_B).tolist()},
        "position": ned_to_enu(X_WB[4:]).tolist(),
        "quaternion": codec.quaternion_to_frd_ned(X_WB[:4]).tolist(),
        "velocity": ned_to_enu(v_W).tolist(),
        "battery": {"voltage": volts, "current": amps},
    }
    return f"\n{json.dumps(state, allow_nan=False)}\n".encode()


Turn = Literal["first", "next", "repeated", "restarted"]


class Frames:
    """What a packet's count says about its place in the sequence.

    An autopilot that gets no answer repeats its packet, with the same count. One that boots anew
    counts from zero.
    """

    def __init__(self):
        self.missed = 0
        self._last: int | None = None

    def turn(self, frame: int) -> Turn:
        """The place of a packet with this count."""
        last, self._last = self._last, frame
        if last is None:
            return "first"
        ahead = (frame - last) % _COUNTS
        if ahead == 0:
            return "repeated"
        if ahead >= _COUNTS // 2:
            return "restarted"
        self.missed += ahead - 1
        return "next"
