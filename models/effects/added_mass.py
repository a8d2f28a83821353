"""Errors of the added mass: diagonal, off-diagonal, and in the Munk moment."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import se3
from ..dynamics import Dynamics
from ..rigid_body import FossenDynamics
from ..se3 import AXES
from .base import Effect, Parameter, Plant

ENTRIES = (
    ("surge_pitch", 0, 4),
    ("sway_roll", 1, 3),
    ("sway_yaw", 1, 5),
    ("heave_pitch", 2, 4),
)


class AddedMass(Effect):
    """M_ii grows by Δ on one axis (kg, kg·m²)."""

    name: ClassVar[str] = "added_mass"
    family: ClassVar = "body"
    parameters: ClassVar = (Parameter("change", "kg or kg·m²", (0.05,), -60.0, 100.0, 25.0),)
    places: ClassVar = AXES
    refits: ClassVar = ("linear", "all")
    source: ClassVar[str] = "published sets differ by a factor of 2"

    @classmethod
    def believed(cls, base: Dynamics, place: str) -> float:
        if not isinstance(base, FossenDynamics):
            return 0.0
        i = AXES.index(place)
        return float(base.mass.matrix()[i, i] - base.rigid_inertia[i, i])

    @classmethod
    def refit_prior(cls, base: Dynamics, place: str) -> tuple[float, float]:
        """As much as the believed one, and a tenth of the rigid body's at least."""
        old, rigid = cls.believed(base, place), np.diag(np.asarray(base.rigid_inertia))
        return max(old, 0.1 * float(rigid[AXES.index(place)])), -old

    def inertia(self, plant: Plant) -> Float[Array, "6 6 *batch"]:
        eye = jnp.eye(6, dtype=self.values.dtype)
        return eye.reshape((6, 6) + (1,) * (self.values.ndim - 1)) * self.values[None]

    def in_constants(self, base: FossenDynamics, plant: Plant) -> FossenDynamics:
        del plant
        added = np.asarray(base.mass.matrix() - base.rigid_inertia, float)
        change = np.diag(np.asarray(self.values, float))
        return base.with_constants(added_mass=added + change)


class AddedMassCoupling(Effect):
    """Off-diagonal added mass M_ij = M_ji (kg·m), or `munk`: (1 + κ) times the Munk moment.

    The Munk moment of a body that moves with v is p × v with p = M v (Fossen 2011, section 6.3.1:
    the destabilising part of C_A).
    """

    name: ClassVar[str] = "added_mass_coupling"
    family: ClassVar = "body"
    parameters: ClassVar = (Parameter("change", "kg·m or 1", (0.1,), -20.0, 20.0),)
    places: ClassVar = (*(name for name, _, _ in ENTRIES), "munk")
    source: ClassVar[str] = "a few cm between Bo and the centre of the water's inertia"

    def inertia(self, plant: Plant) -> Float[Array, "6 6 *batch"]:
        M = jnp.zeros((6, 6, *self.values.shape[1:]), self.values.dtype)
        for k, (_, i, j) in enumerate(ENTRIES):
            M = M.at[i, j].add(self.values[k]).at[j, i].add(self.values[k])
        return M

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        v = V_CB_B[:3]
        moment = se3.cross(jnp.tensordot(plant.mass[:3, :3], v, 1), v)
        moment = self.part(len(ENTRIES), V_CB_B)[None] * moment
        return jnp.concatenate([jnp.zeros_like(moment), moment])
