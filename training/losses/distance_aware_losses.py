"""The two published objectives for distance-aware diffusion, on the Euclidean SPINN.

Both train a model whose diffusion is `models.distance_aware.DistanceAware`; names and numbers of
the public code are given with each. `head_decay` replaces their penalties on parameters, and
Adam's rate follows a cosine instead of a line.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models.config.checks import check_numbers, require
from ...models.config.errors import UserError
from ...models.distance_aware import DistanceAware as Diffusion
from ...models.dynamics import Dynamics
from ...models.euclidean import EuclideanSpinn
from ..data.windows import Windows
from .base import Batch, Objective
from .euclidean_losses import euclidean, observed, predict_coordinates
from .kernels import VelocityKernel


@dataclass(frozen=True)
class DistanceAware:
    """Squared error of particles at random times, with penalties on the distance network.

    Djeumou, Neary, Topcu (2023), the loss of section 2.3; numbers of wuwushrek/sde4mbrl at f4f34bf
    for a hexacopter (`optimizer_sde.yaml`), which is a rigid body too:

        mean Σ_t Σ_i ((y_i - x_i) / w_i)² + λ (g mean|∇ρ|² + h mean ΣΣ lack + m / mean μ).
    """

    horizon_s: float = 1.0
    """Duration (s) used of each window, from its start: 20 steps of 0.05 s."""
    times: int = 5
    """Random times of the horizon at which each window's particle is compared."""
    particles: int = 1
    gradient_weight: float = 1.0
    """g (`pen_grad_density`)."""
    convexity_weight: float = 1.0
    """h (`pen_density_scvex`); the `lack` is summed over the ball and the horizon."""
    mu_weight: float = 100.0
    """m (`pen_mu_coeff`, of type `lin_inv`)."""
    penalty_scale: float = 0.01
    """λ (`pen_scvex_mult`)."""
    ball_radius: float = 0.1
    """Standard deviation of the points around the data, in units of `velocity_scale`."""
    ball_samples: int = 10
    substeps: int = 2

    def __post_init__(self) -> None:
        _check(self, "times", "particles", "ball_samples", "substeps")
        require(self.horizon_s > 0, self, "horizon_s", "give a time above 0 s")

    def build(self, model: Dynamics, windows: Windows) -> "DistanceAwareObjective":
        """The objective with w, the largest absolute value of each component (`obs_weights`).

        Raises:
            UserError: the model has no such diffusion, or is on the group.
        """
        _diffusion(euclidean(model), "distance-aware")
        steps = int(np.clip(round(self.horizon_s / windows.dt), 1, windows.steps))
        pose, velocity = _components(windows)
        size = (np.nanmax(np.abs(a), axis=(1, 2)) for a in (pose, velocity))
        return DistanceAwareObjective(self, steps, windows.dt, *_units(size, windows))


class DistanceAwareObjective(Objective):
    """The loss of `DistanceAware`."""

    name: ClassVar[str] = "distance-aware"
    mean_of_windows: ClassVar[bool] = False  # 1/μ of the mean μ
    config: DistanceAware = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    pose_unit: Float[Array, "6"]
    velocity_unit: Float[Array, "6"]

    def loss(
        self, model: Dynamics, batch: Batch, key: Array
    ) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        c, model, batch = self.config, euclidean(model), _beginning(batch, self.steps)
        noise_key, time_key, ball_key = jax.random.split(key, 3)
        q, V = predict_coordinates(
            model, batch, self.dt, noise_key, c.particles, substeps=c.substeps
        )
        e = (observed(batch)[1:, :, None] - q) / self.pose_unit[None, :, None, None]
        d = (batch.V[1:, :, None] - V) / self.velocity_unit[None, :, None, None]
        square = jnp.sum(e * e + d * d, axis=1)  # (T, P, W)
        order = jnp.argsort(jax.random.uniform(time_key, square.shape), axis=0)
        chosen = jnp.take_along_axis(square, order[: c.times], axis=0)
        aware = _diffusion(model, "distance-aware")
        z = model.scaled_velocity(jnp.moveaxis(batch.V[:-1], 1, 0))
        ball = _ball(ball_key, z, c.ball_radius, c.ball_samples)
        slope, lack, _ = aware.hinge(z, ball)
        parts = {
            "error": jnp.mean(jnp.sum(chosen, axis=0)),
            "density_gradient": jnp.mean(slope),
            "convexity": jnp.mean(jnp.sum(lack, axis=(0, 1))),
            "mu": jnp.mean(aware.mu(z)),
        }
        penalty = c.gradient_weight * parts["density_gradient"]
        penalty = penalty + c.convexity_weight * parts["convexity"] + c.mu_weight / parts["mu"]
        return parts["error"] + c.penalty_scale * penalty, parts


