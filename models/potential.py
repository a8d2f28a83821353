"""Learned potential energies and their left-trivialised derivatives (wrenches in B)."""

import abc
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import se3
from .networks import Activation, Heads, MlpStack

PotentialKind = Literal["gravity", "pose"]


class BoundedScalar(eqx.Module):
    """λ tanh(MLP(x) + s·x) with a learned bound λ (Palmer et al., footnote on V; Kidger 2021).

    With the skip s V starts at the reference's restoring energy; the MLP starts at zero.
    """

    hidden: MlpStack
    head: Heads
    skip: Float[Array, "in"]
    bound: Float[Array, ""]

    @classmethod
    def create(
        cls,
        width: int,
        depth: int,
        activation: Activation,
        skip: Float[Array, "in"],
        bound: Float[Array, ""],
        key: Array,
    ) -> "BoundedScalar":
        """A network that starts at `bound` tanh(`skip`·x)."""
        inputs = skip.shape[0]
        hidden = MlpStack.create(1, inputs, width, depth, activation, key, bound.dtype)
        return cls(hidden, Heads.constant(jnp.zeros((1, 1), bound.dtype), width), skip, bound)

    def __call__(self, x: Float[Array, "in *batch"]) -> Float[Array, "*batch"]:
        return self.bound * jnp.tanh(
            self.head(self.hidden(x, 1), 1)[0, 0] + jnp.tensordot(self.skip, x, 1)
        )

    def gradient(self, x: Float[Array, "in *batch"]) -> Float[Array, "in *batch"]:
        """The derivative with respect to the input, for each batch entry."""
        return jax.grad(lambda y: jnp.sum(self(y)))(x)


class Potential(eqx.Module):
    """A potential energy V(g) in J and F_V, minus its derivative along g exp(s e_i)."""

    @abc.abstractmethod
    def energy(self, X_WB: Float[Array, "7 *batch"]) -> Float[Array, "*batch"]:
        """V(g) in J, up to a constant."""

    @abc.abstractmethod
    def wrench(self, X_WB: Float[Array, "7 *batch"]) -> Float[Array, "6 *batch"]:
        """The wrench about Bo in B that V exerts."""


class GravityPotential(Potential):
    """V = λ tanh(MLP(Rᵀ e_z)) - f_b z: the symmetry of weight and buoyancy.

    It is invariant to x, y and yaw and affine in height, so it holds over a whole dive; f_b is the
    net buoyancy (N). The wrench is [f_b u, u × ∇_u λ tanh(MLP(u))] with u = Rᵀ e_z.
    """

    restoring: BoundedScalar
    net_buoyancy: Float[Array, ""]

    def energy(self, X_WB: Float[Array, "7 *batch"]) -> Float[Array, "*batch"]:
        return self.restoring(_up(X_WB)) - self.net_buoyancy * X_WB[6]

    def wrench(self, X_WB: Float[Array, "7 *batch"]) -> Float[Array, "6 *batch"]:
        up = _up(X_WB)
        moment = se3.cross(up, self.restoring.gradient(up))
        return jnp.concatenate([self.net_buoyancy * up, moment])


class PosePotential(Potential):
    """V = λ tanh(MLP(R, p / length)) of the chordal embedding, as in Palmer et al.

    It depends on the whole pose, so all windows must share one origin: they start at the identity.
    """

    scalar: BoundedScalar
    length: Float[Array, ""]

    def energy(self, X_WB: Float[Array, "7 *batch"]) -> Float[Array, "*batch"]:
        return self._of(se3.rotation_matrix(X_WB), X_WB[4:])

    def _of(self, R: Array, p: Array) -> Array:
        scaled = p / jax.lax.stop_gradient(self.length)
        return self.scalar(jnp.concatenate([R[0], R[1], R[2], scaled]))

    def wrench(self, X_WB: Float[Array, "7 *batch"]) -> Float[Array, "6 *batch"]:
        """F_V = [-Rᵀ ∂V/∂p, -vee(RᵀG - GᵀR)] with G = ∂V/∂R.

        The derivative along R exp(s ω̂) is tr(Gᵀ R ω̂) = Σ_j G_j · (r_j × ω) over the rows of G and
        R, so the moment is Σ_j r_j × G_j.
        """
        R, p = se3.rotation_matrix(X_WB), jnp.split(X_WB, [4])[1]
        G, dp = jax.grad(lambda R, p: jnp.sum(self._of(R, p)), argnums=(0, 1))(R, p)
        moment = se3.cross(R[0], G[0]) + se3.cross(R[1], G[1]) + se3.cross(R[2], G[2])
        return jnp.concatenate([-se3.rotate_inverse(X_WB, dp), moment])


def _up(X_WB: Array) -> Array:
    """W's z axis in B: the last row of R_WB."""
    w, x, y, z, *_ = jnp.unstack(X_WB)
    return jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
