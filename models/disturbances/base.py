"""Interface of disturbances."""

import abc

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..config.checks import check_numbers
from ..dynamics import Flow
from ..randomness import Scalar


class Disturbance(abc.ABC):
    """A frozen configuration whose methods are pure functions of arrays.

    The state is one flat array `(state_size, *batch)`, so a Drake system can hold it as a discrete
    state. Randomness enters through `w` alone, independent unit Gaussians: `initial_noise_size` of
    them at the start and `noise_size` at every advance. Sizes may be zero.

    `advance` is called at the start t of a step and returns the state that holds on [t, t + dt);
    `wrench` and `flow` read it at any time of that step.
    """

    def __post_init__(self) -> None:
        """Check numbers; kinds extend this with their own limits and raise `UserError`."""
        check_numbers(self)

    @property
    @abc.abstractmethod
    def state_size(self) -> int:
        """Length of the state."""

    @property
    def noise_size(self) -> int:
        """Number of unit Gaussians that one advance takes."""
        return 0

    @property
    def initial_noise_size(self) -> int:
        """Number of unit Gaussians that the initial state takes."""
        return 0

    def initial(self, w: Float[Array, "w *batch"]) -> Float[Array, "s *batch"]:
        """Return a state drawn from the stationary law, before the first advance."""
        return jnp.zeros((self.state_size, *w.shape[1:]), w.dtype)

    def advance(
        self,
        state: Float[Array, "s *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        dt: Scalar,
        w: Float[Array, "w *batch"],
    ) -> Float[Array, "s *batch"]:
        """Return the state on [t, t + dt)."""
        del X_WB, V_WB_B, t, dt, w
        return state

    def wrench(
        self,
        state: Float[Array, "s *batch"],
        X_WB: Float[Array, "7 *batch"],
        V_WB_B: Float[Array, "6 *batch"],
        t: Scalar,
        flow: Flow | None = None,
    ) -> Float[Array, "6 *batch"]:
        """Return the wrench F_Bo_B (N, N·m); `flow` is the water's motion, still water if None."""
        del state, t, flow
        return jnp.zeros_like(V_WB_B)

    def flow(
        self, state: Float[Array, "s *batch"], X_WB: Float[Array, "7 *batch"], t: Scalar
    ) -> Flow:
        """Return the water's velocity and local acceleration ∂v/∂t at Bo, in W."""
        del state, t
        return Flow(jnp.zeros_like(X_WB[4:]), jnp.zeros_like(X_WB[4:]))
