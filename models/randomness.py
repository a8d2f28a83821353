"""Random variables and processes from unit Gaussians, the only external source of noise."""

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, Bool, Float

Scalar = float | Float[Array, ""]


def uniform(w: Float[Array, "*batch"], low: float, high: float) -> Float[Array, "*batch"]:
    """Uniform values in [low, high]: low + (high − low) Φ(w) of unit Gaussians w."""
    return low + (high - low) * ndtr(w)


def bernoulli(
    w: Float[Array, "*batch"], probability: float | Float[Array, "*batch"]
) -> Bool[Array, "*batch"]:
    """True with the given probability: Φ(w) < probability for unit Gaussians w."""
    return ndtr(w) < probability


def gauss_markov(
    x: Float[Array, "n *batch"],
    std: Float[Array, "n *ones"],
    time_constant: Float[Array, "n *ones"],
    dt: Scalar,
    w: Float[Array, "n *batch"],
) -> Float[Array, "n *batch"]:
    """Advance first-order Gauss–Markov (Ornstein–Uhlenbeck) processes by dt, exactly for any dt.

    x⁺ = ρ x + std √(1 − ρ²) w with ρ = exp(−dt / time_constant); stationary variance std²,
    autocorrelation exp(−|lag| / time_constant) (Gillespie 1996, eq. 2.14).
    """
    exponent = jnp.asarray(dt, x.dtype) / time_constant
    return jnp.exp(-exponent) * x + std * jnp.sqrt(-jnp.expm1(-2 * exponent)) * w


def column(values: float | tuple[float, ...] | np.ndarray, like: Float[Array, "n *batch"]) -> Array:
    """Constants as an array (n, 1, …) of the dtype and rank of `like`."""
    return jnp.asarray(values, like.dtype).reshape((-1,) + (1,) * (like.ndim - 1))
