"""Commands whose scale is unknown: the wrench that reaches the water, axis by axis."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import AXES, Effect, Parameter, Plant


class CommandGain(Effect):
    """F_i = (1 + g_i) F_i^c: the wrench along an axis of B differs from the commanded one.

    For commands that pass through an autopilot whose gains and mixer are not known. The change of
    the wrench is split over the thrusters with the least effort. Of motion alone (1 + g_i), the
    inertia and the drag of an axis are known as ratios, so a diagnosis has these gains only where
    its user says that the command is of unknown scale.
    """

    name: ClassVar[str] = "command_gain"
    family: ClassVar = "actuation"
    parameters: ClassVar = (Parameter("gain", "1", (0.1,), -3.0, 9.0),)
    places: ClassVar = AXES
    order: ClassVar[int] = 5
    source: ClassVar[str] = "gains of pilots and autopilots: a factor of ten either way"

    def thrust(
        self,
        force: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"],
        plant: Plant,
    ) -> Float[Array, "n *#batch"]:
        lever = jnp.cross(plant.positions, plant.directions, axis=0)
        allocation = jnp.concatenate([plant.directions, lever])
        change = self.column(force) * jnp.tensordot(allocation, force, 1)
        return force + jnp.tensordot(plant.inverse, change, 1)
