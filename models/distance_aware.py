"""Diffusion that grows with the distance from the data: two published parametrisations.

A scalar network η of the scaled body velocity z is a learned distance from the training data;
ρ(z) = σ(η(z) - 7), with the logistic function σ, is nearly zero near the data and one far away. It
multiplies a prior diffusion, the upper bound:

- `distance-aware` (Djeumou, Neary, Topcu 2023, "How to learn and generalize from three minutes of
  data", section 2.2, and the public code wuwushrek/sde4mbrl at f4f34bf): b / prior =
  σ((1 + ε eᵃ) η - 7 + ε eˢ) with learned a, s for each axis and ε = 1e-7, and a local strong
  convexity coefficient μ(z) = 10 exp(network(z)).
- `unconstrained` (Koprulu, Djeumou, Topcu 2025, "Neural stochastic differential equations for
  uncertainty-aware offline RL", and cevahir-koprulu/sde4mbrltatu, branch iclr2025 at e8bdbd7):
  b / prior = exp(c + |w| tanh(A z + a₀)) + σ((1 + eᵃ) η - 7 + eˢ), the first term for the noise
  near the data, and one learned number μ that starts at 100.

Activations are LipSwish, which is swish up to a factor that the next layer's weights absorb.
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .networks import Activation, Heads, MlpStack, expand

DiffusionKind = Literal["network", "distance-aware", "unconstrained"]

_OFFSET = 7.0
_SWISH = 1.1  # swish = 1.1 LipSwish


class Scalar(eqx.Module):
    """A perceptron with one output, initial weights uniform in ±`bound` and biases zero."""

    hidden: MlpStack
    output: Heads

    @classmethod
    def create(
        cls, width: int, depth: int, activation: Activation, bound: float, key: Array, dtype: Any
    ) -> "Scalar":
        keys = jax.random.split(key, depth + 1)
        sizes = [6] + [width] * depth

        def uniform(k: Array, shape: tuple[int, ...], b: float) -> Array:
            return jax.random.uniform(k, shape, dtype, -b, b)

        swish = _SWISH if activation == "lipswish" else 1.0
        bounds = [bound] + [bound * swish] * depth
        weights = tuple(
            uniform(k, (1, width, size), b)
            for k, size, b in zip(keys[:-1], sizes, bounds, strict=False)
        )
        biases = tuple(jnp.zeros((1, width), dtype) for _ in weights)
        last = uniform(keys[-1], (1, 1, width), bounds[-1])
        return cls(MlpStack(weights, biases, activation), Heads(last, jnp.zeros((1, 1), dtype)))

    def __call__(self, z: Float[Array, "6 *batch"]) -> Float[Array, "*batch"]:
        return self.output(self.hidden(z, 1), 1)[0, 0]


class Aleatoric(eqx.Module):
    """exp(c + |w| tanh(A z + a₀)): diffusion that does not depend on the distance."""

    center: Float[Array, "6"]
    width: Float[Array, "6"]
    slope: Float[Array, "6 6"]
    offset: Float[Array, "6"]

    def __call__(self, z: Float[Array, "6 *batch"]) -> Float[Array, "6 *batch"]:
        t = jnp.tanh(jnp.tensordot(self.slope, z, 1) + expand(self.offset, z.ndim))
        return jnp.exp(expand(self.center, z.ndim) + expand(jnp.abs(self.width), z.ndim) * t)


class DistanceAware(eqx.Module):
    """The factor on the prior diffusion, and the coefficient μ of the penalties on ρ."""

    distance: Scalar
    scaler: Float[Array, "2 6"]
    convexity: Scalar | Float[Array, ""]
    aleatoric: Aleatoric | None
    scaler_unit: float = eqx.field(static=True)

    @classmethod
    def create(cls, kind: DiffusionKind, key: Array, dtype: Any) -> "DistanceAware":
        """Networks with the sizes and initial values of the public code.

        Raises:
            ValueError: the kind is neither of the two.
        """
        η, s, μ, c, a = jax.random.split(key, 5)
        if kind == "distance-aware":
            return cls(
                distance=Scalar.create(32, 2, "lipswish", 1e-3, η, dtype),
                scaler=jax.random.uniform(s, (2, 6), dtype, -0.01, 0.01),
                convexity=Scalar.create(8, 2, "tanh", 0.01, μ, dtype),
                aleatoric=None,
                scaler_unit=1e-7,
            )
        if kind == "unconstrained":
            both = jax.random.uniform(c, (2, 6), dtype, 0.0, 0.01)
            slope = jax.random.uniform(a, (6, 6), dtype, -1e-3, 1e-3)
            return cls(
                distance=Scalar.create(64, 2, "lipswish", 0.1, η, dtype),
                scaler=jax.random.uniform(s, (2, 6), dtype, 0.0, 1e-3),
                convexity=jnp.ones((), dtype),
                aleatoric=Aleatoric(both[0], both[1], slope, jnp.zeros(6, dtype)),
                scaler_unit=1.0,
            )
        raise ValueError(f"diffusion {kind!r} is neither distance-aware nor unconstrained")

    def __call__(self, z: Float[Array, "6 *batch"]) -> Float[Array, "6 *batch"]:
        """Diffusion b in units of the prior."""
        slope, offset = self.scaler_unit * jnp.exp(self.scaler)
        slope, offset = expand(slope, z.ndim), expand(offset, z.ndim)
        b = jax.nn.sigmoid((1 + slope) * self.distance(z)[None] - _OFFSET + offset)
        return b if self.aleatoric is None else b + self.aleatoric(z)

    def density(self, z: Float[Array, "6 *batch"]) -> Float[Array, "*batch"]:
        """ρ(z) = σ(η(z) - 7)."""
        return jax.nn.sigmoid(self.distance(z) - _OFFSET)

    def mu(self, z: Float[Array, "6 *batch"]) -> Float[Array, "*batch"]:
        """The required local strong convexity of ρ at the data."""
        if isinstance(self.convexity, Scalar):
            return 10 * jnp.exp(self.convexity(z))
        return jnp.broadcast_to(100 * jnp.abs(self.convexity), z.shape[1:])

    def hinge(
        self, z: Float[Array, "6 *batch"], displaced: Float[Array, "6 S *batch"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "S *batch"], Float[Array, "S *batch"]]:
        """|∇ρ|² at z, the squared lack of strong convexity towards each z + d, and ρ(z + d).

        The lack is min(0, ρ(z + d) - ρ(z) - ∇ρ·d - μ |d|² / 2) (Djeumou et al. 2023, the local
        strong convexity constraint).
        """
        value, slope = self.density(z), jax.grad(lambda x: jnp.sum(self.density(x)))(z)
        there = self.density(z[:, None] + displaced)
        rise = jnp.sum(slope[:, None] * displaced, axis=0)
        square = jnp.sum(displaced * displaced, axis=0)
        margin = there - value[None] - rise - self.mu(z)[None] * square / 2
        return jnp.sum(slope * slope, axis=0), jnp.minimum(margin, 0) ** 2, there
