"""The pull of an anchored tether."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from .base import Effect, Parameter, Plant


class TetherEffect(Effect):
    """F = -k (p_T - p_A): a spring from the attachment T on the vehicle to an anchor A in W.

    Written as F_0 - k p_T in W; the anchor is p_A = F_0 / k. A force that does not grow with
    distance (k = 0) is a steady pull. T lies at `arm` in B.
    """

    name: ClassVar[str] = "tether"
    family: ClassVar = "environment"
    parameters: ClassVar = (
        Parameter("stiffness", "N/m", (0.1,), 0.0, 200.0),
        Parameter("pull_east", "N", (0.3,), -200.0, 200.0),
        Parameter("pull_north", "N", (0.3,), -200.0, 200.0),
        Parameter("pull_up", "N", (0.3,), -200.0, 200.0),
        Parameter("arm_x", "m", (0.1,), -2.0, 2.0),
        Parameter("arm_y", "m", (0.1,), -2.0, 2.0),
        Parameter("arm_z", "m", (0.1,), -2.0, 2.0),
    )
    places: ClassVar = ("W",)
    needs: ClassVar = frozenset({"velocity"})
    simpler: ClassVar = ("current_steady", "net_buoyancy")
    essential: ClassVar = ("stiffness", "pull_east", "pull_north")
    source: ClassVar[str] = "11 N for 10 m of cable broadside at 0.5 m/s"

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        k, *rest = (self.part(i, V_CB_B) for i in range(7))
        pull, arm = (jnp.stack(jnp.broadcast_arrays(*part)) for part in (rest[:3], rest[3:]))
        stretched = pull - k[None] * X_WB[4:]
        force = se3.rotate_inverse(X_WB, stretched) - k[None] * arm
        arm, force = jnp.broadcast_arrays(arm, force)
        return jnp.concatenate([force, se3.cross(arm, force)])
