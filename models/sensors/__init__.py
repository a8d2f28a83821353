"""Sensors of the vehicle: pure measurement functions and their noise-free forms."""

from collections.abc import Mapping

from .base import Sensor as Sensor
from .compass import Compass as Compass
from .compass import wrap as wrap
from .depth import DepthSensor as DepthSensor
from .dvl import Dvl as Dvl
from .faults import SensorFault as SensorFault
from .imu import Imu as Imu

Kind = Imu | Dvl | DepthSensor | Compass
"""The kinds that a scenario can name by a tag."""

SHIPPED: Mapping[str, Kind] = {
    "imu": Imu(),
    "dvl": Dvl(),
    "depth": DepthSensor(),
    "compass": Compass(),
}
"""The sensors of a station whose configuration names none, by the names of their ports."""
