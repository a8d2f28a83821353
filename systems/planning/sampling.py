"""What a call of the planner samples: wrench sequences and process noise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models.dynamics import Dynamics
from ..plant.wrench_limits import WrenchLimits
from .mppi_config import MppiConfig
from .path_integral import spline_basis

_WORST = 1e3
"""Condition number beyond which the slope of the acting wrench is not inverted."""


class Sampler(eqx.Module):
    """Samples sequences about a nominal one, with smooth noise and within the limits.

    The noise applies to the wrench that acts on the body. Where the model's thrust differs from the
    command (a weak thruster, say), commands are sampled that produce this noise; noise on the
    commands themselves would hardly ever surge without turning.
    """

    limits: WrenchLimits
    axes: Float[Array, "6"]
    bases: tuple[Float[Array, "horizon _"], ...]
    command: Float[Array, "6 6"] | None
    config: MppiConfig = eqx.field(static=True)

    @classmethod
    def create(
        cls,
        config: MppiConfig,
        limits: WrenchLimits,
        dynamics: Dynamics,
        X_WB: Float[Array, "7"],
        dtype: jnp.dtype | type,
    ) -> "Sampler":
        """A sampler with arrays of type `dtype`; `X_WB` is where the command is linearised."""
        axes = eqx.filter_jit(type(limits).axes)(limits).astype(dtype)
        scale = np.maximum(config.noise, 0.01) * np.asarray(axes, float)
        command = command_of_felt(dynamics, X_WB, scale)
        return cls(
            limits,
            axes,
            tuple(jnp.asarray(spline_basis(config.horizon, k), dtype) for k in config.knots),
            None if command is None else jnp.asarray(command, dtype),
            config,
        )

    def sequences(
        self, key: Array, nominal: Float[Array, "horizon 6"], hold: Float[Array, "horizon 6"]
    ) -> Float[Array, "horizon 6 sequences"]:
        """Feasible wrench sequences: `nominal`, `hold`, then `nominal` with noise."""
        c = self.config
        n = c.sequences
        noise = jnp.asarray(c.noise, nominal.dtype) * self.axes
        counts = [n // len(self.bases) + (i < n % len(self.bases)) for i in range(len(self.bases))]
        parts = []
        for basis, count, k in zip(
            self.bases, counts, jax.random.split(key, len(counts)), strict=True
        ):
            w = jax.random.normal(k, (basis.shape[1], 6 * count), basis.dtype)
            part = c.smallest_noise ** jnp.linspace(0, 1, count, dtype=basis.dtype)
            parts.append((basis @ w).reshape(c.horizon, 6, count) * part[None, None])
        change = jnp.concatenate(parts, axis=2) * noise[None, :, None]
        if self.command is not None:
            change = jnp.einsum("ij,tjn->tin", self.command, change)
        F = nominal[:, :, None] + change
        F = F.at[:, :, 0].set(nominal)
        if n > 1:
            F = F.at[:, :, 1].set(hold)
        return self.cut(F)

    def cut(self, F_Bo_B: Float[Array, "horizon 6 *batch"]) -> Float[Array, "horizon 6 *batch"]:
        """Sequences clipped to the feasible set."""
        return jnp.moveaxis(self.limits.clip(jnp.moveaxis(F_Bo_B, 1, 0)), 0, 1)

    def process_noise(
        self, key: Array, tracked: bool
    ) -> Float[Array, "horizon substeps 6 r"] | None:
        """Brownian increments (√s) for the realisations; None for a single one.

        Pairs have opposite signs, so the mean is zero. Without tracking, each axis is scaled to the
        expected mean square of its Brownian path over the horizon, so that a few realisations have
        the spread of many.
        """
        c = self.config
        if c.realisations == 1:
            return None
        m, h = c.steps_of_model, c.dt / c.steps_of_model
        shape = (c.horizon * m, 6, c.realisations // 2)
        dW = jax.random.normal(key, shape, self.axes.dtype) * h**0.5
        if not tracked:
            sampled = jnp.mean(jnp.cumsum(dW, axis=0) ** 2, axis=(0, 2))
            dW = dW * jnp.sqrt(h * (c.horizon * m + 1) / 2 / sampled)[None, :, None]
        return jnp.concatenate([dW, -dW], axis=2).reshape(c.horizon, m, 6, c.realisations)


def command_of_felt(
    dynamics: Dynamics, X_WB: Float[Array, "7"], scale: Float[np.ndarray, "6"]
) -> Float[np.ndarray, "6 6"] | None:
    """The change of the commanded wrench for a unit change of the one that acts on the body.

    The inverse of the model's mean slope over ± `scale` (N, N·m) about a command of zero, at rest,
    on the axes with a scale; None where it is the identity, as for every model without effects on
    its thrusters, and where the slope is nearly singular.
    """
    given = np.ix_(scale > 0, scale > 0)
    scale = np.where(scale > 0, scale, 1.0)
    X = jnp.asarray(X_WB, dynamics.rigid_inertia.dtype)
    steps = jnp.asarray(np.concatenate([np.diag(scale), -np.diag(scale)], axis=1), X.dtype)
    X = jnp.broadcast_to(X[:, None], (7, 12))
    felt = np.asarray(dynamics.balance(X, jnp.zeros_like(steps), steps)[1], float)
    slope = ((felt[:, :6] - felt[:, 6:]) / (2 * scale))[given]
    if np.allclose(slope, np.eye(len(slope)), atol=1e-3) or np.linalg.cond(slope) > _WORST:
        return None
    command = np.zeros((6, 6))
    command[given] = np.linalg.inv(slope)
    return command
