"""Heading from the magnetic field."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from ..config.checks import require
from ..randomness import Scalar, column, gauss_markov
from .base import Gauge, Innovation, along_pose


@dataclass(frozen=True)
class Compass(Gauge):
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

    observes: ClassVar[Literal["attitude"]] = "attitude"
    angle: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check signs."""
        super().__post_init__()
        self._require_not_negative("noise", "wander")
        require(self.wander_time > 0, self, "wander_time", "give a time above zero")

    @property
    def noise_size(self) -> int:
        """White noise and the slow error's noise."""
        return 2

    @property
    def slow_error(self) -> tuple[float, float]:
        """The wander."""
        return self.wander, self.wander_time

    def innovation(
        self,
        X_WB: Float[Array, "7"],
        V_WB_B: Float[Array, "6"],
        slow: Float[Array, "1"],
        values: Float[Array, "1"],
    ) -> Innovation:
        """Component of the bow perpendicular to the compass heading, corrected for the wander.

        The component of the bow perpendicular to the true heading is zero at every attitude, and is
        differentiable where yaw is not. A yaw error Δ makes it cos θ sin Δ, so the residual is
        cos θ times that of yaw; beyond 90° it is clipped. The noise, cos θ times that of the
        compass, is taken as the compass' own: a compass is no more accurate than that while the bow
        is up.
        """
        yaw = self.expected(X_WB)
        off = jnp.clip(wrap(values - yaw - slow), -math.pi / 2, math.pi / 2)
        shown = yaw + off
        across = jnp.concatenate([-jnp.sin(shown), jnp.cos(shown), jnp.zeros_like(shown)])
        bow = jnp.eye(3, dtype=yaw.dtype)[0]
        h, H = along_pose(lambda X: (across @ se3.rotate(X, bow))[None], X_WB)
        level = jnp.linalg.norm(se3.rotate(X_WB, bow)[:2]) * jnp.cos(off[0])
        return Innovation(-h, H, slow=level[None])

    def off(
        self,
        X_WB: Float[Array, "7"],
        V_WB_B: Float[Array, "6"],
        slow: Float[Array, "1"],
        values: Float[Array, "1"],
    ) -> Float[Array, "1"]:
        """The difference of yaw, in [−π, π) rad."""
        del V_WB_B
        return wrap(values - self.expected(X_WB) - slow)

    def expected(self, X_WB: Float[Array, "7 *batch"]) -> Float[Array, "1 *batch"]:
        """Noise-free reading: the yaw of B."""
        return se3.yaw(X_WB)[None]

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
