"""Ornstein–Uhlenbeck wrench: a coloured disturbance."""

from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import se3
from ..config.checks import Vector6, require
from ..dynamics import Flow
from ..randomness import Scalar, column, gauss_markov
from .base import Disturbance


@dataclass(frozen=True)
class OrnsteinUhlenbeckWrench(Disturbance):
    """A mean-reverting wrench, dF = −F/τ dt + σ √(2/τ) dW, discretised exactly.

    It starts from its stationary law; the autocorrelation is σ² exp(−|lag|/τ) (Uhlenbeck and
    Ornstein 1930).

    Attributes:
        std: stationary standard deviation σ of fx, fy, fz (N) and τx, τy, τz (N·m).
        time_constant: τ of each component (s).
        frame: axes of the components: `body`, or `world` for wrenches that keep their
            direction while the vehicle turns. Moments are about Bo in both.
    """

    std: Vector6 = (1.0, 1.0, 1.0, 0.1, 0.1, 0.1)
    time_constant: Vector6 = (2.0, 2.0, 2.0, 1.0, 1.0, 1.0)
    frame: Literal["body", "world"] = "body"

    def __post_init__(self) -> None:
        """Check numbers and the frame's name."""
        super().__post_init__()
        require(min(self.std) >= 0, self, "std", "give standard deviations of zero or more")
        require(min(self.time_constant) > 0, self, "time_constant", "give times above zero")
        require(self.frame in ("body", "world"), self, "frame", "give body or world")

    @property
    def state_size(self) -> int:
        """The six components of the wrench."""
        return 6

    @property
    def noise_size(self) -> int:
        """One for each component."""
        return 6

    @property
    def initial_noise_size(self) -> int:
        """One for each component."""
        return 6

    def initial(self, w: Float[Array, "6 *batch"]) -> Float[Array, "6 *batch"]:
        """Draw from the stationary law."""
        return column(self.std, w) * w

    def advance(
        self,
        state: Float[Array, "6 *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        dt: Scalar,
        w: Float[Array, "6 *batch"],
    ) -> Float[Array, "6 *batch"]:
        """Advance the process by dt."""
        del X_WB, V_WB_B, t
        return gauss_markov(
            state, column(self.std, state), column(self.time_constant, state), dt, w
        )

    def wrench(
        self,
        state: Float[Array, "6 *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        flow: Flow | None = None,
    ) -> Float[Array, "6 *batch"]:
        """Return the current wrench, rotated into B if its components are in W."""
        del V_WB_B, t, flow
        if self.frame == "body":
            return state
        return jnp.concatenate(
            [se3.rotate_inverse(X_WB, state[:3]), se3.rotate_inverse(X_WB, state[3:])]
        )
