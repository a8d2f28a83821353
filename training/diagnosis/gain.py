"""Errors of noise-free simulations over several seconds, base against extended model."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models.effects.extended import Extended
from ...models.effects.library import Library
from ...models.effects.predict import advance
from .data import Data
from .innovations import Arrays, as_arrays, difference, settle

GROUPS = {"position": slice(0, 3), "rotation": slice(3, 6), "velocity": slice(6, 9)}


@eqx.filter_jit
def _errors(
    model: Extended,
    effects: Any,
    arrays: Arrays,
    every: int,
    dt: float,
) -> Float[Array, "N 12 R"]:
    X, V, u, voltage = arrays
    model = model.with_effects(effects)
    inertia = model.inertia()

    def body(carry: Any, given: Any) -> Any:
        memory, x, v = carry
        n, X0, V0, X1, V1, command, volts = given
        fresh = model.infer(X0, V0, (V1 - V0) / dt)
        starts = n % every == 0
        x, v = (jnp.where(starts, a, b) for a, b in zip(fresh, (x, v), strict=True))
        memory, x, v, a = advance(model, inertia, memory, x, v, command, dt, 1, volts[None])
        return (memory, x, v), difference(*model.observe(x, v, a), X1, V1)

    start = (settle(model, u[0], dt, 1), X[0], V[0])
    xs = (jnp.arange(len(u)), X[:-1], V[:-1], X[1:], V[1:], u, voltage)
    return jax.lax.scan(body, start, xs)[1]


def simulation_errors(
    model: Extended, library: Library, theta: Float[np.ndarray, "p R"], data: Data, seconds: float
) -> Float[np.ndarray, "K H 12 R"]:
    """Errors of K simulations a piece, at H horizons, each from a recorded state.

    Every piece has parameters of its own: those fitted without its scenario.
    """
    every = max(1, min(round(seconds / data.dt), len(data.u)))
    arrays = as_arrays(data)
    e = np.asarray(_errors(model, library.filled(jnp.asarray(theta)), arrays, every, data.dt))
    whole = len(e) // every
    e = np.where(data.weight[:, None] > 0, e, np.nan)
    return e[: whole * every].reshape(whole, every, 12, -1)


def rmse(
    errors: Float[np.ndarray, "K H 12 R"], group: str, fold: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Root mean square by horizon, and its bootstrap over scenarios (200, H)."""
    square = np.nansum(errors[:, :, GROUPS[group]] ** 2, axis=2)
    square = np.where(np.isnan(errors[:, :, 0]), np.nan, square)
    labels = np.unique(fold)
    sums = np.stack([np.nansum(square[:, :, fold == f], axis=(0, 2)) for f in labels])
    counts = np.stack([np.sum(np.isfinite(square[:, :, fold == f]), axis=(0, 2)) for f in labels])
    drawn = rng.integers(len(labels), size=(200, len(labels)))
    bootstrap = np.sqrt(sums[drawn].sum(axis=1) / np.maximum(counts[drawn].sum(axis=1), 1))
    return np.sqrt(sums.sum(axis=0) / np.maximum(counts.sum(axis=0), 1)), bootstrap
