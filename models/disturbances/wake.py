"""Ship wake: one packet of waves, the longest first."""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..config.checks import require
from ..dynamics import Flow
from ..randomness import Scalar, uniform
from .base import Disturbance
from .linear_waves import orbital_factors, wave_number


@dataclass(frozen=True)
class ShipWake(Disturbance):
    """The wake of a passing ship, a chirped packet with the envelope sin²(π s), s in [0, 1].

    With s the fraction of the packet that has passed a point, the frequency rises as
    ω(s) = ω_m c^(2s − 1) from ω_m / c to ω_m c. The orbital velocity, with its decay over depth, is
    that of a linear wave of this frequency and of height H sin²(π s) in water of finite depth. The
    crests travel at the phase speed of the middle period. The
    acceleration is the exact derivative of the velocity in time, and both vanish smoothly at the
    ends. The state holds the start time at the origin of W and the phase.

    Attributes:
        height: crest-to-trough height H at the middle of the packet (m).
        period: period at the middle of the packet, 2π/ω_m (s).
        duration: time the packet takes to pass (s).
        chirp: c, the ratio of the first period to the middle one.
        earliest_start: lower end of the range of start times (s).
        latest_start: upper end (s); the start is uniform between the two.
        direction: direction the waves travel to (rad), counter-clockwise from W's x axis.
        water_depth: h (m); the bed lies at z = −h.
        gravity: (m/s²).
    """

    height: float = 0.3
    period: float = 3.0
    duration: float = 60.0
    chirp: float = 1.4
    earliest_start: float = 0.0
    latest_start: float = 0.0
    direction: float = 0.0
    water_depth: float = 10.0
    gravity: float = 9.80665

    def __post_init__(self) -> None:
        """Check signs and the order of the start times."""
        super().__post_init__()
        for field in ("period", "duration", "water_depth", "gravity"):
            require(getattr(self, field) > 0, self, field, "give a number above zero")
        require(self.height >= 0, self, "height", "give zero or more")
        require(1 < self.chirp <= 3, self, "chirp", "give more than 1, at most 3")
        late = self.latest_start >= self.earliest_start
        require(late, self, "latest_start", "give at least earliest_start")

    @property
    def state_size(self) -> int:
        """Start time and phase."""
        return 2

    @property
    def initial_noise_size(self) -> int:
        """Start time and phase."""
        return 2

    def initial(self, w: Float[Array, "2 *batch"]) -> Float[Array, "2 *batch"]:
        """Draw a start time in the range and a phase."""
        start = uniform(w[0], self.earliest_start, self.latest_start)
        return jnp.stack([start, uniform(w[1], 0.0, 2 * math.pi)])

    def _velocity(self, state: Array, p_W: Array, t: Array) -> Array:
        middle, h, g = 2 * math.pi / self.period, self.water_depth, self.gravity
        c, s = math.cos(self.direction), math.sin(self.direction)
        speed = middle / float(wave_number(np.float64(middle), h, g, xp=np))
        local = t - state[0] - (c * p_W[0] + s * p_W[1]) / speed
        share = jnp.clip(local / self.duration, 0, 1)
        rise = 2 * math.log(self.chirp)
        ratio = jnp.exp(rise * (share - 0.5))
        omega = middle * ratio
        phase = middle * self.duration / rise * ratio + state[1]
        horizontal, vertical = orbital_factors(wave_number(omega, h, g), p_W[2], h)
        amplitude = self.height / 2 * jnp.sin(math.pi * share) ** 2 * omega
        u = amplitude * horizontal * jnp.cos(phase)
        return jnp.stack([c * u, s * u, -amplitude * vertical * jnp.sin(phase)])

    def flow(
        self, state: Float[Array, "2 *batch"], X_WB: Float[Array, "7 *batch"], t: Scalar
    ) -> Flow:
        """Return the packet's velocity at Bo and its derivative in time."""
        time = jnp.full_like(state[0], t)
        velocity, acceleration = jax.jvp(
            lambda at: self._velocity(state, X_WB[4:], at), (time,), (jnp.ones_like(time),)
        )
        return Flow(velocity, acceleration)
