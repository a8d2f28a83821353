"""The pull of a tether that is made fast somewhere."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from .base import Effect, Parameter, Plant, force_only


class Tether(Effect):
    """F = -k (p - p_A) horizontally: a spring to an anchor, in W, acting at Bo.

    Written linearly as -k p + F_0; the anchor is p_A = F_0 / k. A force that does not grow with
    distance (k = 0) is a steady pull.
    """

    name: ClassVar[str] = "tether"
    family: ClassVar = "environment"
    parameters: ClassVar = (
        Parameter("stiffness", "N/m", (0.1,), 0.0, 200.0),
        Parameter("pull_east", "N", (0.3,), -200.0, 200.0),
        Parameter("pull_north", "N", (0.3,), -200.0, 200.0),
    )
    places: ClassVar = ("W",)
    simpler: ClassVar = ("current_steady", "net_buoyancy")
    source: ClassVar[str] = "11 N for 10 m of cable broadside at 0.5 m/s"

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        k, east, north = (self.part(i, V_CB_B) for i in range(3))
        x, y = X_WB[4], X_WB[5]
        pull = jnp.stack(jnp.broadcast_arrays(east - k * x, north - k * y, jnp.zeros_like(x) * k))
        return force_only(se3.rotate_inverse(X_WB, pull))
