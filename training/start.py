"""The model that training starts from: a preset, drift and diffusion brought near the data."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..models.dynamics import Dynamics
from ..models.euclidean import create_spinn
from ..models.spinn import Spinn
from ..models.vehicle import Vehicle
from .config import TrainingConfig
from .drift import fit_drift
from .fit import Progress
from .objective import Batch
from .predict import predict_drift
from .pretrain import pretrain
from .windows import Windows

_NORMAL_QUARTILE = 0.6744897501960817


def estimate_diffusion(
    dynamics: Dynamics, windows: Windows, horizon_s: float = 0.5, substeps: int = 1
) -> Float[np.ndarray, "6"]:
    """A first guess of b (N√s, N·m√s): how far M ξ misses its prediction after `horizon_s`.

    b_i² h = Var[(M (ξ̂ - ξ))_i] for a horizon h short against the drag's time constant; the variance
    is taken from the median of absolute values. It contains what the model misses by bias and the
    sensors' noise, so it is rather too large. At least 1e-3 of what accelerates by 1 in a second.
    """
    steps = int(np.clip(round(horizon_s / windows.dt), 1, windows.steps))
    pieces = windows.thin(256).subdivide(steps).thin(1024)
    batch = Batch.of(pieces)
    _, V = eqx.filter_jit(predict_drift)(
        dynamics, batch.X[0], batch.V[0], batch.F, windows.dt, substeps=substeps
    )
    mass = dynamics.coefficients(jnp.zeros(6, V.dtype)).mass.matrix()
    M = np.asarray(mass, np.float64)
    miss = np.abs(M @ np.asarray(batch.V[-1] - V[-1], np.float64))
    miss = miss[:, np.isfinite(miss).all(axis=0)]
    floor = 1e-3 * np.diag(M)
    if not miss.size:
        return floor
    return np.maximum(
        np.median(miss, axis=1) / _NORMAL_QUARTILE / (steps * windows.dt) ** 0.5, floor
    )


def starting_model(
    config: TrainingConfig, vehicle: Vehicle, windows: Windows, progress: Progress | None = None
) -> Spinn:
    """A SPINN at the vehicle's preset, its drift fitted to short pieces, b from what is then left.

    A function of its arguments alone, so that a resumed run starts from the same bits.
    """
    dtype = jnp.dtype(windows.X.dtype)
    reference = vehicle.dynamics(dtype=dtype)
    model_key, pretrain_key = jax.random.split(jax.random.key(config.seed))
    model = create_spinn(config.model, reference, model_key, dtype)
    model = pretrain(model, reference, config.pretrain, pretrain_key)[0]
    model = fit_drift(config.drift, model, windows, config.objective.substeps, progress)
    if not config.model.stochastic:
        return model
    b = estimate_diffusion(model, windows, substeps=config.objective.substeps)
    return eqx.tree_at(lambda m: m.scales.diffusion, model, jnp.asarray(b, dtype))
