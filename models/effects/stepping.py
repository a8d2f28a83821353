"""Steps of a model with effects over a period, as a plant in a diagram takes them."""

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import integrate, se3
from ..dynamics import Flow, Memory
from .extended import FOR_EVER, Extended, Random
from .recent import Recent


def advanced(
    model: Extended,
    carried: tuple[Memory, Random],
    X_WB: Float[Array, "7 *#batch"],
    V_WB_B: Float[Array, "6 *#batch"],
    level: Float[Array, "n *#batch"],
    voltage: Float[Array, "1 *#batch"] | None,
    F_Bo_B: Sequence[Float[Array, "6 *#batch"]],
    noise: Sequence[Float[Array, "k *#batch"]] | None,
    period: float,
    started: Any = True,
    water: Sequence[Flow | None] | None = None,
    rise: Float[Array, "n *#batch"] | None = None,
) -> tuple[tuple[Memory, Random], Float[Array, "7 *#batch"], Float[Array, "6 *#batch"]]:
    """Simulation state, pose and twist after a `period` (s) under thruster forces.

    These are held, or have the mean `level` and change by `rise` over the period.

    It takes a substep for each wrench of `F_Bo_B`, which adds to the thrusters'; `noise` holds the
    unit Gaussians of each substep (`Extended.noise_size`), `water` its flow. If not `started`, the
    random states are drawn from their stationary law; without noise they are left out.
    """
    memory, random = carried
    body, count = model.body, len(F_Bo_B)
    h = period / count
    memory, levels = model.actuate(memory, level, period, count, rise)
    memory, felt = model.feel(memory, V_WB_B, period)
    X, V = X_WB, V_WB_B
    for s, F_other in enumerate(F_Bo_B):
        flow = None if water is None else water[s]
        V_r = V
        if flow is not None:
            v_c = se3.rotate_inverse(X, flow.v_WC_W)
            V_r = V - jnp.concatenate([v_c, jnp.zeros_like(v_c)])
        F = model.push(levels[..., s], X, V_r, voltage) + F_other
        F = F if felt is None else F + felt
        dW = None
        if noise is not None:
            dt = jnp.where(started, h, FOR_EVER) if random and s == 0 else h
            random, push = model.step_random_state(random, X, V, noise[s], dt)
            F, dW = F + push, h**0.5 * noise[s][:6]
        X, V = integrate.step(body, X, V, F, h, dW, flow)
    return (memory, random), X, V


class Stepper:
    """Steps a model and the state of its effects under thruster forces held for a period.

    Memories and random states are one vector: `start` before the first period, with commands of
    zero. In the first period random states are drawn from their stationary law.
    """

    def __init__(self, model: Extended, period: float, substeps: int):
        """`period` in s, divided into `substeps`."""
        self.model = model.for_steps_of(period)
        self.period, self.substeps = period, substeps
        carried = self.model.simulation_state(
            jnp.zeros(model.inverse.shape[0], model.inverse.dtype)
        )
        parts, self._structure = jax.tree.flatten(carried)
        self._ends = list(accumulate(part.size for part in parts))
        # the last number is 1 once the first period is over
        self.start = (
            np.concatenate([*map(np.asarray, parts), np.zeros(1)]) if parts else np.zeros(0)
        )

    @property
    def gaussians(self) -> int:
        """Unit Gaussians per substep: six for b dW, then those of random states."""
        return self.model.noise_size

    @property
    def reads(self) -> bool:
        """Whether any effect makes the recorded state differ from the true one."""
        return self.model.reads

    @property
    def lags(self) -> bool:
        """Whether the model has a thruster lag of its own."""
        return any(effect.name == "thruster_lag" for effect in self.model.effects)

    def seen(
        self, X_WB: Float[Array, "7"], V_WB_B: Float[Array, "6"], A_WB_B: Float[Array, "6"]
    ) -> tuple[Float[Array, "7"], Float[Array, "6"]]:
        """Pose and twist as instruments measure them, at acceleration A."""
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
        """Pose, twist and simulation state after a period.

        `level` holds thruster forces (N) before effects, `voltage` is relative to the nominal one,
        `F_Bo_B` is added to theirs; `noise` has unit Gaussians of S substeps, `water` their flow.
        """
        *parts, started = jnp.split(carried, self._ends) if self._ends else [carried]
        before = jax.tree.unflatten(self._structure, parts)
        began = started[0] > 0 if self._ends else True
        pushes = [F_Bo_B] * self.substeps
        after, X, V = advanced(
            self.model, before, X_WB, V_WB_B, level, voltage, pushes, list(noise), self.period,
            began, water,
        )  # fmt: skip
        left = jax.tree.leaves(after)
        return X, V, jnp.concatenate([*left, jnp.ones(1)]) if left else carried
