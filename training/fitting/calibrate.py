"""Bands that hold what they say: b scaled to the errors on training and validation windows.

A median of errors does not know their tails, and errors on the windows that the drift was fitted to
are smaller than on others, so that bands of a b from there alone are too narrow. Validation windows
are honest but few. Both sets count alike: on each axis two factors of b are found, at which the
central bands of 50 and of 90 % of predicted pose and velocity hold their shares, on average over
both sets and all horizons; b is scaled by their geometric mean. Before that b is let grow with
speed as far as errors do (`noise_growth`): no constant b holds both bands then.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
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
from .noise_growth import TERMS, Spread, Twists, can_grow, sizes, with_growth
from .start import NORMAL_QUARTILE, diffusion_scale, with_diffusion

Model = TypeVar("Model", bound=Dynamics)

_SAMPLES, _CHUNK, _WINDOWS = 39, 16, 48
_ROUNDS = 2
"""Spreads are nearly proportional to b, so that a second round is a small correction."""
_MOST = 4.0
"""Largest factor of a round."""
_SMALL = 0.1
"""Share of b² at which spreads are linear in it."""
_NOTHING = 1e-6
"""Size of a constant term that is left out."""


def calibrated(model: Model, sets: Sequence[Windows], substeps: int, seed: int = 0) -> Model:
    """The model with b scaled, axis by axis, so that its bands hold their shares of the windows.

    The b of a constant model, or of a SPINN with a network for it, also grows with the twist as far
    as errors do.

    Each of the `sets` counts alike, whatever its size. A model without diffusion is returned as it
    is, and so is the b of an axis whose pose and velocity nobody has measured or whose motion
    diverges.
    """
    own = core(model)
    if not isinstance(own, FossenDynamics | Spinn) or not own.stochastic:
        return model
    if not np.all(diffusion_scale(model) > 0):
        return model
    sets = [one.thin(_WINDOWS) for one in sets]
    if can_grow(model):
        twists = Twists.of(sets)
        terms = [_by_term(model, one, substeps, seed, twists) for one in sets]
        model = with_growth(model, sizes(terms), twists)
    for _ in range(_ROUNDS):
        spreads = [_spreads(model, one, substeps, seed) for one in sets]
        model = with_diffusion(model, diffusion_scale(model) * _factors(spreads))
    return model


def _by_term(model: Dynamics, windows: Windows, substeps: int, seed: int, twists: Twists) -> Spread:
    """The spread by each term of b² alone, drawn with less noise and scaled up."""

    def variance(size: np.ndarray, windows: Windows) -> tuple[np.ndarray, np.ndarray]:
        size = _SMALL * np.tile(size, (6, 1))
        size[:, 0] = np.maximum(size[:, 0], _NOTHING)
        e, y = _spreads(with_growth(model, size, twists), windows, substeps, seed)
        low, high = order_statistics(e.shape[2], 0.5)
        # by quartiles, as single samples may run away
        std = (e[:, :, high] - e[:, :, low]).astype(float) / (2 * NORMAL_QUARTILE)
        return std**2, y

    known, hidden = windows, windows.hidden
    if hidden is not None:
        known = replace(windows, hidden=hidden._replace(spread=np.zeros_like(hidden.spread)))
    drawn = [variance(term, known) for term in np.eye(TERMS)]
    terms, observed = np.stack([one for one, _ in drawn]) / _SMALL, drawn[0][1]
    start = np.zeros_like(terms[0])
    if hidden is not None:
        start, _ = variance(np.zeros(TERMS), windows)
    return Spread(start, terms, observed)


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
        rise=batch.rise,
    )  # fmt: skip
    drift = X[:, :, _SAMPLES:], V[:, :, _SAMPLES:]
    e = displacement(X[:, :, :_SAMPLES], V[:, :, :_SAMPLES], *drift)
    return e, displacement(batch.X[1:, :, None], batch.V[1:, :, None], *drift)[:, :, 0]


def _factors(sets: Sequence[tuple[np.ndarray, np.ndarray]]) -> Float[np.ndarray, "6"]:
    """By which factor each axis' spread has to grow; of each set what `_spreads` returns."""
    factors = np.ones(6)
    for axis in range(6):
        parts = [part for e, y in sets if (part := _known(e, y, axis))]

        def short(log_factor: float, k: int, parts: Any = parts) -> float:
            s = np.exp(log_factor)
            inside = [np.mean((s * low[k] <= y) & (y <= s * high[k])) for low, high, y in parts]
            return float(np.mean(inside)) - BANDS[k]

        if parts:
            factors[axis] = np.exp(np.mean([_root(short, k) for k in range(len(BANDS))]))
    return factors


def _root(short: Callable[[float, int], float], band: int) -> float:
    """The logarithm of the factor at which a band holds its share, within bounds."""
    most = float(np.log(_MOST))
    if short(-most, band) >= 0:
        return -most
    if short(most, band) <= 0:
        return most
    found: Any = scipy.optimize.bisect(short, -most, most, args=(band,), xtol=1e-3)
    return found


def _known(
    e: Float[np.ndarray, "12 T P W"], y: Float[np.ndarray, "12 T W"], axis: int
) -> tuple[np.ndarray, ...] | None:
    """Ends of both bands (2, n) on an axis, and what was observed (n), where all are finite."""
    own = [axis, axis + 6]
    ends = np.array([order_statistics(e.shape[2], band) for band in BANDS])
    low, high = (np.moveaxis(e[own][:, :, at], 2, 0) for at in ends.T)
    known = np.isfinite(y[own]) & np.isfinite(low).all(axis=0) & np.isfinite(high).all(axis=0)
    return (low[:, known], high[:, known], y[own][known]) if known.any() else None
