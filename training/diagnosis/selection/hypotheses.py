"""Fits, held-out gains and tests of sets of causes, all from inner products by run.

A hypothesis is a set of parameters; with sensitivities J in columns the innovations are z + J θ,
and ½ |z + J θ|² is minus the log likelihood up to a constant. Parameters with a nonlinear response
(lag, delay, dead zone) have several probes; in between, a cubic spline through the probed
responses is taken, which is again a combination of columns.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Float, Int
from scipy.interpolate import CubicSpline

from ....models.effects.base import Parameter
from ....models.effects.library import Library
from ..filter.gram import least_within, pooled

PRIOR = 50.0
"""Standard deviation of the weak prior on every parameter, in units of its first probe."""
_GRID = 49


@dataclass(frozen=True)
class Design:
    """Probes (differences from θ) and which parameter each belongs to."""

    probes: Float[np.ndarray, "k p"]
    owner: Int[np.ndarray, " k"]
    size: Float[np.ndarray, " k"]

    @classmethod
    def of(
        cls, library: Library, theta: Float[np.ndarray, " p"], chosen: Sequence[int] | None = None
    ) -> "Design":
        """All probes of the chosen parameters (all by default) around θ.

        Where a curved parameter is already in use, its response is taken by one small step.
        """
        owner, size = [], []
        for i in range(library.size) if chosen is None else chosen:
            parameter = library.entries[i].parameter
            sizes = parameter.probes if is_curved(library, i) else parameter.probes[:1]
            if is_curved(library, i) and theta[i] != 0:
                sizes = (0.01 * theta[i],)
            owner += [i] * len(sizes)
            size += list(sizes)
        probes = np.zeros((len(owner), library.size))
        probes[np.arange(len(owner)), owner] = size
        return cls(probes, np.array(owner, int), np.array(size))

    @classmethod
    def one_each(
        cls, library: Library, theta: Float[np.ndarray, " p"], chosen: Sequence[int]
    ) -> "Design":
        """The first probe of each of the parameters chosen, in their order."""
        every = cls.of(library, theta, chosen)
        first = [int(np.flatnonzero(every.owner == i)[0]) for i in chosen]
        return cls(every.probes[first], every.owner[first], every.size[first])


def is_curved(library: Library, i: int) -> bool:
    """Whether a parameter's response is probed at several sizes of one sign."""
    probes = library.entries[i].parameter.probes
    return len(probes) > 2 and min(probes) > 0


