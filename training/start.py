"""The model that training starts from: a preset, drift and diffusion brought near the data."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..models.euclidean import create_spinn
from ..models.rigid_body import FossenDynamics
from ..models.spinn import Spinn
from ..models.vehicle import Vehicle
from .config import TrainingConfig
from .drift import fit_drift
from .fit import Progress
from .innovations import mass_at_rest
from .likelihood import fit_innovations
from .objective import Batch
from .predict import predict, predict_drift
from .pretrain import pretrain
from .windows import Windows

Model = TypeVar("Model", bound=FossenDynamics | Spinn)

_NORMAL_QUARTILE = 0.6744897501960817


def estimate_diffusion(
    dynamics: FossenDynamics | Spinn, windows: Windows, horizon_s: float = 0.5, substeps: int = 1
) -> Float[np.ndarray, "6"]:
    """A first guess of b (N√s, N·m√s): how far M ξ misses its prediction after `horizon_s`.

    b is such that motions drawn from `dynamics` with it miss the noise-free motion as far as the
    data do, by the median of absolute values on each axis; drag, which pulls back what noise has
    moved, is thereby accounted for. b contains what the model misses by bias and the sensors'
    noise, so it is rather too large. At least 1e-3 of what accelerates by 1 in a second. A
    distance-aware diffusion isn't drawn from: there b_i² h = Var[(M (ξ̂ - ξ))_i], too small by
    what drag pulls back.
    """
    steps = int(np.clip(round(horizon_s / windows.dt), 1, windows.steps))
    pieces = windows.thin(256).subdivide(steps).thin(1024)
    batch = Batch.of(pieces)
    start = batch.X[0], batch.V[0], batch.F, windows.dt
    M = mass_at_rest(dynamics, batch.V.dtype)
    floor = 1e-3 * np.diag(M)

    def spread(difference: Float[Array, "6 W"]) -> Float[np.ndarray, "6"]:
        miss = np.abs(M @ np.asarray(difference, np.float64))
        miss = miss[:, np.isfinite(miss).all(axis=0)]
        return np.median(miss, axis=1) / _NORMAL_QUARTILE if miss.size else np.zeros(6)

    _, V = eqx.filter_jit(predict_drift)(dynamics, *start, substeps=substeps)
    missed = spread(batch.V[-1] - V[-1])
    b = np.maximum(missed / (steps * windows.dt) ** 0.5, floor)
    if isinstance(dynamics, Spinn) and dynamics.config.diffusion != "network":
        return b
    for _ in range(2):
        model = with_diffusion(dynamics, b)
        _, Vs = eqx.filter_jit(predict)(model, *start, jax.random.key(0), 1, substeps=substeps)
        drawn = spread(Vs[-1, :, 0] - V[-1])
        b = np.maximum(b * np.clip(missed / np.maximum(drawn, 1e-12), 0.25, 4.0), floor)
    return b


def with_diffusion(model: Model, b: Float[np.ndarray, "6"]) -> Model:
    """The model with another b (a SPINN: as the scale of its diffusion network)."""
    if isinstance(model, Spinn):
        like = model.scales.diffusion
        return eqx.tree_at(lambda m: m.scales.diffusion, model, jnp.asarray(b, like.dtype))
    like = model.diffusion
    return eqx.tree_at(lambda m: m.diffusion, model, jnp.asarray(b, like.dtype))


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
    substeps = config.objective.substeps
    fitted = fit_innovations(config.drift, model, windows, substeps)
    if fitted is None:
        model = fit_drift(config.drift, model, windows, substeps, progress)
    else:
        model = fitted.apply(model)
    if not config.model.stochastic:
        return model
    if fitted is not None and config.model.diffusion == "network":
        return with_diffusion(model, fitted.diffusion)
    return with_diffusion(model, estimate_diffusion(model, windows, substeps=substeps))
