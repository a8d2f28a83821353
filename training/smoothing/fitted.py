"""A model on a recording that lacks channels: levels of noise, and what the data tell of it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ...models.dynamics import Dynamics
from ...models.effects.extended import core
from ...models.recordings.store import Recording
from ...models.rigid_body import FossenDynamics
from ...models.se3 import AXES
from .complete import Completed, complete
from .levels import Belief, Levels
from .states import Scaled

COEFFICIENTS = (
    *(f"{name}, {axis}" for name in ("mass", "linear drag", "quadratic drag") for axis in AXES),
    *("net buoyancy", "righting lever, x", "righting lever, y", "righting lever, z"),
)
"""Names of the scales."""
_ROUNDS = 6
"""Gauss-Newton steps where the coefficients stay."""
_LEAST_DRAG = 0.01
"""Drag in a second, relative to the mass, added where factors are taken: zero has no logarithm."""


@dataclass(frozen=True)
class Told:
    """What the data tell of one coefficient, given the thrust.

    Attributes:
        name: one of `COEFFICIENTS`.
        before, after: standard deviation of its logarithm (of buoyancy: % of the displacement; of
            levers: relative) before and given the data.
        change: from the preset to the fitted model.
    """

    name: str
    before: float
    after: float
    change: float

    @property
    def learned(self) -> bool:
        """Whether the data have more information on it than the preset."""
        return self.after < self.before / 2**0.5


def completed_as_it_is(recording: Recording, vehicle: Any, model: Dynamics) -> Completed:
    """The recording completed with a model that is not adapted to it."""
    return complete(recording, vehicle, model, belief=Belief.exact(), rounds=_ROUNDS)


def told_by(
    recording: Recording, vehicle: Any, model: Dynamics, preset: FossenDynamics, levels: Levels
) -> tuple[Told, ...]:
    """What a recording tells of the coefficients of a model that was fitted to it.

    Args:
        recording: what it was fitted to.
        vehicle: as in `Recording.wrench`.
        model: a Fossen model, which may have effects.
        preset: what it is compared with.
        levels: of all noise under `model`.
    """
    belief = Belief.of_preset()
    found = complete(recording, vehicle, model, belief=belief, levels=levels, rounds=1)
    after = np.sqrt(np.diag(found.scales_cov))
    own = core(model)
    assert isinstance(own, FossenDynamics)
    told = zip(COEFFICIENTS, belief.scales, after, _change(preset, own), strict=True)
    return tuple(Told(name, *map(float, numbers)) for name, *numbers in told)


def _change(before: FossenDynamics, after: FossenDynamics) -> Float[np.ndarray, "22"]:
    """From one model to another, in the units of the scales (`Scaled`)."""
    logs = []
    for name, least in (
        ("mass", 0.0),
        ("linear_drag", _LEAST_DRAG),
        ("quadratic_drag", _LEAST_DRAG),
    ):
        old, new = (
            np.diag(np.asarray(getattr(m, name).matrix(), float))
            + least * np.diag(np.asarray(m.mass.matrix(), float))
            for m in (before, after)
        )
        logs.append(np.log(new / old))
    unit = Scaled.of(before)
    lift = [float(m.buoyancy - m.weight) for m in (before, after)]
    lever = [
        np.asarray(m.p_BoCb_B * m.buoyancy - m.p_BoBcm_B * m.weight, float) for m in (before, after)
    ]
    buoyancy = (lift[1] - lift[0]) / float(unit.weight)
    righting = (lever[1] - lever[0]) / float(unit.righting)
    return np.concatenate([*logs, [buoyancy], righting])
