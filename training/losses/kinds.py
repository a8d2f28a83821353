"""Every objective's settings in one union, which YAML tells apart by their tags."""

from .distance_aware_losses import DistanceAware, Unconstrained
from .euclidean_losses import EuclideanFdm, EuclideanMoments
from .matching import Fdm, Mse
from .moments import Moments

ObjectiveConfig = (
    Fdm | Mse | Moments | EuclideanFdm | EuclideanMoments | DistanceAware | Unconstrained
)
"""Settings of every objective; YAML picks one by its tag."""
