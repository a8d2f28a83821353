"""Integration of stochastic Euler–Poincaré dynamics on SE(3) × R⁶ in the Stratonovich sense.

The scheme is the partitioned Lie-group integrator of Palmer et al. (appendix, Algorithm 1): a
Lie-Euler step for the pose (Iserles et al. 2000) and an Euler-Heun step for the velocity (Roberts
2012), in two forms that take the same steps: a fused `lax.scan` (`rollout`) and a Diffrax solver
(`LieEulerHeun`).
"""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from diffrax import RESULTS
from jaxtyping import Array, Float

from . import se3
from .dynamics import Dynamics, Flow, Memory


def step(
    dynamics: Dynamics,
    X_WB: Float[Array, "7 *#batch"],
    V_WB_B: Float[Array, "6 *#batch"],
    F_Bo_B: Float[Array, "6 *#batch"],
    dt: float | Float[Array, ""],
    dW: Float[Array, "6 *#batch"] | None = None,
    flow: Flow | None = None,
) -> tuple[Float[Array, "7 *#batch"], Float[Array, "6 *#batch"]]:
    """One step of Algorithm 1 over `dt` (s) with the Brownian increment `dW` (√s, variance dt).

    Without `dW`, or for a model without noise, it is the deterministic Lie-Euler step. `flow` is
    the water's motion at Bo.
    """
    h = jnp.asarray(dt, V_WB_B.dtype)
    if dW is None or not dynamics.stochastic:
        dV = h * dynamics.acceleration(X_WB, V_WB_B, F_Bo_B, flow)
    elif flow is None:
        c = dynamics.coefficients(V_WB_B)
        mass, wrench = dynamics.balance(X_WB, V_WB_B, F_Bo_B, coefficients=c)
        b, correlated = se3.align(c.diffusion, dynamics.correlate(V_WB_B, dW))
        both = jnp.stack(jnp.broadcast_arrays(wrench, b * correlated), axis=1)
        drift, first = jnp.unstack(mass.solve(both), axis=1)
        second = dynamics.noise_acceleration(V_WB_B + first, dW)
        dV = h * drift + (first + second) / 2
    else:
        drift = dynamics.acceleration(X_WB, V_WB_B, F_Bo_B, flow)
        first = dynamics.noise_acceleration(V_WB_B, dW)
        second = dynamics.noise_acceleration(V_WB_B + first, dW)
        dV = h * drift + (first + second) / 2
    return dynamics.displace(X_WB, V_WB_B * h), V_WB_B + dV


def over_substeps(
    mean: Float[Array, "*shape"], rise: Float[Array, "*shape"] | None, substeps: int
) -> Float[Array, "*shape S"]:
    """Means over a step's substeps of a command with this `mean`: held, or with a linear `rise`."""
    levels = jnp.broadcast_to(mean[..., None], (*mean.shape, substeps))
    if rise is None:
        return levels
    middles = (jnp.arange(substeps, dtype=mean.dtype) + 0.5) / substeps - 0.5
    return levels + jnp.tensordot(rise, middles, 0)


def rollout(
    dynamics: Dynamics,
    X_WB: Float[Array, "7 *#batch"],
    V_WB_B: Float[Array, "6 *#batch"],
    F_Bo_B: Float[Array, "T 6 *command"],
    dt: float,
    dW: Float[Array, "T S n *#batch"] | None = None,
    *,
    substeps: int = 1,
    remat: bool = True,
) -> tuple[Float[Array, "T 7 *#batch"], Float[Array, "T 6 *#batch"]]:
    """States at dt, 2 dt, …, T dt (the start is left out) under zero-order-held wrenches.

    `dW` holds the Brownian increments of S substeps of length dt / S, with variance dt / S; without
    it `substeps` deterministic ones are taken. There are 6 increments per substep, or
    `Dynamics.brownian_size` for a model with coloured noise, which starts from its stationary law;
    with 6 the coloured noise is left out. Actuation with memory (lag, delay) starts in the steady
    state of the first wrench. `remat` recomputes each step in the backward pass, so that memory
    grows with the states only, not with the networks' activations.
    """
    count = substeps if dW is None else dW.shape[1]
    h = dt / count
    push = None
    if dW is not None and dW.shape[2] > 6:
        w = dW[:, :, 6:].reshape(-1, *dW[0, 0, 6:].shape) / jnp.sqrt(jnp.asarray(h, dW.dtype))
        dW = dW[:, :, :6]
        push = dynamics.lasting_push(w, h).reshape(dW.shape)

    def shaped(F: Array) -> Array:
        return F.reshape(F.shape + (1,) * (V_WB_B.ndim - F.ndim))

    def advance(carry: tuple[Array, Array, Memory], inputs: tuple[Array, Any, Any]) -> Any:
        X, V, memory = carry
        F, dW_step, push_step = inputs
        F, late = shaped(F), None
        if dynamics.remembers:
            memory, late = dynamics.arriving(memory, jnp.broadcast_to(F, V.shape), V, dt, count)
        for s in range(count):
            F_s = F if late is None else late[..., s]
            F_s = F_s if push_step is None else F_s + push_step[s]
            X, V = step(dynamics, X, V, F_s, h, None if dW_step is None else dW_step[s])
        return (X, V, memory), (X, V)

    body = jax.checkpoint(advance) if remat else advance
    memory = ()
    if dynamics.remembers:
        memory = dynamics.commanded(jnp.broadcast_to(shaped(F_Bo_B[0]), V_WB_B.shape))
    _, (Xs, Vs) = jax.lax.scan(body, (X_WB, V_WB_B, memory), (F_Bo_B, dW, push))
    return Xs, Vs


