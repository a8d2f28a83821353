"""Heading from the magnetic field."""

import math
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from ..config.checks import require
from ..randomness import Scalar, column, gauss_markov
from .base import Sensor


@dataclass(frozen=True)
class Compass(Sensor):
    """A tilt-compensated compass with white noise and a slow first-order Gauss–Markov error.

    Reading (1): yaw (rad), counter-clockwise from W's x axis, in [−π, π). State: the slow error,
    then the reading. Mount and position have no effect.

    The slow error models steel and thruster currents nearby; 5 to 10° over 30 to 120 s are
    estimates for a harbour's pylons, the default is for open water.

    Attributes:
        noise: standard deviation of one measurement (rad).
        wander: stationary standard deviation of the slow error (rad).
        wander_time: its time constant (s).
    """

    rate: float = 10.0
    noise: float = 0.01
    wander: float = 0.03
    wander_time: float = 60.0

    def __post_init__(self) -> None:
        """Check signs."""
        super().__post_init__()
        self._require_not_negative("noise", "wander")
        require(self.wander_time > 0, self, "wander_time", "give a time above zero")

    @property
    def state_size(self) -> int:
        """Slow error and reading."""
        return 2

    @property
    def noise_size(self) -> int:
        """White noise and the slow error's noise."""
        return 2

    @property
    def initial_noise_size(self) -> int:
        """The slow error."""
        return 1

    @property
    def reading_size(self) -> int:
        """Yaw."""
        return 1

    def expected(self, X_WB: Float[Array, "7 *batch"]) -> Float[Array, "1 *batch"]:
        """Noise-free reading: the yaw of B."""
        return se3.yaw(X_WB)[None]

    def initial(self, w: Float[Array, "1 *batch"]) -> Float[Array, "2 *batch"]:
        """Draw the slow error from its stationary law."""
        return jnp.concatenate([self.wander * w, jnp.zeros_like(w)])

    def measure(
        self,
        state: Float[Array, "2 *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        dV_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        w: Float[Array, "2 *batch"],
    ) -> Float[Array, "2 *batch"]:
        """Measure, then advance the slow error."""
        del V_WB_B, dV_WB_B, t
        error = state[:1]
        yaw = wrap(self.expected(X_WB) + error + self.noise * w[:1])
        std, time_constant = column(self.wander, state), column(self.wander_time, state)
        return jnp.concatenate([gauss_markov(error, std, time_constant, 1 / self.rate, w[1:]), yaw])


def wrap(angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Angle (rad) brought to [−π, π)."""
    return jnp.mod(angle + math.pi, 2 * math.pi) - math.pi
