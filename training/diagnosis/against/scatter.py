"""Changes of parameters between two sets of units, by the scatter of the healthy ones.

A unit u (scenario, run or stretch) has the score s_u and the information I_u of some parameters at
the healthy model: x_u = I_u⁻¹ s_u is its own estimate of their change. The healthy model is not
exact, so x_u scatters by more than the noise of innovations explains. Along directions in which the
information of both sets is diagonal (generalised eigenvectors), the dispersion

    φ = Σ_u e_u² / i_u / (n - 1),  e_u = s_u - I_u x̄,

is 1 for noise alone (DerSimonian and Laird 1986). With few units it is uncertain: the dispersions
of all parameters are shrunk to their common value (Smyth 2004, "Linear models and empirical Bayes
methods", eqs. 3 and 4), and never taken as less than 1. The excess φ - 1 is read in both ways,
as correlated innovations and as parameters that differ from unit to unit; the larger variance
counts.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.special
import scipy.stats
from jaxtyping import Bool, Float

_LITTLE = 1e-9
"""Share of the healthy information below which new data tell nothing."""
_ROUNDING = 1e-6
"""Share of the largest information, of parameters in units of their own errors, below which a
combination of them is not shown: sensitivities have single precision."""
_LEAST_UNITS = 1.2
"""Effective number of units that show a parameter, below which its scatter is unknown."""


class Units(NamedTuple):
    """Scores and information of k parameters by unit."""

    score: Float[np.ndarray, "u k"]
    information: Float[np.ndarray, "u k k"]

    def select(self, kept: Bool[np.ndarray, " u"]) -> "Units":
        """Some of the units."""
        return Units(self.score[kept], self.information[kept])


class Directions(NamedTuple):
    """Two sets of units along d directions W of k parameters, x = W y.

    Attributes:
        W: directions in which the information of both sets is diagonal, and 1 for the healthy.
        healthy, new: estimates y.
        ratio: information of the new set (that of the healthy one is 1).
        spread: of the new set, Σ i² / (Σ i)².
        own: φ of the new units, 0 for a single one.
        dispersion: φ of healthy units.
        freedom: effective number of healthy units less one.
        each: information of a typical healthy unit, Σ i².
    """

    W: Float[np.ndarray, "k d"]
    healthy: Float[np.ndarray, " d"]
    new: Float[np.ndarray, " d"]
    ratio: Float[np.ndarray, " d"]
    spread: Float[np.ndarray, " d"]
    own: Float[np.ndarray, " d"]
    dispersion: Float[np.ndarray, " d"]
    freedom: Float[np.ndarray, " d"]
    each: Float[np.ndarray, " d"]


class Change(NamedTuple):
    """A change of k parameters and its test.

    Attributes:
        healthy: what healthy units estimate (k,).
        change: new less healthy (k,).
        covariance: of the change.
        freedom: of Student's t for intervals.
        score: -log of the p value that there is no change.
    """

    healthy: Float[np.ndarray, " k"]
    change: Float[np.ndarray, " k"]
    covariance: Float[np.ndarray, "k k"]
    freedom: float
    score: float

    @property
    def errors(self) -> Float[np.ndarray, " k"]:
        """Standard errors."""
        return np.sqrt(np.diag(self.covariance))


def directions(healthy: Units, new: Units) -> Directions | None:
    """Both sets along directions of their own; None where healthy units don't show a parameter."""
    H, N = healthy.information.sum(axis=0), new.information.sum(axis=0)
    size = np.sqrt(np.maximum(np.diag(H), 0.0))
    if len(healthy.score) < 2 or not np.all(size > 0) or not np.isfinite(H + N).all():
        return None
    both = np.outer(size, size)
    values, vectors = np.linalg.eigh(H / both)
    shown = values > _ROUNDING * values[-1]
    roots = vectors[:, shown] / np.sqrt(values[shown])
    ratio, turned = np.linalg.eigh(roots.T @ (N / both) @ roots)
    W = roots @ turned / size[:, None]
    i, dispersion = _dispersion(healthy, W, W.T @ healthy.score.sum(axis=0))
    each = (i**2).sum(axis=0)
    kept = (ratio > _LITTLE) & (1 / each > _LEAST_UNITS)
    if not kept.any():
        return None
    ratio, W = ratio[kept], W[:, kept]
    estimate = W.T @ new.score.sum(axis=0) / ratio
    own, of_new = _dispersion(new, W, estimate)
    return Directions(
        W,
        W.T @ healthy.score.sum(axis=0),
        estimate,
        ratio,
        (own**2).sum(axis=0) / own.sum(axis=0) ** 2,
        of_new if len(own) > 1 else np.zeros(len(ratio)),
        dispersion[kept],
        1 / each[kept] - 1,
        each[kept],
    )


