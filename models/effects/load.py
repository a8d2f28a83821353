"""What hangs on the vehicle: buoyancy, the centre of gravity, a payload."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from .base import XYZ, Effect, Parameter, Plant, force_only


def up_in_body(X_WB: Float[Array, "7 *batch"]) -> Float[Array, "3 *batch"]:
    """W's z axis expressed in B."""
    w, x, y, z = jnp.unstack(X_WB[:4])
    return jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z])


class NetBuoyancy(Effect):
    """A constant upward force ΔB at Bo (N)."""

    name: ClassVar[str] = "net_buoyancy"
    family: ClassVar = "body"
    parameters: ClassVar = (Parameter("force", "N", (0.5,), -60.0, 60.0),)
    source: ClassVar[str] = "0.2 to 4 N: trim, foam, water density"

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        return force_only(self.part(0, V_CB_B)[None] * up_in_body(X_WB))


class CentreOfGravity(Effect):
    """The centre of gravity moved by r along an axis of B: moment r × weight."""

    name: ClassVar[str] = "centre_of_gravity"
    family: ClassVar = "body"
    parameters: ClassVar = (Parameter("shift", "m", (0.001,), -0.1, 0.1),)
    places: ClassVar = XYZ
    source: ClassVar[str] = "mm to cm: batteries, tools, ballast"

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        down = -plant.weight * up_in_body(X_WB)
        r = jnp.broadcast_to(self.column(V_CB_B), (3, *jnp.broadcast_shapes(
            self.column(V_CB_B).shape[1:], down.shape[1:])))  # fmt: skip
        moment = se3.cross(r, jnp.broadcast_to(down, r.shape))
        return jnp.concatenate([jnp.zeros_like(moment), moment])


class Payload(Effect):
    """A load: inertia m, weight in water w and its moment w·(x, y) about Bo.

    The mass includes the water that moves with it; its own rotational inertia and the coupling of
    its lever with acceleration are left out.
    """

    name: ClassVar[str] = "payload"
    family: ClassVar = "body"
    parameters: ClassVar = (
        Parameter("mass", "kg", (0.5,), 0.0, 30.0),
        Parameter("weight", "N", (0.5,), 0.0, 100.0),
        Parameter("moment_x", "N·m", (0.05,), -30.0, 30.0),
        Parameter("moment_y", "N·m", (0.05,), -30.0, 30.0),
    )
    simpler: ClassVar = ("net_buoyancy", "centre_of_gravity")
    source: ClassVar[str] = "0.1 to 3 kg"

    def inertia(self) -> Float[Array, "6 6 *batch"]:
        m = self.values[0]
        shape = (6,) + (1,) * m.ndim
        translates = jnp.asarray([1, 1, 1, 0, 0, 0], m.dtype).reshape(shape)
        eye = jnp.eye(6, dtype=m.dtype).reshape((6, 6) + (1,) * m.ndim)
        return eye * (translates * m[None])[None]

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        ux, uy, uz = jnp.unstack(up_in_body(X_WB))
        w, a, b = (self.part(i, V_CB_B) for i in (1, 2, 3))
        # (a, b, 0) × (-up): the moment of a weight with lever (a, b)/w
        moment = [-b * uz, a * uz, b * ux - a * uy]
        return jnp.stack(jnp.broadcast_arrays(-w * ux, -w * uy, -w * uz, *moment))
