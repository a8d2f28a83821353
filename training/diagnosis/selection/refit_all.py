"""Joint fit of all coefficients of a grey-box model, before any cause is selected.

Where most coefficients are wrong, causes that are tried one by one fit each other's errors. With
`--refit all` the coefficients are fitted together first: added mass, drag, buoyancy and restoring
moment, the thrust curve, thrust along each axis and its lever arms. Motion alone determines all of
these only relative to each other. The scale is that of the rigid body's mass and inertia, which can
be weighed and computed; added mass and drag are not negative, and thrust is as near to the believed
one as that allows.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ....models.effects.library import COEFFICIENTS, PART, Entry, kind
from ....models.effects.traits import Group
from ...least_squares import Damping, LocalModel, minimise
from ..filter.gram import least_within
from ..filter.kalman import Filter
from ..filter.problem import DiagnosisProblem, Evaluation
from .hypotheses import known_within
from .model_selection import acts_unseen

_ROUNDS = 40
_DAMPING, _FULL_STEP = Damping(start=0.0, after_failure=1.0, least=0.0), 0.1
"""Damping in units of the prior, and the one below which it is left out."""
_ENOUGH = 1.0
"""Gain of a round (nats) below which the fit ends."""
_COMMON = 13
"""Prior weight (samples) of the pooled covariance in a piece's own: enough for an inverse."""


@dataclass(frozen=True)
class Coefficient:
    """An entry of θ with its prior standard deviation about the believed value, and its range."""

    row: int
    spread: float
    low: float
    high: float


def is_coefficient(entry: Entry, group: Group) -> bool:
    """Whether a parameter belongs to a group: of effects with a place `all`, only there."""
    if PART in entry.cause:
        return False
    cls = kind(entry.cause)
    return group in cls.refits and (entry.where == "all" or "all" not in cls.places_with(1))


def with_coefficients(problem: DiagnosisProblem, group: Group) -> DiagnosisProblem:
    """The problem with the effects that only such a fit has and, for `all`, physical bounds."""
    for cls in COEFFICIENTS.values():
        there = cls.needs | cls.refit_needs <= problem.data.offers
        if group in cls.refits and there and not problem.library.has(cls.name):
            problem = problem.with_effect(cls.neutral())
    if group != "all":
        return problem
    return problem.within({c.row: (c.low, c.high) for c in coefficients(problem)})


def coefficients(problem: DiagnosisProblem) -> list[Coefficient]:
    """All coefficients that are fitted."""
    library, found, base = problem.library, [], problem.model.base
    replaced = {name for effect in library.effects for name in effect.replaces}
    for i, entry in enumerate(library.entries):
        cls, p = kind(entry.cause), entry.parameter
        prior = cls.refit_prior(base, entry.where) or (p.refit or p.spread, p.low)
        if not is_coefficient(entry, "all") or entry.cause in replaced or not prior[0]:
            continue
        if acts_unseen(entry.cause, entry.where, problem.data.unseen):
            continue
        if cls.refit_needs <= problem.data.offers:
            start = problem.believed[i]
            low, high = start + min(prior[1], 0.0), start + p.high
            found.append(Coefficient(i, prior[0], low, high))
    return found


def identify(
    problem: DiagnosisProblem,
    progress: Callable[[float], None] = lambda fraction: None,
    start: Float[np.ndarray, " p"] | None = None,
    also: Sequence[int] = (),
) -> Float[np.ndarray, " p"]:
    """Maximum a posteriori θ of all coefficients, by damped Gauss–Newton (Levenberg 1944).

    Steps are damped in units of the prior standard deviations, so that they are short along the
    flat, curved valleys that data leave undetermined, and full across them.

    It starts at the believed θ, or at `start`; the parameters `also` of causes are free too. Each
    step weights one-step errors by their covariances (of pose and of twist) at the current θ, piece
    by piece. That needs no noise levels, which a wrong model makes too large, and an
    estimator's slow errors do less harm where the vehicle rests than where drag multiplies them.
    """
    posterior = _Posterior(problem, [*coefficients(problem), *_as_coefficients(problem, also)])
    rows = posterior.rows
    theta = (problem.believed if start is None else start).copy()
    if start is None:
        theta[rows] += [problem.library.entries[i].parameter.start for i in rows]
    else:
        theta[rows] = np.clip(theta[rows], posterior.low, posterior.high)
    rounds = itertools.count()

    def local(theta: np.ndarray) -> LocalModel:
        progress(next(rounds) / _ROUNDS)
        return posterior.local(theta)

    return minimise(theta, local, _ROUNDS, _ENOUGH, _DAMPING)


