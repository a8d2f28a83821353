"""Inertial measurement unit: specific force and angular rate."""

import math
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from ..config.checks import require
from ..randomness import Scalar, column
from .base import Sensor, velocity_at

_DEGREE = math.pi / 180


@dataclass(frozen=True)
class Imu(Sensor):
    """Accelerometers and gyroscopes with white noise, bias random walk and saturation.

    Reading: specific force (m/s²), then angular rate (rad/s), in the sensor's axes. A strapdown
    unit integrates at some kHz between its output samples (Savage 1998, eq. 1 and 2), so with
    `integrating` a reading is the mean since the previous reading: the rate whose exponential is
    the rotation, and the specific force whose integral is the change of velocity, in the axes at
    the interval's end. Otherwise it is the instantaneous rate, and the specific force for the given
    derivative of the twist: motion between samples is not measured.

    White noise of one measurement has the deviation density · √(rate / 2); the biases change by
    walk · √(1 / rate). State: six biases in the reading's order, attitude (4) and velocity in W (3)
    of the sensor at the previous measurement, 1 once there was one, then the reading.

    Defaults are those of the ICM-20602 on a Navigator board (data sheet: 100 µg/√Hz, 4 mdps/√Hz;
    bench logs agree within a factor of two); the initial biases are an estimate of the residual
    after a calibration at rest.

    Attributes:
        accelerometer_density: noise density (m/s²/√Hz).
        gyroscope_density: noise density (rad/s/√Hz).
        accelerometer_walk: bias random walk (m/s²/√s).
        gyroscope_walk: bias random walk (rad/s/√s).
        accelerometer_bias: standard deviation of the initial bias (m/s²).
        gyroscope_bias: standard deviation of the initial bias (rad/s).
        accelerometer_range: readings saturate at ± this (m/s²).
        gyroscope_range: readings saturate at ± this (rad/s).
        gravity: (m/s²).
        integrating: whether a reading is the mean since the previous one.
    """

    rate: float = 100.0
    accelerometer_density: float = 9.8e-4
    gyroscope_density: float = 7.0e-5
    accelerometer_walk: float = 1.0e-4
    gyroscope_walk: float = 1.0e-5
    accelerometer_bias: float = 0.05
    gyroscope_bias: float = 0.1 * _DEGREE
    accelerometer_range: float = 16 * 9.80665
    gyroscope_range: float = 2000 * _DEGREE
    gravity: float = 9.80665
    integrating: bool = True

    def __post_init__(self) -> None:
        """Check signs."""
        super().__post_init__()
        for kind in ("accelerometer", "gyroscope"):
            self._require_not_negative(*(f"{kind}_{x}" for x in ("density", "walk", "bias")))
            require(getattr(self, f"{kind}_range") > 0, self, f"{kind}_range", "give above zero")

    @property
    def port_size(self) -> int:
        """Its output has no mark and no time: it is never late."""
        return 6

    @property
    def state_size(self) -> int:
        """Six biases, the last attitude and velocity, whether there are any, and the reading."""
        return 20

    @property
    def noise_size(self) -> int:
        """White noise and the random walk of the biases."""
        return 12

    @property
    def initial_noise_size(self) -> int:
        """The biases."""
        return 6

    @property
    def reading_size(self) -> int:
        """Specific force and angular rate."""
        return 6

    def expected(
        self,
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        dV_WB_B: Float[Array, "6 *batch"],
    ) -> Float[Array, "6 *batch"]:
        """Noise-free reading: v̇ + ω × v + ω̇ × r + ω × (ω × r) − Rᵀ g, and ω, in sensor axes."""
        X_BS = self.mount(X_WB.dtype)
        v, omega, alpha = V_WB_B[:3], V_WB_B[3:], dV_WB_B[3:]
        r = column(self.position, v) + jnp.zeros_like(v)
        f = dV_WB_B[:3] + se3.cross(omega, v)
        f = f + se3.cross(alpha, r) + se3.cross(omega, se3.cross(omega, r))
        f = f + se3.rotate_inverse(X_WB, column((0.0, 0.0, self.gravity), v))
        return jnp.concatenate([se3.rotate_inverse(X_BS, f), se3.rotate_inverse(X_BS, omega)])

    def mean(
        self,
        before: Float[Array, "7 *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
    ) -> Float[Array, "6 *batch"]:
        """Noise-free mean reading over 1/rate since the attitude and velocity in W of `before`."""
        now = self._carried(X_WB, V_WB_B)
        turn = se3.local(_pose(before[:4]), _pose(now[:4]))[3:]
        force = (now[4:] - before[4:]) * self.rate + column((0.0, 0.0, self.gravity), now)
        return jnp.concatenate([se3.rotate_inverse(_pose(now[:4]), force), turn * self.rate])

    def _carried(
        self, X_WB: Float[Array, "7 *batch"], V_WB_B: Float[Array, "6 *batch"]
    ) -> Float[Array, "7 *batch"]:
        """Attitude of the sensor's axes, then velocity of its origin, both in W."""
        X_BS = self.mount(X_WB.dtype)
        v_W = se3.rotate(X_WB, velocity_at(X_BS[4:], V_WB_B))
        return jnp.concatenate([se3.compose(X_WB, X_BS)[:4], v_W])

    @property
    def noise_std(self) -> tuple[float, ...]:
        """Standard deviation of one measurement's white noise (m/s², rad/s)."""
        scale = math.sqrt(self.rate / 2)
        return (self.accelerometer_density * scale,) * 3 + (self.gyroscope_density * scale,) * 3

    def initial(self, w: Float[Array, "6 *batch"]) -> Float[Array, "20 *batch"]:
        """Draw the initial biases."""
        bias = _six(self.accelerometer_bias, self.gyroscope_bias, w) * w
        return jnp.concatenate([bias, jnp.zeros((14, *w.shape[1:]), w.dtype)])

    def measure(
        self,
        state: Float[Array, "20 *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        dV_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        w: Float[Array, "12 *batch"],
    ) -> Float[Array, "20 *batch"]:
        """Measure, then advance the biases."""
        del t
        bias, before, started = state[:6], state[6:13], state[13:14]
        true = self.expected(X_WB, V_WB_B, dV_WB_B)
        if self.integrating:
            # before the first measurement the stored quaternion is zero, which is no attitude
            before = jnp.where(started > 0, before, self._carried(X_WB, V_WB_B))
            true = jnp.where(started > 0, self.mean(before, X_WB, V_WB_B), true)
        z = true + bias + column(self.noise_std, state) * w[:6]
        limit = _six(self.accelerometer_range, self.gyroscope_range, state)
        step = 1 / math.sqrt(self.rate)
        walk = _six(self.accelerometer_walk * step, self.gyroscope_walk * step, state)
        parts = [bias + walk * w[6:], self._carried(X_WB, V_WB_B), jnp.ones_like(started)]
        return jnp.concatenate([*parts, jnp.clip(z, -limit, limit)])


def _pose(q: Float[Array, "4 *batch"]) -> Float[Array, "7 *batch"]:
    """The pose of an attitude at the origin."""
    return jnp.concatenate([q, jnp.zeros_like(q[:3])])


def _six(accelerometer: float, gyroscope: float, like: Float[Array, "n *batch"]) -> Array:
    return column((accelerometer,) * 3 + (gyroscope,) * 3, like)
