"""Pre-training: fit the coefficient networks to a preset before training on data.

Coefficients of an underwater vehicle differ by orders of magnitude between axes; starting with the
right magnitudes makes training from little data possible (Palmer et al., experiments).
"""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from ...models import se3
from ...models.dynamics import Dynamics
from ...models.rigid_body import FossenDynamics
from ..compile_options import QUICK_COMPILE
from ..config import PretrainConfig
from .step import all_finite, partition

Model = TypeVar("Model", bound=Dynamics)

_OF_RATE = 0.05
"""Share of the learning rate for V alone: it starts near its target, and larger steps leave it
(`test_a_potential_follows_its_target`)."""


def pretrain(
    model: Model, target: FossenDynamics, config: PretrainConfig, key: Array
) -> tuple[Model, Float[Array, " _"]]:
    """Fit M, D, D^f, b and F_V of `model` to those of `target`; returns the model and its losses.

    Velocities are Gaussian with `speed` (m/s, rad/s), attitudes uniform in roll and pitch. Every
    entry is scaled by the target's diagonal, every wrench by its own size. All steps run inside one
    compiled scan; none is taken if the model starts within `tolerance`.

    Raises:
        ValueError: the loss is not finite.
    """
    if config.steps == 0:
        return model, jnp.zeros(0)
    params, static = partition(model)
    dtype = target.weight.dtype
    adam = optax.scale_by_adam()

    def loss(p: Any, k: Array) -> Array:
        velocity_key, attitude_key = jax.random.split(k)
        V = config.speed * jax.random.normal(velocity_key, (6, config.batch), dtype)
        X = _attitudes(attitude_key, config.batch, dtype)
        return coefficient_error(eqx.combine(p, static), target, V, X)

    def step(carry: Any, inputs: Any) -> Any:
        p, moments = carry
        k, rate = inputs
        value, gradient = jax.value_and_grad(loss)(p, k)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes int32 and float
            direction, moments = adam.update(gradient, moments, p)
        p = jax.tree.map(lambda a, d: a - rate.astype(a.dtype) * d, p, direction)
        return (p, moments), value

    def run(p: Any, keys: Array, rates: Array) -> Any:
        return jax.lax.scan(step, (p, adam.init(p)), (keys, rates))

    rates = jnp.asarray(
        config.learning_rate * np.cos(np.linspace(0, np.pi / 2, config.steps)) ** 2, dtype
    )
    start = jax.jit(loss)(params, key)
    if float(start) <= config.tolerance:
        return model, start[None]
    (params, _), losses = jax.jit(run, compiler_options=QUICK_COMPILE)(
        params, jax.random.split(key, config.steps), rates
    )
    if not bool(all_finite((params, losses))):
        raise ValueError("pre-training ran away; give a smaller pretrain.learning_rate")
    return eqx.combine(params, static), losses


def fit_potential(
    model: Model, target: FossenDynamics, config: PretrainConfig, key: Array
) -> Model:
    """Fit V of `model` alone to F_V of `target`; the better of both is returned.

    A SPINN starts at the matrices of its reference exactly, but at its V only to a few percent;
    this leaves a third of that error.
    """
    params, static = partition(model)
    dtype = target.weight.dtype
    adam = optax.scale_by_adam()
    rates = jnp.asarray(
        _OF_RATE * config.learning_rate * np.cos(np.linspace(0, np.pi / 2, config.steps)) ** 2,
        dtype,
    )

    def joined(V: Any) -> Model:
        return eqx.combine(eqx.tree_at(lambda p: p.learned_potential, params, V), static)

    def loss(V: Any, k: Array) -> Array:
        return _potential_error(joined(V), target, _attitudes(k, config.batch, dtype))

    def step(carry: Any, inputs: Any) -> Any:
        V, moments = carry
        k, rate = inputs
        gradient = jax.grad(loss)(V, k)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes int32 and float
            direction, moments = adam.update(gradient, moments, V)
        return (
            jax.tree.map(lambda a, d: a - rate.astype(a.dtype) * d, V, direction),
            moments,
        ), None

    def run(V: Any, keys: Array) -> Any:
        (fitted, _), _ = jax.lax.scan(step, (V, adam.init(V)), (keys, rates))
        return fitted, loss(V, key), loss(fitted, key)

    start: Any = params
    found, before, after = jax.jit(run, compiler_options=QUICK_COMPILE)(
        start.learned_potential, jax.random.split(key, config.steps)
    )
    return joined(found) if float(after) < float(before) else model


def coefficient_error(
    model: Dynamics,
    target: FossenDynamics,
    V_WB_B: Float[Array, "6 W"],
    X_WB: Float[Array, "7 W"],
) -> Float[Array, ""]:
    """Mean squared relative differences of M, D, D^f, b and F_V at these velocities and poses.

    Diagonals of the target are raised to at least 1 % of the drag that stops the vehicle in a
    second, as a SPINN's scales are: a positive definite drag can't be zero, and driving networks
    towards zero spoils them. A diffusion of zero is ignored.
    """
    mine, theirs = model.coefficients(V_WB_B), target.coefficients(V_WB_B)
    inertia = jnp.diagonal(theirs.mass.matrix())
    total = jnp.zeros((), V_WB_B.dtype)
    for name in ("mass", "linear_drag", "quadratic_drag"):
        A, B = getattr(mine, name).matrix(), getattr(theirs, name).matrix()
        A = A.reshape(6, 6, -1)
        d = jnp.maximum(jnp.diagonal(B), 0.01 * inertia)
        B = B + jnp.diag(d - jnp.diagonal(B))
        total = total + jnp.mean(jnp.sum((A - B[:, :, None]) ** 2 / _outer(d), axis=(0, 1)))
    b = theirs.diffusion[:, None]
    known = b > 0
    ratio = mine.diffusion.reshape(6, -1) / jnp.where(known, b, 1) - 1
    total = total + jnp.mean(jnp.where(known, ratio * ratio, 0))
    return total + _potential_error(model, target, X_WB)


def _potential_error(model: Dynamics, target: FossenDynamics, X_WB: Float[Array, "7 W"]) -> Array:
    """Mean squared relative difference of F_V."""
    F, G = model.potential_wrench(X_WB), target.potential_wrench(X_WB)
    inertia = jnp.diagonal(target.coefficients(jnp.zeros(6, X_WB.dtype)).mass.matrix())
    size = jnp.mean(G * G, axis=1) + (0.01 * inertia) ** 2
    return jnp.mean((F - G) ** 2 / size[:, None])


def _outer(d: Float[Array, "6"]) -> Float[Array, "6 6 1"]:
    return (d[:, None] * d[None, :])[:, :, None]


def _attitudes(key: Array, count: int, dtype: Any) -> Float[Array, "7 W"]:
    angles = jax.random.uniform(key, (3, count), dtype, -jnp.pi, jnp.pi)
    position = jnp.zeros((3, count), dtype)
    half = jnp.asarray([1.0, 0.5, 1.0], dtype)[:, None]
    return se3.from_position_rpy(position, angles * half)
