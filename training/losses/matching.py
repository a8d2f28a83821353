"""The objectives: finite dimensional matching (with a squared error), and a squared error alone."""

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models import se3
from ...models.config.checks import check_numbers, require
from ...models.config.errors import UserError
from ...models.dynamics import Dynamics
from ...models.effects.extended import core
from ...models.spinn import Spinn
from ..data.windows import Windows
from ..predict import normal_by_window, predict, predict_drift
from .base import Batch, Objective
from .kernels import (
    KERNELS,
    GeodesicKernel,
    Kernel,
    Profile,
    VelocityKernel,
    bandwidths_from_differences,
)
from .scores import kernel_score, time_pairs
from .specific_force import ForceError

_CHUNK = 128  # windows whose errors determine the scales


@dataclass(frozen=True)
class Fdm:
    """Finite dimensional matching: kernel scores of two-time laws plus a squared error."""

    pose_kernel: Literal["geodesic", "chordal"] = "geodesic"
    samples: int = 16
    """P, number of predicted motions of each window."""
    lags_s: tuple[float, ...] = (0.25, 1.0)
    """Lags between the two times (s), used in turn."""
    time_pairs: int = 16
    """Pairs of times per step, redrawn in each step."""
    pair_shifts: int | None = None
    """Number of cyclic shifts that pair predicted samples; null uses all pairs."""
    scales: tuple[float, ...] = (1.0, 0.35)
    """Multiples of the bandwidths whose kernels are averaged."""
    profile: Profile = "gaussian"
    """`energy` replaces the Gaussian kernels' score by the energy score
    (`training.losses.kernels`)."""
    bandwidth_quantile: float = 0.5
    bandwidth_factor: float = 1.0
    pose_weight: float = 1.0
    velocity_weight: float = 1.0
    mse_weight: float = 0.1
    mse_of: Literal["drift", "samples"] = "drift"
    """Squared error of the noise-free motion, or of every sample as in the paper (which also
    drives the diffusion towards zero)."""
    mse_unit: Literal["typical", "SI"] = "typical"
    """Errors in units of the starting model's errors, or in metres and radians as in the paper."""
    mass_weight: float = 0.0
    """Weight of the regulariser that keeps M constant in velocity."""
    substeps: int = 2
    """Integration steps per sample: a small vehicle's rates settle within 0.1 s."""

    def __post_init__(self) -> None:
        check_numbers(self)
        require(self.pose_kernel in ("geodesic", "chordal"), self, "pose_kernel", "use a known one")
        require(self.profile in get_args(Profile), self, "profile", "use gaussian or energy")
        require(self.samples >= 2, self, "samples", "give at least 2")
        require(self.time_pairs >= 1, self, "time_pairs", "give at least 1")
        require(len(self.lags_s) > 0 and min(self.lags_s) > 0, self, "lags_s", "give times above 0")
        require(len(self.scales) > 0 and min(self.scales) > 0, self, "scales", "give positive ones")
        require(0 < self.bandwidth_quantile < 1, self, "bandwidth_quantile", "give 0 < q < 1")
        require(self.bandwidth_factor > 0, self, "bandwidth_factor", "give a positive number")
        require(self.substeps >= 1, self, "substeps", "give at least 1")
        for name in ("pose_weight", "velocity_weight", "mse_weight", "mass_weight"):
            require(getattr(self, name) >= 0, self, name, "give zero or more")

    def build(self, model: Dynamics, windows: Windows) -> "FdmObjective":
        """The objective with units and bandwidths from the errors of `model` on the windows."""
        steps, dtype = windows.steps, windows.X.dtype
        lags = (int(np.clip(round(lag / windows.dt), 1, steps - 1)) for lag in self.lags_s)
        kernel = KERNELS[self.pose_kernel]
        unfitted = FdmObjective(
            config=self,
            lags=tuple(dict.fromkeys(lags)),
            error=SquaredError.build(self.mse_unit, self.substeps, model, windows),
            pose_kernel=kernel(
                jnp.ones((len(kernel.floors), steps), dtype), self.scales, self.profile
            ),
            velocity_kernel=VelocityKernel(jnp.ones((6, steps), dtype), self.scales, self.profile),
            force=ForceError.build(model, windows, self.substeps) if self.mse_weight > 0 else None,
        )
        return unfitted.refit(model, windows)