class _Posterior:
    """Posterior of coefficients given one-step errors, weighted as at a θ."""

    def __init__(self, problem: DiagnosisProblem, chosen: Sequence[Coefficient]):
        self.problem, self.rows = problem, [c.row for c in chosen]
        self.spread = np.array([c.spread for c in chosen])
        self.low, self.high = np.array([c.low for c in chosen]), np.array([c.high for c in chosen])
        self.centre = problem.believed[self.rows]

    def loss(self, theta: np.ndarray, common: np.ndarray) -> float:
        """Its negative logarithm, with the pooled covariance `common` as the pieces' prior."""
        away = (theta[self.rows] - self.centre) / self.spread
        C, counts = _by_piece(self.problem, self.problem.errors(theta), common)
        if not np.isfinite(C).all():
            return np.inf
        rows = _by_forces(self.problem)
        C = C[:, rows[:, None], rows]
        return float(counts @ np.linalg.slogdet(C)[1] + away @ away) / 2

    def local(self, theta: np.ndarray) -> LocalModel:
        """Its quadratic model in units of the prior, with errors weighted as at θ."""
        problem, rows, spread = self.problem, self.rows, self.spread
        common = problem.covariance(problem.errors(theta), apart=True)
        now = self.loss(theta, common)
        gradient, H = _quadratic(problem.evaluate(theta, rows, one_step(problem, theta)), rows)
        gradient = (gradient + (theta[rows] - self.centre) / spread**2) * spread
        # but for rounding, no eigenvalue is below 1 with the prior
        values, vectors = np.linalg.eigh(H * np.outer(spread, spread) + np.eye(len(rows)))
        values = np.maximum(values, 1.0)
        within = (self.low - theta[rows]) / spread, (self.high - theta[rows]) / spread

        def stepped(damping: float) -> np.ndarray:
            damped = values + (damping if damping >= _FULL_STEP else 0.0)
            step = least_within(damped, vectors, gradient, *within)
            moved = theta.copy()
            moved[rows] = np.clip(theta[rows] + step * spread, self.low, self.high)
            return moved

        return LocalModel(now, lambda theta: self.loss(theta, common), stepped)


def _as_coefficients(problem: DiagnosisProblem, rows: Sequence[int]) -> list[Coefficient]:
    """Parameters of causes as coefficients, with the priors and bounds that they have as causes."""
    low, high = problem.limits(rows)
    return [
        Coefficient(i, known_within(problem.library.entries[i].parameter), a, b)
        for i, a, b in zip(rows, low.tolist(), high.tolist(), strict=True)
    ]


def one_step(problem: DiagnosisProblem, theta: Float[np.ndarray, " p"]) -> Filter:
    """The filter with the gain K = I: its innovations are one-step errors, whitened.

    Latent velocities have no gain: they are simulated, and depend on θ through all steps before.
    """
    error = problem.errors(theta)
    C, _ = _by_piece(problem, error, problem.covariance(error, apart=True))
    rows = _by_forces(problem)
    C = C[:, rows[:, None], rows]
    whiten = np.zeros((len(problem.data.u), 12, 12, len(C)))
    inverse = np.moveaxis(np.linalg.inv(np.linalg.cholesky(C)), 0, -1)
    whiten[:, rows[:, None], rows] = inverse
    log_det = np.broadcast_to(np.linalg.slogdet(C)[1] / 2, problem.data.weight.shape)
    keep = np.zeros_like(whiten)
    for i in problem.data.latent:
        keep[:, 6 + i, 6 + i] = 1.0
    return Filter(keep, whiten, log_det)


def _by_forces(problem: DiagnosisProblem) -> Int[np.ndarray, " k"]:
    """Rows of the errors that forces show in: twists, and poses whose twists were not measured."""
    twist = np.arange(6, 12)
    return np.concatenate([np.flatnonzero(problem.data.measured[twist] == 0), twist])


def _by_piece(
    problem: DiagnosisProblem,
    error: Float[np.ndarray, "N 12 R"],
    common: Float[np.ndarray, "12 12"],
) -> tuple[Float[np.ndarray, "R 12 12"], Float[np.ndarray, " R"]]:
    """Covariance of each piece's one-step errors, and its number of samples with the prior's.

    It is the estimate under an inverse Wishart prior centred on `common`.
    """
    C = np.einsum("nir,njr->rij", error, error)
    C[:, :6, 6:], C[:, 6:, :6] = 0.0, 0.0
    counts = problem.data.weight.sum(axis=0) + _COMMON
    return (C + _COMMON * common) / counts[:, None, None], counts


def _quadratic(seen: Evaluation, rows: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Gradient and Gauss–Newton Hessian of ½ |z|² by the parameters."""
    columns = [seen.evidence.column(i) for i in rows]
    total = seen.evidence.total
    return total[columns, 0], total[np.ix_(columns, columns)]
