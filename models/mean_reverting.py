"""A mean-reverting disturbance of a model: coloured noise, in addition to the white noise."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .networks import expand
from .randomness import gauss_markov


class MeanReverting(eqx.Module):
    """An Ornstein–Uhlenbeck wrench on the body, dF = −F/τ dt + σ √(2/τ) dW (axes of B).

    It is a latent state: without further information it has its stationary law, with mean 0 and
    standard deviation σ (Uhlenbeck and Ornstein 1930).
    """

    log_ratio: Float[Array, "6"]
    """log of σ √(2τ) in units of the model's diffusion scale."""
    log_time: Float[Array, "6"]
    """log of τ in s."""

    @classmethod
    def create(cls, dtype: jnp.dtype | type) -> "MeanReverting":
        """Half the white noise's intensity over long times, and a time constant of 1 s."""
        return cls(jnp.log(jnp.full(6, 0.5, dtype)), jnp.zeros(6, dtype))

    @property
    def time_constant(self) -> Float[Array, "6"]:
        """τ (s)."""
        return jnp.exp(self.log_time)

    def std(self, scale: Float[Array, "6"]) -> Float[Array, "6"]:
        """σ (N, N·m) for the diffusion's scale (N√s, N·m√s)."""
        return self.white(jax.lax.stop_gradient(scale)) / jnp.sqrt(2 * self.time_constant)

    def white(self, scale: Float[Array, "6"]) -> Float[Array, "6"]:
        """σ √(2τ): the b of the white noise with equal effect over times much longer than τ."""
        return scale * jnp.exp(self.log_ratio)

    def path(
        self, scale: Float[Array, "6"], w: Float[Array, "T 6 *batch"], dt: float | Float[Array, ""]
    ) -> Float[Array, "T 6 *batch"]:
        """The wrench over T steps of `dt` (s) from unit Gaussians; the first one sets its start."""
        std, time = expand(self.std(scale), w.ndim - 1), expand(self.time_constant, w.ndim - 1)

        def advance(force: Array, w: Array) -> tuple[Array, Array]:
            force = gauss_markov(force, std, time, dt, w)
            return force, force

        first = std * w[0]
        rest = jax.lax.scan(advance, first, w[1:])[1]
        return jnp.concatenate([first[None], rest])