def _dispersion(
    units: Units, W: Float[np.ndarray, "k d"], y: Float[np.ndarray, " d"]
) -> tuple[Float[np.ndarray, "u d"], Float[np.ndarray, " d"]]:
    """Information of units along W, and φ about the estimates y."""
    e = (units.score - units.information @ (W @ y)) @ W
    i = np.maximum(np.einsum("kd,ukl,ld->ud", W, units.information, W), 0.0)
    there = i > _LITTLE * i.max(axis=0)
    squares = np.where(there, e**2 / np.where(there, i, 1.0), 0.0).sum(axis=0)
    return i, squares / np.maximum(there.sum(axis=0) - 1, 1)


def moderated(
    dispersion: Float[np.ndarray, " d"], freedom: Float[np.ndarray, " d"]
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """Dispersions shrunk to their common value, and their degrees of freedom."""
    own = np.maximum(dispersion, 1e-12)
    if len(own) < 3:
        return own, freedom
    half = freedom / 2
    e = np.log(own) - scipy.special.digamma(half) + np.log(half)
    chance = scipy.special.polygamma(1, half)  # variance of e by chance
    weight = 1 / chance / np.sum(1 / chance)
    mean = float(weight @ e)
    excess = float(weight @ (e - mean) ** 2) * len(e) / (len(e) - 1) - float(weight @ chance)
    if excess <= 0:  # they differ no more than by chance
        return np.full(len(own), np.exp(mean)), np.full(len(own), np.inf)
    prior = 2 * _inverse_trigamma(excess)
    common = np.exp(mean + scipy.special.digamma(prior / 2) - np.log(prior / 2))
    return (prior * common + freedom * own) / (prior + freedom), prior + freedom


def _inverse_trigamma(x: float) -> float:
    """The y with ψ'(y) = x, by Newton's method on 1/ψ' (Smyth 2004, appendix)."""
    y = 0.5 + 1 / x
    for _ in range(50):
        value = float(scipy.special.polygamma(1, y))
        step = value * (1 - value / x) / float(scipy.special.polygamma(2, y))
        y += step
        if -step / y < 1e-8:
            break
    return y


def changes(sets: Sequence[Directions | None], louder: float = 1.0) -> list[Change | None]:
    """Tests of all sets of parameters, with dispersions moderated over them together.

    New units may scatter by more than healthy ones: by their own dispersion, or as their errors are
    `louder` in variance. The p values of a set's directions are combined by Fisher's method.
    """
    found = [d for d in sets if d is not None]
    if not found:
        return [None] * len(sets)
    columns = Directions(np.zeros((0, 0)), *(
        np.concatenate([getattr(d, name) for d in found]) for name in Directions._fields[1:]
    ))  # fmt: skip
    dispersion, freedom = moderated(columns.dispersion, columns.freedom)
    dispersion = np.maximum(dispersion, 1.0)
    between = (dispersion - 1) / columns.each  # variance of parameters from unit to unit
    old = np.maximum(dispersion, between * columns.each + 1)
    new = np.maximum(np.maximum(dispersion, columns.own), louder) / columns.ratio
    variance = old + np.maximum(new, between * columns.spread + 1 / columns.ratio)
    t = np.abs(columns.new - columns.healthy) / np.sqrt(variance)
    log_p = np.minimum(np.log(2) + log_tail(t, freedom), 0.0)
    results: list[Change | None] = []
    at = 0
    for d in sets:
        if d is None:
            results.append(None)
            continue
        own = slice(at, at + len(d.ratio))
        at += len(d.ratio)
        results.append(
            Change(
                d.W @ d.healthy,
                d.W @ (d.new - d.healthy),
                d.W * variance[own] @ d.W.T,
                float(freedom[own].min()),
                _fisher(log_p[own]),
            )
        )
    return results


def log_tail(t: Float[np.ndarray, " d"], freedom: Float[np.ndarray, " d"]) -> np.ndarray:
    """Logarithm of P(T > t) of Student's t."""
    with np.errstate(divide="ignore"):
        found = scipy.stats.t.logsf(t, np.minimum(freedom, 1e6))
    return np.where(np.isfinite(found), found, -(t**2) / 2)


def _fisher(log_p: Float[np.ndarray, " d"]) -> float:
    """-log of the p value of several p values together, by -2 Σ log p ~ χ² of 2 d."""
    d, total = len(log_p), -float(log_p.sum())
    if d == 1:
        return total
    # P(χ²_2d > 2 s) = exp(-s) Σ_(j<d) s^j / j!
    j = np.arange(d)
    terms = j * np.log(max(total, 1e-300)) - scipy.special.gammaln(j + 1)
    return max(total - float(np.logaddexp.reduce(terms)), 0.0)


def noise_changes(
    healthy: Float[np.ndarray, "u c"], new: Float[np.ndarray, "v c"]
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Changes of logarithms of error sizes by channel: estimates, half-widths (95 %), scores."""
    n, m = len(healthy), len(new)
    variance, freedom = moderated(healthy.var(axis=0, ddof=1), np.full(healthy.shape[1], n - 1.0))
    off = new.mean(axis=0) - healthy.mean(axis=0)
    error = np.sqrt(variance * (1 / n + 1 / m))
    score = -np.minimum(np.log(2) + log_tail(np.abs(off) / error, freedom), 0.0)
    return off, error * scipy.stats.t.ppf(0.975, np.minimum(freedom, 1e6)), score
