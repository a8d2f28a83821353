"""Bands that hold what they say: b scaled to the errors on windows that nothing was fitted to.

On the windows that the drift was fitted to errors are smaller than on others, and a median of them
does not know their tails, so that bands of a b from there are too narrow elsewhere. Here each axis'
b is scaled until the central bands of 50 and 90 % of predicted pose and velocity on that axis hold
their shares of other windows, on average over both bands and all horizons.
"""

from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
import scipy.optimize
from jaxtyping import Array, Float

from ...models.dynamics import Dynamics
from ...models.effects.extended import core
from ...models.rigid_body import FossenDynamics
from ...models.spinn import Spinn
from ..data.windows import Windows
from ..evaluation.metrics import BANDS, displacement, order_statistics
from ..losses.base import Batch
from ..predict import predict
from .start import diffusion_scale, with_diffusion

Model = TypeVar("Model", bound=Dynamics)

_SAMPLES, _CHUNK, _WINDOWS = 39, 16, 96
_ROUNDS = 2
"""Spreads are nearly proportional to b, so that a second round is a small correction."""
_MOST = 4.0
"""Largest factor of a round."""


def calibrated(model: Model, windows: Windows, substeps: int, seed: int = 0) -> Model:
    """The model with b scaled, axis by axis, so that its bands hold their shares of the windows.

    A model without diffusion is returned as it is, and so is the b of an axis whose pose and
    velocity nobody has measured or whose motion diverges.
    """
    own = core(model)
    if not isinstance(own, FossenDynamics | Spinn) or not own.stochastic:
        return model
    if not np.all(diffusion_scale(model) > 0):
        return model
    windows = windows.thin(_WINDOWS)
    for _ in range(_ROUNDS):
        factors = _factors(*_spreads(model, windows, substeps, seed))
        model = with_diffusion(model, diffusion_scale(model) * factors)
    return model


def _spreads(
    model: Dynamics, windows: Windows, substeps: int, seed: int
) -> tuple[Float[np.ndarray, "12 T P W"], Float[np.ndarray, "12 T W"]]:
    """Displacements from the noise-free motion: of samples (sorted), and of what was observed."""
    drawn, observed = [], []
    for first in range(0, len(windows), _CHUNK):
        wanted = np.arange(first, min(first + _CHUNK, len(windows)))
        chunk = windows.take(np.resize(wanted, min(_CHUNK, len(windows))))
        key = jax.random.fold_in(jax.random.key(seed), first)
        e, y = _displacements(model, Batch.of(chunk), windows.dt, key, substeps)
        drawn.append(np.sort(np.asarray(e), axis=2)[..., : wanted.size])
        observed.append(np.asarray(y)[..., : wanted.size])
    e, y = np.concatenate(drawn, axis=-1), np.concatenate(observed, axis=-1)
    hidden = windows.hidden
    if hidden is not None:  # what nobody has measured tells nothing
        seen = np.any(hidden.seen, axis=(0, 2))
        y[~np.concatenate([seen[:3], np.ones(3, bool), seen[3:]])] = np.nan
    return e, y


@eqx.filter_jit
def _displacements(
    model: Dynamics, batch: Batch, dt: float, key: Array, substeps: int
) -> tuple[Array, Array]:
    X, V = predict(
        model, batch.X[0], batch.V[0], batch.F, dt, key, _SAMPLES, substeps=substeps,
        with_path_of_drift=True, commands=batch.commands, spread=batch.spread,
    )  # fmt: skip
    drift = X[:, :, _SAMPLES:], V[:, :, _SAMPLES:]
    e = displacement(X[:, :, :_SAMPLES], V[:, :, :_SAMPLES], *drift)
    return e, displacement(batch.X[1:, :, None], batch.V[1:, :, None], *drift)[:, :, 0]


def _factors(
    e: Float[np.ndarray, "12 T P W"], y: Float[np.ndarray, "12 T W"]
) -> Float[np.ndarray, "6"]:
    """By which factor each axis' spread has to grow."""
    ends = [order_statistics(e.shape[2], band) for band in BANDS]
    factors = np.ones(6)
    for axis in range(6):
        channels = [axis, axis + 6]
        at, low = y[channels], e[channels][:, :, [a for a, _ in ends]]
        high = e[channels][:, :, [b for _, b in ends]]
        known = np.isfinite(at) & np.isfinite(low).all(axis=2) & np.isfinite(high).all(axis=2)
        if not known.any():
            continue

        def short(log_factor: float, at=at, low=low, high=high, known=known) -> float:
            s = np.exp(log_factor)
            inside = (s * low <= at[:, :, None]) & (at[:, :, None] <= s * high)
            return float(np.moveaxis(inside, 2, 0)[:, known].mean() - np.mean(BANDS))

        most = np.log(_MOST)
        if short(-most) >= 0 or short(most) <= 0:
            factors[axis] = 1 / _MOST if short(-most) >= 0 else _MOST
        else:
            root: Any = scipy.optimize.bisect(short, -most, most, xtol=1e-3)
            factors[axis] = np.exp(root)
    return factors
