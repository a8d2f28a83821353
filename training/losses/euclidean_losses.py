"""Objectives in R¹² for the Euclidean SPINN, as in published methods.

Predictions keep position, Euler angles and twist as vectors (`EuclideanSpinn.rollout`); the
observed angles are those of atan2 and asin. Differences are subtractions: errors and kernels
include the data's angle jumps by a full turn and the singularity near the vertical (Palmer et al.,
Euclidean baselines).
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models.config.checks import check_numbers, require
from ...models.config.errors import UserError
from ...models.dynamics import Dynamics
from ...models.euclidean import EuclideanSpinn, coordinates
from ..data.groups import group_size
from ..data.windows import Windows
from ..predict import in_substeps, normal_by_window
from .base import Batch, Objective
from .kernels import VelocityKernel, bandwidths_from_differences
from .moments import Moments, MomentsObjective, Unit, compare, pooled, units, vector_moments
from .scores import kernel_score, time_pairs

_CHUNK = 128  # windows whose errors determine the scales


def euclidean(model: Dynamics) -> EuclideanSpinn:
    """The model, checked to be a Euclidean one.

    Raises:
        UserError: the model is on the group.
    """
    if not isinstance(model, EuclideanSpinn):
        raise UserError(
            f"model: a {type(model).__name__} has no coordinates in R¹²; set model.coordinates to "
            "euler, or train it with an objective on the group"
        )
    return model


def observed(batch: Batch) -> Float[Array, "N 6 W"]:
    """Positions and Euler angles of the windows."""
    return jnp.moveaxis(coordinates(jnp.moveaxis(batch.X, 1, 0)), 0, 1)


def predict_coordinates(
    model: Dynamics,
    batch: Batch,
    dt: float,
    key: Array | None,
    samples: int,
    *,
    substeps: int = 1,
    with_path_of_drift: bool = False,
) -> tuple[Float[Array, "T 6 P W"], Float[Array, "T 6 P W"]]:
    """Coordinates and twists of `samples` motions of each window; without `key` noise-free ones."""
    T, _, W = batch.F.shape
    count, dt = samples + with_path_of_drift, dt / substeps
    dW = None
    if key is not None:
        scale = jnp.asarray(dt**0.5, batch.F.dtype)
        shape = (T * substeps, 6)
        drawn = normal_by_window(key, batch.place, shape, samples, batch.F.dtype)
        dW = scale * jnp.swapaxes(drawn, 2, 3)
        quiet = jnp.zeros((T * substeps, 6, count - samples, W), batch.F.dtype)
        dW = jnp.concatenate([dW, quiet], axis=2)
    F = in_substeps(batch.F, batch.rise, substeps)[:, :, None]
    q, V = (
        jnp.broadcast_to(a[:, None], (6, count, W)) for a in (coordinates(batch.X[0]), batch.V[0])
    )
    qs, Vs = euclidean(model).rollout(q, V, F, dt, dW)
    return qs[substeps - 1 :: substeps], Vs[substeps - 1 :: substeps]


def typical_coordinates(
    model: Dynamics, windows: Windows, substeps: int
) -> tuple[Float[np.ndarray, "6 T W"], Float[np.ndarray, "6 T W"]]:
    """Errors of coordinates and twists of the noise-free motion in up to 128 windows.

    Raises:
        UserError: the motion diverges in half of the windows or more.
    """
    finite = np.isfinite(windows.X).all((0, 1)) & np.isfinite(windows.V).all((0, 1))
    finite &= np.isfinite(windows.F).all((0, 1))
    batch = Batch.of(windows.take(np.flatnonzero(finite)).thin(_CHUNK))

    @eqx.filter_jit
    def errors(model: Dynamics, batch: Batch) -> tuple[Array, Array]:
        q, V = predict_coordinates(model, batch, windows.dt, None, 1, substeps=substeps)
        return observed(batch)[1:] - q[:, :, 0], batch.V[1:] - V[:, :, 0]

    found = [np.moveaxis(np.asarray(e, np.float64), 1, 0) for e in errors(model, batch)]
    kept = np.logical_and.reduce([np.isfinite(e).all((0, 1)) for e in found])
    if 2 * kept.sum() <= kept.size:
        raise UserError(
            f"model: its motion in coordinates runs away in {kept.size - kept.sum()} of "
            f"{kept.size} windows at {windows.dt / substeps:g} s a step; give more substeps than "
            f"{substeps}"
        )
    pose, velocity = (e[..., kept] for e in found)
    return pose, velocity


class CoordinateError(eqx.Module):
    """Mean of the squared differences of coordinates and twists, each axis in its unit."""

    pose_unit: Float[Array, "6 T"]
    velocity_unit: Float[Array, "6 T"]
    dt: float = eqx.field(static=True)

    @classmethod
    def build(
        cls, unit: Unit, substeps: int, model: Dynamics, windows: Windows
    ) -> "CoordinateError":
        """Units are 1 (SI), or RMS errors of `model` by axis and time (typical)."""
        found = [np.ones((6, windows.steps))] * 2
        if unit == "typical":
            errors = typical_coordinates(model, windows, substeps)
            floor = np.asarray(VelocityKernel.floors)[:, None]
            found = [np.maximum(np.sqrt(np.mean(e**2, axis=2)), floor) for e in errors]
        pose, velocity = (jnp.asarray(u, windows.X.dtype) for u in found)
        return cls(pose, velocity, windows.dt)

    def __call__(
        self, q: Float[Array, "T 6 P W"], V: Float[Array, "T 6 P W"], batch: Batch
    ) -> Float[Array, ""]:
        """The mean for P predicted motions of each window."""
        e = (observed(batch)[1:, :, None] - q) / self.pose_unit.T[:, :, None, None]
        d = (batch.V[1:, :, None] - V) / self.velocity_unit.T[:, :, None, None]
        return (jnp.mean(e * e) + jnp.mean(d * d)) / 2


@dataclass(frozen=True)
class EuclideanFdm:
    """Finite dimensional matching in R¹²: ARD kernels on coordinates and on twists."""

    samples: int = 16
    lags_s: tuple[float, ...] = (0.25, 1.0)
    time_pairs: int = 16
    scales: tuple[float, ...] = (1.0, 0.35)
    bandwidth_quantile: float = 0.5
    pose_weight: float = 1.0
    velocity_weight: float = 1.0
    mse_weight: float = 0.0
    mse_of: Literal["drift", "samples"] = "drift"
    mse_unit: Unit = "typical"
    substeps: int = 2
    """All as in `Fdm`."""

    def __post_init__(self) -> None:
        check_numbers(self)
        require(self.samples >= 2, self, "samples", "give at least 2")
        require(self.time_pairs >= 1, self, "time_pairs", "give at least 1")
        require(len(self.lags_s) > 0 and min(self.lags_s) > 0, self, "lags_s", "give times above 0")
        require(len(self.scales) > 0 and min(self.scales) > 0, self, "scales", "give positive ones")
        require(0 < self.bandwidth_quantile < 1, self, "bandwidth_quantile", "give 0 < q < 1")
        require(self.substeps >= 1, self, "substeps", "give at least 1")
        for name in ("pose_weight", "velocity_weight", "mse_weight"):
            require(getattr(self, name) >= 0, self, name, "give zero or more")

    def build(self, model: Dynamics, windows: Windows) -> "EuclideanFdmObjective":
        """The objective with units and bandwidths from the errors of `model` on the windows."""
        steps, dtype = windows.steps, windows.X.dtype
        lags = (int(np.clip(round(lag / windows.dt), 1, steps - 1)) for lag in self.lags_s)
        unit = self.mse_unit if self.mse_weight > 0 else "SI"
        kernels = (VelocityKernel(jnp.ones((6, steps), dtype), self.scales) for _ in range(2))
        return EuclideanFdmObjective(
            self,
            tuple(dict.fromkeys(lags)),
            CoordinateError.build(unit, self.substeps, model, windows),
            *kernels,
        ).refit(model, windows)


class EuclideanFdmObjective(Objective):
    """w_q S(coordinates) + w_ξ S(velocities) + w_e squared error."""

    name: ClassVar[str] = "euclidean fdm"
    config: EuclideanFdm = eqx.field(static=True)
    lags: tuple[int, ...] = eqx.field(static=True)
    error: CoordinateError
    pose_kernel: VelocityKernel
    velocity_kernel: VelocityKernel

    def loss(
        self, model: Dynamics, batch: Batch, key: Array
    ) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        c, P = self.config, self.config.samples
        noise_key, time_key = jax.random.split(key)
        drift = c.mse_of == "drift" and c.mse_weight > 0
        q, V = predict_coordinates(
            model,
            batch,
            self.error.dt,
            noise_key,
            P,
            substeps=c.substeps,
            with_path_of_drift=drift,
        )
        first, second = time_pairs(time_key, batch.F.shape[0], self.lags, c.time_pairs)
        parts = {}
        for name, kernel, own, data in (
            ("pose", self.pose_kernel, q, observed(batch)),
            ("velocity", self.velocity_kernel, V, batch.V),
        ):
            score = kernel_score(kernel, own[:, :, :P], data[1:], first, second)
            parts[f"{name}_score"] = jnp.mean(score)
        total = c.pose_weight * parts["pose_score"] + c.velocity_weight * parts["velocity_score"]
        if c.mse_weight > 0:
            judged = slice(P, None) if drift else slice(None)
            parts["mse"] = self.error(q[:, :, judged], V[:, :, judged], batch)
            total = total + c.mse_weight * parts["mse"]
        return total, parts

    def refit(self, model: Dynamics, windows: Windows) -> "EuclideanFdmObjective":
        """Bandwidths from the errors of `model`'s noise-free motion."""
        kernels = []
        for errors in typical_coordinates(model, windows, self.config.substeps):
            gamma = bandwidths_from_differences(
                VelocityKernel,
                np.moveaxis(errors, 1, 0),
                min(self.lags),
                quantile=self.config.bandwidth_quantile,
            )
            dtype = self.pose_kernel.bandwidths.dtype
            kernels.append(VelocityKernel(jnp.asarray(gamma, dtype), self.config.scales))
        return eqx.tree_at(lambda o: (o.pose_kernel, o.velocity_kernel), self, tuple(kernels))