@dataclass(frozen=True)
class Unconstrained:
    """Gaussian negative log-likelihood with the diffusion as deviation, and separate penalties.

    Koprulu, Djeumou, Topcu (2025); cevahir-koprulu/sde4mbrltatu, branch iclr2025 at e8bdbd7
    (`nll_type: gauss_approx`, `losses_diffusion`). In units of the data's standard deviation,

        mean Σ_n γⁿ Σ_i ((y_i - x_i)² / σ_i² + log σ_i²) + v Σ|w|,

    σ² the diagonal of M⁻¹ b b M⁻ᵀ at the particle's state before the step, as in the code (a
    diffusion in place of a deviation: no factor √dt). Position and angles have no diffusion here
    and use σ = 1. The likelihood does not train the distance network; only

        a mean ρ + o mean (ρ(ball) - 1)² + g mean|∇ρ|² + mean Σ lack + 1/μ²
        - 1000 log(mean|∇ρ|²) where that mean is below 1e-6

    does, at each window's initial state. One optimiser trains both; the code has two.
    """

    horizon: int = 2
    """Number of steps used of each window, from its start."""
    discount: float = 0.9
    particles: int = 1
    width_weight: float = 1e-3
    """v (`VarBoundLoss`)."""
    density_weight: float = 1e-3
    """a (`density_value`)."""
    outside_weight: float = 1e-4
    """o (`density_set_one`)."""
    gradient_weight: float = 1e-5
    """g (`gradient_loss`)."""
    least_gradient: float = 1e-6
    least_gradient_weight: float = 1000.0
    ball_radius: float = 0.1
    ball_samples: int = 20
    substeps: int = 2

    def __post_init__(self) -> None:
        _check(self, "horizon", "particles", "ball_samples", "substeps")
        require(0 < self.discount <= 1, self, "discount", "give more than 0, at most 1")

    def build(self, model: Dynamics, windows: Windows) -> "UnconstrainedObjective":
        """The objective with the data's standard deviations.

        Raises:
            UserError: the model has no such diffusion, or is on the group.
        """
        _diffusion(euclidean(model), "unconstrained")
        steps = min(self.horizon, windows.steps)
        size = (np.nanstd(a, axis=(1, 2)) for a in _components(windows))
        return UnconstrainedObjective(self, steps, windows.dt, *_units(size, windows))


