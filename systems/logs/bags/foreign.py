"""Messages of other packages, read by the names of their fields: DVLs, depth, pose, thrusters.

The packages differ in name and layout (uuv_sensor_ros_plugins_msgs, cola2_msgs, stonefish_ros,
waterlinked_a50_ros_driver, dvl_msgs, marine_acoustic_msgs, ds_sensor_msgs, nortek_dvl), and hardly
in the names of these fields: a bag with definitions suffices.
"""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from .messages import Form, Quantity

_VECTORS = ("geometry_msgs/msg/Vector3", "geometry_msgs/msg/Point")
_OF_A_DVL = {
    "altitude", "beamDistance", "beams", "fom", "figureOfMerit", "figure_of_merit",
    "velocity_covar", "velocity_covariance", "velocity_valid",
}  # fmt: skip
"""Fields that stand beside the `velocity` of a DVL."""
_OF_A_GOAL = {"acceleration", "acceleration_or_force", "type_mask"}
"""Fields that stand beside the velocity of a set-point, as of mavros_msgs/PositionTarget."""
_OF_DEPTH = re.compile(r"depth|pressure|baro|bar\d0|ms5837", re.I)
"""In the type of a message whose `depth` is the vehicle's, as mil_msgs/DepthStamped."""
_VALID = ("velocity_valid", "beam_velocities_valid")
_WATER_TRACK, _BEAMS = 2, 0
"""velocity_mode and coordinate_mode of ds_sensor_msgs and marine_acoustic_msgs."""
_FAILED = 32.0
"""m/s: -32.768 marks a ping without an answer (Teledyne, Nortek)."""
_Z_DOWN = re.compile(r"^(dvl_msgs|waterlinked\w*|marine_acoustic_msgs|ds_sensor_msgs)/")
"""Packages whose velocities have z along the beams, down: those of the instrument itself."""


_NAVIGATED: Mapping[Quantity, slice] = {
    "attitude": slice(0, 4),
    "position": slice(4, 7),
    "velocity": slice(7, 10),
}
NAVIGATION = "/NavSts"
"""End of the types of auv_msgs and cola2_msgs for pose and velocity in NED and FRD."""


def points_down(type_: str) -> bool:
    """Whether a DVL's message has z down by its package's convention, so that it is FRD."""
    return _Z_DOWN.match(type_) is not None


def form_by_fields(type_: str, fields: Mapping[str, str]) -> Form | None:
    """The form of a message with these fields, by their types; None if it is none of those read."""
    names = fields.keys()
    if fields.get("velocity") in _VECTORS and names & _OF_A_DVL and not names & _OF_A_GOAL:
        return Form(_velocity, {"velocity": slice(0, 3)})
    if fields.get("position", "").endswith("/NED") and "body_velocity" in names:
        return Form(_navigation, _NAVIGATED)
    if fields.get("depth") in ("float32", "float64") and _OF_DEPTH.search(type_):
        return Form(lambda m: (m.depth,), {"depth": slice(None)})
    if fields.get("thrust", "").endswith("[]") and "setpoint" in names:  # Stonefish
        return Form(lambda m: m.thrust, {"forces": slice(None)})
    return None


def _navigation(m: Any) -> tuple[float, ...]:
    """Quaternion, position and velocity of the body; rates may be Euler's, and are left out."""
    e, p, v = m.orientation, m.position, m.body_velocity
    q = Rotation.from_euler("xyz", (e.roll, e.pitch, e.yaw)).as_quat(scalar_first=True)
    return *q, p.north, p.east, p.depth, v.x, v.y, v.z


def _velocity(m: Any) -> tuple[float, ...]:
    """Velocity over the ground (m/s); NaN without bottom track."""
    v = m.velocity.x, m.velocity.y, m.velocity.z
    marked = any(not getattr(m, name, True) for name in _VALID)
    marked |= getattr(m, "velocity_mode", 0) == _WATER_TRACK
    marked |= getattr(m, "coordinate_mode", 1) == _BEAMS
    covariance = getattr(m, "velocity_covariance", ())
    marked |= len(covariance) > 0 and covariance[0] == -1
    failed = not all(abs(x) < _FAILED for x in v)
    return (np.nan,) * 3 if marked or failed else v
