"""The constant mass matrix of a model with effects, and its products."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Inertia(NamedTuple):
    """Constant mass matrix and its inverse, with the effects' batch axes; computed once a call."""

    matrix: Float[Array, "6 6 *batch"]
    inverse: Float[Array, "6 6 *batch"]


def times(M: Array, x: Array) -> Array:
    """M x for matrices with or without batch axes."""
    if M.ndim == 2:
        return jnp.tensordot(M, x, 1)
    M = M.reshape(M.shape + (1,) * (x.ndim + 1 - M.ndim))
    return jnp.sum(M * x[None], axis=1)
