"""Settings of every objective in one union; YAML selects one by its tag."""

from .distance_aware_losses import DistanceAware, Unconstrained
from .euclidean_losses import EuclideanFdm, EuclideanMoments
from .matching import Fdm, Mse
from .moments import Moments

ObjectiveConfig = (
    Fdm | Mse | Moments | EuclideanFdm | EuclideanMoments | DistanceAware | Unconstrained
)
"""Settings of every objective; YAML selects one by its tag."""
