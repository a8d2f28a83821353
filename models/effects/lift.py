"""Lift: forces perpendicular to the motion."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import Effect, Parameter, Plant, axes_only


class Lift(Effect):
    """Z = c u², M = c u² (cambered hull), Z = -c |u| w, Y = -c |u| v (lift of a plate).

    Lift grows with speed squared and angle of attack: ½ρA c_α u² α, α ≈ w / u.
    """

    name: ClassVar[str] = "lift"
    family: ClassVar = "body"
    parameters: ClassVar = (
        Parameter("coefficient", "N·s²/m² or N·m·s²/m²", (1.0,), -150.0, 150.0),
    )
    places: ClassVar = ("heave_from_surge", "pitch_from_surge", "heave", "sway")
    source: ClassVar[str] = "½ρA c with A = 0.05 to 0.2 m²"

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        u, v, w = V_CB_B[0], V_CB_B[1], V_CB_B[2]
        c = [self.part(i, V_CB_B) for i in range(4)]
        speed = jnp.abs(u)
        entries = {2: c[0] * u * u - c[2] * speed * w, 4: c[1] * u * u, 1: -c[3] * speed * v}
        return axes_only(entries, V_CB_B)
