"""Multilayer perceptrons for coefficients: component first, several networks in one product.

A step of the integrator evaluates up to four networks of the same input and the same width. Their
weights are stacked, so that each layer is one batched matrix product over all networks and samples.
"""

from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Activation = Literal["tanh", "rational_tanh", "softplus", "lipswish"]
ACTIVATIONS: tuple[str, ...] = get_args(Activation)

_LOG2 = 0.6931471805599453


@jax.custom_jvp
def rational_tanh(x: Array) -> Array:
    """The [7/6] Padé approximant of tanh, clipped at ±1: within 1e-4, with no exponential.

    Its derivative is taken as 1 - y², which is that of tanh within 4e-4.
    """
    x = jnp.clip(x, -4.97, 4.97)
    s = x * x
    return x * (135135 + s * (17325 + s * (378 + s))) / (135135 + s * (62370 + s * (3150 + s * 28)))


@rational_tanh.defjvp
def _rational_tanh_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    y = rational_tanh(*primals)
    return y, (1 - y * y) * tangents[0]


def activate(x: Array, kind: Activation) -> Array:
    """A 1-Lipschitz activation; softplus is shifted to zero at zero, LipSwish is x σ(x) / 1.1.

    Reference: Chen et al. (2019), "Residual flows", for LipSwish.
    """
    if kind == "tanh":
        return jnp.tanh(x)
    if kind == "rational_tanh":
        return rational_tanh(x)
    if kind == "softplus":
        return jnp.maximum(x, 0) + jnp.log1p(jnp.exp(-jnp.abs(x))) - _LOG2
    return jax.nn.silu(x) * (1 / 1.1)


def expand(a: Array, rank: int) -> Array:
    """Append batch axes of length one up to this rank."""
    return a.reshape(a.shape + (1,) * (rank - a.ndim))


class MlpStack(eqx.Module):
    """The hidden layers of n perceptrons of equal shape: act(W_k … act(W_1 x + b_1) … + b_k)."""

    weights: tuple[Float[Array, "n _out _in"], ...]
    biases: tuple[Float[Array, "n _out"], ...]
    activation: Activation = eqx.field(static=True)

    @classmethod
    def create(
        cls,
        count: int,
        inputs: int,
        width: int,
        depth: int,
        activation: Activation,
        key: Array,
        dtype: jnp.dtype | type = float,
    ) -> "MlpStack":
        """Draw `depth` layers: weights N(0, 1/inputs), biases uniform in ±1/√inputs."""
        weights, biases = [], []
        for layer_key in jax.random.split(key, depth):
            w_key, b_key = jax.random.split(layer_key)
            bound = jnp.asarray(inputs**-0.5, dtype)
            weights.append(jax.random.normal(w_key, (count, width, inputs), dtype) * bound)
            biases.append(jax.random.uniform(b_key, (count, width), dtype, -1, 1) * bound)
            inputs = width
        return cls(tuple(weights), tuple(biases), activation)

    def __call__(self, x: Float[Array, "in *batch"], count: int) -> Float[Array, "n out *batch"]:
        """The features of the first `count` networks, which have the same input."""
        h = jnp.tensordot(self.weights[0][:count], x, 1)
        h = activate(h + expand(self.biases[0][:count], h.ndim), self.activation)
        for w, b in zip(self.weights[1:], self.biases[1:], strict=True):
            h = jnp.einsum("noi,ni...->no...", w[:count], h)
            h = activate(h + expand(b[:count], h.ndim), self.activation)
        return h


class Heads(eqx.Module):
    """The linear output layers of n networks with the same number of outputs."""

    weight: Float[Array, "n out in"]
    bias: Float[Array, "n out"]

    @classmethod
    def constant(cls, bias: Float[Array, "n out"], width: int) -> "Heads":
        """Heads with zero weights: the networks start as the constants `bias`."""
        return cls(jnp.zeros((*bias.shape, width), bias.dtype), bias)

    def __call__(self, h: Float[Array, "k in *batch"], count: int) -> Float[Array, "k out *batch"]:
        """The outputs of the first `count` networks."""
        y = jnp.einsum("noi,ni...->no...", self.weight[:count], h)
        return y + expand(self.bias[:count], y.ndim)
