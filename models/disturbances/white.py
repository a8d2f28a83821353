"""White body wrench: the sum of all disturbances without memory."""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..config.checks import Vector6, require
from ..dynamics import Flow
from ..randomness import Scalar, column
from .base import Disturbance


@dataclass(frozen=True)
class WhiteWrench(Disturbance):
    """Gaussian white noise in the body frame, constant over each step: F = b w / √dt.

    The impulse over a time T then has the variance b² T for any step. The state is the wrench of
    the current step; it is zero before the first advance, since its size depends on dt.

    Attributes:
        intensity: b of fx, fy, fz (N·√s) and τx, τy, τz (N·m·√s).
    """

    intensity: Vector6 = (0.5, 0.5, 0.5, 0.05, 0.05, 0.05)

    def __post_init__(self) -> None:
        """Check numbers."""
        super().__post_init__()
        require(min(self.intensity) >= 0, self, "intensity", "give intensities of zero or more")

    @property
    def state_size(self) -> int:
        """The six components of the wrench."""
        return 6

    @property
    def noise_size(self) -> int:
        """One for each component."""
        return 6

    def advance(
        self,
        state: Float[Array, "6 *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        dt: Scalar,
        w: Float[Array, "6 *batch"],
    ) -> Float[Array, "6 *batch"]:
        """Draw the wrench of this step."""
        del X_WB, V_WB_B, t
        return column(self.intensity, state) * w / jnp.sqrt(jnp.asarray(dt, state.dtype))

    def wrench(
        self,
        state: Float[Array, "6 *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        flow: Flow | None = None,
    ) -> Float[Array, "6 *batch"]:
        """Return the wrench of this step."""
        del X_WB, V_WB_B, t, flow
        return state
