"""The parts of path integral control that do not depend on the vehicle: noise, risk, weights."""

import math
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Array, Float
from scipy.interpolate import BSpline

_BISECTIONS = 48
_LOG_TEMPERATURES = -40.0, 80.0  # beyond all cost differences that float32 resolves


def spline_basis(horizon: int, pieces: int) -> Float[np.ndarray, "horizon coefficients"]:
    """Cubic B-splines on uniform knots at the midpoints of `horizon` steps, rows of unit length.

    Independent unit Gaussian coefficients then give a smooth process of unit variance at every
    step, correlated over about one of the `pieces` (pieces + 3 coefficients).
    """
    knots = np.arange(-3, pieces + 4, dtype=float)
    times = (np.arange(horizon) + 0.5) * pieces / horizon
    basis = BSpline.design_matrix(times, knots, 3).toarray()
    return basis / np.linalg.norm(basis, axis=1, keepdims=True)


def combine_risk(
    cost: Float[Array, "r n"], risk: Literal["mean", "cvar", "worst"], part: float
) -> Float[Array, " n"]:
    """One cost per sequence from those of its r realisations; NaN in any of them gives NaN."""
    if risk == "mean" or cost.shape[0] == 1:
        return jnp.mean(cost, axis=0)
    count = 1 if risk == "worst" else math.ceil(part * cost.shape[0])
    worst = jnp.mean(jnp.sort(cost, axis=0)[-count:], axis=0)
    return jnp.where(jnp.any(jnp.isnan(cost), axis=0), jnp.nan, worst)


def chance_violation(
    clearance: Float[Array, "r n"], alpha: float, least_std: float
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
    """Violation of P(clearance > 0) ≥ 1 − α by control sequences.

    `clearance` (m) is each realisation's least over the horizon. r realisations resolve a
    probability no finer than 1/r, so the distribution is taken as normal with their mean μ and
    variance σ² = s² + σ₀² (sample variance and floor): P(collision) = Φ(−μ/σ), and the constraint
    holds if μ ≥ σ Φ⁻¹(1 − α).

    Returns:
        The probabilities, their excess over α, and the missing clearance (σ Φ⁻¹(1 − α) − μ)₊ in m,
        which still grows where the probability is one.
    """
    if clearance.shape[0] > 1:
        variance = jnp.var(clearance, axis=0, ddof=1)
    else:
        variance = jnp.zeros_like(clearance[0])
    mean, std = jnp.mean(clearance, axis=0), jnp.sqrt(variance + least_std**2)
    probability = ndtr(-mean / std)
    factor = ndtri(jnp.asarray(1 - alpha, clearance.dtype))
    return probability, jnp.maximum(probability - alpha, 0), jnp.maximum(factor * std - mean, 0)


def effective_count(weights: Float[Array, " n"]) -> Float[Array, ""]:
    """Effective sample size 1 / Σ w² of normalised weights (Kong 1992)."""
    return 1 / jnp.sum(weights * weights)


def path_integral_weights(
    cost: Float[Array, " n"], effective_samples: float
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """w_i ∝ exp(−S_i/λ), with λ such that the effective sample size is `effective_samples`; and λ.

    Williams et al. 2016, "Aggressive driving with model predictive path integral control", eq. 6,
    in log-sum-exp form. The effective sample size 1/Σw² grows with λ, so bisection finds λ; only
    the differences of the low costs matter, not how high the costs of collisions are. Costs that
    are not finite get no weight, and if none is finite all weights are equal.
    """
    finite = jnp.isfinite(cost)
    some = jnp.any(finite)
    excess = jnp.where(finite, cost, jnp.inf) - jnp.where(
        some, jnp.min(jnp.where(finite, cost, jnp.inf)), 0
    )
    excess = jnp.where(some, excess, 0)
    # the effective sample size can't exceed the number of finite costs
    target = jnp.minimum(
        effective_samples, 0.999 * jnp.sum(finite & some | ~some, dtype=cost.dtype)
    )

    def weights(log_temperature: Array) -> Array:
        return jax.nn.softmax(-excess * jnp.exp(-log_temperature))

    def halve(_: Any, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = (low + high) / 2
        enough = effective_count(weights(middle)) >= target
        return jnp.where(enough, low, middle), jnp.where(enough, middle, high)

    bracket = tuple(jnp.asarray(end, cost.dtype) for end in _LOG_TEMPERATURES)
    _, high = jax.lax.fori_loop(0, _BISECTIONS, halve, bracket)
    return weights(high), jnp.exp(high)
