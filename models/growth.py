"""Diffusion that grows with the twist."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float

from . import se3


class Growth(eqx.Module):
    """b_i √(1 + Σ_j g_ij min(|ξ_j|, c_j)²): the size of model errors, which come with motion.

    Bounded by the twists of the data that it was found in, so that noise does not feed itself. It
    is found by calibration, not trained.
    """

    rate: Float[Array, "6 6"]
    """g (s²/m², s²/rad²), zero or more."""
    fastest: Float[Array, "6"]
    """c (m/s, rad/s)."""

    @classmethod
    def create(
        cls,
        rate: Float[np.ndarray, "6 6"],
        fastest: Float[np.ndarray, "6"],
        dtype: DTypeLike = float,
    ) -> "Growth":
        """From arrays."""
        return cls(jnp.asarray(rate, dtype), jnp.asarray(fastest, dtype))

    @classmethod
    def none(cls, dtype: DTypeLike = float) -> "Growth":
        """No growth."""
        return cls.create(np.zeros((6, 6)), np.ones(6), dtype)

    def __call__(
        self, b: Float[Array, "6"], V_WB_B: Float[Array, "6 *#batch"]
    ) -> Float[Array, "6 *#batch"]:
        """The diffusion at a twist whose value at rest is b."""
        rate, fastest = jax.lax.stop_gradient((self.rate, self.fastest))
        fastest, V = se3.align(fastest, V_WB_B)
        b, more = se3.align(b, jnp.tensordot(rate, jnp.minimum(jnp.abs(V), fastest) ** 2, 1))
        return b * jnp.sqrt(1 + more)
