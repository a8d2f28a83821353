"""A model with effects, period by period: what a plant in a diagram does."""

from collections.abc import Sequence
from itertools import accumulate

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import integrate, se3
from ..dynamics import Flow
from .extended import FOR_EVER, Extended
from .recent import Recent


class Stepper:
    """Steps a model under thruster forces held for a period, with all that its effects carry.

    Memories and random states travel as one vector: `start` before the first period, when no
    thruster has been commanded yet; random states are drawn from their stationary law in it.
    """

    def __init__(self, model: Extended, period: float, substeps: int):
        """`period` in s; a period takes `substeps` steps."""
        self.model = model.for_steps_of(period)
        self.period, self.substeps = period, substeps
        carried = self.model.carried(jnp.zeros(model.inverse.shape[0], model.inverse.dtype))
        parts, self._structure = jax.tree.flatten(carried)
        self._ends = list(accumulate(part.size for part in parts))
        # the last number tells whether it has started
        self.start = (
            np.concatenate([*map(np.asarray, parts), np.zeros(1)]) if parts else np.zeros(0)
        )

    @property
    def gaussians(self) -> int:
        """Unit Gaussians of a substep: six for b dW, then those of random states."""
        return self.model.noise_size

    @property
    def reads(self) -> bool:
        """Whether instruments show anything else than the state."""
        return any(effect.acts("measure") for effect in self.model.effects)

    @property
    def lags(self) -> bool:
        """Whether the model says itself how thrusters follow their command."""
        return any(effect.name == "thruster_lag" for effect in self.model.effects)

    def seen(
        self, X_WB: Float[Array, "7"], V_WB_B: Float[Array, "6"], A_WB_B: Float[Array, "6"]
    ) -> tuple[Float[Array, "7"], Float[Array, "6"]]:
        """Pose and twist as instruments show them, of a state that accelerates by A."""
        return self.model.observe(X_WB, V_WB_B, Recent.steady(A_WB_B, self.period))

    def __call__(
        self,
        X_WB: Float[Array, "7"],
        V_WB_B: Float[Array, "6"],
        carried: Float[Array, " m"],
        level: Float[Array, " n"],
        voltage: Float[Array, "1"] | None,
        F_Bo_B: Float[Array, "6"],
        noise: Float[Array, "S k"],
        water: Sequence[Flow | None],
    ) -> tuple[Float[Array, "7"], Float[Array, "6"], Float[Array, " m"]]:
        """Pose, twist and what is carried after a period.

        `level` are the thrusters' forces (N) before effects, `voltage` is relative to the nominal
        one, `F_Bo_B` acts besides; `noise` has S substeps of unit Gaussians, `water` their flow.
        """
        model, h = self.model, self.period / self.substeps
        *parts, started = jnp.split(carried, self._ends) if self._ends else [carried]
        memory, random = jax.tree.unflatten(self._structure, parts)
        memory, levels = model.actuate(memory, level, self.period, self.substeps)
        memory, felt = model.feel(memory, V_WB_B, self.period)
        F_other = F_Bo_B if felt is None else F_Bo_B + felt
        X, V, body = X_WB, V_WB_B, model.body
        for s, flow in enumerate(water):
            V_r = V
            if flow is not None:
                V_r = V - jnp.concatenate([se3.rotate_inverse(X, flow.v_WC_W), jnp.zeros(3)])
            fresh = self._ends and s == 0
            dt = jnp.where(started[0] > 0, h, FOR_EVER) if fresh else h
            random, push = model.stir(random, X, V, noise[s], dt)
            F = model.push(levels[..., s], X, V_r, voltage) + push + F_other
            X, V = integrate.step(body, X, V, F, h, h**0.5 * noise[s, :6], flow)
        left = jax.tree.leaves((memory, random))
        return X, V, jnp.concatenate([*left, jnp.ones(1)]) if left else carried