@dataclass(frozen=True)
class Mse:
    """Squared error of the noise-free motion alone: a deterministic fit (b is not trained)."""

    unit: Literal["typical", "SI"] = "typical"
    mass_weight: float = 0.0
    substeps: int = 2

    def __post_init__(self) -> None:
        check_numbers(self)
        require(self.substeps >= 1, self, "substeps", "give at least 1")
        require(self.mass_weight >= 0, self, "mass_weight", "give zero or more")

    def build(self, model: Dynamics, windows: Windows) -> "MseObjective":
        """The objective with units from the errors of `model` on the windows."""
        return MseObjective(
            self,
            SquaredError.build(self.unit, self.substeps, model, windows),
            ForceError.build(model, windows, self.substeps),
        )


class SquaredError(eqx.Module):
    """Mean of ‖log(g⁻¹ ĝ)‖² and ‖ξ̂ - ξ‖² over samples and times, each axis in its unit."""

    pose_unit: Float[Array, "6 T"]
    velocity_unit: Float[Array, "6 T"]
    dt: float = eqx.field(static=True)
    substeps: int = eqx.field(static=True)

    @classmethod
    def build(
        cls, unit: Literal["typical", "SI"], substeps: int, model: Dynamics, windows: Windows
    ) -> "SquaredError":
        """Units are 1 (SI), or RMS errors of `model` by axis and time (typical)."""
        ones = np.ones((6, windows.steps))
        units = [ones, ones]
        if unit == "typical":
            X, V = typical_motion(model, windows, substeps)
            for i, (kernel, motion) in enumerate(((GeodesicKernel, X), (VelocityKernel, V))):
                e = np.stack(kernel.difference(*motion))
                rms = np.sqrt(np.mean(e.astype(np.float64) ** 2, axis=2))
                units[i] = np.maximum(rms, np.asarray(kernel.floors)[:, None])
        dtype = windows.X.dtype
        pose_unit, velocity_unit = (jnp.asarray(u, dtype) for u in units)
        return cls(pose_unit, velocity_unit, windows.dt, substeps)

    def __call__(
        self, X: Float[Array, "T 7 P W"], V: Float[Array, "T 6 P W"], batch: Batch
    ) -> Float[Array, ""]:
        """The mean for P predicted motions of each window."""
        e, d = self.by_axis(X, V, batch)
        return (jnp.mean(e * e) + jnp.mean(d * d)) / 2

    def by_axis(
        self, X: Float[Array, "T 7 P W"], V: Float[Array, "T 6 P W"], batch: Batch
    ) -> tuple[Float[Array, "6 T P W"], Float[Array, "6 T P W"]]:
        """The errors of pose and twist, in their units."""
        X, V, X_hat, V_hat = (
            jnp.moveaxis(a, 1, 0) for a in (X, V, batch.X[1:, :, None], batch.V[1:, :, None])
        )
        e = se3.local(X, X_hat) / self.pose_unit[:, :, None, None]
        return e, (V_hat - V) / self.velocity_unit[:, :, None, None]


class FdmObjective(Objective):
    """w_g S(poses) + w_ξ S(velocities) + w_e squared error (Palmer et al., ocean objective)."""

    name: ClassVar[str] = "fdm"
    config: Fdm = eqx.field(static=True)
    lags: tuple[int, ...] = eqx.field(static=True)
    error: SquaredError
    pose_kernel: Kernel
    velocity_kernel: Kernel
    force: ForceError | None = None

    def loss(
        self, model: Dynamics, batch: Batch, key: Array
    ) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        c, P = self.config, self.config.samples
        noise_key, time_key, mass_key = jax.random.split(key, 3)
        drift = (c.mse_of == "drift" and c.mse_weight > 0) or self.force is not None
        X, V = predict(
            model,
            batch.X[0],
            batch.V[0],
            batch.F,
            self.error.dt,
            noise_key,
            P,
            substeps=c.substeps,
            with_path_of_drift=drift,
            place=batch.place,
            commands=batch.commands,
            spread=batch.spread,
            rise=batch.rise,
        )
        path = X[:, :, P:], V[:, :, P:]
        X, V = batch.shown(X, V)
        first, second = time_pairs(time_key, batch.F.shape[0], self.lags, c.time_pairs)
        pose = kernel_score(
            self.pose_kernel, X[:, :, :P], batch.X[1:], first, second, c.pair_shifts
        )
        velocity = kernel_score(
            self.velocity_kernel, V[:, :, :P], batch.V[1:], first, second, c.pair_shifts
        )
        parts = {"pose_score": jnp.mean(pose), "velocity_score": jnp.mean(velocity)}
        total = c.pose_weight * parts["pose_score"] + c.velocity_weight * parts["velocity_score"]
        if c.mse_weight > 0:
            judged = slice(P, None) if c.mse_of == "drift" else slice(0, P)
            parts["mse"] = self.error(X[:, :, judged], V[:, :, judged], batch)
            total = total + c.mse_weight * parts["mse"]
        if self.force is not None:
            parts["force"] = self.force(model, *path, batch)
            total = total + c.mse_weight * parts["force"]
        if c.mass_weight > 0:
            parts["mass_variation"] = _mass_variation(model, batch, mass_key)
            total = total + c.mass_weight * parts["mass_variation"]
        return total, parts

    def refit(self, model: Dynamics, windows: Windows) -> "FdmObjective":
        """Bandwidths from the errors of `model`'s noise-free motion."""
        X, V = typical_motion(model, windows, self.config.substeps)
        kernels = []
        for kernel, motion in ((self.pose_kernel, X), (self.velocity_kernel, V)):
            gamma = bandwidths_from_differences(
                type(kernel),
                np.stack(kernel.difference(*motion), axis=1),
                min(self.lags),
                quantile=self.config.bandwidth_quantile,
                factor=self.config.bandwidth_factor,
            )
            dtype = kernel.bandwidths.dtype
            kernels.append(eqx.tree_at(lambda k: k.bandwidths, kernel, jnp.asarray(gamma, dtype)))
        return eqx.tree_at(lambda o: (o.pose_kernel, o.velocity_kernel), self, tuple(kernels))


