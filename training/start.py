"""The model that training starts from: a preset, with its diffusion estimated from the data."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..models.rigid_body import FossenDynamics
from ..models.spinn import Spinn
from ..models.vehicle import Vehicle
from .config import TrainingConfig
from .objective import Batch
from .predict import predict_drift
from .pretrain import pretrain
from .windows import Windows

_NORMAL_QUARTILE = 0.6744897501960817


def estimate_diffusion(
    dynamics: FossenDynamics, windows: Windows, horizon_s: float = 0.5
) -> Float[np.ndarray, "6"]:
    """A first guess of b (N√s, N·m√s): how far M ξ misses its prediction after `horizon_s`.

    b_i² h = Var[(M (ξ̂ - ξ))_i] for a horizon h short against the drag's time constant; the variance
    is taken from the median of absolute values. It contains what the preset misses by bias and the
    sensors' noise, so it is rather too large. At least 1e-3 of what accelerates by 1 in a second.
    """
    steps = int(np.clip(round(horizon_s / windows.dt), 1, windows.steps))
    pieces = windows.thin(256).subdivide(steps).thin(1024)
    batch = Batch.of(pieces)
    _, V = eqx.filter_jit(predict_drift)(dynamics, batch.X[0], batch.V[0], batch.F, windows.dt)
    momentum = dynamics.mass.matvec(batch.V[-1] - V[-1])
    miss = np.abs(np.asarray(momentum, np.float64))
    miss = miss[:, np.isfinite(miss).all(axis=0)]
    floor = 1e-3 * np.diag(np.asarray(dynamics.mass.matrix(), np.float64))
    if not miss.size:
        return floor
    return np.maximum(
        np.median(miss, axis=1) / _NORMAL_QUARTILE / (steps * windows.dt) ** 0.5, floor
    )


def starting_model(config: TrainingConfig, vehicle: Vehicle, windows: Windows) -> Spinn:
    """A SPINN at the vehicle's preset, its diffusion as the windows suggest."""
    dtype = jnp.dtype(windows.X.dtype)
    preset = vehicle.dynamics(dtype=dtype)
    reference = vehicle.dynamics(estimate_diffusion(preset, windows), dtype)
    model_key, pretrain_key = jax.random.split(jax.random.key(config.seed))
    model = Spinn.create(config.model, reference, model_key, dtype)
    return pretrain(model, reference, config.pretrain, pretrain_key)[0]
