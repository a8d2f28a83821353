"""Every objective's settings in one union, which YAML tells apart by their tags."""

from .distance_aware import DistanceAware, Unconstrained
from .euclidean import EuclideanFdm, EuclideanMoments
from .losses import Fdm, Mse
from .moments import Moments

ObjectiveConfig = (
    Fdm | Mse | Moments | EuclideanFdm | EuclideanMoments | DistanceAware | Unconstrained
)
"""Settings of every objective; YAML picks one by its tag."""
