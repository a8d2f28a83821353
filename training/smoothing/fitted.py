"""A Fossen model fitted to a recording that lacks channels, and what the data tell of it.

The scales of the model's coefficients are part of the smoother's state (`states`), common to all
runs: their means and covariance are those of the marginal likelihood, in which the states that were
not recorded are integrated out.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ...models.dynamics import Dynamics
from ...models.recordings.store import Recording
from ...models.rigid_body import FossenDynamics
from ...models.se3 import AXES
from .complete import Completed, complete
from .levels import Belief, Levels
from .states import BUOYANCY, LINEAR, MASS, QUADRATIC, RIGHTING, Scaled

COEFFICIENTS = (
    *(f"{name}, {axis}" for name in ("mass", "linear drag", "quadratic drag") for axis in AXES),
    *("net buoyancy", "righting lever, x", "righting lever, y", "righting lever, z"),
)
"""Names of the scales."""
_ROUNDS = 6
"""Gauss-Newton steps where the coefficients stay."""
_LEAST_DRAG = 0.01
"""Least drag in a second, relative to the mass: a factor on zero could not be fitted."""


@dataclass(frozen=True)
class Told:
    """What the data tell of one coefficient.

    Attributes:
        name: one of `COEFFICIENTS`.
        before, after: standard deviation of its logarithm (of buoyancy: % of the displacement; of
            levers: relative) before and given the data.
        change: mean.
    """

    name: str
    before: float
    after: float
    change: float

    @property
    def learned(self) -> bool:
        """Whether the data have more information on it than the preset."""
        return self.after < self.before / 2**0.5


@dataclass(frozen=True)
class Fitted:
    """A model with its scales applied, the levels of noise, and what the data told."""

    model: FossenDynamics
    levels: Levels
    belief: Belief
    told: tuple[Told, ...]


def fit_hidden(recording: Recording, vehicle: Any, reference: FossenDynamics) -> Fitted:
    """The most likely coefficients of a Fossen model, and the noise, from what was recorded."""
    belief, start = Belief.of_preset(), _with_least_drag(reference)
    found = complete(recording, vehicle, start, belief=belief)
    after = np.sqrt(np.diag(found.scales_cov))
    told = zip(COEFFICIENTS, belief.scales, after, found.scales, strict=True)
    return Fitted(
        with_scales(start, found.scales, found.levels.diffusion),
        found.levels,
        Belief(belief.scales, found.scales_cov),
        tuple(Told(name, *map(float, numbers)) for name, *numbers in told),
    )


def completed_as_it_is(recording: Recording, vehicle: Any, model: Dynamics) -> Completed:
    """The recording completed with a model that is not adapted to it."""
    return complete(recording, vehicle, model, belief=Belief.exact(), rounds=_ROUNDS)


def _with_least_drag(model: FossenDynamics) -> FossenDynamics:
    M, D, Df = (
        np.asarray(o.matrix(), float) for o in (model.mass, model.linear_drag, model.quadratic_drag)
    )
    least = np.diag(_LEAST_DRAG * np.diag(M))
    return _built(model, M, np.maximum(D, least), np.maximum(Df, least))


def with_scales(
    model: FossenDynamics, scales: Float[np.ndarray, "22"], diffusion: Float[np.ndarray, "6"]
) -> FossenDynamics:
    """The model whose coefficients have these scales (`Scaled`), and a diffusion."""
    parts = []
    operators = model.mass, model.linear_drag, model.quadratic_drag
    for operator, part in zip(operators, (MASS, LINEAR, QUADRATIC), strict=True):
        factor = np.exp(scales[part] / 2)
        parts.append(np.asarray(operator.matrix(), float) * np.outer(factor, factor))
    unit = Scaled.of(model)
    buoyancy = float(model.buoyancy) + float(unit.weight) * float(scales[BUOYANCY][0])
    weighed = np.asarray(model.p_BoBcm_B, float) * float(model.weight)
    lever = np.asarray(model.p_BoCb_B, float) * float(model.buoyancy) - weighed
    lever = lever + float(unit.righting) * scales[RIGHTING]
    return _built(
        model, *parts, buoyancy=buoyancy, p_BoCb_B=(lever + weighed) / buoyancy, b=diffusion
    )


def _built(
    model: FossenDynamics,
    M: np.ndarray,
    D: np.ndarray,
    Df: np.ndarray,
    buoyancy: float | None = None,
    p_BoCb_B: np.ndarray | None = None,
    b: np.ndarray | None = None,
) -> FossenDynamics:
    rigid = np.asarray(model.rigid_inertia, float)
    return FossenDynamics(
        rigid_inertia=rigid,
        added_mass=M - rigid,
        linear_drag=D,
        quadratic_drag=Df,
        weight=float(model.weight),
        buoyancy=float(model.buoyancy) if buoyancy is None else buoyancy,
        p_BoBcm_B=np.asarray(model.p_BoBcm_B, float),
        p_BoCb_B=np.asarray(model.p_BoCb_B, float) if p_BoCb_B is None else p_BoCb_B,
        displaced_mass=float(model.displaced_mass),
        diffusion=b,
        dtype=model.rigid_inertia.dtype,
    )
