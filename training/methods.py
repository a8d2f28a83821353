"""Every method of the paper's simulation study by name, each as one typed `TrainingConfig`.

The study's default follows the physics: windows normalised by heading with the gravity
potential. The paper's own form (windows from the identity, a potential of the whole pose) is
`windows.normalise: identity` with `model.potential: pose` in a settings file.
"""

import operator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..models.config import typed_yaml as yaml
from ..models.config.errors import UserError
from ..models.distance_aware import DiffusionKind
from ..models.spinn import SpinnConfig
from .config import TrainingConfig
from .losses.distance_aware_losses import DistanceAware, Unconstrained
from .losses.euclidean_losses import EuclideanFdm, EuclideanMoments
from .losses.matching import Fdm, Mse
from .losses.moments import Moments


@dataclass(frozen=True)
class Method:
    """A named method: its settings, and those among them that define it."""

    summary: str
    config: TrainingConfig
    fixed: tuple[str, ...]
    """Settings (dotted) that a file must not change; the objective's kind is always one."""

    def check(self, name: str, config: TrainingConfig, source: str) -> None:
        """Refuse settings of another method.

        Raises:
            UserError: a setting that defines this method differs.
        """
        wanted, found = type(self.config.objective).__name__, type(config.objective).__name__
        if wanted != found:
            raise UserError(
                f"{source}: objective: found !{found}, but method '{name}' is !{wanted}; "
                "leave out one of the two"
            )
        for path in self.fixed:
            want, have = (operator.attrgetter(path)(c) for c in (self.config, config))
            same = (want > 0) == (have > 0) if path.endswith("mse_weight") else want == have
            if not same:
                raise UserError(
                    f"{source}: {path}: found {have!r}, but method '{name}' has {want!r}; "
                    "leave out one of the two"
                )


_MODEL = SpinnConfig(constant_mass=True)
_SLOW: dict[str, Any] = {"learning_rate": 1e-4, "head_decay": 300.0}
"""The paper's rate, and a weight decay at which networks and biases drift equally.

The starting model is as close to the truth as the data allow. From there training adds mostly
gradient noise, which Adam turns into a random walk of r per step: over n steps with cosine decay a
bias drifts by r √(0.37 n), 0.0015; an output weight under decay d drifts by √(r / 2 d), and the 32
of an output, with features of 0.6, by 3.4 times that. The two are equal at d = 260. With d = 30 the
networks made the law worse (geodesic FDM on sparse data: W₂ from 1.06, 1.04, 1.09 to 1.20, 1.13,
1.26 times the floor). Real logs, which the start fits less well, need more rate and less decay."""
_KIND = ("model.stochastic", "model.coordinates", "model.diffusion")


def _spinn(summary: str, objective: Any, *fixed: str, **settings: Any) -> Method:
    config = TrainingConfig(objective=objective, model=_MODEL, **settings)
    return Method(summary, config, (*_KIND, *(f"objective.{f}" for f in fixed)))


def _euclidean(
    summary: str,
    objective: Any,
    *fixed: str,
    diffusion: DiffusionKind = "network",
    **settings: Any,
) -> Method:
    model = replace(_MODEL, coordinates="euler", diffusion=diffusion)
    config = TrainingConfig(objective=objective, model=model, **(_SLOW | settings))
    return Method(summary, config, (*_KIND, *(f"objective.{f}" for f in fixed)))


_PUBLISHED = {
    "batch": 64,
    "learning_rate": 1e-2,
    "head_decay": 30.0,
    "clip": 0.0,
    "refit_at": (),
}
"""Adam from 1e-2 without clipping, as in the published code of the distance-aware methods."""


_FDM = ("pose_kernel", "mse_weight")

METHODS: dict[str, Method] = {
    "fdm-geodesic": _spinn(
        "finite dimensional matching, geodesic kernel",
        Fdm("geodesic", mse_weight=0.0),
        *_FDM,
        **_SLOW,
    ),
    "fdm-geodesic+mse": _spinn("the same with a squared error", Fdm("geodesic"), *_FDM),
    "fdm-chordal": _spinn(
        "finite dimensional matching, chordal kernel",
        Fdm("chordal", mse_weight=0.0),
        *_FDM,
        **_SLOW,
    ),
    "fdm-chordal+mse": _spinn("the same with a squared error", Fdm("chordal"), *_FDM),
    "moments": _spinn(
        "moment matching: group mean and covariance, velocity moments",
        Moments(),
        "mse_weight",
        batch=64,
        **_SLOW,
    ),
    "moments+mse": _spinn(
        "the same with a squared error", Moments(mse_weight=0.1), "mse_weight", batch=64
    ),
    "pinn": Method(
        "the geometric network without diffusion, by squared error",
        TrainingConfig(objective=Mse(), model=replace(_MODEL, stochastic=False), **_SLOW),
        _KIND,
    ),
    "euclidean-fdm": _euclidean(
        "finite dimensional matching in position and Euler angles", EuclideanFdm(), "mse_weight"
    ),
    "euclidean-moments": _euclidean(
        "moment matching in position and Euler angles", EuclideanMoments(), "mse_weight", batch=64
    ),
    "euclidean-distance-aware": _euclidean(
        "squared error with distance-aware diffusion (Djeumou et al. 2023)",
        DistanceAware(),
        diffusion="distance-aware",
        **_PUBLISHED,
    ),
    "euclidean-unconstrained": _euclidean(
        "likelihood with distance-aware diffusion (Koprulu et al. 2025)",
        Unconstrained(),
        diffusion="unconstrained",
        **_PUBLISHED,
    ),
}
"""All methods; `+mse` is the paper's ocean objective, with the rate that real logs need."""


def method_config(name: str, settings: str | Path | None = None) -> TrainingConfig:
    """The settings of a method, overridden by those in a YAML file.

    The file may set anything except what defines the method (`Method.fixed`), so neither
    overrides the other silently.

    Raises:
        UserError: the name is unknown, or the file is invalid or contradicts the method.
    """
    if name not in METHODS:
        raise UserError(f"method '{name}' is unknown; take one of {', '.join(METHODS)}")
    method = METHODS[name]
    if settings is None:
        return method.config
    config = yaml.load(TrainingConfig, settings, base=method.config)
    method.check(name, config, str(settings))
    return config
