"""Errors of the DVL's mounting and scale."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from ..se3 import AXES, XYZ
from .base import Effect, Parameter
from .recent import Recent


def _turn(angles: Float[Array, "3 *batch"]) -> Float[Array, "7 *batch"]:
    """The pose of a rotation vector, at the origin."""
    return se3.exp(jnp.concatenate([jnp.zeros_like(angles), angles]))


class DvlLeverArm(Effect):
    """v_recorded = v + ω × l: the DVL is mounted l away from its assumed position."""

    name: ClassVar[str] = "dvl_lever_arm"
    family: ClassVar = "measurement"
    parameters: ClassVar = (Parameter("offset", "m", (0.02,), -1.0, 1.0),)
    places: ClassVar = XYZ
    order: ClassVar[int] = 20
    source: ClassVar[str] = "cm"

    def _lever(self, V: Array) -> Array:
        shape = (3, *jnp.broadcast_shapes(self.column(V).shape[1:], V.shape[1:]))
        v = se3.cross(jnp.broadcast_to(V[3:], shape), jnp.broadcast_to(self.column(V), shape))
        return jnp.concatenate([v, jnp.zeros_like(v)])

    def measure(
        self,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        recent: Recent,
    ) -> tuple[Float[Array, "7 *#batch"], Float[Array, "6 *#batch"]]:
        return X_WB, V_WB_B + self._lever(V_WB_B)

    def unmeasure(
        self,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        recent: Recent,
    ) -> tuple[Float[Array, "7 *#batch"], Float[Array, "6 *#batch"]]:
        return X_WB, V_WB_B - self._lever(V_WB_B)


class DvlMisalignment(Effect):
    """v_recorded = R(θ)ᵀ v: the DVL is rotated by the rotation vector θ relative to B."""

    name: ClassVar[str] = "dvl_misalignment"
    family: ClassVar = "measurement"
    parameters: ClassVar = (Parameter("angle", "rad", (0.01,), -0.5, 0.5),)
    places: ClassVar = AXES[3:]
    order: ClassVar[int] = 30
    source: ClassVar[str] = "0.1 to 5°"

    def measure(
        self,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        recent: Recent,
    ) -> tuple[Float[Array, "7 *#batch"], Float[Array, "6 *#batch"]]:
        v = se3.rotate_inverse(_turn(self.column(V_WB_B)), V_WB_B[:3])
        omega = jnp.broadcast_to(V_WB_B[3:], v.shape)
        return X_WB, jnp.concatenate([v, omega])

    def unmeasure(
        self,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        recent: Recent,
    ) -> tuple[Float[Array, "7 *#batch"], Float[Array, "6 *#batch"]]:
        v = se3.rotate(_turn(self.column(V_WB_B)), V_WB_B[:3])
        omega = jnp.broadcast_to(V_WB_B[3:], v.shape)
        return X_WB, jnp.concatenate([v, omega])


class DvlScale(Effect):
    """v_recorded = (1 + s) v: the DVL assumes a wrong speed of sound."""

    name: ClassVar[str] = "dvl_scale"
    family: ClassVar = "measurement"
    parameters: ClassVar = (Parameter("scale", "1", (0.01,), -0.5, 0.5),)
    order: ClassVar[int] = 40
    source: ClassVar[str] = "0.1 to 1 % and worse with wrong salinity"

    def _factor(self, V: Array) -> Array:
        like = jnp.ones((3,) + (1,) * (V.ndim - 1), V.dtype)
        s = self.part(0, V)[None] * like
        return jnp.concatenate([1 + s, jnp.ones_like(s)])

    def measure(
        self,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        recent: Recent,
    ) -> tuple[Float[Array, "7 *#batch"], Float[Array, "6 *#batch"]]:
        return X_WB, V_WB_B * self._factor(V_WB_B)

    def unmeasure(
        self,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        recent: Recent,
    ) -> tuple[Float[Array, "7 *#batch"], Float[Array, "6 *#batch"]]:
        return X_WB, V_WB_B / self._factor(V_WB_B)
