"""The messages of the vehicle, each made from its state when it is due."""

import math
from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from ....models.frames import frd_to_flu
from ....systems.mavlink import codec
from ....systems.mavlink.dialect import Message, mavlink
from ..autopilot.autopilot import ALIGNED, READY, Autopilot
from ..autopilot.navigation import Motion, rotated

Place = tuple[float, float, float]


@runtime_checkable
class State(Protocol):
    """What the messages are made of."""

    autopilot: Autopilot
    origin: Place | None
    frozen_alt: float
    serial_number: bytes

    @property
    def motion(self) -> Motion: ...

    @property
    def boot_us(self) -> int: ...


_SENSORS_PRESENT = 321977487  # as an ArduSub 4.5.6 in simulation sends them
_SENSORS_ENABLED, _SENSORS_ENABLED_ARMED = 304127119, 320928911
_SENSORS_BOOTING, _SENSORS_ALIGNED, _SENSORS_HEALTHY = 51420175, 319855759, 321977487
_EKF_FLAGS = {"none": 1024, "aligning": 0, "unaided": 167, "aided": 303}
_FIELD_NED = (241.0, 0.0, 393.0)  # mGauss
_AIR_CDEG, _WATER_CDEG = 2500, 1500
_HULL_HPA = 1010.0
_EARTH = 6378100.0  # m
_UNKNOWN = 65535
_VERSION = 4 << 24 | 5 << 16 | 6 << 8 | 255
_CAPABILITIES = 1 | 2 | 4 | 8 | 2048 | 8192  # missions, parameters, COMMAND_INT, MAVLink 2


def _built(kind: Callable[..., Message], *fields) -> Message:
    """A message of a type whose fields come from sequences."""
    return kind(*fields)


def _whole(value: float, bits: int = 16) -> int:
    """The nearest whole number of a signed field, at its limit beyond."""
    most = 2 ** (bits - 1) - 1
    return round(max(-most, min(most, value)))


def _ms(s: State) -> int:
    return s.boot_us // 1000 % 2**32


def _motion_us(s: State) -> int:
    """Boot clock (µs) at the time of `motion`, at most one step of the physics ago."""
    return max(0, s.boot_us - round(1e6 * s.motion.age))


def _motion_ms(s: State) -> int:
    return _motion_us(s) // 1000 % 2**32


def heartbeat(s: State) -> Message:
    """HEARTBEAT: type, mode, armed and state."""
    a = s.autopilot
    base = 81 | (codec.ARMED_FLAG if a.armed else 0)
    return mavlink.MAVLink_heartbeat_message(12, 3, base, a.mode, a.status, 3)


def _sys_status(s: State) -> Message:
    a, m = s.autopilot, s.motion
    enabled = _SENSORS_ENABLED_ARMED if a.armed else _SENSORS_ENABLED
    health = _SENSORS_HEALTHY if a.aid.valid(a.t) else _SENSORS_ALIGNED
    health = health if a.t >= ALIGNED else _SENSORS_BOOTING
    millivolts, centiamps = _whole(1e3 * m.voltage), _whole(1e2 * m.current)
    return mavlink.MAVLink_sys_status_message(
        _SENSORS_PRESENT, enabled, health, 200, millivolts, centiamps, 80, 0, 0, 0, 0, 0, 0
    )


def _system_time(s: State) -> Message:
    return mavlink.MAVLink_system_time_message(0, _ms(s))


def _gps_raw(s: State) -> Message:
    del s
    return mavlink.MAVLink_gps_raw_int_message(0, 0, 0, 0, 0, _UNKNOWN, _UNKNOWN, 0, 0, 0)


def _imu_fields(s: State) -> list[int]:
    """Accelerometer, gyroscope and magnetic field, truncated as by an autopilot."""
    m = s.motion
    gyro, accelerometer = codec.imu_fields(m.omega_B, m.f_B)
    inverse = codec.quaternion_to_frd_ned(m.q_WB) * [1, -1, -1, -1]
    field = rotated(inverse, np.array(_FIELD_NED))
    values = [*accelerometer, *gyro, *field]
    return [_whole(math.trunc(v)) for v in values]


def _raw_imu(s: State) -> Message:
    return _built(mavlink.MAVLink_raw_imu_message, _motion_us(s), *_imu_fields(s), 0, _AIR_CDEG)


def _scaled_imu(kind: Callable[..., Message]) -> Callable[[State], Message]:
    return lambda s: kind(_motion_ms(s), *_imu_fields(s), _AIR_CDEG)


