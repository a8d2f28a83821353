"""Errors of gyro, heading and clock."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import se3
from ..se3 import XYZ
from .base import Parameter
from .measurement import MeasurementEffect
from .recent import Recent


class GyroBias(MeasurementEffect):
    """ω_recorded = ω + β (rad/s)."""

    name: ClassVar[str] = "gyro_bias"
    parameters: ClassVar = (Parameter("bias", "rad/s", (0.002,), -0.2, 0.2),)
    places: ClassVar = XYZ
    order: ClassVar[int] = 50
    source: ClassVar[str] = "mrad/s for MEMS gyros after warm-up"

    def twist(
        self, V_WB_B: Float[Array, "6 *#batch"], inverse: bool = False
    ) -> Float[Array, "6 *#batch"]:
        beta = self.column(V_WB_B)
        bias = jnp.concatenate([jnp.zeros_like(beta), beta])
        return V_WB_B - bias if inverse else V_WB_B + bias


class HeadingError(MeasurementEffect):
    """ψ_recorded = ψ + s sin ψ + c cos ψ + o: compass deviation by the vehicle's magnetic field.

    ψ is measured from east, counter-clockwise. s and c are the semicircular deviation (Bowditch
    2019, ch. 8); o is a constant offset.
    """

    name: ClassVar[str] = "heading_error"
    parameters: ClassVar = (
        Parameter("sine", "rad", (0.01,), -0.8, 0.8),
        Parameter("cosine", "rad", (0.01,), -0.8, 0.8),
        Parameter("offset", "rad", (0.01,), -3.2, 3.2),
    )
    order: ClassVar[int] = 60
    source: ClassVar[str] = "degrees"

    def _error(self, X: Array, sine: Array, cosine: Array) -> Array:
        s, c, o = (self.part(i, X) for i in range(3))
        return s * sine + c * cosine + o

    def pose(
        self, X_WB: Float[Array, "7 *#batch"], inverse: bool = False
    ) -> Float[Array, "7 *#batch"]:
        sine, cosine = _heading(X_WB)
        error = self._error(X_WB, sine, cosine)
        if not inverse:
            return _turned(X_WB, error)
        for _ in range(2):  # fixed-point iteration; contracts by the size of the error
            s, c = jnp.sin(error), jnp.cos(error)
            error = self._error(X_WB, sine * c - cosine * s, cosine * c + sine * s)
        return _turned(X_WB, -error)


class ClockOffset(MeasurementEffect):
    """The time stamps of one channel are late by δ: the record at t holds the value at t - δ.

    `linear` and `angular` delay these velocities, `twist` both. `pose` records X exp(-Ω), with Ω
    the integral of the twist over δ (Magnus 1954, first term). δ is relative to the command clock.
    """

    name: ClassVar[str] = "clock_offset"
    parameters: ClassVar = (Parameter("delay", "s", (0.005, -0.005), -0.3, 0.3),)
    places: ClassVar = ("twist", "pose", "linear", "angular")
    echoes: ClassVar = ("thruster_lag", "actuation_delay")
    order: ClassVar[int] = 10
    timing: ClassVar[bool] = True
    source: ClassVar[str] = "5 to 50 ms between computers"

    def pose_delay(self) -> np.ndarray:
        values = np.asarray(self.values, float)
        twist, pose, linear, angular = values.reshape(4, -1).mean(axis=1)
        return pose - twist - np.array([linear] * 3 + [angular] * 3)

    def _delays(self, V: Array) -> tuple[Array, Array]:
        """Delays (s) of the twist's six components, and of the pose."""
        twist, pose, linear, angular = (self.part(i, V)[None] for i in range(4))
        return jnp.concatenate([twist + linear] * 3 + [twist + angular] * 3), pose

    def measure(
        self, X_WB: Float[Array, "7 *#batch"], V_WB_B: Float[Array, "6 *#batch"], recent: Recent
    ) -> tuple[Float[Array, "7 *#batch"], Float[Array, "6 *#batch"]]:
        late, pose = self._delays(V_WB_B)
        way = pose * V_WB_B + recent.back(pose)[1]
        return se3.retract(X_WB, -way), V_WB_B + recent.back(late)[0]

    def unmeasure(
        self, X_WB: Float[Array, "7 *#batch"], V_WB_B: Float[Array, "6 *#batch"], recent: Recent
    ) -> tuple[Float[Array, "7 *#batch"], Float[Array, "6 *#batch"]]:
        late, pose = self._delays(V_WB_B)
        V = recent.now(V_WB_B, late)
        return se3.retract(X_WB, pose * V + recent.back(pose)[1]), V


def _heading(X: Array) -> tuple[Array, Array]:
    """Sine and cosine of the heading."""
    w, x, y, z = jnp.unstack(X[:4])
    s, c = 2 * (w * z + x * y), 1 - 2 * (y * y + z * z)
    size = jnp.sqrt(s * s + c * c)
    return s / size, c / size


def _turned(X: Array, angle: Array) -> Array:
    """The pose with its attitude rotated about W's z axis; the position is kept."""
    w, x, y, z = jnp.unstack(X[:4])
    c, s = jnp.cos(angle / 2), jnp.sin(angle / 2)
    q = [c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w]
    p = [X[i] + 0 * c for i in (4, 5, 6)]
    return jnp.stack(jnp.broadcast_arrays(*q, *p))
