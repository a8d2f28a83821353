"""The vehicle's newest telemetry in SI, in W and B, with its times.

Each function reads the link's newest message of a kind; None before the first. Conversions are
those of `codec`.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from . import codec
from .commands import is_armed, mode_of
from .dialect import mavlink
from .link import Link, Received

LEAK = "leak"
_LEAK_SPOKEN = 10.0  # s: the vehicle repeats the warning while it is wet
_CRITICAL = 5  # MAV_STATE: some failsafe is on, or there has been no pilot input
_PRESSURES = ("SCALED_PRESSURE2", "SCALED_PRESSURE3")
"""Of sensors in the water; SCALED_PRESSURE is that of the air in the hull."""
_DOWN = mavlink.MAV_SENSOR_ROTATION_PITCH_270
_BODY_FRAMES = (mavlink.MAV_FRAME_BODY_FRD, mavlink.MAV_FRAME_LOCAL_FRD)
_LATE, _APART = 1.0, 0.05  # s between a time on the vehicle's clock and the arrival
STREAMS = {
    "HEARTBEAT": 5.0,
    "ATTITUDE_QUATERNION": 50.0,
    "SCALED_PRESSURE2": 25.0,  # above the sensor's own rate: a change tells when it measured
    "SERVO_OUTPUT_RAW": 20.0,
    "LOCAL_POSITION_NED": 10.0,
    "BATTERY_STATUS": 2.0,
    "SYS_STATUS": 2.0,
    "EKF_STATUS_REPORT": 2.0,
}
"""Rates that are asked for (Hz)."""
IMUS = ("RAW_IMU", "SCALED_IMU2", "SCALED_IMU")
"""Messages with inertial samples, the preferred first."""


class Reading(NamedTuple):
    """A value and when it was taken, on the local monotonic clock (s)."""

    value: Float[np.ndarray, " n"]
    taken: float
    arrival: float


def _reading(link: Link, found: Received, value: np.ndarray) -> Reading:
    taken = None if found.boot is None else link.clock.local(found.boot)
    # the clocks' offset is known to some milliseconds: nothing is taken after it arrived
    return Reading(
        value, found.arrival if taken is None else min(taken, found.arrival), found.arrival
    )


def attitude(link: Link) -> Reading | None:
    """q_WB (w x y z) from ATTITUDE_QUATERNION, else from ATTITUDE."""
    found = link.latest("ATTITUDE_QUATERNION")
    if found is not None:
        m = found.message
        return _reading(link, found, codec.attitude(m.q1, m.q2, m.q3, m.q4))
    found = link.latest("ATTITUDE")
    if found is None:
        return None
    m = found.message
    return _reading(link, found, codec.attitude_from_euler(m.roll, m.pitch, m.yaw))


def turn_rate(link: Link) -> Reading | None:
    """Angular rate in B (rad/s), with the attitude."""
    for name in ("ATTITUDE_QUATERNION", "ATTITUDE"):
        found = link.latest(name)
        if found is not None:
            m = found.message
            return _reading(link, found, codec.body_vector(m.rollspeed, m.pitchspeed, m.yawspeed))
    return None


def heading(link: Link) -> Reading | None:
    """Yaw of B in W (rad), counter-clockwise from the x axis (east)."""
    found = attitude(link)
    if found is None:
        return None
    yaw = codec.yaw_ned_to_enu(codec.euler_from_attitude(found.value)[2])
    return found._replace(value=np.array([float(yaw)]))


def imu(link: Link, streams: Sequence[str] = IMUS) -> Reading | None:
    """Specific force (m/s²) and angular rate (rad/s) in B, from the first stream that comes."""
    for name in streams:
        found = link.latest(name)
        if found is not None:
            return inertial(link, found)
    return None


def inertial(link: Link, found: Received) -> Reading:
    """The reading of a message of `IMUS`, as `imu`."""
    m = found.message
    force = codec.imu_specific_force(m.xacc, m.yacc, m.zacc)
    rate = codec.imu_angular_rate(m.xgyro, m.ygyro, m.zgyro)
    return _reading(link, found, np.concatenate([force, rate]))


def dvl(link: Link, parameters: Mapping[str, float]) -> Reading | None:
    """Velocity of the DVL over the bed (m/s), 1 if valid, altitude (m, NaN if unknown).

    From VISION_POSITION_DELTA, which a DVL's driver sends to the autopilot, else from ODOMETRY; the
    velocity is in the axes of B at the DVL. Drivers send the velocity of the stamp times the
    interval, as which the autopilot takes it. The altitude is that of a DISTANCE_SENSOR that looks
    down. A time that is not the vehicle's counts as arrival less the autopilot's VISO_DELAY_MS.
    """
    found = link.latest("VISION_POSITION_DELTA")
    if found is not None:
        m = found.message
        dt = m.time_delta_usec * 1e-6
        valid = dt > 0 and m.confidence > 0
        v = codec.body_vector(*m.position_delta) / (dt if valid else 1.0)
    else:
        found = link.latest("ODOMETRY")
        if found is None or found.message.child_frame_id not in _BODY_FRAMES:
            return None
        m = found.message
        v, valid = codec.body_vector(m.vx, m.vy, m.vz), m.quality >= 0
    valid = valid and bool(np.isfinite(v).all())
    taken = None if found.boot is None else link.clock.local(found.boot)
    if taken is None or not found.arrival - _LATE <= taken <= found.arrival + _APART:
        taken = found.arrival - parameters.get("VISO_DELAY_MS", 10.0) * 1e-3
    value = np.array([*(v if valid else np.zeros(3)), float(valid), _altitude(link)])
    return Reading(value, min(taken, found.arrival), found.arrival)


def _altitude(link: Link) -> float:
    found = link.latest("DISTANCE_SENSOR")
    if found is None or found.message.orientation != _DOWN:
        return float("nan")
    m = found.message
    inside = m.min_distance < m.current_distance < m.max_distance
    return m.current_distance * 1e-2 if inside else float("nan")


def depth(link: Link, parameters: Mapping[str, float], density: float) -> Reading | None:
    """Depth of the pressure sensor (m), positive down, in water of `density` (kg/m³).

    The pressure at the surface is the one that the autopilot measured on the ground
    (BAROn_GND_PRESS, GND_ABS_PRESSn until ArduSub 4.0).
    """
    name = depth_message(link)
    found = link.latest(name)
    if found is None:
        return None
    number = name.removeprefix("SCALED_PRESSURE")
    before = parameters.get(f"GND_ABS_PRESS{number}", 0.0)
    ground = parameters.get(f"BARO{number}_GND_PRESS", before) / 100
    surface = ground if ground > 0 else codec.SURFACE_PRESSURE_HPA
    gradient = codec.pascal_per_metre(density=density)
    value = codec.depth_from_pressure(found.message.press_abs, surface, gradient)
    return _reading(link, found, np.array([float(value)]))


def depth_message(link: Link) -> str:
    """The message that `depth` reads."""
    return next((name for name in _PRESSURES if link.latest(name) is not None), _PRESSURES[0])


def position(link: Link) -> Reading | None:
    """p_WBo and its rate in W (m, m/s) from LOCAL_POSITION_NED, about the autopilot's origin."""
    found = link.latest("LOCAL_POSITION_NED")
    if found is None:
        return None
    m = found.message
    p, v = codec.world_vector(m.x, m.y, m.z), codec.world_vector(m.vx, m.vy, m.vz)
    return _reading(link, found, np.concatenate([p, v]))


