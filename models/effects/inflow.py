"""Thrust lost to the vehicle's own motion through the water."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import ByThruster, Parameter, Plant


class InflowThrustLoss(ByThruster):
    """f = u - k √|u| v_a, with v_a the thruster's velocity through the water along its axis.

    First order of the thrust coefficient in the advance ratio: T = T_0 - k √T_0 v_a (Fossen 2011,
    section 12.3; Whitcomb and Yoerger 1999).
    """

    name: ClassVar[str] = "inflow_thrust_loss"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("loss", "√N/(m/s)", (0.1,), 0.0, 3.0),)
    order: ClassVar[int] = 17
    source: ClassVar[str] = "1 to 12 % at 0.5 m/s"

    def thrust(
        self,
        force: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"],
        plant: Plant,
    ) -> Float[Array, "n *#batch"]:
        lever = jnp.cross(plant.positions, plant.directions, axis=0)
        along = jnp.tensordot(jnp.concatenate([plant.directions, lever]).T, V_CB_B, 1)
        return force - self.each(0, force) * jnp.sqrt(jnp.abs(force)) * along
