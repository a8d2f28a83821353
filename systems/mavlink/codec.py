"""Frames and units between ArduPilot (NED world, FRD body, PWM, message units) and this project.

The one place for such conversions, for live messages and logs alike (the bare axis swaps are in
`models/frames.py`); each has its inverse and a round-trip test. NumPy, component first: fields may
be scalars or arrays of any batch shape.

ArduPilot: world N is north, east, down; body is forward, right, down; quaternions w x y z rotate
body to world; yaw is clockwise from north. Here: W is east, north, up; B is forward, left, up.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ...models.frames import frd_to_flu, ned_to_enu, quaternion_to_flu_enu

Field = ArrayLike | float | int | Sequence[float]
Values = np.ndarray | np.float64

G = 9.80665  # standard gravity, as ArduPilot's GRAVITY_MSS (m/s²)
SURFACE_PRESSURE_HPA = 1013.25
ARDUSUB_PASCAL_PER_METRE = 9800.0  # times BARO_SPEC_GRAV: ArduSub's gradient in fresh water

NEUTRAL_US = 1500.0
UINT16_MAX = 65535

MODES = {
    0: "STABILIZE",
    1: "ACRO",
    2: "ALT_HOLD",
    3: "AUTO",
    4: "GUIDED",
    7: "CIRCLE",
    9: "SURFACE",
    16: "POSHOLD",
    19: "MANUAL",
    20: "MOTOR_DETECT",
    21: "SURFTRAK",
}
ARMED_FLAG = 128

MOTOR_FUNCTIONS = range(33, 41)  # SERVOn_FUNCTION of Motor1 … Motor8
FRAME_THRUSTERS = {1: 6, 2: 8}  # of VECTORED and VECTORED_6DOF, by FRAME_CONFIG
PASS_THROUGH_FUNCTIONS = (1, *range(51, 67))  # RCPassThru, RCIN1 … RCIN16
THRUSTER_INPUTS = (1, *range(51, 59))  # those of the pilot's eight axes; beyond are lamps, cameras


def mode_name(custom_mode: int) -> str:
    """Name of an ArduSub mode number."""
    return MODES.get(custom_mode, f"MODE_{custom_mode}")


# frames


def quaternion_to_frd_ned(q_WB: Float[np.ndarray, "4 *batch"]) -> Float[np.ndarray, "4 *batch"]:
    """Attitude FLU-to-ENU (w x y z) as FRD-to-NED."""
    return quaternion_to_flu_enu(q_WB)


def yaw_ned_to_enu(yaw: Field) -> Values:
    """ψ_ENU = π/2 − ψ_NED, wrapped to (−π, π] (its own inverse)."""
    turned = np.pi / 2 - np.asarray(yaw, float)
    return np.pi - np.mod(np.pi - turned, 2 * np.pi)


# messages and DataFlash fields to SI in W and B


def attitude(q1: Field, q2: Field, q3: Field, q4: Field) -> Float[np.ndarray, "4 *batch"]:
    """q_WB from ATTITUDE_QUATERNION or XKQ, normalised; NaN where it is all zero or not finite."""
    fields = _stack(q1, q2, q3, q4)
    q = quaternion_to_flu_enu(np.where(np.isfinite(fields).all(axis=0), fields, 0.0))
    norm = np.linalg.norm(q, axis=0)
    return q / np.where(norm > 0, norm, np.nan)


def attitude_from_euler(
    roll: Field, pitch: Field, yaw: Field, degrees: bool = False
) -> Float[np.ndarray, "4 *batch"]:
    """q_WB from NED roll, pitch, yaw: ATTITUDE (rad) or ATT (degrees)."""
    angles = np.moveaxis(_stack(yaw, pitch, roll), 0, -1)
    q = Rotation.from_euler("ZYX", angles, degrees=degrees).as_quat(scalar_first=True)
    return quaternion_to_flu_enu(np.moveaxis(q, -1, 0))


def euler_from_attitude(
    q_WB: Float[np.ndarray, "4 *batch"], degrees: bool = False
) -> Float[np.ndarray, "3 *batch"]:
    """NED roll, pitch, yaw (rad) of q_WB: inverse of `attitude_from_euler`, yaw in (−π, π]."""
    q = np.moveaxis(quaternion_to_frd_ned(q_WB), 0, -1)
    turned = Rotation.from_quat(q, scalar_first=True)
    angles = turned.as_euler("ZYX", degrees=degrees, suppress_warnings=True)  # nose up or down
    return np.moveaxis(angles, -1, 0)[::-1]


def world_vector(north: Field, east: Field, down: Field) -> Float[np.ndarray, "3 *batch"]:
    """Position (m) or velocity (m/s) in W from NED fields: LOCAL_POSITION_NED, XKF1."""
    return ned_to_enu(_stack(north, east, down))


def body_vector(forward: Field, right: Field, down: Field) -> Float[np.ndarray, "3 *batch"]:
    """Vector in B from FRD fields in SI: rates of ATTITUDE (rad/s), IMU of DataFlash."""
    return frd_to_flu(_stack(forward, right, down))


def imu_angular_rate(xgyro: Field, ygyro: Field, zgyro: Field) -> Float[np.ndarray, "3 *batch"]:
    """ω in B (rad/s) from RAW_IMU or SCALED_IMU fields (mrad/s, FRD)."""
    return body_vector(*map(_untruncated, (xgyro, ygyro, zgyro))) * 1e-3


def imu_specific_force(xacc: Field, yacc: Field, zacc: Field) -> Float[np.ndarray, "3 *batch"]:
    """Specific force in B (m/s²; +9.8 along z at rest, level) from RAW_IMU fields (mg, FRD)."""
    return body_vector(*map(_untruncated, (xacc, yacc, zacc))) * (G * 1e-3)


def _untruncated(field: Field) -> np.ndarray:
    """The middle of the values that an integer field stands for.

    ArduPilot converts to integers by truncation towards zero (`GCS_MAVLINK::send_raw_imu`): in a
    turn the rate is half a mrad/s too small on average, which attitude gains as an error.
    """
    values = np.asarray(field, float)
    return np.asarray(values + np.sign(values) / 2)


def imu_fields(
    omega_B: Float[np.ndarray, "3 *batch"], f_B: Float[np.ndarray, "3 *batch"]
) -> tuple[Float[np.ndarray, "3 *batch"], Float[np.ndarray, "3 *batch"]]:
    """Gyro (mrad/s) and accelerometer (mg) fields of RAW_IMU, not yet truncated to integers."""
    return frd_to_flu(omega_B) * 1e3, frd_to_flu(f_B) * (1e3 / G)


def filter_delay(cutoff_hz: float) -> float:
    """Delay (s) of the autopilot's low-pass on gyro or accelerometer (INS_GYRO_FILTER, in Hz).

    A Butterworth filter of second order has the group delay √2/ω_c at low frequency. A
    cutoff outside 1 to 500 Hz is taken as no filter, with a delay of 0.
    """
    if not 1.0 <= cutoff_hz <= 500.0:
        return 0.0
    return float(np.sqrt(2.0) / (2 * np.pi * cutoff_hz))


def low_pass_delays(parameters: Mapping[str, float]) -> tuple[float, float]:
    """Delays (s) of the autopilot's low-passes on specific force and on body rates."""
    force, rate = (parameters.get(name, 0.0) for name in ("INS_ACCEL_FILTER", "INS_GYRO_FILTER"))
    return filter_delay(force), filter_delay(rate)


