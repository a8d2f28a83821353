"""Model predictive path integral control of a vehicle among pylons, as a pure function."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...models import se3
from ...models.dynamics import Dynamics
from ...models.effects.extended import Extended
from ...models.integrate import cast, step
from ..plant.frozen_coefficients import FrozenCoefficients
from ..plant.wrench_limits import WrenchLimits
from .mppi_config import MppiConfig
from .obstacles import Cylinders, SphereHull
from .path_integral import (
    chance_violation,
    combine_risk,
    effective_count,
    path_integral_weights,
    spline_basis,
)

_WORST = 1e3
"""Condition number beyond which the slope of the acting wrench is not inverted."""


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
    """Samples of a call: its sequences in parts, and the noise that all of them share.

    Attributes:
        nominal: the last plan, shifted by the elapsed time.
        before: the wrench of the last plan that acted until now.
        parts: the sequences, in as many parts as `MppiConfig.threads`.
        dW: Brownian increments (√s) of the realisations; None for a single one.
    """

    nominal: Float[Array, "horizon 6"]
    before: Float[Array, "6"]
    parts: tuple[Float[Array, "horizon 6 _"], ...]
    dW: Float[Array, "horizon substeps 6 r"] | None


class Rolled(NamedTuple):
    """Rollouts of n sequences in r realisations; the states are those of the first realisation."""

    cost: Float[Array, "r n"]
    clearance: Float[Array, "r n"]
    states: tuple[Array, ...]


class MppiPlanner(eqx.Module):
    """Sampled solution of the stochastic optimal control problem of Palmer et al., "Field
    Experiments",

        min_u E ∫ ‖log(g⁻¹ g_goal)‖²_L + ‖ξ_goal − ξ‖²_Q dt   subject to   u ∈ U,
        d(g, ξ) = model,  P(g ∈ G over the horizon) ≥ 1 − α,

    by path integrals (Williams et al. 2016). Around the last plan, shifted by the elapsed time,
    wrench sequences are sampled with smooth noise and clipped to U. Every sequence is rolled out
    under the same `realisations` of the model's process noise (in antithetic pairs), as common
    random numbers. Costs become weights and the weighted mean sequence is clipped to U. The
    candidates are the mean, the best sample, the best sample that satisfies the chance constraint,
    and the last plan, since the mean of passing left and passing right of a pylon may collide. The
    candidate of least cost that satisfies the constraint is chosen, or else the one that violates
    it least: a distant goal's cost never outweighs a collision. The plan's states are those of the
    model's drift under it.

    With `tracking` gains the noise paths are those of a vehicle that tracks the plan: the two paths
    of a pair are pulled to their midpoint, which approximates the path without noise, by
    K_p log(g⁻¹ g_mid) + K_d (ξ_mid − ξ). Without them the paths diverge in open loop, as in the
    problem above, and the plan avoids gaps that the tracked vehicle passes safely.

    With `tracking` gains and `hold_attitude`, the sampled wrenches are added to a feedback with K_p
    and K_d on the attitude alone, towards the goal's attitude; the sum is clipped to U. The Munk
    moment turns a moving hull broadside (Fossen 2011, section 6.3.1): hardly any open-loop sequence
    of wrenches keeps the attitude over the horizon, least of all in a current.

    The noise of the sequences applies to the wrench that acts on the body. Where the model's thrust
    differs from the command (a weak thruster, say), commands are sampled that produce this noise;
    noise on the commands themselves would hardly ever surge without turning.

    `F_bias_W` is a wrench about Bo with axes of W that acts besides the model's (an observed
    current, say); the plan's wrenches then include its compensation.
    """

    dynamics: Dynamics
    limits: WrenchLimits
    cylinders: Cylinders
    hull: SphereHull
    X_WG: Float[Array, "7"]
    V_goal: Float[Array, "6"]
    axes: Float[Array, "6"]
    bases: tuple[Float[Array, "horizon _"], ...]
    command: Float[Array, "6 6"] | None
    tracking: tuple[Float[Array, "6 6"], Float[Array, "6 6"]] | None
    config: MppiConfig = eqx.field(static=True)

    def __init__(
        self,
        dynamics: Dynamics,
        limits: WrenchLimits,
        cylinders: Cylinders,
        hull: SphereHull,
        X_WG: Float[Array, "7"],
        V_goal: Float[Array, "6"] | None = None,
        config: MppiConfig | None = None,
        tracking: tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6 6"]] | None = None,
        dtype: jnp.dtype | type = jnp.float32,
    ):
        """`X_WG` is the goal's pose, `V_goal` its twist in B, `tracking` K_p and K_d (or None).

        All arrays are cast to `dtype`.
        """
        self.config = MppiConfig() if config is None else config
        if isinstance(dynamics, Extended):
            dynamics = dynamics.for_steps_of(self.config.dt)
        self.dynamics = cast(dynamics, dtype)
        self.limits = cast(limits, dtype)
        self.cylinders = cast(cylinders, dtype)
        self.hull = cast(hull, dtype)
        self.X_WG = jnp.asarray(X_WG, dtype)
        self.V_goal = jnp.zeros(6, dtype) if V_goal is None else jnp.asarray(V_goal, dtype)
        self.axes = eqx.filter_jit(type(limits).axes)(limits).astype(dtype)
        scale = np.maximum(self.config.noise, 0.01) * np.asarray(self.axes, float)
        command = command_of_felt(dynamics, X_WG, scale)
        self.command = None if command is None else jnp.asarray(command, dtype)
        self.tracking = None
        if tracking is not None:
            self.tracking = jnp.asarray(tracking[0], dtype), jnp.asarray(tracking[1], dtype)
        self.bases = tuple(
            jnp.asarray(spline_basis(self.config.horizon, k), dtype) for k in self.config.knots
        )

    def hold_wrench(self, F_bias_W: Float[Array, "6"]) -> Float[Array, "6"]:
        """The wrench that keeps the vehicle at rest at the goal.

        It balances the potential wrench and the remaining static wrenches of an extended model:
        buoyancy, payload, tether or current.
        """
        hold = -self.dynamics.potential_wrench(self.X_WG)
        hold = hold - self.dynamics.balance(self.X_WG, jnp.zeros_like(hold), hold)[1]
        return hold - _in_body(self.X_WG, F_bias_W)

    def init(self) -> MppiState:
        """State before the first call: hold."""
        hold = self.hold_wrench(jnp.zeros_like(self.V_goal))
        return MppiState(jnp.broadcast_to(hold[None], (self.config.horizon, 6)))

    def step(
        self,
        state: MppiState,
        key: Array,
        X_WB: Float[Array, "7"],
        V_WB_B: Float[Array, "6"],
        F_bias_W: Float[Array, "6"] | None = None,
    ) -> tuple[MppiState, MppiOutput]:
        """Plan from a state; the same arguments give the same plan, bit for bit.

        It draws, rolls out and chooses; a multithreaded caller rolls out each part by itself.
        """
        bias = jnp.zeros_like(self.V_goal) if F_bias_W is None else F_bias_W
        draw = self.draw(state, key, bias)
        whole = jnp.concatenate(draw.parts, axis=2)
        rolled = self.roll(whole, draw.dW, X_WB, V_WB_B, bias, draw.before)
        return self.choose(draw, [rolled], X_WB, V_WB_B, bias)

    def draw(self, state: MppiState, key: Array, F_bias_W: Float[Array, "6"]) -> Draw:
        """Sequences about the last plan, and the process noise that they all share."""
        c = self.config
        control_key, noise_key = jax.random.split(key)
        last, bias = self._cast(state.F_Bo_B, F_bias_W)
        nominal = jnp.concatenate([last[c.shift :], jnp.repeat(last[-1:], c.shift, 0)])[: c.horizon]
        parts = jnp.array_split(self.sample(control_key, nominal, bias), c.threads, axis=2)
        before = last[max(min(c.shift, c.horizon) - 1, 0)]
        return Draw(nominal, before, tuple(parts), self._process_noise(noise_key))

    def roll(
        self,
        F_Bo_B: Float[Array, "horizon 6 n"],
        dW: Float[Array, "horizon substeps 6 r"] | None,
        X_WB: Float[Array, "7"],
        V_WB_B: Float[Array, "6"],
        F_bias_W: Float[Array, "6"],
        before: Float[Array, "6"],
    ) -> Rolled:
        """Rollouts of sequences under all noise paths; of the states only positions are kept.

        `before` is the command until now, for a model with lag or delay.
        """
        X, V, bias = self._cast(X_WB, V_WB_B, F_bias_W)
        n = F_Bo_B.shape[2]
        return self._rollouts(X, V, F_Bo_B, bias, dW, lambda X, V, F: (X[4:, :n],), before)

    def choose(
        self,
        draw: Draw,
        rolled: Sequence[Rolled],
        X_WB: Float[Array, "7"],
        V_WB_B: Float[Array, "6"],
        F_bias_W: Float[Array, "6"],
    ) -> tuple[MppiState, MppiOutput]:
        """The plan, from the rollouts of all parts."""
        c, dW = self.config, draw.dW
        X, V, bias = self._cast(X_WB, V_WB_B, F_bias_W)
        F = jnp.concatenate(draw.parts, axis=2)
        whole = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-1), *rolled)
        cost, _ = self.sequence_cost(F, whole, bias)
        weights, temperature = path_integral_weights(cost, c.effective_samples)

        mean = self._cut(jnp.sum(F * weights[None, None], axis=2))
        best = F[:, :, jnp.argmin(jnp.where(jnp.isfinite(cost), cost, jnp.inf))]
        safe = F[:, :, _first_choice(cost, self.violation(whole))]
        candidates = jnp.stack([mean, best, draw.nominal, safe], axis=2)
        quiet = None if dW is None else jnp.concatenate([dW, jnp.zeros_like(dW[..., :1])], axis=3)
        tried = self._rollouts(
            X,
            V,
            candidates,
            bias,
            quiet,
            lambda X, V, F: (X[:, -4:], V[:, -4:], F[:, -4:]),
            draw.before,
        )
        if dW is not None:
            tried = Rolled(tried.cost[:-1], tried.clearance[:-1], tried.states)
        candidate_cost, probability = self.sequence_cost(candidates, tried, bias)
        candidate_cost = jnp.where(jnp.isfinite(candidate_cost), candidate_cost, jnp.inf)
        chosen = _first_choice(candidate_cost, self.violation(tried))
        plan = candidates[:, :, chosen]
        Xs = jnp.concatenate([X[:, None], tried.states[0][:, :, chosen].T], axis=1)
        Vs = jnp.concatenate([V[:, None], tried.states[1][:, :, chosen].T], axis=1)
        given = tried.states[2][:, :, chosen].T
        valid = jnp.isfinite(candidate_cost[chosen]) & jnp.all(jnp.isfinite(given))
        hold = jnp.broadcast_to(self.hold_wrench(jnp.zeros_like(bias))[None], plan.shape)
        stride = max(1, c.sequences // c.shown_paths)
        shown = slice(0, stride * min(c.shown_paths, c.sequences), stride)
        output = MppiOutput(
            X_WB=Xs,
            V_WB_B=Vs,
            F_Bo_B=given,
            valid=valid,
            cost=candidate_cost[chosen],
            collision_probability=probability[chosen],
            clearance=jnp.mean(tried.clearance, axis=0)[chosen],
            effective_samples=effective_count(weights),
            temperature=temperature,
            weights=weights,
            paths=whole.states[0][:, :, shown],
            path_weights=weights[shown],
        )
        return MppiState(jnp.where(valid, plan, hold)), output

    def sample(
        self, key: Array, nominal: Float[Array, "horizon 6"], F_bias_W: Float[Array, "6"]
    ) -> Float[Array, "horizon 6 sequences"]:
        """Feasible wrench sequences: `nominal`, the hold wrench, then `nominal` with noise."""
        c = self.config
        n = c.sequences
        noise = jnp.asarray(c.noise, nominal.dtype) * self.axes
        counts = [n // len(self.bases) + (i < n % len(self.bases)) for i in range(len(self.bases))]
        parts = []
        for basis, count, k in zip(
            self.bases, counts, jax.random.split(key, len(counts)), strict=True
        ):
            w = jax.random.normal(k, (basis.shape[1], 6 * count), basis.dtype)
            part = c.smallest_noise ** jnp.linspace(0, 1, count, dtype=basis.dtype)
            parts.append((basis @ w).reshape(c.horizon, 6, count) * part[None, None])
        change = jnp.concatenate(parts, axis=2) * noise[None, :, None]
        if self.command is not None:
            change = jnp.einsum("ij,tjn->tin", self.command, change)
        F = nominal[:, :, None] + change
        F = F.at[:, :, 0].set(nominal)
        if n > 1:
            F = F.at[:, :, 1].set(self.hold_wrench(F_bias_W)[None])
        return self._cut(F)

    def sequence_cost(
        self,
        F_Bo_B: Float[Array, "horizon 6 n"],
        rolled: Rolled,
        F_bias_W: Float[Array, "6"],
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Cost of sequences over all their realisations, and their collision probability."""
        c, dt = self.config, self.config.dt
        total = combine_risk(rolled.cost, c.risk, c.cvar_part)
        used = (F_Bo_B - self.hold_wrench(F_bias_W)[None, :, None]) / self.axes[None, :, None]
        total = total + c.effort_weight * dt * jnp.sum(used * used, axis=(0, 1))
        change = jnp.diff(used, axis=0) / dt
        total = total + c.rate_weight * dt * jnp.sum(change * change, axis=(0, 1))
        if self.cylinders.radius.shape[0] == 0:
            return total, jnp.zeros_like(total)
        alpha = 0.5 if c.collision_risk is None else c.collision_risk
        probability, excess, missing = chance_violation(rolled.clearance, alpha, c.clearance_std)
        if c.collision_risk is not None:
            total = total + c.risk_weight * (excess + missing)
        return total, probability

    def violation(self, rolled: Rolled) -> Float[Array, " n"]:
        """Violation of the chance constraint by each sequence; 0 where it is satisfied."""
        c, clearance = self.config, rolled.clearance
        if c.collision_risk is None or self.cylinders.radius.shape[0] == 0:
            return jnp.zeros_like(clearance[0])
        _, excess, missing = chance_violation(clearance, c.collision_risk, c.clearance_std)
        return excess + missing

    def _process_noise(self, key: Array) -> Float[Array, "horizon substeps 6 r"] | None:
        """Brownian increments (√s) for the realisations; None for a single one.

        Pairs have opposite signs, so the mean is zero. Without tracking, each axis is scaled to the
        expected mean square of its Brownian path over the horizon, so that a few realisations have
        the spread of many.
        """
        c = self.config
        if c.realisations == 1:
            return None
        m, h = c.steps_of_model, c.dt / c.steps_of_model
        shape = (c.horizon * m, 6, c.realisations // 2)
        dW = jax.random.normal(key, shape, self.V_goal.dtype) * h**0.5
        if not self._tracked:
            sampled = jnp.mean(jnp.cumsum(dW, axis=0) ** 2, axis=(0, 2))
            dW = dW * jnp.sqrt(h * (c.horizon * m + 1) / 2 / sampled)[None, :, None]
        return jnp.concatenate([dW, -dW], axis=2).reshape(c.horizon, m, 6, c.realisations)

    @property
    def _tracked(self) -> bool:
        return self.tracking is not None and self.config.tracked

    def _turned(self, F: Array, X: Array, V: Array, n: int) -> Array:
        """Wrenches of n sequences plus the feedback to the goal's attitude, clipped to U.

        Both paths of a pair get the feedback of their midpoint: the feedback to the midpoint is not
        part of the plan (`_pull`).
        """
        if self.tracking is None or not self.config.hold_attitude:
            return F
        K_p, K_d = (gain[3:, 3:] for gain in self.tracking)
        to_goal = se3.local(X, self.X_WG)[3:]
        moment = K_p @ to_goal + K_d @ (self.V_goal[3:, None] - V[3:])
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

    def _cast(self, *arrays: Array) -> list[Array]:
        """Arrays in the planner's precision."""
        return [array.astype(self.V_goal.dtype) for array in arrays]

    def _cut(self, F: Array) -> Array:
        """Wrenches (horizon, 6, …) clipped to the feasible set."""
        return jnp.moveaxis(self.limits.clip(jnp.moveaxis(F, 1, 0)), 0, 1)

    def _state_cost(self, X: Array, V: Array) -> Array:
        """Cost rate of the paper's problem and of the speed limit."""
        c = self.config
        L = jnp.asarray(c.pose_weight, V.dtype)[:, None]
        Q = jnp.asarray(c.twist_weight, V.dtype)[:, None]
        to_goal, twist = se3.local(X, self.X_WG), self.V_goal[:, None] - V
        cost = jnp.sum(L * to_goal * to_goal + Q * twist * twist, axis=0)
        if c.speed_limit is not None:
            speed = jnp.sqrt(jnp.sum(V[:3] * V[:3], axis=0))
            cost = cost + c.speed_weight * jnp.maximum(speed - c.speed_limit, 0) ** 2
        return cost

    def _rollouts(
        self, X0: Array, V0: Array, F: Array, bias: Array, dW: Array | None, keep,
        before: Array | None = None,
    ):  # fmt: skip
        """Sequences (horizon, 6, n) under all noise paths (horizon, substeps, 6, r), r-major."""
        c = self.config
        n = F.shape[2]
        r = 1 if dW is None else dW.shape[3]
        h = c.dt / c.steps_of_model
        X = jnp.broadcast_to(X0[:, None], (7, r * n))
        V = jnp.broadcast_to(V0[:, None], (6, r * n))
        last = jnp.zeros(c.horizon, V.dtype).at[-1].set(c.terminal_time)

        def advance(carry, inputs):
            X, V, cost, least, memory = carry
            F, dW, terminal = inputs
            planned, later = self._turned(jnp.tile(F, (1, r)), X, V, n), _in_body(X, bias)
            wrench = planned
            if self._tracked and dW is not None:
                wrench = wrench + self._pull(X, V, n)
            wrenches = [wrench + later] * c.steps_of_model
            if self.dynamics.remembers:
                memory, late = self.dynamics.arriving(memory, wrench, V, c.dt, c.steps_of_model)
                wrenches = [late[..., i] + later for i in range(c.steps_of_model)]
            model = FrozenCoefficients(self.dynamics, V) if c.steps_of_model > 1 else self.dynamics
            for i in range(c.steps_of_model):
                noise = None if dW is None else jnp.repeat(dW[i], n, 1)
                X, V = step(model, X, V, wrenches[i], h, noise)
            distance = self.hull.clearance(X, self.cylinders)
            near = jnp.maximum(1 - distance / c.margin, 0)
            cost = cost + (c.dt + terminal) * self._state_cost(X, V)
            cost = cost + c.dt * c.margin_weight * near * near
            return (X, V, cost, jnp.minimum(least, distance), memory), keep(X, V, planned)

        memory = ()
        if self.dynamics.remembers:
            first = F[0] if before is None else before[:, None]
            memory = self.dynamics.commanded(jnp.broadcast_to(first, (6, r * n)))
        start = (X, V, jnp.zeros_like(V[0]), jnp.full_like(V[0], jnp.inf), memory)
        (_, _, cost, least, _), kept = jax.lax.scan(advance, start, (F, dW, last))
        return Rolled(cost.reshape(r, n), least.reshape(r, n), kept)


def _first_choice(cost: Float[Array, " n"], violation: Float[Array, " n"]) -> Array:
    """Index of the least cost among feasible sequences, or of the least violation if none is."""
    finite = jnp.isfinite(cost) & jnp.isfinite(violation)
    kept = finite & (violation <= 0)
    rest = jnp.where(finite, violation, jnp.inf)
    return jnp.argmin(jnp.where(jnp.any(kept), jnp.where(kept, cost, jnp.inf), rest))


def command_of_felt(
    dynamics: Dynamics, X_WB: Float[Array, "7"], scale: Float[np.ndarray, "6"]
) -> Float[np.ndarray, "6 6"] | None:
    """The change of the commanded wrench for a unit change of the one that acts on the body.

    The inverse of the model's mean slope over ± `scale` (N, N·m) about a command of zero, at rest;
    None where it is the identity, as for every model without effects on its thrusters, and where
    the slope is nearly singular.
    """
    X = jnp.asarray(X_WB, dynamics.rigid_inertia.dtype)
    steps = jnp.asarray(np.concatenate([np.diag(scale), -np.diag(scale)], axis=1), X.dtype)
    X = jnp.broadcast_to(X[:, None], (7, 12))
    felt = np.asarray(dynamics.balance(X, jnp.zeros_like(steps), steps)[1], float)
    slope = (felt[:, :6] - felt[:, 6:]) / (2 * scale)
    if np.allclose(slope, np.eye(6), atol=1e-3) or np.linalg.cond(slope) > _WORST:
        return None
    return np.linalg.inv(slope)


def _in_body(X_WB: Array, F_W: Array) -> Array:
    """A wrench about Bo whose axes are W's, with the axes of B."""
    return jnp.concatenate([se3.rotate_inverse(X_WB, F_W[:3]), se3.rotate_inverse(X_WB, F_W[3:])])