@dataclass(frozen=True)
class Fit:
    """Fit of a hypothesis to all data, and its gain on scenarios left out.

    Attributes:
        parameters: indices into θ.
        values: estimated changes of θ.
        others: estimated changes of the nuisance parameters, by index.
        errors: their standard errors, robust against dependence within runs.
        gain: nats won on all data.
        heldout: nats won on each run while its scenario is left out of the fit.
        p_value: of the robust Wald test, for this hypothesis alone.
    """

    parameters: tuple[int, ...]
    values: Float[np.ndarray, " k"]
    others: dict[int, float]
    errors: Float[np.ndarray, " k"]
    gain: float
    heldout: Float[np.ndarray, " runs"]
    p_value: float

    @property
    def heldout_gain(self) -> float:
        """Nats won on data that the fit has not seen."""
        return float(self.heldout.sum())

    def added_to(self, theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """θ with the changes of the fit."""
        moved = theta.copy()
        moved[list(self.parameters)] += self.values
        for i, change in self.others.items():
            moved[i] += change
        return moved


class Chance(NamedTuple):
    """Largest gain in noise alone: P(more than g nats) = exp((start - g) / scale) where small."""

    start: float
    scale: float

    def exceeded(self, alpha: float) -> float:
        """The gain that noise alone exceeds with probability `alpha` (0.1 at most)."""
        return float(max(self.start + self.scale * np.log(1 / min(alpha, 0.1)), 0.0))

    def beyond(self, gain: float) -> float:
        """The probability that noise alone wins more."""
        return float(np.exp(min((self.start - gain) / self.scale, 0.0)))


def known_within(parameter: Parameter) -> float:
    """Prior standard deviation of a parameter."""
    return parameter.spread or PRIOR * parameter.probes[0]


class Evidence:
    """Inner products of innovations (column 0) and responses to probes, by run and by fold."""

    def __init__(
        self,
        library: Library,
        theta: Float[np.ndarray, " p"],
        design: Design,
        products: Float[np.ndarray, "R m m"],
        run: Int[np.ndarray, " R"],
        fold: Int[np.ndarray, " R"],
    ):
        self.library, self.theta, self.design = library, theta, design
        self.runs = pooled(self.scaled(products), run)
        labels, first = np.unique(run, return_index=True)
        self.fold = fold[first]
        self.folds = pooled(self.runs, self.fold)
        self.fold_of = np.unique(self.fold, return_inverse=True)[1]
        del labels

    def scaled(self, products: Float[np.ndarray, "*R m m"]) -> Float[np.ndarray, "*R m m"]:
        """Products of sensitivities per unit of each parameter, from responses to the probes."""
        scale = np.concatenate([[1.0], 1 / self.design.size])
        return products * scale[:, None] * scale

    @cached_property
    def total(self) -> Float[np.ndarray, "m m"]:
        """Sum over all folds."""
        return self.folds.sum(axis=0)

    def column(self, i: int) -> int:
        """The column of a parameter's first probe."""
        return 1 + int(np.flatnonzero(self.design.owner == i)[0])

    def shows(self, i: int) -> bool:
        """Whether data are sensitive to a parameter (to a lever arm once there is a force)."""
        own = 1 + np.flatnonzero(self.design.owner == i)
        return bool(np.any(np.diag(self.total)[own] * self.design.size[own - 1] ** 2 > 1e-12))

    def prior(self, parameters: Sequence[int]) -> np.ndarray:
        """Precision of the prior: weak, except for parameters that declare a `spread`."""
        known = [known_within(self.library.entries[i].parameter) for i in parameters]
        return 1 / np.array(known) ** 2

    def curve(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Values t of a curved parameter, and for each the weights of all columns."""
        own = np.flatnonzero(self.design.owner == i)
        nodes = np.concatenate([[0.0], self.design.size[own]])
        t = np.geomspace(nodes[1] / 40, nodes[-1], _GRID)
        weights = np.zeros((len(t), self.total.shape[0]))
        # columns are divided by their size: a unit at node k weighs size_k
        unit = CubicSpline(nodes, np.eye(len(nodes))[:, 1:])(t)
        weights[:, 1 + own] = unit * self.design.size[own]
        weights[:, 0] = 1
        return t, weights

    def _split(self, parameters: Sequence[int]) -> tuple[int | None, list[int]]:
        """The one curved parameter (if any, and several probes are there) and the linear ones."""
        curved = [i for i in parameters if np.sum(self.design.owner == i) > 1]
        first = curved[0] if curved else None
        return first, [i for i in parameters if i != first]

    def _solve(
        self, T: np.ndarray, shifts: np.ndarray, columns: list[int], prior: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Linear values for each shift, and the loss ½|z + …|²."""
        loss = np.einsum("ti,ij,tj->t", shifts, T, shifts) / 2
        if not columns:
            return np.zeros((len(shifts), 0)), loss
        H = T[np.ix_(columns, columns)] + np.diag(prior)
        g = shifts @ T[:, columns]
        theta = -np.linalg.solve(H, g.T).T
        return theta, loss + np.sum(g * theta, axis=1) / 2

    def _combine(
        self, T: np.ndarray, curved: int | None, linear: list[int]
    ) -> tuple[np.ndarray, float, np.ndarray]:
        """Weights of all columns at the best fit of T, the curved value, the linear values."""
        columns = [self.column(i) for i in linear]
        if curved is None:
            t, shifts = np.zeros(1), np.eye(1, T.shape[0])
        else:
            t, shifts = self.curve(curved)
            t = np.concatenate([[0.0], t])
            shifts = np.concatenate([np.eye(1, T.shape[0]), shifts])
        theta, loss = self._solve(T, shifts, columns, self.prior(linear))
        best = int(np.argmin(loss))
        weights = shifts[best].copy()
        weights[columns] += theta[best]
        return weights, float(t[best]), theta[best]

    def fit(self, parameters: Sequence[int], nuisance: Sequence[int] = ()) -> Fit:
        """Fit a hypothesis, with nuisance parameters free in it and in the null hypothesis."""
        named, parameters = list(parameters), [i for i in parameters if self.shows(i)]
        parameters = parameters or named
        extra = [i for i in nuisance if i not in named and self.shows(i)]
        curved, linear = self._split([*parameters, *extra])
        weights, t, theta = self._combine(self.total, curved, linear)
        base = self._combine(self.total, None, extra)[0]

        def loss(w: np.ndarray, T: np.ndarray) -> Any:
            used = np.flatnonzero(w)
            return np.einsum("...ij,i,j->...", T[..., used[:, None], used], w[used], w[used]) / 2

        values = dict(zip(linear, theta, strict=True))
        if curved is not None:
            values[curved] = t
        heldout = np.zeros(len(self.runs))
        for f, fold in enumerate(self.folds):
            rest = self.total - fold if len(self.folds) > 1 else self.total
            here = self.fold_of == f
            w = self._combine(rest, curved, linear)[0]
            w0 = self._combine(rest, None, extra)[0]
            heldout[here] = loss(w0, self.runs[here]) - loss(w, self.runs[here])
        tangent = self._tangent(curved, t, [*parameters, *extra])
        prior = self.prior([*parameters, *extra])
        errors, p_value = self._wald(weights, base, tangent, prior, len(parameters))
        known = dict(zip(parameters, errors, strict=False))
        unknown = 1 / np.sqrt(self.prior(named))
        return Fit(
            tuple(named),
            np.array([values.get(i, 0.0) for i in named]),
            {i: float(values[i]) for i in extra},
            np.array([known.get(i, e) for i, e in zip(named, unknown, strict=True)]),
            float(loss(base, self.total) - loss(weights, self.total)),
            heldout,
            p_value,
        )

    def step(
        self,
        parameters: Sequence[int],
        low: Float[np.ndarray, " k"],
        high: Float[np.ndarray, " k"],
        without: int | None = None,
    ) -> Float[np.ndarray, " k"]:
        """The changes of θ that fit best between `low` and `high`, optionally `without` a fold."""
        T = self.total if without is None else self.total - self.folds[without]
        place = {i: k for k, i in enumerate(parameters)}
        curved, linear = self._split([i for i in parameters if self.shows(i)])
        changes, shift = np.zeros(len(place)), np.eye(1, len(T))[0]
        if curved is not None:
            k = place[curved]
            changes[k] = np.clip(self._combine(T, curved, linear)[1], low[k], high[k])
            grid, weights = self.curve(curved)
            if changes[k] != 0:
                shift = weights[np.argmin(np.abs(grid - changes[k]))]
        if linear:
            own, columns = [place[i] for i in linear], [self.column(i) for i in linear]
            H = T[np.ix_(columns, columns)] + np.diag(self.prior(linear))
            s = np.sqrt(np.diag(H))
            values, vectors = np.linalg.eigh(H / np.outer(s, s))
            values, gradient = np.maximum(values, 1e-12), shift @ T[:, columns] / s
            changes[own] = least_within(values, vectors, gradient, low[own] * s, high[own] * s) / s
        return changes

    def least(self, T: Float[np.ndarray, "m m"], parameters: Sequence[int]) -> float:
        """Minimum over these parameters of the loss of some products T (½ T_00 without any)."""
        weights, _, _ = self._combine(T, *self._split([i for i in parameters if self.shows(i)]))
        return float(weights @ T @ weights) / 2

    def _tangent(self, curved: int | None, t: float, parameters: list[int]) -> np.ndarray:
        """Weights (k, m) of the derivative of the innovations by each parameter."""
        rows = np.zeros((len(parameters), self.total.shape[0]))
        for row, i in zip(rows, parameters, strict=True):
            if i == curved:
                grid, weights = self.curve(i)
                k = int(np.clip(np.searchsorted(grid, t), 1, len(grid) - 1))
                row[:] = (weights[k] - weights[k - 1]) / (grid[k] - grid[k - 1])
            else:
                row[self.column(i)] = 1
        return rows

    def _wald(
        self,
        weights: np.ndarray,
        base: np.ndarray,
        tangent: np.ndarray,
        prior: np.ndarray,
        count: int,
    ) -> tuple[np.ndarray, float]:
        """Robust standard errors, and the p value of a robust score test at the base.

        Errors are clustered by run, but no smaller than those of independent innovations: the
        spread between few runs is itself uncertain, and often small by chance.
        """
        H = tangent @ self.total @ tangent.T + np.diag(prior)
        H = H + 1e-10 * np.diag(np.maximum(np.diag(H), 1e-300))
        inverse = np.linalg.inv(H)
        scores = self._scores(weights, tangent)
        n = len(scores)
        meat = scores.T @ scores * n / max(n - 1, 1)
        spread = inverse @ meat @ inverse
        errors = np.sqrt(np.maximum(np.diag(spread), np.diag(inverse)))
        own, other = np.arange(count), np.arange(count, len(tangent))
        project = np.eye(len(tangent))[own]
        if len(other):
            project[:, other] = -H[np.ix_(own, other)] @ np.linalg.inv(H[np.ix_(other, other)])
        s = self._scores(base, project @ tangent)
        meat = s.T @ s
        total = s.sum(axis=0)
        try:
            wald = float(total @ np.linalg.solve(meat, total))
        except np.linalg.LinAlgError:
            wald = 0.0
        # with few runs the statistic is bounded by their number: Hotelling's form
        if n > count + 1:
            ratio = wald / n
            F = (n - count) / count * ratio / max(1 - ratio, 1e-300) if ratio < 1 else np.inf
            return errors, float(scipy.stats.f.sf(F, count, n - count))
        return errors, 1.0

    def _scores(
        self, weights: Float[np.ndarray, " m"], tangent: Float[np.ndarray, "k m"]
    ) -> Float[np.ndarray, "runs k"]:
        """Derivatives of each run's loss at `weights`."""
        rows, used = np.flatnonzero(tangent.any(axis=0)), np.flatnonzero(weights)
        return self.runs[:, rows[:, None], used] @ weights[used] @ tangent[:, rows].T

    def chance(
        self,
        hypotheses: Sequence[Sequence[int]],
        nuisance: Sequence[int],
        rng: np.random.Generator,
        draws: int = 400,
    ) -> Chance:
        """The largest held-out gain of any hypothesis in pure noise.

        Under the fitted base the innovations are white and their products with the sensitivities of
        a fold are Gaussian with the sensitivities' own products as covariance: no simulation of
        motion is needed. The largest tenth is taken to be exponential.
        """
        m = self.total.shape[0]
        linear = [
            self.column(i) for i in range(self.library.size) if np.any(self.design.owner == i)
        ]
        noise = np.zeros((len(self.folds), m, draws))
        for f, T in enumerate(self.folds):
            H = T[np.ix_(linear, linear)]
            values, vectors = np.linalg.eigh(H)
            root = vectors * np.sqrt(np.maximum(values, 0))
            noise[f][linear] = root @ rng.standard_normal((len(linear), draws))
        total = noise.sum(axis=0)
        best = np.full(draws, -np.inf)
        for parameters in hypotheses:
            extra = [i for i in nuisance if i not in parameters]
            gain = self._null_gain(noise, total, [*parameters, *extra])
            best = np.maximum(best, gain - self._null_gain(noise, total, extra))
        q = np.quantile(best, 0.9)
        mean_excess = np.mean(best[best > q] - q)
        return Chance(float(q + mean_excess * np.log(0.1)), float(mean_excess))

    def _null_gain(self, noise: np.ndarray, total: np.ndarray, parameters: list[int]) -> np.ndarray:
        if not parameters:
            return np.zeros(noise.shape[2])
        columns = [self.column(i) for i in parameters]
        gain = np.zeros(noise.shape[2])
        prior = np.diag(self.prior(parameters))
        for f, T in enumerate(self.folds):
            rest = self.total - T if len(self.folds) > 1 else self.total
            g = (total - noise[f] if len(self.folds) > 1 else total)[columns]
            theta = -np.linalg.solve(rest[np.ix_(columns, columns)] + prior, g)
            H = T[np.ix_(columns, columns)]
            gain -= np.sum(noise[f][columns] * theta, axis=0)
            gain -= np.einsum("id,ij,jd->d", theta, H, theta) / 2
        return gain