def pascal_per_metre(specific_gravity: float = 1.0, density: float | None = None) -> float:
    """Pressure gradient: the autopilot's 9800 · BARO_SPEC_GRAV, or ρ g for a known density."""
    return ARDUSUB_PASCAL_PER_METRE * specific_gravity if density is None else density * G


def depth_from_pressure(
    press_abs: Field,
    surface: float = SURFACE_PRESSURE_HPA,
    gradient: float = ARDUSUB_PASCAL_PER_METRE,
) -> Values:
    """Depth (m, positive down) from absolute pressure (hPa)."""
    return (np.asarray(press_abs, float) - surface) * (100.0 / gradient)


def pressure_from_depth(
    depth: Field,
    surface: float = SURFACE_PRESSURE_HPA,
    gradient: float = ARDUSUB_PASCAL_PER_METRE,
) -> Values:
    """Absolute pressure (hPa) at a depth (m)."""
    return surface + np.asarray(depth, float) * (gradient / 100.0)


def height_from_relative_alt(relative_alt: Field) -> Values:
    """Height z in W (m) from GLOBAL_POSITION_INT.relative_alt (mm)."""
    return np.asarray(relative_alt, float) * 1e-3


def climb_from_vz(vz: Field) -> Values:
    """Vertical velocity, up (m/s), from GLOBAL_POSITION_INT.vz (cm/s, down)."""
    return np.asarray(vz, float) * -1e-2


def volts(millivolts: Field) -> Values:
    """Battery voltage (V) from mV fields; 65535 (unknown) and 0 become NaN."""
    mv = np.asarray(millivolts, float)
    return np.where((mv == UINT16_MAX) | (mv <= 0), np.nan, mv * 1e-3)


def pack_voltage(cells_mv: Float[np.ndarray, "n *batch"]) -> Values:
    """Battery voltage (V) from BATTERY_STATUS.voltages: the sum of the entries in use."""
    known = (cells_mv != UINT16_MAX) & (cells_mv > 0)
    total = np.where(known, cells_mv, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), total * 1e-3, np.nan)


