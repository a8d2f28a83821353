"""Model predictive path integral control as a pure function."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...models.dynamics import Dynamics
from ...models.effects.extended import Extended
from ...models.integrate import cast
from ..plant.wrench_limits import WrenchLimits
from .mppi_config import MppiConfig
from .path_integral import (
    chance_violation,
    combine_risk,
    effective_count,
    path_integral_weights,
)
from .rollouts import Rolled, Rollouts, Situation
from .sampling import Sampler
from .task import Task, check_task


class MppiState(eqx.Module):
    """The chosen sequence, from the time of the last call on, for the warm start of the next.

    The attitude controller's moments are not included (`MppiPlanner`).
    """

    F_Bo_B: Float[Array, "horizon 6"]


class MppiOutput(NamedTuple):
    """The plan and the samples it was chosen from; times k dt with k = 0 … H count from the call.

    `F_Bo_B` is the whole planned wrench, including the moments that hold the attitude.
    """

    X_WB: Float[Array, "7 n"]
    V_WB_B: Float[Array, "6 n"]
    F_Bo_B: Float[Array, "6 horizon"]
    valid: Bool[Array, ""]
    cost: Float[Array, ""]
    collision_probability: Float[Array, ""]
    clearance: Float[Array, ""]
    effective_samples: Float[Array, ""]
    temperature: Float[Array, ""]
    weights: Float[Array, " sequences"]
    paths: Float[Array, "horizon 3 shown"]
    path_weights: Float[Array, " shown"]


class Draw(NamedTuple):
    """Samples of a call: its sequences in parts, and what all of them share.

    Attributes:
        nominal: the last plan, shifted by the elapsed time.
        parts: the sequences, in as many parts as `MppiConfig.threads`.
        at: the state, the times, the hold and the noise.
    """

    nominal: Float[Array, "horizon 6"]
    parts: tuple[Float[Array, "horizon 6 _"], ...]
    at: Situation


class MppiPlanner(eqx.Module):
    """Sampled solution of a task's stochastic optimal control problem (`systems.planning.task`) for
    a vehicle d(g, ξ) = model with wrenches u ∈ U. With the task of Palmer et al., "Field
    Experiments", it is their

        min_u E ∫ ‖log(g⁻¹ g_goal)‖²_L + ‖ξ_goal − ξ‖²_Q dt   subject to   u ∈ U,
        d(g, ξ) = model,  P(g ∈ G over the horizon) ≥ 1 − α,

    by path integrals (Williams et al. 2016). Around the last plan, shifted by the elapsed time,
    wrench sequences are sampled with smooth noise and clipped to U. Every sequence is rolled out
    under the same `realisations` of the model's process noise (in antithetic pairs), as common
    random numbers. Costs become weights and the weighted mean sequence is clipped to U. The
    candidates are the mean, the best sample, the best sample that satisfies the chance constraint,
    and the last plan, since the mean of passing left and passing right of an obstacle may collide.
    The candidate of least cost that satisfies the constraint is chosen, or else the one that
    violates it least: a distant goal's cost never outweighs a collision. The plan's states are
    those of the model's drift under it.

    With `tracking` gains the noise paths are those of a vehicle that tracks the plan: the two paths
    of a pair are pulled to their midpoint, which approximates the path without noise, by
    K_p log(g⁻¹ g_mid) + K_d (ξ_mid − ξ). Without them the paths diverge in open loop, as in the
    problem above, and the plan avoids gaps that the tracked vehicle passes safely.

    With `tracking` gains and `hold_attitude`, the sampled wrenches are added to a feedback with K_p
    and K_d on the attitude alone, towards the wanted attitude; the sum is clipped to U. The Munk
    moment turns a moving hull broadside (Fossen 2011, section 6.3.1): hardly any open-loop sequence
    of wrenches keeps the attitude over the horizon, least of all in a current.

    `F_bias_W` is a wrench about Bo with axes of W that acts besides the model's (an observed
    current, say); the plan's wrenches then include its compensation.
    """

    sampler: Sampler
    rollouts: Rollouts
    config: MppiConfig = eqx.field(static=True)

    def __init__(
        self,
        dynamics: Dynamics,
        limits: WrenchLimits,
        task: Task,
        config: MppiConfig | None = None,
        tracking: tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6 6"]] | None = None,
        dtype: jnp.dtype | type = jnp.float32,
    ):
        """`tracking` are K_p and K_d (or None). All arrays are cast to `dtype`.

        Raises:
            ValueError: a function of the task returns another size than it should.
        """
        self.config = MppiConfig() if config is None else config
        if isinstance(dynamics, Extended):
            dynamics = dynamics.for_steps_of(self.config.dt)
        check_task(task)
        first = task.wanted(jnp.zeros(())).X_WB
        self.sampler = Sampler.create(self.config, cast(limits, dtype), dynamics, first, dtype)
        gains = None
        if tracking is not None:
            gains = jnp.asarray(tracking[0], dtype), jnp.asarray(tracking[1], dtype)
        self.rollouts = Rollouts(
            cast(dynamics, dtype), cast(limits, dtype), cast(task, dtype), gains, self.config
        )

    def times(self, t: Float[Array, "1"]) -> Float[Array, " n"]:
        """The times of a plan's states from t (s) on, in the planner's precision."""
        steps = jnp.arange(self.config.horizon + 1, dtype=t.dtype)
        return self._cast(t + self.config.dt * steps)[0]

    def init(self) -> MppiState:
        """State before the first call: hold."""
        times = self.times(jnp.zeros(1))[:-1]
        return MppiState(self.rollouts.hold_wrenches(times, jnp.zeros_like(self.sampler.axes)))

    def step(
        self,
        state: MppiState,
        key: Array,
        X_WB: Float[Array, "7"],
        V_WB_B: Float[Array, "6"],
        F_bias_W: Float[Array, "6"] | None = None,
        t: Float[Array, "1"] | None = None,
    ) -> tuple[MppiState, MppiOutput]:
        """Plan from a state at time t (s, 0 if left out).

        The same arguments give the same plan, bit for bit. It draws, rolls out and chooses; a
        multithreaded caller rolls out each part by itself.
        """
        bias = jnp.zeros_like(self.sampler.axes) if F_bias_W is None else F_bias_W
        draw = self.draw(state, key, X_WB, V_WB_B, bias, jnp.zeros(1) if t is None else t)
        whole = jnp.concatenate(draw.parts, axis=2)
        return self.choose(draw, [self.roll(whole, draw.at)])

    def draw(
        self,
        state: MppiState,
        key: Array,
        X_WB: Float[Array, "7"],
        V_WB_B: Float[Array, "6"],
        F_bias_W: Float[Array, "6"],
        t: Float[Array, "1"],
    ) -> Draw:
        """Sequences about the last plan, and what they share."""
        c = self.config
        control_key, noise_key = jax.random.split(key)
        last, X, V, bias = self._cast(state.F_Bo_B, X_WB, V_WB_B, F_bias_W)
        nominal = jnp.concatenate([last[c.shift :], jnp.repeat(last[-1:], c.shift, 0)])[: c.horizon]
        times = self.times(t)
        hold = self.rollouts.hold_wrenches(times[:-1], bias)
        sequences = self.sampler.sequences(control_key, nominal, hold)
        dW = self.sampler.process_noise(noise_key, self.rollouts.tracked)
        before = last[max(min(c.shift, c.horizon) - 1, 0)]
        at = Situation(X, V, bias, before, times, hold, dW)
        return Draw(nominal, tuple(jnp.array_split(sequences, c.threads, axis=2)), at)

    def roll(self, F_Bo_B: Float[Array, "horizon 6 n"], at: Situation) -> Rolled:
        """Rollouts of sequences under all noise paths; of the states only positions are kept."""
        n = F_Bo_B.shape[2]
        return self.rollouts(F_Bo_B, at, lambda X, V, F: (X[4:, :n],))

    def choose(self, draw: Draw, rolled: Sequence[Rolled]) -> tuple[MppiState, MppiOutput]:
        """The plan, from the rollouts of all parts."""
        c, at = self.config, draw.at
        F = jnp.concatenate(draw.parts, axis=2)
        whole = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-1), *rolled)
        cost, _ = self.sequence_cost(F, whole, at.hold)
        weights, temperature = path_integral_weights(cost, c.effective_samples)

        mean = self.sampler.cut(jnp.sum(F * weights[None, None], axis=2))
        best = F[:, :, jnp.argmin(jnp.where(jnp.isfinite(cost), cost, jnp.inf))]
        safe = F[:, :, _first_choice(cost, self.violation(whole))]
        candidates = jnp.stack([mean, best, draw.nominal, safe], axis=2)
        tried = self._without_noise_too(candidates, at)
        candidate_cost, probability = self.sequence_cost(candidates, tried, at.hold)
        candidate_cost = jnp.where(jnp.isfinite(candidate_cost), candidate_cost, jnp.inf)
        chosen = _first_choice(candidate_cost, self.violation(tried))
        plan = candidates[:, :, chosen]
        Xs = jnp.concatenate([at.X_WB[:, None], tried.states[0][:, :, chosen].T], axis=1)
        Vs = jnp.concatenate([at.V_WB_B[:, None], tried.states[1][:, :, chosen].T], axis=1)
        given = tried.states[2][:, :, chosen].T
        valid = jnp.isfinite(candidate_cost[chosen]) & jnp.all(jnp.isfinite(given))
        least = jnp.full_like(tried.cost, jnp.inf) if tried.clearance is None else tried.clearance
        stride = max(1, c.sequences // c.shown_paths)
        shown = slice(0, stride * min(c.shown_paths, c.sequences), stride)
        output = MppiOutput(
            X_WB=Xs,
            V_WB_B=Vs,
            F_Bo_B=given,
            valid=valid,
            cost=candidate_cost[chosen],
            collision_probability=probability[chosen],
            clearance=jnp.mean(least, axis=0)[chosen],
            effective_samples=effective_count(weights),
            temperature=temperature,
            weights=weights,
            paths=whole.states[0][:, :, shown],
            path_weights=weights[shown],
        )
        hold = self.rollouts.hold_wrenches(at.times[:-1], jnp.zeros_like(at.F_bias_W))
        return MppiState(jnp.where(valid, plan, hold)), output

    def _without_noise_too(self, F: Float[Array, "horizon 6 n"], at: Situation) -> Rolled:
        """Rollouts of sequences; the states are those without noise."""
        n, dW = F.shape[2], at.dW
        if dW is not None:
            quiet = jnp.concatenate([dW, jnp.zeros_like(dW[..., :1])], axis=3)
            at = at._replace(dW=quiet)
        tried = self.rollouts(F, at, lambda X, V, F: (X[:, -n:], V[:, -n:], F[:, -n:]))
        if dW is None:
            return tried
        clearance = None if tried.clearance is None else tried.clearance[:-1]
        return Rolled(tried.cost[:-1], clearance, tried.states)

    def sequence_cost(
        self, F_Bo_B: Float[Array, "horizon 6 n"], rolled: Rolled, hold: Float[Array, "horizon 6"]
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Cost of sequences over all their realisations, and their collision probability."""
        c, dt, axes = self.config, self.config.dt, self.sampler.axes
        total = combine_risk(rolled.cost, c.risk, c.cvar_part)
        full = jnp.where(axes > 0, axes, jnp.inf)  # infinite where nothing can be given
        used = (F_Bo_B - hold[:, :, None]) / full[None, :, None]
        total = total + c.effort_weight * dt * jnp.sum(used * used, axis=(0, 1))
        change = jnp.diff(used, axis=0) / dt
        total = total + c.rate_weight * dt * jnp.sum(change * change, axis=(0, 1))
        if rolled.clearance is None:
            return total, jnp.zeros_like(total)
        alpha = 0.5 if c.collision_risk is None else c.collision_risk
        probability, excess, missing = chance_violation(rolled.clearance, alpha, c.clearance_std)
        if c.collision_risk is not None:
            total = total + c.risk_weight * (excess + missing)
        return total, probability

    def violation(self, rolled: Rolled) -> Float[Array, " n"]:
        """Violation of the chance constraint by each sequence; 0 where it is satisfied."""
        c = self.config
        if c.collision_risk is None or rolled.clearance is None:
            return jnp.zeros_like(rolled.cost[0])
        _, excess, missing = chance_violation(rolled.clearance, c.collision_risk, c.clearance_std)
        return excess + missing

    def _cast(self, *arrays: Array) -> list[Array]:
        """Arrays in the planner's precision."""
        return [array.astype(self.sampler.axes.dtype) for array in arrays]


def _first_choice(cost: Float[Array, " n"], violation: Float[Array, " n"]) -> Array:
    """Index of the least cost among feasible sequences, or of the least violation if none is."""
    finite = jnp.isfinite(cost) & jnp.isfinite(violation)
    kept = finite & (violation <= 0)
    rest = jnp.where(finite, violation, jnp.inf)
    return jnp.argmin(jnp.where(jnp.any(kept), jnp.where(kept, cost, jnp.inf), rest))