class UnconstrainedObjective(Objective):
    """The loss of `Unconstrained`."""

    name: ClassVar[str] = "unconstrained"
    mean_of_windows: ClassVar[bool] = False  # a threshold on the mean gradient
    config: Unconstrained = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    pose_unit: Float[Array, "6"]
    velocity_unit: Float[Array, "6"]

    def loss(
        self, model: Dynamics, batch: Batch, key: Array
    ) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        c, model, batch = self.config, euclidean(model), _beginning(batch, self.steps)
        noise_key, ball_key = jax.random.split(key)
        aware = _diffusion(model, "unconstrained")
        fixed = eqx.tree_at(
            lambda m: m.distance_aware.distance,
            model,
            jax.tree.map(jax.lax.stop_gradient, aware.distance),
        )
        parts = self.likelihood(fixed, batch, noise_key)
        z = model.scaled_velocity(batch.V[0])
        ball = _ball(ball_key, z, c.ball_radius, c.ball_samples)
        slope, lack, there = aware.hinge(z, ball)
        gradient, mu = jnp.mean(slope), aware.mu(z[:, 0])
        parts |= {
            "density": jnp.mean(aware.density(z)),
            "density_gradient": gradient,
            "convexity": jnp.mean(jnp.sum(lack, axis=0)),
            "mu": mu,
        }
        penalty = c.density_weight * parts["density"] + parts["convexity"] + 1 / mu**2
        penalty = penalty + c.outside_weight * jnp.mean((there - 1) ** 2)
        penalty = penalty + c.gradient_weight * gradient
        flat = jnp.where(gradient < c.least_gradient, -jnp.log(gradient), 0)
        penalty = penalty + c.least_gradient_weight * flat
        assert aware.aleatoric is not None
        width = jnp.sum(jnp.abs(aware.aleatoric.width))
        return parts["likelihood"] + c.width_weight * width + penalty, parts

    def likelihood(self, model: EuclideanSpinn, batch: Batch, key: Array) -> dict[str, Array]:
        """The negative log-likelihood and its squared error."""
        c = self.config
        q, V = predict_coordinates(model, batch, self.dt, key, c.particles, substeps=c.substeps)
        q, V = jnp.mean(q, axis=2), jnp.moveaxis(V, 1, 0)
        started = jnp.broadcast_to(batch.V[0][:, None, None], (6, 1, *V.shape[2:]))
        before = jnp.concatenate([started, V[:, :-1]], axis=1)  # (6, T, P, W)
        mass, b = model.mass_and_diffusion(before)
        eye = jnp.eye(6, dtype=b.dtype).reshape(6, 6, *(1,) * (b.ndim - 1))
        columns = mass.solve(jnp.broadcast_to(eye, (6, *b.shape)) * b[None])
        variance = jnp.sum(columns**2, axis=1) / self.velocity_unit[:, None, None, None] ** 2
        sigma = jnp.mean(jnp.sqrt(variance), axis=2)
        e = (observed(batch)[1:] - q) / self.pose_unit[None, :, None]
        d = jnp.moveaxis(batch.V[1:], 1, 0) - jnp.mean(V, axis=2)
        d = d / self.velocity_unit[:, None, None]
        steps = np.arange(self.steps)
        weight = jnp.asarray(c.discount**steps, d.dtype)[:, None]
        nll = jnp.sum(e * e, axis=1) + jnp.sum((d / sigma) ** 2 + 2 * jnp.log(sigma), axis=0)
        square = jnp.sum(e * e, axis=1) + jnp.sum(d * d, axis=0)
        return {
            "likelihood": jnp.mean(jnp.sum(weight * nll, axis=0)),
            "error": jnp.mean(jnp.sum(weight * square, axis=0)),
        }


def _check(config: DistanceAware | Unconstrained, *counts: str) -> None:
    check_numbers(config)
    for name in counts:
        require(getattr(config, name) >= 1, config, name, "give at least 1")
    require(config.ball_radius > 0, config, "ball_radius", "give a positive number")
    for name in config.__dataclass_fields__:
        if name.endswith("_weight"):
            require(getattr(config, name) >= 0, config, name, "give zero or more")


def _diffusion(model: EuclideanSpinn, kind: str) -> Diffusion:
    if model.distance_aware is None or model.config.diffusion != kind:
        raise UserError(
            f"model: its diffusion is of kind {model.config.diffusion}; set model.diffusion to "
            f"{kind} for this objective"
        )
    return model.distance_aware


def _beginning(batch: Batch, steps: int) -> Batch:
    rise = None if batch.rise is None else batch.rise[:steps]
    X, V = batch.X[: steps + 1], batch.V[: steps + 1]
    return batch._replace(X=X, V=V, F=batch.F[:steps], rise=rise)


def _ball(key: Array, z: Float[Array, "6 *batch"], radius: float, samples: int) -> Array:
    shape = (6, samples, *z.shape[1:])
    return jnp.asarray(radius, z.dtype) * jax.random.normal(key, shape, z.dtype)


def _components(windows: Windows) -> tuple[np.ndarray, np.ndarray]:
    batch = Batch.of(windows)
    pose = jnp.moveaxis(eqx.filter_jit(observed)(batch), 1, 0)
    return np.asarray(pose, np.float64), np.moveaxis(windows.V, 1, 0).astype(np.float64)


def _units(size: Iterable[np.ndarray], windows: Windows) -> tuple[Array, Array]:
    floor = np.asarray(VelocityKernel.floors)
    pose, velocity = (jnp.asarray(np.maximum(s, floor), windows.X.dtype) for s in size)
    return pose, velocity
