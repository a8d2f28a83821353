"""Sensors of the vehicle: pure measurement functions and their noise-free forms."""

from .base import Sensor as Sensor
from .compass import Compass as Compass
from .compass import wrap as wrap
from .depth import DepthSensor as DepthSensor
from .dvl import Dvl as Dvl
from .faults import SensorFault as SensorFault
from .imu import Imu as Imu
