"""Messages that are read, and the numbers taken from each."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

Quantity = Literal[
    "attitude",
    "position",
    "velocity",
    "rates",
    "acceleration",
    "depth",
    "height",
    "voltage",
    "pwm",
    "forces",
    "wrench",
    "rc",
    "state",
    "aiding",
    "parameters",
]
COMMANDS: tuple[Quantity, ...] = ("pwm", "forces", "wrench")
"""Quantities that say what drives the vehicle, the most direct one first."""


@dataclass(frozen=True)
class Form:
    """One type of message.

    Attributes:
        numbers: the numbers taken from a message, always as many or as long as its array.
        gives: quantities it may hold, and which of the numbers they are.
        text: a word taken from a message.
    """

    numbers: Callable[[Any], Any]
    gives: Mapping[Quantity, slice]
    text: Callable[[Any], str] = field(default=lambda message: "")


_ALL = slice(None)
_NAN3, _NAN4 = (np.nan,) * 3, (np.nan,) * 4


def _xyz(v: Any) -> tuple[float, ...]:
    return v.x, v.y, v.z


def _pose(pose: Any) -> tuple[float, ...]:
    q = pose.orientation
    return q.w, q.x, q.y, q.z, *_xyz(pose.position)


def _two(pair: Any, names: tuple[str, str]) -> tuple[float, ...]:
    return *_xyz(getattr(pair, names[0])), *_xyz(getattr(pair, names[1]))


def _vector(get: Callable[[Any], Any], *gives: Quantity) -> Form:
    """Form of a message with one vector, which may be any of some quantities."""
    return Form(lambda m: _xyz(get(m)), dict.fromkeys(gives, slice(0, 3)))


def _twist(twist: Any) -> tuple[float, ...]:
    return _two(twist, ("linear", "angular"))


def _wrench(wrench: Any) -> tuple[float, ...]:
    return _two(wrench, ("force", "torque"))


def _imu(m: Any) -> tuple[float, ...]:
    """By sensor_msgs/Imu a covariance that begins with −1 says that there is no measurement."""
    q = m.orientation
    parts = (
        (m.orientation_covariance, (q.w, q.x, q.y, q.z), _NAN4),
        (m.angular_velocity_covariance, _xyz(m.angular_velocity), _NAN3),
        (m.linear_acceleration_covariance, _xyz(m.linear_acceleration), _NAN3),
    )
    return tuple(x for cov, there, absent in parts for x in (absent if cov[0] == -1 else there))


def _parameter(m: Any) -> tuple[float]:
    value = m.value
    return (float(value.integer) if value.integer else float(value.real),)


def _parameter_event(m: Any) -> tuple[float]:
    value = m.value  # rcl_interfaces: type 1 bool, 2 integer, 3 double
    numbers = {1: value.bool_value, 2: value.integer_value, 3: value.double_value}
    return (float(numbers.get(value.type, np.nan)),)


def _manual(m: Any) -> tuple[float, ...]:
    """Stick as ArduSub's channels 1 to 8 at full pilot gain: roll and pitch are not in it."""
    span = 0.4
    forward, lateral, yaw = (1500 + span * x for x in (m.x, m.y, m.r))
    return 1500, 1500, 1500 + 2 * span * (m.z - 500), yaw, forward, lateral, 1500, 1500


def _channels(m: Any) -> Any:
    values = np.asarray(m.channels, float)[:8]
    return np.pad(np.where(values == 65535, 0, values), (0, 8 - values.size))


def _aided(m: Any) -> tuple[float]:
    """As the bits of EKF_STATUS_REPORT: velocity and position horizontal, no constant position."""
    position = m.pos_horiz_rel_status_flag or m.pos_horiz_abs_status_flag
    return (float(m.velocity_horiz_status_flag and position and not m.const_pos_mode_status_flag),)


_POSE: Mapping[Quantity, slice] = {
    "attitude": slice(0, 4),
    "position": slice(4, 7),
    "height": slice(6, 7),
}
_TWIST: Mapping[Quantity, slice] = {"velocity": slice(0, 3), "rates": slice(3, 6)}
_VECTORS: tuple[Quantity, ...] = ("velocity", "rates", "acceleration")
_NUMBER = Form(
    lambda m: (m.data,),
    {"depth": _ALL, "height": _ALL, "voltage": _ALL, "pwm": _ALL, "forces": _ALL},
)
NUMBERS = (
    "std_msgs/msg/Float32",
    "std_msgs/msg/Float64",
    "uuv_gazebo_ros_plugins_msgs/msg/FloatStamped",
    *(f"std_msgs/msg/{sign}Int{bits}" for sign in ("U", "") for bits in (16, 32)),
)
"""Types of a single number: of a sensor, or of one thruster."""
_WHOLE = Form(lambda m: (m.data,), {"pwm": _ALL, "forces": _ALL})
_ARRAY = Form(lambda m: m.data, {"pwm": _ALL, "forces": _ALL, "wrench": _ALL})

