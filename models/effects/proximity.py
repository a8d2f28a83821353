"""Bottom, surface and walls near by."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import Effect, Parameter, Plant
from .load import up_in_body


class Proximity(Effect):
    """exp(-d / ℓ) times a vertical force (N) and times more quadratic drag, d the clearance.

    `bottom` lies at height `floor` (m, in W), `surface` at z = 0; ℓ = `reach`, about the hull's
    height. Both signs occur: suction and cushion.
    """

    name: ClassVar[str] = "proximity"
    family: ClassVar = "body"
    parameters: ClassVar = (
        Parameter("force", "N", (0.5,), -60.0, 60.0),
        Parameter("drag", "N·s²/m²", (5.0,), -300.0, 600.0),
    )
    places: ClassVar = ("bottom", "surface")
    source: ClassVar[str] = "drag up by half within one hull height of a wall"
    floor: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=-10.0)
    reach: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=0.3)

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        z, v = X_WB[6], V_CB_B[:3]
        near = jnp.exp(-jnp.maximum(z - self.floor, 0) / self.reach)
        shallow = jnp.exp(jnp.minimum(z, 0) / self.reach)
        part = [self.part(i, V_CB_B) for i in range(4)]
        push = part[0] * near + part[2] * shallow
        drag = part[1] * near + part[3] * shallow
        f = push[None] * up_in_body(X_WB) - drag[None] * jnp.abs(v) * v
        return jnp.concatenate([f, jnp.zeros_like(f)])