class MseObjective(Objective):
    """The squared error of the noise-free motion (a geometric PINN's objective)."""

    name: ClassVar[str] = "mse"
    config: Mse = eqx.field(static=True)
    error: SquaredError
    force: ForceError | None = None

    def loss(
        self, model: Dynamics, batch: Batch, key: Array
    ) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        path = predict_drift(
            model, batch.X[0], batch.V[0], batch.F, self.error.dt, substeps=self.error.substeps,
            commands=batch.commands, rise=batch.rise,
        )  # fmt: skip
        X, V = (a[:, :, None] for a in path)
        total = self.error(*batch.shown(X, V), batch)
        parts = {"mse": total}
        if self.force is not None:
            parts["force"] = self.force(model, X, V, batch)
            total = total + parts["force"]
        if self.config.mass_weight > 0:
            parts["mass_variation"] = _mass_variation(model, batch, key)
            total = total + self.config.mass_weight * parts["mass_variation"]
        return total, parts


def _mass_variation(model: Dynamics, batch: Batch, key: Array) -> Array:
    """The dependence of M on velocity (`Spinn.mass_variation`), at velocities of the batch."""
    own = core(model)
    if not isinstance(own, Spinn):
        return jnp.zeros((), batch.V.dtype)
    time_key, direction_key = jax.random.split(key)
    V = batch.V[jax.random.randint(time_key, (), 0, batch.V.shape[0])]
    direction = normal_by_window(direction_key, batch.place, (6,), 1, V.dtype)[..., 0]
    return own.mass_variation(V, direction)


def typical_motion(
    model: Dynamics, windows: Windows, substeps: int = 1
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Noise-free and observed motion of up to 128 windows: poses (7, T, W), then twists (6, T, W).

    Raises:
        UserError: the noise-free motion of the model diverges in half of the windows or more.
    """
    finite = np.isfinite(windows.X).all((0, 1)) & np.isfinite(windows.V).all((0, 1))
    finite &= np.isfinite(windows.F).all((0, 1))
    batch = Batch.of(windows.take(np.flatnonzero(finite)).thin(_CHUNK))
    predict_all = eqx.filter_jit(predict_drift)
    X, V = predict_all(
        model, batch.X[0], batch.V[0], batch.F, windows.dt, substeps=substeps,
        commands=batch.commands, rise=batch.rise,
    )  # fmt: skip
    kept = np.flatnonzero(np.isfinite(X).all((0, 1)) & np.isfinite(V).all((0, 1)))
    if 2 * kept.size <= batch.X.shape[2]:
        raise UserError(
            f"model: its motion runs away in {batch.X.shape[2] - kept.size} of {batch.X.shape[2]} "
            f"windows at {windows.dt / substeps:g} s a step; give the objective more substeps "
            f"than {substeps} or start from another preset"
        )

    X, V = (a[:, :, 0] for a in batch.shown(X[:, :, None], V[:, :, None]))

    def arranged(a: Array) -> Array:
        return jnp.moveaxis(a[..., kept], 1, 0)

    return (arranged(X), arranged(batch.X[1:])), (arranged(V), arranged(batch.V[1:]))