FORMS: dict[str, Form] = {
    "nav_msgs/msg/Odometry": Form(
        lambda m: (*_pose(m.pose.pose), *_twist(m.twist.twist)),
        {**_POSE, "velocity": slice(7, 10), "rates": slice(10, 13)},
    ),
    "geometry_msgs/msg/Pose": Form(_pose, _POSE),
    "geometry_msgs/msg/PoseStamped": Form(lambda m: _pose(m.pose), _POSE),
    "geometry_msgs/msg/PoseWithCovariance": Form(lambda m: _pose(m.pose), _POSE),
    "geometry_msgs/msg/PoseWithCovarianceStamped": Form(lambda m: _pose(m.pose.pose), _POSE),
    "geometry_msgs/msg/Twist": Form(_twist, _TWIST),
    "geometry_msgs/msg/TwistStamped": Form(lambda m: _twist(m.twist), _TWIST),
    "geometry_msgs/msg/TwistWithCovariance": Form(lambda m: _twist(m.twist), _TWIST),
    "geometry_msgs/msg/TwistWithCovarianceStamped": Form(lambda m: _twist(m.twist.twist), _TWIST),
    "geometry_msgs/msg/Vector3": _vector(lambda m: m, *_VECTORS),
    "geometry_msgs/msg/Vector3Stamped": _vector(lambda m: m.vector, *_VECTORS),
    "geometry_msgs/msg/Point": _vector(lambda m: m, "position"),
    "geometry_msgs/msg/PointStamped": _vector(lambda m: m.point, "position"),
    "geometry_msgs/msg/Wrench": Form(_wrench, {"wrench": _ALL}),
    "geometry_msgs/msg/WrenchStamped": Form(lambda m: _wrench(m.wrench), {"wrench": _ALL}),
    "sensor_msgs/msg/Imu": Form(
        _imu, {"attitude": slice(0, 4), "rates": slice(4, 7), "acceleration": slice(7, 10)}
    ),
    "sensor_msgs/msg/FluidPressure": Form(lambda m: (m.fluid_pressure,), {"depth": _ALL}),
    "sensor_msgs/msg/BatteryState": Form(lambda m: (m.voltage,), {"voltage": _ALL}),
    "mavros_msgs/msg/RCOut": Form(lambda m: m.channels, {"pwm": _ALL}),
    "mavros_msgs/msg/RCIn": Form(_channels, {"rc": _ALL}),
    "mavros_msgs/msg/OverrideRCIn": Form(_channels, {"rc": _ALL, "pwm": _ALL}),
    "mavros_msgs/msg/ManualControl": Form(_manual, {"rc": _ALL}),
    "mavros_msgs/msg/State": Form(lambda m: (m.armed,), {"state": _ALL}, lambda m: m.mode),
    "mavros_msgs/msg/EstimatorStatus": Form(_aided, {"aiding": _ALL}),
    "mavros_msgs/msg/Param": Form(_parameter, {"parameters": _ALL}, lambda m: m.param_id),
    "mavros_msgs/msg/ParamEvent": Form(
        _parameter_event, {"parameters": _ALL}, lambda m: m.param_id
    ),
    **{t: _WHOLE if "Int" in t else _NUMBER for t in NUMBERS},
    **{f"std_msgs/msg/Float{bits}MultiArray": _ARRAY for bits in (32, 64)},
    **{
        f"std_msgs/msg/{sign}Int{bits}MultiArray": Form(lambda m: m.data, {"pwm": _ALL})
        for sign in ("U", "")
        for bits in (16, 32)
    },
}  # fmt: skip
"""Types of messages that are read, in the names of ROS 2."""
PRESSURE = "sensor_msgs/msg/FluidPressure"
SAMPLED = ("mavros_msgs/msg/RCOut",)
"""Types of commands that are samples of a faster signal; others act until the next message."""
