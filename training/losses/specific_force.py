"""The error of the specific force along predicted motions, where velocities were not recorded.

An accelerometer shows f = v̇ + ω × v - Rᵀ g: with it drag and mass of axes whose velocity nobody has
measured are still fitted.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models import se3
from ...models.dynamics import Dynamics
from ...models.effects.extended import Extended
from ...models.effects.recorded_rollout import actuated
from ...models.integrate import over_substeps
from ...models.rigid_body import GRAVITY
from ..data.windows import Windows
from ..predict import predict_drift
from .base import Batch

_FLOOR = 0.05  # m/s²: an accelerometer's noise
_PARTS = 2
"""Parts of a step, the nearest of which give the forces at its ends."""
_WINDOWS = 128  # whose errors determine the units


class ForceError(eqx.Module):
    """Mean square of the specific force's error along one motion a window, by axis in its unit."""

    unit: Float[Array, "3"]
    dt: float = eqx.field(static=True)

    @classmethod
    def build(cls, model: Dynamics, windows: Windows, substeps: int) -> "ForceError | None":
        """Units are the model's own RMS errors. None where no force was recorded, or not at Bo."""
        hidden = windows.hidden
        if hidden is None or not np.any(hidden.felt):
            return None
        batch = Batch.of(windows.take(np.flatnonzero(hidden.felt)).thin(_WINDOWS))
        X, V = eqx.filter_jit(predict_drift)(
            model, batch.X[0], batch.V[0], batch.F, windows.dt, substeps=substeps,
            commands=batch.commands, rise=batch.rise,
        )  # fmt: skip
        e = np.asarray(_errors(model, X, V, batch, windows.dt), np.float64)
        e = e[..., np.isfinite(e).all(axis=(0, 1))]
        rms = np.sqrt(np.mean(e**2, axis=(1, 2))) if e.size else np.ones(3)
        return cls(jnp.asarray(np.maximum(rms, _FLOOR), windows.X.dtype), windows.dt)

    def __call__(
        self, model: Dynamics, X: Float[Array, "T 7 1 W"], V: Float[Array, "T 6 1 W"], batch: Batch
    ) -> Float[Array, ""]:
        """The mean over times, axes and the windows with a force."""
        assert batch.hidden is not None
        e = _errors(model, X[:, :, 0], V[:, :, 0], batch, self.dt) / self.unit[:, None, None]
        felt = jnp.asarray(batch.hidden.felt)[0, 0]
        return jnp.sum(jnp.mean(e * e, axis=(0, 1)) * felt) / jnp.maximum(jnp.sum(felt), 1)


@eqx.filter_jit
def _errors(
    model: Dynamics, X: Float[Array, "T 7 W"], V: Float[Array, "T 6 W"], batch: Batch, dt: float
) -> Float[Array, "3 S W"]:
    """Predicted less measured at t_1 … t_(T-1); the wrench there is the mean of both sides."""
    assert batch.hidden is not None
    X, V = (jnp.moveaxis(a[:-1], 1, 0) for a in (X, V))
    if isinstance(model, Extended) and batch.commands is not None:
        levels = actuated(model, batch.commands, dt, _PARTS)
        level = _at_samples(levels)
        voltage = jnp.moveaxis(jnp.asarray(batch.commands.voltage[1:]), 1, 0)
        a = model.body.acceleration(X, V, model.push(level, X, V, voltage))
    else:
        F = _at_samples(over_substeps(batch.F, batch.rise, _PARTS))
        a = model.acceleration(X, V, F)
    up = jnp.zeros_like(V[:3]).at[2].set(GRAVITY)
    f = a[:3] + se3.cross(V[3:], V[:3]) + se3.rotate_inverse(X, up)
    return f - jnp.moveaxis(batch.hidden.force[1:-1], 1, 0)


def _at_samples(levels: Float[Array, "T n W S"]) -> Float[Array, "n N W"]:
    """Commands at t_1 … t_(T-1): the mean of the parts of steps before and after."""
    return jnp.moveaxis((levels[1:, ..., 0] + levels[:-1, ..., -1]) / 2, 1, 0)