State = tuple[Array, Array]
"""(X_WB, V_WB_B)"""


class DriftTerm(diffrax.AbstractTerm):
    """dt times (ξ, ξ's drift): an element of se(3) × R⁶, which `LieEulerHeun` maps to the group."""

    dynamics: Dynamics
    wrench: Callable[[Any], Array]

    def vf(self, t: Any, y: State, args: Any) -> State:
        X, V = y
        return V, self.dynamics.acceleration(X, V, self.wrench(t))

    def contr(self, t0: Any, t1: Any, **kwargs: Any) -> Any:
        return t1 - t0

    def prod(self, vf: State, control: Any) -> State:
        return jax.tree.map(lambda v: v * jnp.asarray(control, v.dtype), vf)


class NoiseTerm(diffrax.AbstractTerm):
    """M⁻¹ b C dW; it acts on the velocity only (the diffusion is hypoelliptic)."""

    dynamics: Dynamics
    brownian: diffrax.AbstractBrownianPath

    def vf(self, t: Any, y: State, args: Any) -> Array:
        return y[1]

    def contr(self, t0: Any, t1: Any, **kwargs: Any) -> Any:
        return self.brownian.evaluate(t0, t1)

    def prod(self, vf: Array, control: Any) -> Array:
        return self.dynamics.noise_acceleration(vf, control)


def _unwrapped(term: Any) -> DriftTerm:
    """The term itself, without Diffrax's wrappers."""
    while not isinstance(term, DriftTerm):
        term = term.term
    return term


class LieEulerHeun(diffrax.AbstractStratonovichSolver):
    """Algorithm 1 as a Diffrax solver; solve `sde_terms(...)` from y0 = (X_WB, V_WB_B)."""

    term_structure: ClassVar = diffrax.MultiTerm[tuple[DriftTerm, NoiseTerm]]
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms: Any) -> int:
        return 1

    def strong_order(self, terms: Any) -> float:
        return 0.5

    def init(self, terms: Any, t0: Any, t1: Any, y0: State, args: Any) -> None:
        return None

    def step(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: State,
        args: Any,
        solver_state: None,
        made_jump: Any,
    ) -> Any:
        """One step; see `models.integrate.step`."""
        drift, noise = terms.terms
        X, V = y0
        twist, dV = drift.vf_prod(t0, y0, args, drift.contr(t0, t1))
        dW = noise.contr(t0, t1)
        first = noise.prod(V, dW)
        second = noise.prod(V + first, dW)
        y1 = (_unwrapped(drift).dynamics.displace(X, twist), V + dV + (first + second) / 2)
        return y1, None, {"y0": y0, "y1": y1}, None, RESULTS.successful

    def func(self, terms: Any, t0: Any, y0: State, args: Any) -> Any:
        return terms.vf(t0, y0, args)


def sde_terms(
    dynamics: Dynamics,
    wrench: Callable[[Any], Float[Array, "6 *#batch"]],
    brownian: diffrax.AbstractBrownianPath,
) -> diffrax.MultiTerm:
    """The terms of `LieEulerHeun` for a wrench as a function of time and a Brownian path in R⁶."""
    return diffrax.MultiTerm(DriftTerm(dynamics, wrench), NoiseTerm(dynamics, brownian))


def brownian_increments(
    key: Array, shape: tuple[int, ...], dt: float, dtype: jnp.dtype | type = float
) -> Array:
    """Independent normal increments of variance `dt` (s)."""
    return jax.random.normal(key, shape, dtype) * jnp.asarray(dt**0.5, dtype)


def cast(tree: Any, dtype: jnp.dtype | type) -> Any:
    """The same module with its floating-point arrays in another precision."""

    def convert(leaf: Any) -> Any:
        return leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf

    return jax.tree.map(convert, tree)