def outputs(link: Link, count: int) -> Reading | None:
    """Pulse widths (µs) of outputs 1 to `count` from SERVO_OUTPUT_RAW."""
    found = link.latest("SERVO_OUTPUT_RAW")
    if found is None:
        return None
    values = [float(getattr(found.message, f"servo{n}_raw")) for n in range(1, count + 1)]
    return _reading(link, found, np.array(values))


def battery(link: Link) -> float:
    """Voltage of the first battery under load (V), NaN if unknown."""
    found = link.latest("BATTERY_STATUS/0")
    if found is not None:
        volts = float(codec.pack_voltage(np.array(found.message.voltages, float)))
        if np.isfinite(volts):
            return volts
    found = link.latest("SYS_STATUS")
    return float("nan") if found is None else float(codec.volts(found.message.voltage_battery))


def pilot_gain(link: Link, parameters: Mapping[str, float]) -> float:
    """The gain of MANUAL_CONTROL: as the vehicle tells it, else JS_GAIN_DEFAULT."""
    found = link.latest("NAMED_VALUE_FLOAT/PilotGain")
    if found is not None and found.message.value > 0:
        return float(found.message.value)
    return float(parameters.get("JS_GAIN_DEFAULT", 0.5))


class Sensed(NamedTuple):
    """The newest readings; None before the first of a kind."""

    imu: Reading | None
    heading: Reading | None
    depth: Reading | None
    attitude: Reading | None
    position: Reading | None
    outputs: Reading | None
    voltage: float


def sensed(link: Link, parameters: Mapping[str, float], density: float, thrusters: int) -> Sensed:
    """The newest readings of a vehicle with that many thrusters; does not wait."""
    return Sensed(
        imu(link),
        heading(link),
        depth(link, parameters, density),
        attitude(link),
        position(link),
        outputs(link, thrusters),
        battery(link),
    )


class Status(NamedTuple):
    """What the vehicle's heartbeat and texts say."""

    armed: bool
    mode: str
    critical: bool
    """A failsafe is on; also before the first command of a pilot."""
    leak: bool
    age: float
    """Of the heartbeat (s)."""


def status(link: Link, now: float) -> Status | None:
    """The newest status at a local time (s)."""
    found = link.latest("HEARTBEAT")
    if found is None:
        return None
    m = found.message
    spoken = [text.lower() for _, _, text in link.texts(now - _LEAK_SPOKEN)]
    return Status(
        is_armed(m),
        codec.mode_name(mode_of(m)),
        m.system_status == _CRITICAL,
        any(LEAK in text for text in spoken),
        now - found.arrival,
    )
