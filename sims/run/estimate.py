"""The filter's estimate against the truth: errors, consistency, health."""

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from ...models import se3
from .log import RunLog

BLOCKS = ("position", "attitude", "velocity")
"""Blocks of the error: δp, δθ, δv."""
HEALTH = ("good", "degraded", "lost")
TRUSTED = ("imu", "dvl", "depth", "compass")
_CONFIDENCE = 0.95


def estimate_error(log: RunLog) -> tuple[np.ndarray, np.ndarray] | None:
    """The filter's error δ = (δp, δθ, δv) (N, 9) and its estimated standard deviations (N, 9).

    The truth is p̂ + R̂ δp, R̂ exp(δθ), v̂ + δv, in body axes. Without a covariance in the log the
    deviations are NaN.
    """
    if "X_WB_estimate" not in log:
        return None
    here, true = log["X_WB_estimate"], log["X_WB"]
    place = se3.rotate_inverse(jnp.asarray(here.T), jnp.asarray((true - here)[:, 4:].T)).T
    velocity = (log["V_WB_B"] - log["V_WB_B_estimate"])[:, :3]
    error = np.concatenate([place, local(here, true)[:, 3:], velocity], axis=1)
    return error, log["error_std"][:, :9] if "error_std" in log else np.full_like(error, np.nan)


def local(X: Float[np.ndarray, "n 7"], Y: Float[np.ndarray, "n 7"]) -> Float[np.ndarray, "n 6"]:
    """log(X⁻¹ Y), row by row."""
    return np.asarray(se3.local(jnp.asarray(X.T), jnp.asarray(Y.T))).T


def nees(log: RunLog) -> Float[np.ndarray, "n 3"]:
    """Normalised estimation error squared δᵀ P⁻¹ δ of each of `BLOCKS`.

    Chi-square with three degrees of freedom if the filter is consistent (Bar-Shalom et al. 2001,
    section 5.4.2); NaN where the covariance is singular or anything is not finite.
    """
    known = estimate_error(log)
    if known is None or "error_covariance" not in log:
        return np.full((log.time.size, 3), np.nan)
    return mahalanobis(known[0], log["error_covariance"])


def mahalanobis(
    error: Float[np.ndarray, "n 9"], covariance: Float[np.ndarray, "n 27"]
) -> Float[np.ndarray, "n 3"]:
    """δᵀ P⁻¹ δ of the three blocks of errors, NaN where P is singular or either is not finite."""
    delta, P = error.reshape(-1, 3), covariance.reshape(-1, 3, 3)
    usable = np.all(np.isfinite(np.concatenate([delta, P.reshape(-1, 9)], axis=1)), axis=1)
    scale = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0))
    usable &= (scale > 0).all(axis=1)
    scale, eye = np.where(usable[:, None], scale, 1), np.eye(3)
    alike = np.where(usable[:, None, None], P / scale[:, :, None] / scale[:, None], eye)
    usable &= np.linalg.eigvalsh(alike)[:, 0] > 1e-9  # of correlations, which have no units
    delta, alike = delta / scale, np.where(usable[:, None, None], alike, eye)
    squares = np.einsum("ni,ni->n", delta, np.linalg.solve(alike, delta[:, :, None])[:, :, 0])
    return np.where(usable, squares, np.nan).reshape(-1, 3)


@cache
def average_bound(freedom: int, count: int = 1) -> tuple[float, float]:
    """Two-sided 95 % bounds of the mean of `count` independent chi-square values.

    The sum is chi-square with count · freedom degrees of freedom (Bar-Shalom et al. 2001,
    eq. 5.4.2-6).
    """
    tail = (1 - _CONFIDENCE) / 2
    low, high = chi2.ppf([tail, 1 - tail], count * freedom) / count
    return float(low), float(high)


def nees_words(estimate: Mapping[str, Any]) -> str | None:
    """A run's NEES: `position 2.1, attitude 3.4, velocity 12 (outside), bounds 0.22 to 9.3`.

    None if a block has no finite NEES. `estimate` are the metrics of `sims.run.metrics`.
    """
    told = {name: estimate.get(f"{name}_nees") for name in BLOCKS}
    known = {name: x for name, x in told.items() if x is not None and math.isfinite(x)}
    if len(known) < len(BLOCKS):
        return None
    low, high = estimate["nees_low"], estimate["nees_high"]
    inside = {name: low <= x <= high for name, x in known.items()}
    listed = ", ".join(
        f"{name} {x:.2g}{'' if inside[name] else ' (outside)'}" for name, x in known.items()
    )
    all_in = "all inside the " if all(inside.values()) else ""
    return f"{listed}, {all_in}bounds {low:.2g} to {high:.2g}"


def health_shares(log: RunLog) -> dict[str, dict[str, float]]:
    """Share of the run's time in each state of `HEALTH`, by the sensors that are not trusted."""
    trusted = ("imu", *log.fused)
    state = np.nan_to_num(log["health"], nan=2.0)
    found: dict[str, dict[str, float]] = {name: {} for name in HEALTH}
    rows, counts = np.unique(np.clip(state, 0, 2), axis=0, return_counts=True)
    for row, count in zip(rows, counts, strict=True):
        doubted = ", ".join(n for n, mark in zip(trusted, row[1:], strict=True) if mark < 0.5)
        own = found[HEALTH[int(row[0])]]
        own[doubted] = own.get(doubted, 0.0) + float(count / len(state))
    return found


def health_words(shares: Mapping[str, Mapping[str, float]]) -> str:
    """`good 97 %, degraded (dvl) 3 %`."""
    told = []
    for name, own in shares.items():
        for doubted, share in sorted(own.items(), key=lambda item: -item[1]):
            told.append(f"{name}{f' ({doubted})' if doubted else ''} {_percent(share)}")
    return ", ".join(told)


def _percent(share: float) -> str:
    """In whole per cent; 0 % and 100 % only for shares that are exactly that."""
    return "below 1 %" if share < 0.005 else f"{min(100 * share, 99 if share < 1 else 100):.0f} %"