def thruster_pwm(output_us: Field, direction: Field = 1) -> Values:
    """PWM (µs) at which a thruster of direction +1 has the thrust of this one at `output_us`.

    With MOT_n_DIRECTION −1 the thruster is mounted or wired in reverse and the output is mirrored
    about 1500. No pulses (0) means stopped. Its own inverse except for zero.
    """
    us = np.asarray(output_us, float)
    us = np.where(us == 0, NEUTRAL_US, us)
    return NEUTRAL_US + (us - NEUTRAL_US) * np.asarray(direction, float)


def stick(value: Field, trim: float = NEUTRAL_US, span: float = 400.0) -> Values:
    """Pilot's channel in [−1, 1] from PWM (µs)."""
    return (np.asarray(value, float) - trim) / span


# commands to the autopilot


def manual_control_fields(
    surge: float = 0.0,
    sway: float = 0.0,
    heave: float = 0.0,
    roll: float = 0.0,
    pitch: float = 0.0,
    yaw: float = 0.0,
    gain: float = 0.5,
) -> dict[str, int]:
    """MANUAL_CONTROL fields for axis demands in [−1, 1] about B (FLU: + left, up, nose down, ccw).

    x, y, r are ±1000 about 0 and z is 0 … 1000 about 500; the autopilot multiplies all four by the
    pilot gain. s (pitch, nose up) and t (roll, right side down) are plain µs, ±400. Demands beyond
    the range that the gain allows are clipped.

    Raises:
        ValueError: if a demand or the gain is not finite, or the gain is not positive.
    """
    demands = np.array([surge, sway, heave, roll, pitch, yaw], float)
    if not np.isfinite(demands).all() or not (np.isfinite(gain) and gain > 0):
        raise ValueError(f"manual control: demands and gain must be finite, got {demands}, {gain}")
    surge, sway, heave, roll, pitch, yaw = np.clip(demands, -1, 1)

    def full(value: float) -> int:
        return round(float(np.clip(1000 * value / gain, -1000, 1000)))

    return {
        "x": full(surge),
        "y": full(-sway),
        "z": round(500 + 0.5 * full(heave)),
        "r": full(-yaw),
        "s": round(-400 * pitch),
        "t": round(400 * roll),
    }


def manual_control_demand(
    x: Field, y: Field, z: Field, r: Field, s: Field = 0, t: Field = 0, gain: Field = 0.5
) -> Float[np.ndarray, "6 *n"]:
    """Surge, sway, heave, roll, pitch, yaw in [−1, 1] about B from MANUAL_CONTROL fields."""
    ahead, right, up, clockwise, nose_up, right_down, k = _stack(x, y, z, r, s, t, gain)
    return np.stack(
        [
            k * ahead / 1000,
            -k * right / 1000,
            k * (up - 500) / 500,
            right_down / 400,
            -nose_up / 400,
            -k * clockwise / 1000,
        ]
    )


def rc_override_fields(
    demand: Float[np.ndarray, "6"],
    low: Sequence[float] = (1100,) * 6,
    trim: Sequence[float] = (NEUTRAL_US,) * 6,
    high: Sequence[float] = (1900,) * 6,
) -> dict[str, int]:
    """RC_CHANNELS_OVERRIDE fields of demands in [−1, 1] about B (as `manual_control_fields`).

    Channels 1 to 6 are pitch (nose up), roll, throttle, yaw (clockwise), forward, lateral (right);
    `low`, `trim`, `high` are their RCn_MIN, RCn_TRIM, RCn_MAX (µs). Other channels are left as they
    are.

    Raises:
        ValueError: a demand is not finite.
    """
    if not np.isfinite(demand).all():
        raise ValueError(f"overrides: demands must be finite, got {demand}")
    surge, sway, heave, roll, pitch, yaw = np.clip(demand, -1, 1)
    values = (-pitch, roll, heave, -yaw, surge, -sway)
    pulses = [
        middle + value * (top - middle if value > 0 else middle - bottom)
        for value, bottom, middle, top in zip(values, low, trim, high, strict=True)
    ]
    return _channels(pulses)


def rc_override_passthrough(pwm: Float[np.ndarray, " n"]) -> dict[str, int]:
    """RC_CHANNELS_OVERRIDE fields that carry outputs 1 to n, at most 8, each within 1100–1900 µs.

    Raises:
        ValueError: a pulse width is not finite.
    """
    if not np.isfinite(pwm).all():
        raise ValueError(f"pass-through: pulse widths must be finite, got {pwm}")
    return _channels(np.clip(pwm, 1100, 1900))


def _channels(pulses: Iterable[float]) -> dict[str, int]:
    known = dict(enumerate((round(float(p)) for p in pulses), 1))
    return {f"chan{k}_raw": known.get(k, UINT16_MAX) for k in range(1, 9)}


def _stack(*fields: Field) -> np.ndarray:
    return np.stack(np.broadcast_arrays(*(np.asarray(f, float) for f in fields)))