def _scaled_imu3(s: State) -> Message:
    field = _imu_fields(s)[6:]
    zero = [0] * 6
    return _built(mavlink.MAVLink_scaled_imu3_message, _ms(s), *zero, *field, 0)


def _hull_pressure(s: State) -> Message:
    return mavlink.MAVLink_scaled_pressure_message(_ms(s), _HULL_HPA, 0.0, _AIR_CDEG)


def _water_pressure(s: State) -> Message:
    hpa = codec.SURFACE_PRESSURE_HPA + s.motion.pressure / 100
    return mavlink.MAVLink_scaled_pressure2_message(_ms(s), hpa, 0.0, _WATER_CDEG)


def _third_pressure(s: State) -> Message:
    return mavlink.MAVLink_scaled_pressure3_message(_ms(s), 0.0, 0.0, _WATER_CDEG)


def _euler(s: State) -> tuple[float, float, float]:
    roll, pitch, yaw = codec.euler_from_attitude(s.motion.q_WB)
    return float(roll), float(pitch), float(yaw)


def _rates(s: State) -> list[float]:
    return [float(v) for v in frd_to_flu(s.motion.omega_B)]


def _attitude(s: State) -> Message:
    return mavlink.MAVLink_attitude_message(_motion_ms(s), *_euler(s), *_rates(s))


def _attitude_quaternion(s: State) -> Message:
    q = [float(v) for v in codec.quaternion_to_frd_ned(s.motion.q_WB)]
    if q[0] < 0:
        q = [-v for v in q]
    return _built(mavlink.MAVLink_attitude_quaternion_message, _motion_ms(s), *q, *_rates(s))


def _north_east(s: State) -> tuple[float, float, float, float]:
    """Horizontal position and velocity."""
    (east, north), (v_east, v_north) = s.autopilot.aid.p_W, s.autopilot.aid.v_W
    return float(north), float(east), float(v_north), float(v_east)


def _local_position(s: State) -> Message | None:
    """LOCAL_POSITION_NED, which is not sent without a horizontal position."""
    if not s.autopilot.aid.valid(s.autopilot.t):
        return None
    north, east, v_north, v_east = _north_east(s)
    down, v_down = -s.motion.height, -s.motion.climb
    return mavlink.MAVLink_local_position_ned_message(
        _ms(s), north, east, down, v_north, v_east, v_down
    )


def _global_position(s: State) -> Message:
    """GLOBAL_POSITION_INT: relative_alt follows the depth, alt only with a horizontal position."""
    aided = s.autopilot.aid.valid(s.autopilot.t)
    north, east, v_north, v_east = _north_east(s) if aided else (0.0, 0.0, 0.0, 0.0)
    latitude = longitude = 0.0
    if s.origin is not None:
        latitude = s.origin[0] + math.degrees(north / _EARTH)
        longitude = s.origin[1] + math.degrees(
            east / (_EARTH * max(math.cos(math.radians(s.origin[0])), 1e-6))
        )
    return mavlink.MAVLink_global_position_int_message(
        _ms(s),
        _whole(1e7 * latitude, 32),
        _whole(1e7 * longitude, 32),
        _whole(1e3 * s.frozen_alt, 32),
        _whole(1e3 * s.motion.height, 32),
        _whole(1e2 * v_north),
        _whole(1e2 * v_east),
        _whole(-1e2 * s.motion.climb),
        round(100 * (math.degrees(_euler(s)[2]) % 360)) % 36000,
    )


def _servo_outputs(s: State) -> Message:
    us = [v & 0xFFFF for v in s.autopilot.outputs.us]
    return _built(mavlink.MAVLink_servo_output_raw_message, s.boot_us % 2**32, 0, *us)


def _rc_channels(s: State) -> Message:
    us = s.autopilot.channels.us
    return _built(mavlink.MAVLink_rc_channels_message, _ms(s), len(us), *us, 0, 0, 255)


def _mission_current(s: State) -> Message:
    del s
    return mavlink.MAVLink_mission_current_message(0, 0, 1, 0)


def _origin(s: State) -> Message | None:
    if s.origin is None:
        return None
    return mavlink.MAVLink_gps_global_origin_message(*_e7(s.origin), s.boot_us)


def _home(s: State) -> Message | None:
    if s.origin is None:
        return None
    nan = [math.nan] * 4
    return mavlink.MAVLink_home_position_message(
        *_e7(s.origin), 0.0, 0.0, 0.0, nan, 0.0, 0.0, 0.0, s.boot_us
    )


def _e7(place: Place) -> tuple[int, int, int]:
    return _whole(1e7 * place[0], 32), _whole(1e7 * place[1], 32), _whole(1e3 * place[2], 32)


