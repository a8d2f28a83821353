"""Rollouts of wrench sequences under the model, and their costs."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...models import se3
from ...models.dynamics import Dynamics
from ...models.integrate import step
from ..plant.frozen_coefficients import FrozenCoefficients
from ..plant.wrench_limits import WrenchLimits
from .mppi_config import MppiConfig
from .task import Task


class Situation(NamedTuple):
    """What all sequences of a call share.

    Attributes:
        X_WB: state at the call.
        V_WB_B: the same.
        F_bias_W: wrench about Bo with axes of W that acts besides the model's.
        before: the wrench of the last plan that acted until now, for a model with lag or delay.
        times: t0 + k dt with k = 0 … H (s).
        hold: the wrenches that keep the vehicle at rest in the states that are wanted at the first
            H of them.
        dW: Brownian increments (√s) of the realisations; None for a single one.
    """

    X_WB: Float[Array, "7"]
    V_WB_B: Float[Array, "6"]
    F_bias_W: Float[Array, "6"]
    before: Float[Array, "6"]
    times: Float[Array, " n"]
    hold: Float[Array, "horizon 6"]
    dW: Float[Array, "horizon substeps 6 r"] | None


class Rolled(NamedTuple):
    """Rollouts of n sequences in r realisations; the states are those of the first realisation.

    `clearance` is each realisation's least over the horizon, None for a task without one.
    """

    cost: Float[Array, "r n"]
    clearance: Float[Array, "r n"] | None
    states: tuple[Array, ...]


class Rollouts(eqx.Module):
    """The vehicle that a planner simulates, on its task.

    With `tracking` gains, K_p and K_d, the noise paths are those of a vehicle that tracks the plan,
    and the attitude is held, as `MppiPlanner` describes.
    """

    dynamics: Dynamics
    limits: WrenchLimits
    task: Task
    tracking: tuple[Float[Array, "6 6"], Float[Array, "6 6"]] | None
    config: MppiConfig = eqx.field(static=True)

    @property
    def tracked(self) -> bool:
        """Whether the noise paths follow the plan."""
        return self.tracking is not None and self.config.tracked

    def hold_wrenches(
        self, t: Float[Array, " n"], F_bias_W: Float[Array, "6"]
    ) -> Float[Array, "n 6"]:
        """The wrenches that keep the vehicle at rest in the poses that are wanted at times t (s).

        They balance the potential wrench and the remaining static wrenches of an extended model:
        buoyancy, payload, tether or current.
        """
        X_WB = jax.vmap(lambda t: self.task.wanted(t).X_WB, out_axes=1)(t)
        hold = -self.dynamics.potential_wrench(X_WB)
        hold = hold - self.dynamics.balance(X_WB, jnp.zeros_like(hold), hold)[1]
        return (hold - in_body(X_WB, F_bias_W)).T

    def __call__(self, F_Bo_B: Float[Array, "horizon 6 n"], at: Situation, keep) -> Rolled:
        """Roll out n sequences under all noise paths, r-major; `keep(X, V, F)` picks the states."""
        c, dW = self.config, at.dW
        n = F_Bo_B.shape[2]
        r = 1 if dW is None else dW.shape[3]
        h = c.dt / c.steps_of_model
        X = jnp.broadcast_to(at.X_WB[:, None], (7, r * n))
        V = jnp.broadcast_to(at.V_WB_B[:, None], (6, r * n))
        last = jnp.zeros(c.horizon, V.dtype).at[-1].set(c.terminal_time)

        def advance(carry, inputs):
            X, V, cost, least, memory = carry
            F, dW, terminal, now, then = inputs
            planned = self._turned(now, jnp.tile(F, (1, r)), X, V, n)
            later = in_body(X, at.F_bias_W)
            wrench = planned
            if self.tracked and dW is not None:
                wrench = wrench + self._pull(X, V, n)
            wrenches = [wrench + later] * c.steps_of_model
            if self.dynamics.remembers:
                memory, late = self.dynamics.arriving(memory, wrench, V, c.dt, c.steps_of_model)
                wrenches = [late[..., i] + later for i in range(c.steps_of_model)]
            model = FrozenCoefficients(self.dynamics, V) if c.steps_of_model > 1 else self.dynamics
            for i in range(c.steps_of_model):
                noise = None if dW is None else jnp.repeat(dW[i], n, 1)
                X, V = step(model, X, V, wrenches[i], h, noise)
            clearance = self.task.clearance(then, X, V)
            cost = cost + (c.dt + terminal) * self.task.running_cost(then, X, V)
            if clearance is not None:
                near = jnp.maximum(1 - clearance / c.margin, 0)
                cost = cost + c.dt * c.margin_weight * near * near
                least = jnp.minimum(least, clearance)
            return (X, V, cost, least, memory), keep(X, V, planned)

        memory = ()
        if self.dynamics.remembers:
            memory = self.dynamics.commanded(jnp.broadcast_to(at.before[:, None], (6, r * n)))
        least = jnp.full_like(V[0], jnp.inf)
        start = (X, V, jnp.zeros_like(V[0]), least, memory)
        inputs = (F_Bo_B, dW, last, at.times[:-1], at.times[1:])
        (X, V, cost, least, _), kept = jax.lax.scan(advance, start, inputs)
        terminal = self.task.terminal_cost(at.times[-1], X, V)
        cost = cost if terminal is None else cost + terminal
        free = self.task.clearance(at.times[-1], X, V) is None
        return Rolled(cost.reshape(r, n), None if free else least.reshape(r, n), kept)

    def _turned(self, t: Array, F: Array, X: Array, V: Array, n: int) -> Array:
        """Wrenches of n sequences plus the feedback to the wanted attitude, clipped to U.

        Both paths of a pair get the feedback of their midpoint: the feedback to the midpoint is not
        part of the plan (`_pull`).
        """
        if self.tracking is None or not self.config.hold_attitude:
            return F
        K_p, K_d = (gain[3:, 3:] for gain in self.tracking)
        wanted = self.task.wanted(t)
        to_wanted = se3.local(X, wanted.X_WB)[3:]
        moment = K_p @ to_wanted + K_d @ (wanted.V_WB_B[3:, None] - V[3:])
        pairs = self.config.realisations // 2 * n
        if moment.shape[1] > n:
            first, second, rest = jnp.split(moment, [pairs, 2 * pairs], axis=1)
            moment = jnp.concatenate([(first + second) / 2] * 2 + [rest], axis=1)
        return self.limits.clip(F + jnp.concatenate([jnp.zeros_like(moment), moment]))

    def _pull(self, X: Array, V: Array, n: int) -> Array:
        """Tracking feedback for n sequences: it pulls each path to the midpoint of its pair."""
        assert self.tracking is not None
        K_p, K_d = self.tracking
        half = self.config.realisations // 2 * n
        first, second = slice(0, half), slice(half, 2 * half)
        to_middle = se3.local(X[:, first], X[:, second]) / 2
        pull = K_p @ to_middle + K_d @ ((V[:, second] - V[:, first]) / 2)
        return jnp.concatenate([pull, -pull, jnp.zeros_like(V[:, 2 * half :])], axis=1)


def in_body(X_WB: Float[Array, "7 *batch"], F_W: Float[Array, "6"]) -> Float[Array, "6 *batch"]:
    """A wrench about Bo whose axes are W's, with the axes of B."""
    return jnp.concatenate([se3.rotate_inverse(X_WB, F_W[:3]), se3.rotate_inverse(X_WB, F_W[3:])])
