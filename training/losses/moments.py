"""Moment matching on SE(3): means and covariances of predicted and observed groups of motions.

Palmer et al., section "Training geometric SPINNs with moment matching": at each time the mean pose
minimises the sum of squared left-invariant distances, the covariance is that of log(μ⁻¹ g), and
velocities have the moments of a vector space.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models import se3
from ...models.config.checks import check_numbers, require
from ...models.dynamics import Dynamics
from ..data.groups import group_size, whole_groups
from ..data.windows import Windows
from ..predict import predict
from .base import Batch, Objective
from .geodesic import relative_log
from .kernels import GeodesicKernel, VelocityKernel
from .matching import SquaredError

Unit = Literal["typical", "SI"]
_GROUPS = 32  # groups that determine the units


def displacements(
    mean: Float[Array, "7 *batch"], X: Float[Array, "7 *batch S"]
) -> Float[Array, "6 *batch S"]:
    """log(μ⁻¹ g_s) for every sample."""
    return jnp.stack(relative_log(mean[..., None], X))


def group_mean(X: Float[Array, "7 *batch S"], iterations: int = 8) -> Float[Array, "7 *batch"]:
    """The mean pose μ: the mean of log(μ⁻¹ g_s) over the samples is zero.

    Iterates μ ← μ exp(mean log(μ⁻¹ g_s)) from the mean of positions and quaternions (Ackerman,
    Wolfe, Chirikjian 2013, eq. 4), which reduces the error by the square of the samples' spread
    (rad) each time. These steps carry no gradient; one Newton step follows, whose derivative is
    that of the mean itself by the implicit function theorem,

        dμ = μ A⁻¹ d(mean log(μ⁻¹ g_s)),   A = mean J_l⁻¹(log(μ⁻¹ g_s)),

    as log(exp(-δ) h) = log h - J_l⁻¹(log h) δ + O(δ²).
    """
    fixed = jax.lax.stop_gradient(X)

    def improve(mean: Array, _: None) -> tuple[Array, None]:
        return se3.retract(mean, jnp.mean(displacements(mean, fixed), axis=-1)), None

    alike = jnp.sum(fixed[:4] * fixed[:4, ..., :1], axis=0) >= 0
    sign = jnp.where(alike, 1, -1).astype(X.dtype)
    start = jnp.mean(jnp.concatenate([sign[None] * fixed[:4], fixed[4:]]), axis=-1)
    mean, _ = jax.lax.scan(improve, se3.normalize(start), None, length=iterations)
    mean = jax.lax.stop_gradient(mean)
    e = displacements(mean, X)
    A = jnp.mean(_inverse_left_jacobian(jax.lax.stop_gradient(e)), axis=-1)
    step = jnp.linalg.solve(
        jnp.moveaxis(A, (0, 1), (-2, -1)), jnp.moveaxis(jnp.mean(e, axis=-1), 0, -1)[..., None]
    )
    return se3.retract(mean, jnp.moveaxis(step[..., 0], -1, 0))


def _inverse_left_jacobian(xi: Float[Array, "6 *batch"]) -> Float[Array, "6 6 *batch"]:
    """J_l⁻¹(ξ) = Σ B_n/n! ad_ξⁿ up to n = 6: within 1e-6 below one radian, 1e-2 at π."""
    ad = se3.ad(xi)
    eye = jnp.eye(6, dtype=xi.dtype).reshape(6, 6, *(1,) * (xi.ndim - 1))
    square = jnp.einsum("ij...,jk...->ik...", ad, ad)
    fourth = jnp.einsum("ij...,jk...->ik...", square, square)
    sixth = jnp.einsum("ij...,jk...->ik...", fourth, square)
    return eye - ad / 2 + square / 12 - fourth / 720 + sixth / 30240


def covariance(e: Float[Array, "C *batch S"]) -> Float[Array, "C C *batch"]:
    """The mean over the samples of e eᵀ, as in the paper (divided by their number)."""
    return jnp.einsum("i...s,j...s->ij...", e, e) / e.shape[-1]


@dataclass(frozen=True)
class Moments:
    """Moment matching: mean and covariance of poses and velocities of groups of windows."""

    runs: int = 16
    """Largest number of observed motions in a group: windows of one scenario with equal start."""
    samples: int = 4
    """Predicted motions from each of the group's starts."""
    mean_weight: float = 1.0
    covariance_weight: float = 1.0
    unit: Unit = "typical"
    """Axes in units of the data's standard deviation, or in SI units as in the paper."""
    mse_weight: float = 0.0
    mse_of: Literal["drift", "samples"] = "drift"
    mse_unit: Unit = "typical"
    """The three as in `Fdm`."""
    iterations: int = 8
    """Iterations of the group mean before the Newton step (`group_mean`)."""
    substeps: int = 2

    def __post_init__(self) -> None:
        check_numbers(self)
        require(self.runs >= 2, self, "runs", "give at least 2")
        for name in ("samples", "iterations", "substeps"):
            require(getattr(self, name) >= 1, self, name, "give at least 1")
        for name in ("mean_weight", "covariance_weight", "mse_weight"):
            require(getattr(self, name) >= 0, self, name, "give zero or more")

    def build(self, model: Dynamics, windows: Windows) -> "MomentsObjective":
        """The objective with its group size and units from the data.

        Raises:
            UserError: the windows form no groups.
        """
        size = group_size(windows, self.runs)
        pose_unit, velocity_unit = units(self.unit, windows, size, _geometric_spread)
        return MomentsObjective(
            config=self,
            size=size,
            error=SquaredError.build(
                self.mse_unit if self.mse_weight > 0 else "SI", self.substeps, model, windows
            ),
            pose_unit=pose_unit,
            velocity_unit=velocity_unit,
        )