@dataclass(frozen=True)
class EuclideanMoments(Moments):
    """Moment matching in R¹²: means and covariances of coordinates and twists."""

    def build(self, model: Dynamics, windows: Windows) -> "EuclideanMomentsObjective":
        """The objective with its group size and units from the data.

        Raises:
            UserError: the windows form no groups.
        """
        size = group_size(windows, self.runs)
        pose_unit, velocity_unit = units(self.unit, windows, size, _spread)
        unit = self.mse_unit if self.mse_weight > 0 else "SI"
        error = CoordinateError.build(unit, self.substeps, model, windows)
        return EuclideanMomentsObjective(self, size, error, pose_unit, velocity_unit)


class EuclideanMomentsObjective(MomentsObjective):
    """As `MomentsObjective`, with the moments of vectors throughout."""

    name: ClassVar[str] = "euclidean moments"

    def motions(
        self, model: Dynamics, batch: Batch, key: Array, with_path_of_drift: bool
    ) -> tuple[Float[Array, "T C P W"], Float[Array, "T 6 P W"]]:
        return predict_coordinates(
            model,
            batch,
            self.error.dt,
            key,
            self.config.samples,
            substeps=self.config.substeps,
            with_path_of_drift=with_path_of_drift,
        )

    def pose_parts(self, X: Float[Array, "T C P W"], batch: Batch) -> dict[str, Array]:
        mean, own = vector_moments(pooled(X, self.size))
        their_mean, theirs = vector_moments(pooled(observed(batch)[1:], self.size))
        return compare(their_mean - mean, own, theirs, self.pose_unit, "pose")


def _spread(X: Array, V: Array) -> tuple[Array, Array]:
    return vector_moments(coordinates(X))[1], vector_moments(V)[1]