def _navigation(s: State) -> Message:
    roll, pitch, yaw = (math.degrees(v) for v in _euler(s))
    heading = round(yaw % 360)
    return mavlink.MAVLink_nav_controller_output_message(roll, pitch, heading, 0, 0, 0.0, 0.0, 0.0)


def _vfr_hud(s: State) -> Message:
    a = s.autopilot
    speed = math.hypot(*a.aid.v_W.tolist()) if a.aid.valid(a.t) else 0.0
    throttle = round(50 * (1 + a.channels.throttle(a.parameters))) if a.armed else 0
    heading = int(math.degrees(_euler(s)[2]) % 360)
    return mavlink.MAVLink_vfr_hud_message(
        0.0, speed, heading, throttle, s.frozen_alt, s.motion.climb
    )


def _power(s: State) -> Message:
    del s
    return mavlink.MAVLink_power_status_message(5000, 0, 0)


def _battery(s: State) -> Message:
    cells = [_whole(1e3 * s.motion.voltage), *[_UNKNOWN] * 9]
    current = _whole(1e2 * s.motion.current)
    return mavlink.MAVLink_battery_status_message(0, 0, 0, 32767, cells, current, 0, 0, 80, 0, 1)


def _version(s: State) -> Message:
    zero, number = [0] * 8, [*s.serial_number, 0, 0]
    return mavlink.MAVLink_autopilot_version_message(
        _CAPABILITIES, _VERSION, 0, 0, 0, zero, zero, zero, 0, 0, 0, number
    )


def _memory(s: State) -> Message:
    del s
    return mavlink.MAVLink_meminfo_message(0, _UNKNOWN, 131072)


def _ahrs(s: State) -> Message:
    del s
    return mavlink.MAVLink_ahrs_message(0.0, 0.0, 0.0, 0.0, 0.0, 0.001, 0.004)


def _ahrs2(s: State) -> Message:
    return mavlink.MAVLink_ahrs2_message(*_euler(s), s.motion.height, 0, 0)


def _ekf(s: State) -> Message:
    a = s.autopilot
    if a.t < ALIGNED:
        kind = "none" if a.t < READY + 2.0 else "aligning"
    else:
        kind = "aided" if a.aid.valid(a.t) else "unaided"
    return mavlink.MAVLink_ekf_status_report_message(
        _EKF_FLAGS[kind], 0.0, 1e-4, 0.02, 0.005, 0.0, 0.0
    )


def _vibration(s: State) -> Message:
    return mavlink.MAVLink_vibration_message(s.boot_us, 0.003, 0.003, 0.003, 0, 0, 0)


def _named_values(s: State) -> list[Message]:
    pilot = s.autopilot.pilot
    values = {
        "CamTilt": 0.5,
        "CamPan": 0.5,
        "TetherTrn": 0.0,
        "Lights1": 0.0,
        "Lights2": 0.0,
        "PilotGain": pilot.gain,
        "InputHold": float(pilot.holding),
        "RollPitch": float(pilot.roll_pitch),
        "RFTarget": -0.01,
    }
    ms = _ms(s)
    return [
        mavlink.MAVLink_named_value_float_message(ms, name.encode(), value)
        for name, value in values.items()
    ]


_MAKERS: dict[int, Callable[[State], Message | list[Message] | None]] = {
    0: heartbeat,
    1: _sys_status,
    2: _system_time,
    24: _gps_raw,
    26: _scaled_imu(mavlink.MAVLink_scaled_imu_message),
    27: _raw_imu,
    29: _hull_pressure,
    30: _attitude,
    31: _attitude_quaternion,
    32: _local_position,
    33: _global_position,
    36: _servo_outputs,
    42: _mission_current,
    49: _origin,
    62: _navigation,
    65: _rc_channels,
    74: _vfr_hud,
    116: _scaled_imu(mavlink.MAVLink_scaled_imu2_message),
    125: _power,
    129: _scaled_imu3,
    137: _water_pressure,
    143: _third_pressure,
    147: _battery,
    148: _version,
    152: _memory,
    163: _ahrs,
    178: _ahrs2,
    193: _ekf,
    241: _vibration,
    242: _home,
    251: _named_values,
}

KNOWN = frozenset(_MAKERS)
"""Messages that can be asked for."""


def make(message: int, state: State) -> Sequence[Message]:
    """The messages of a known id now: usually one, none where the vehicle has nothing to say."""
    made = _MAKERS[message](state)
    if made is None:
        return ()
    return made if isinstance(made, list) else (made,)