class MomentsObjective(Objective):
    """w_m ‖difference of means‖² + w_c ‖difference of covariances‖_F², averaged over times."""

    name: ClassVar[str] = "moments"
    config: Moments = eqx.field(static=True)
    size: int = eqx.field(static=True)
    error: Any
    """Squared error with `dt`: `SquaredError`, or its equivalent for the output of `motions`."""
    pose_unit: Float[Array, "6 T"]
    velocity_unit: Float[Array, "6 T"]

    def group_size(self) -> int:
        return self.size

    def loss(
        self, model: Dynamics, batch: Batch, key: Array
    ) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        c, P = self.config, self.config.samples
        drift = c.mse_of == "drift" and c.mse_weight > 0
        X, V = self.motions(model, batch, key, drift)
        parts = self.pose_parts(X[:, :, :P], batch)
        velocity = [vector_moments(pooled(a, self.size)) for a in (V[:, :, :P], batch.V[1:])]
        (predicted, own), (observed, theirs) = velocity
        parts |= compare(observed - predicted, own, theirs, self.velocity_unit, "velocity")
        total = weighted(parts, c.mean_weight, c.covariance_weight)
        if c.mse_weight > 0:
            judged = slice(P, None) if drift else slice(None)
            parts["mse"] = self.error(X[:, :, judged], V[:, :, judged], batch)
            total = total + c.mse_weight * parts["mse"]
        return total, parts

    def motions(
        self, model: Dynamics, batch: Batch, key: Array, with_path_of_drift: bool
    ) -> tuple[Float[Array, "T C P W"], Float[Array, "T 6 P W"]]:
        """Predicted configurations and twists of each window (`predict`)."""
        X, V = predict(
            model,
            batch.X[0],
            batch.V[0],
            batch.F,
            self.error.dt,
            key,
            self.config.samples,
            substeps=self.config.substeps,
            with_path_of_drift=with_path_of_drift,
            place=batch.place,
            commands=batch.commands,
            spread=batch.spread,
            rise=batch.rise,
        )
        return batch.shown(X, V)

    def pose_parts(self, X: Float[Array, "T C P W"], batch: Batch) -> dict[str, Array]:
        """Parts of the loss from the moments of the configurations."""
        moments = [
            pose_moments(pooled(a, self.size), self.config.iterations) for a in (X, batch.X[1:])
        ]
        (predicted, own), (observed, theirs) = moments
        mean_error = jnp.stack(relative_log(predicted, observed))
        return compare(mean_error, own, theirs, self.pose_unit, "pose")


