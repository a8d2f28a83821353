"""Samples of a model's conditional law for each window."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..models.dynamics import Dynamics
from ..models.integrate import rollout


def predict(
    model: Dynamics,
    X_0: Float[Array, "7 W"],
    V_0: Float[Array, "6 W"],
    F: Float[Array, "T 6 W"],
    dt: float,
    key: Array,
    samples: int,
    *,
    substeps: int = 1,
    with_path_of_drift: bool = False,
) -> tuple[Float[Array, "T 7 P W"], Float[Array, "T 6 P W"]]:
    """Draw `samples` motions from each window's first state and commands, at t_1 … t_T.

    `with_path_of_drift` appends the noise-free motion as one more sample. Increments come from
    `key` alone.
    """
    T, _, W = F.shape
    count = samples + with_path_of_drift
    # substeps as steps of their own: the compiled step is one, however many there are
    F = jnp.repeat(F[:, :, None], substeps, axis=0)
    dt = dt / substeps
    scale = jnp.asarray(dt**0.5, F.dtype)
    dW = scale * jax.random.normal(key, (T * substeps, 1, 6, samples, W), F.dtype)
    if with_path_of_drift:
        dW = jnp.concatenate([dW, jnp.zeros((T * substeps, 1, 6, 1, W), F.dtype)], axis=3)
    X = jnp.broadcast_to(X_0[:, None], (7, count, W))
    V = jnp.broadcast_to(V_0[:, None], (6, count, W))
    Xs, Vs = rollout(model, X, V, F, dt, dW)
    return Xs[substeps - 1 :: substeps], Vs[substeps - 1 :: substeps]


def predict_drift(
    model: Dynamics,
    X_0: Float[Array, "7 W"],
    V_0: Float[Array, "6 W"],
    F: Float[Array, "T 6 W"],
    dt: float,
    *,
    substeps: int = 1,
) -> tuple[Float[Array, "T 7 W"], Float[Array, "T 6 W"]]:
    """The noise-free motion of each window at t_1 … t_T."""
    Xs, Vs = rollout(model, X_0, V_0, jnp.repeat(F, substeps, axis=0), dt / substeps)
    return Xs[substeps - 1 :: substeps], Vs[substeps - 1 :: substeps]
