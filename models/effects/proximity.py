"""Effects of a nearby bottom, surface or wall."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import Effect, Parameter, Plant, force_only
from .load import up_in_body
from .traits import Region

REACH = 0.5
"""Default decay length (m) of a boundary's effect, about the length of the hull."""


class Proximity(Effect):
    """More drag and a vertical force near a boundary: e^(-d / ℓ) times g D(ξ) and times F.

    d is the clearance to the height `floor` (`bottom`), to z = 0 (`surface`), or to a vertical wall
    at the edge of the box `walls` (west, east, south, north; m in W), ℓ its `length`. The drag does
    not determine the position of the boundary: g refers to the stated positions.
    """

    name: ClassVar[str] = "proximity"
    family: ClassVar = "body"
    parameters: ClassVar = (
        Parameter("gain", "1", (0.3,), -1.0, 50.0),
        Parameter("force", "N", (0.5,), -60.0, 60.0),
        Parameter("length", "m", (0.1,), -0.4, 3.0, usual=REACH),
    )
    places: ClassVar = ("bottom", "surface", "wall_west", "wall_east", "wall_south", "wall_north")
    source: ClassVar[str] = "drag up by half within one hull height of a wall"
    floor: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=-10.0)
    walls: Float[Array, "4"] = eqx.field(converter=jnp.asarray, default=(-10.0, 10.0, -10.0, 10.0))

    @classmethod
    def options_for(cls, region: Region) -> dict[str, Any]:
        """Boundaries just around the places where the vehicle was."""
        (west, south, floor), (east, north, _) = region.low, region.high
        return {"floor": floor, "walls": (west, east, south, north)}

    def assumed(self, place: str) -> dict[str, tuple[float, str]]:
        """Assumed position of the boundary (m in W: a height, or east or north)."""
        at = (self.floor, 0.0, *self.walls)[self.places.index(place)]
        return {"boundary": (float(at), "m")}

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        x, y, z = X_WB[4], X_WB[5], X_WB[6]
        west, east, south, north = self.walls
        clearances = (z - self.floor, -z, x - west, east - x, y - south, north - y)
        more = push = jnp.zeros_like(z)
        for k, clearance in enumerate(clearances):
            gain, force, more_length = (self.part(3 * k + i, V_CB_B) for i in range(3))
            near = jnp.exp(-jnp.maximum(clearance, 0) / jnp.maximum(REACH + more_length, 0.05))
            more, push = more + gain * near, push + force * near
        drag = more[None] * plant.drag(V_CB_B)
        return drag + force_only(push[None] * up_in_body(X_WB))
