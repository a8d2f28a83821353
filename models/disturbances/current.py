"""Tidal current: a slow flow of random speed and heading."""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..config.checks import require
from ..dynamics import Flow
from ..randomness import Scalar, column, gauss_markov
from .base import Disturbance


@dataclass(frozen=True)
class GaussMarkovCurrent(Disturbance):
    """A current whose speed, heading and vertical speed are first-order Gauss–Markov processes.

    Speed: dx = −μ (x − mean) dt + std √(2μ) dW; the water's speed is x clipped to
    [min_speed, max_speed] (Fossen 2011, section 8.3). The process itself is not clipped, so its
    stationary law and autocorrelation are exact and only the output saturates. Within a step the
    velocity is linear from its old to its new value: it is continuous, and the acceleration,
    constant over the step, is exactly its time derivative and so averages to zero, clipped or not.

    The state holds x − mean, heading − direction and vertical speed at the end of the step, then
    the velocity at its start (3), the acceleration (3), its start time and its length.

    Attributes:
        mean_speed: mean of the speed process (m/s).
        std_speed: its stationary standard deviation (m/s).
        time_constant: 1/μ of speed and vertical speed (s).
        min_speed: lower limit of the speed (m/s).
        max_speed: upper limit of the speed (m/s).
        direction: mean direction the water flows to (rad), counter-clockwise from W's x axis.
        std_direction: stationary standard deviation of the direction (rad).
        direction_time_constant: time constant of the direction (s).
        std_vertical: stationary standard deviation of the vertical speed (m/s).
        profile_depth: water depth h (m) of the profile v(z) = v(0) (1 + z/h)^(1/7); 0 for none.
    """

    mean_speed: float = 0.2
    std_speed: float = 0.08
    time_constant: float = 200.0
    min_speed: float = 0.0
    max_speed: float = 0.5
    direction: float = 0.0
    std_direction: float = 0.3
    direction_time_constant: float = 600.0
    std_vertical: float = 0.0
    profile_depth: float = 0.0

    def __post_init__(self) -> None:
        """Check signs and the order of the limits."""
        super().__post_init__()
        for field in ("std_speed", "min_speed", "std_direction", "std_vertical", "profile_depth"):
            require(getattr(self, field) >= 0, self, field, "give zero or more")
        for field in ("time_constant", "direction_time_constant"):
            require(getattr(self, field) > 0, self, field, "give a time above zero")
        require(self.max_speed >= self.min_speed, self, "max_speed", "give at least min_speed")

    @property
    def state_size(self) -> int:
        """Three processes, velocity and acceleration of the step, its start and length."""
        return 11

    @property
    def noise_size(self) -> int:
        """Speed, heading, vertical speed."""
        return 3

    @property
    def initial_noise_size(self) -> int:
        """Speed, heading, vertical speed."""
        return 3

    def _std(self, like: Array) -> Array:
        return column((self.std_speed, self.std_direction, self.std_vertical), like)

    def _velocity(self, x: Float[Array, "3 *batch"]) -> Float[Array, "3 *batch"]:
        speed = jnp.clip(self.mean_speed + x[0], self.min_speed, self.max_speed)
        heading = self.direction + x[1]
        return jnp.stack([speed * jnp.cos(heading), speed * jnp.sin(heading), x[2]])

    def initial(self, w: Float[Array, "3 *batch"]) -> Float[Array, "11 *batch"]:
        """Draw from the stationary law; the water does not accelerate before the first advance."""
        x = self._std(w) * w
        return jnp.concatenate([x, self._velocity(x), jnp.zeros_like(x), jnp.zeros_like(x[:2])])

    def advance(
        self,
        state: Float[Array, "11 *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        dt: Scalar,
        w: Float[Array, "3 *batch"],
    ) -> Float[Array, "11 *batch"]:
        """Advance the processes by dt and set the velocity's ramp over [t, t + dt)."""
        del X_WB, V_WB_B
        times = (self.time_constant, self.direction_time_constant, self.time_constant)
        x = gauss_markov(state[:3], self._std(state), column(times, state), dt, w)
        start, step = (jnp.full_like(state[:1], value) for value in (t, dt))
        v = self._velocity(state[:3])
        return jnp.concatenate([x, v, (self._velocity(x) - v) / step, start, step])

    def flow(
        self, state: Float[Array, "11 *batch"], X_WB: Float[Array, "7 *batch"], t: Scalar
    ) -> Flow:
        """Return velocity and acceleration at Bo, with the depth profile if there is one."""
        v, a, start, step = state[3:6], state[6:9], state[9:10], state[10:]
        velocity = v + a * jnp.clip(jnp.asarray(t, state.dtype) - start, 0, step)
        if self.profile_depth > 0:
            height = jnp.clip(1 + X_WB[6:] / self.profile_depth, 1e-6, 1)
            shape = height ** (1 / 7)
            return Flow(velocity * shape, a * shape)
        return Flow(velocity, a)