def pooled(a: Float[Array, "T C *P W"], size: int) -> Float[Array, "C T G S"]:
    """The samples of each group of `size` windows, in one last axis."""
    a = jnp.moveaxis(a, 1, 0)
    if a.ndim == 3:
        a = a[:, :, None]
    C, T, P, W = a.shape
    grouped = a.reshape(C, T, P, W // size, size)
    return jnp.swapaxes(grouped, 2, 3).reshape(C, T, W // size, P * size)


def pose_moments(
    X: Float[Array, "7 *batch S"], iterations: int = 8
) -> tuple[Float[Array, "7 *batch"], Float[Array, "6 6 *batch"]]:
    """Group mean and covariance of log(mean⁻¹ g)."""
    mean = group_mean(X, iterations)
    return mean, covariance(displacements(mean, X))


def vector_moments(
    x: Float[Array, "C *batch S"],
) -> tuple[Float[Array, "C *batch"], Float[Array, "C C *batch"]]:
    """Mean and covariance."""
    mean = jnp.mean(x, axis=-1)
    return mean, covariance(x - mean[..., None])


def compare(
    mean_error: Float[Array, "C T G"],
    own: Float[Array, "C C T G"],
    theirs: Float[Array, "C C T G"],
    unit: Float[Array, "C T"],
    name: str,
) -> dict[str, Array]:
    """Squared norms of the differences of means and covariances, averaged over times and groups."""
    u = unit[:, :, None]
    difference = (own - theirs) / (u[:, None] * u[None])
    return {
        f"{name}_mean": jnp.mean(jnp.sum((mean_error / u) ** 2, axis=0)),
        f"{name}_covariance": jnp.mean(jnp.sum(difference**2, axis=(0, 1))),
    }


def weighted(parts: dict[str, Array], mean: float, covariance: float) -> Array:
    """The weighted sum of the parts of means and of covariances."""
    means = parts["pose_mean"] + parts["velocity_mean"]
    return mean * means + covariance * (parts["pose_covariance"] + parts["velocity_covariance"])


def _geometric_spread(X: Array, V: Array) -> tuple[Array, Array]:
    return pose_moments(X)[1], vector_moments(V)[1]


def units(
    unit: Unit, windows: Windows, size: int, spread: Callable[[Array, Array], tuple[Array, Array]]
) -> tuple[Float[Array, "6 T"], Float[Array, "6 T"]]:
    """Units of pose and velocity by axis and time: 1 (SI), or the groups' typical deviation."""
    ones = np.ones((6, windows.steps))
    found = [ones, ones]
    if unit == "typical":
        kept = whole_groups(windows, size, _GROUPS * size)
        good = np.isfinite(kept.X).all((0, 1)) & np.isfinite(kept.V).all((0, 1))
        good = np.repeat(good.reshape(-1, size).all(1), size)
        X, V = (pooled(jnp.asarray(a[1:][..., good]), size) for a in (kept.X, kept.V))
        covariances = eqx.filter_jit(spread)(X, V)
        for i, (kernel, S) in enumerate(
            zip((GeodesicKernel, VelocityKernel), covariances, strict=True)
        ):
            variance = np.mean(np.diagonal(np.asarray(S, np.float64)), axis=1)  # (T, C)
            found[i] = np.maximum(np.sqrt(variance.T), np.asarray(kernel.floors)[:, None])
    pose, velocity = (jnp.asarray(u, windows.X.dtype) for u in found)
    return pose, velocity
