"""Errors of the DVL: its mounting, its scale, and small speeds that it loses."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from ..se3 import AXES, XYZ
from .base import Parameter
from .measurement import MeasurementEffect


def _turn(angles: Float[Array, "3 *batch"]) -> Float[Array, "7 *batch"]:
    """The pose of a rotation vector, at the origin."""
    return se3.exp(jnp.concatenate([jnp.zeros_like(angles), angles]))


class DvlLeverArm(MeasurementEffect):
    """v_recorded = v + ω × l: the DVL is mounted l away from its assumed position."""

    name: ClassVar[str] = "dvl_lever_arm"
    parameters: ClassVar = (Parameter("offset", "m", (0.02,), -1.0, 1.0),)
    places: ClassVar = XYZ
    order: ClassVar[int] = 20
    needs: ClassVar = frozenset({"velocity"})
    source: ClassVar[str] = "cm"

    def _lever(self, V: Array) -> Array:
        shape = (3, *jnp.broadcast_shapes(self.column(V).shape[1:], V.shape[1:]))
        v = se3.cross(jnp.broadcast_to(V[3:], shape), jnp.broadcast_to(self.column(V), shape))
        return jnp.concatenate([v, jnp.zeros_like(v)])

    def twist(
        self, V_WB_B: Float[Array, "6 *#batch"], inverse: bool = False
    ) -> Float[Array, "6 *#batch"]:
        lever = self._lever(V_WB_B)
        return V_WB_B - lever if inverse else V_WB_B + lever


class DvlMisalignment(MeasurementEffect):
    """v_recorded = R(θ)ᵀ v: the DVL is rotated by the rotation vector θ relative to B."""

    name: ClassVar[str] = "dvl_misalignment"
    parameters: ClassVar = (Parameter("angle", "rad", (0.01,), -0.5, 0.5),)
    places: ClassVar = AXES[3:]
    order: ClassVar[int] = 30
    needs: ClassVar = frozenset({"velocity"})
    source: ClassVar[str] = "0.1 to 5°"

    def twist(
        self, V_WB_B: Float[Array, "6 *#batch"], inverse: bool = False
    ) -> Float[Array, "6 *#batch"]:
        turn = se3.rotate if inverse else se3.rotate_inverse
        v = turn(_turn(self.column(V_WB_B)), V_WB_B[:3])
        return jnp.concatenate([v, jnp.broadcast_to(V_WB_B[3:], v.shape)])


class DvlScale(MeasurementEffect):
    """v_recorded = (1 + s) v: the DVL assumes a wrong speed of sound."""

    name: ClassVar[str] = "dvl_scale"
    parameters: ClassVar = (Parameter("scale", "1", (0.01,), -0.5, 0.5),)
    order: ClassVar[int] = 40
    needs: ClassVar = frozenset({"velocity"})
    source: ClassVar[str] = "0.1 to 1 % and worse with wrong salinity"

    def _factor(self, V: Array) -> Array:
        like = jnp.ones((3,) + (1,) * (V.ndim - 1), V.dtype)
        s = self.part(0, V)[None] * like
        return jnp.concatenate([1 + s, jnp.ones_like(s)])

    def twist(
        self, V_WB_B: Float[Array, "6 *#batch"], inverse: bool = False
    ) -> Float[Array, "6 *#batch"]:
        factor = self._factor(V_WB_B)
        return V_WB_B / factor if inverse else V_WB_B * factor


class DvlDeadZone(MeasurementEffect):
    """v_recorded = v where |v| ≥ w, else 0: a speed below w is lost.

    At an axis the component decides, at `all` the norm of the three. The records themselves show
    which samples are lost, and where speeds begin: the width is read off, and not fitted. Of a lost
    sample nothing is known but the width, so `unmeasure` leaves it at zero.
    """

    name: ClassVar[str] = "dvl_dead_zone"
    parameters: ClassVar = (Parameter("width", "m/s", (0.02,), 0.0, 1.0),)
    places: ClassVar = ("all", *AXES[:3])
    order: ClassVar[int] = 50
    needs: ClassVar = frozenset({"velocity"})
    observed: ClassVar[bool] = True
    source: ClassVar[str] = "thresholds of receivers and drivers, 1 to 10 cm/s"

    def twist(
        self, V_WB_B: Float[Array, "6 *#batch"], inverse: bool = False
    ) -> Float[Array, "6 *#batch"]:
        if inverse:
            return V_WB_B
        w, v = self.column(V_WB_B), V_WB_B[:3]
        square = jnp.sum(v * v, axis=0, keepdims=True)
        shown = jnp.where((jnp.abs(v) < w[1:]) | (square < w[:1] ** 2), 0.0, v)
        return jnp.concatenate([shown, jnp.broadcast_to(V_WB_B[3:], shown.shape)])
