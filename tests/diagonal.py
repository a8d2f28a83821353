"""A small learnable vehicle that compiles fast: diagonal M, D and b, no potential."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spinndrift.models import se3
from spinndrift.models.dynamics import Coefficients, Dynamics
from spinndrift.models.files import checkpoint
from spinndrift.models.spd import ConstantOperator, Operator, Spd
from spinndrift.training.data.windows import Windows
from spinndrift.training.predict import predict


class DiagonalSpd(Spd):
    entries: Float[Array, "6"]

    def matvec(self, x):
        return se3.align(self.entries, x)[0] * x

    def solve(self, y):
        return y / se3.align(self.entries, y)[0]

    def matrix(self):
        return jnp.diag(self.entries)


class Diagonal(Dynamics):
    log_mass: Float[Array, "6"]
    log_drag: Float[Array, "6"]
    log_diffusion: Float[Array, "6"]
    rigid_inertia: Float[Array, "6 6"]
    displaced_mass: Float[Array, ""]
    p_BoCb_B: Float[Array, "3"]

    @classmethod
    def of(cls, mass=10.0, drag=8.0, diffusion=1.0, dtype=jnp.float32):
        """Linear axes as given, angular ones a tenth."""
        share = np.array([1, 1, 1, 0.1, 0.1, 0.1])
        logs = (jnp.asarray(np.log(x * share), dtype) for x in (mass, drag, diffusion))
        return cls(*logs, jnp.eye(6, dtype=dtype), jnp.ones((), dtype), jnp.zeros(3, dtype))

    def trainable(self):
        names = ("log_mass", "log_drag", "log_diffusion")
        return jax.tree_util.tree_map_with_path(lambda path, _: path[0].name in names, self)

    def coefficients(self, V_WB_B):
        mass, drag = DiagonalSpd(jnp.exp(self.log_mass)), jnp.diag(jnp.exp(self.log_drag))
        none: Operator = ConstantOperator(jnp.zeros_like(drag))
        return Coefficients(mass, ConstantOperator(drag), none, jnp.exp(self.log_diffusion))

    def mass_and_diffusion(self, V_WB_B):
        return DiagonalSpd(jnp.exp(self.log_mass)), jnp.exp(self.log_diffusion)

    def potential(self, X_WB):
        return jnp.zeros_like(X_WB[0])

    def potential_wrench(self, X_WB):
        return jnp.zeros_like(X_WB[:6])


checkpoint.register(Diagonal, lambda _: {}, lambda _: Diagonal.of())


def simulated(model, count, steps=20, seed=0, dt=0.1):
    """Windows drawn from a model's own law under random constant wrenches."""
    V_key, F_key, key = jax.random.split(jax.random.key(seed), 3)
    dtype = model.displaced_mass.dtype
    V = 0.2 * jax.random.normal(V_key, (6, count), dtype)
    size = jnp.asarray([8.0, 8, 8, 0.8, 0.8, 0.8], dtype)[:, None]
    F = jnp.repeat((size * jax.random.normal(F_key, (6, count), dtype))[None], steps, axis=0)
    X = jnp.broadcast_to(se3.identity(dtype)[:, None], (7, count))
    Xs, Vs = jax.jit(predict, static_argnums=(4, 6))(model, X, V, F, dt, key, 1)
    return Windows(
        X=np.concatenate([np.asarray(X)[None], np.asarray(Xs)[:, :, 0]]),
        V=np.concatenate([np.asarray(V)[None], np.asarray(Vs)[:, :, 0]]),
        F=np.asarray(F),
        dt=dt,
        scenario=np.arange(count) % 2,
        run=np.arange(count),
        start=np.zeros(count),
        names=("first", "second"),
    )
