"""Disturbance level: whether the white disturbance is stronger or weaker than believed."""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Float

from ....models.dynamics import Dynamics
from ....models.effects.noise import DisturbanceLevel
from ....models.se3 import AXES
from ..filter.kalman import score_of
from ..filter.likely_noise import fit_with_slow_noise
from ..filter.noise import Noise, estimate, unit_processes
from ..filter.problem import DiagnosisProblem, Evaluation
from ..filter.transition import Transition
from .laws import Law

LEVEL = DisturbanceLevel.name


def believed_levels(problem: DiagnosisProblem) -> Float[np.ndarray, "6"]:
    """Diffusion b of the believed model, its root mean square in the runs; zero without any."""
    data = problem.data
    return typical_diffusion(problem.model.base, data.V[:-1], data.weight)


def typical_diffusion(
    model: Dynamics, V_WB_B: Float[np.ndarray, "N 6 R"], weight: Float[np.ndarray, "N R"]
) -> Float[np.ndarray, "6"]:
    """Root mean square of b over the twists whose weight is not zero."""
    V = np.moveaxis(V_WB_B, 1, 0)[:, weight > 0]
    b = np.asarray(model.mass_and_diffusion(jnp.asarray(V))[1])
    return np.sqrt(np.mean(b.reshape(6, -1) ** 2, axis=1))


def find_levels(problem: DiagnosisProblem, evaluation: Evaluation, least: float) -> list[Law]:
    """Levels axis by axis, none where the believed model has none.

    The gain is that of the level estimated on the other folds over the believed one, all other
    levels being estimated. Where it is above `least`, the others are estimated again with the
    believed one held, for measurement noise may compensate for it. The error of a level is
    that of its likelihood or, if larger, that by the jackknife over folds.
    """
    believed, data = believed_levels(problem), problem.data
    believed[data.latent] = 0.0
    if not np.any(believed > 0):
        return []
    latent = evaluation.predictions.latent
    error, jacobian = (
        np.asarray(evaluation.predictions.error),
        np.asarray(evaluation.predictions.jacobian),
    )
    mass, labels = problem.mass(evaluation.theta), np.unique(data.fold)
    inverse = np.linalg.inv(mass)
    gain = np.zeros((6, len(data.fold)))
    levels = np.zeros((len(labels), 6))
    judged = []

    def score(own: np.ndarray, noise: Noise, steps: Transition) -> Float[np.ndarray, " r"]:
        given = data.dt, data.step[:, own], data.weight[:, own]
        some = None if latent is None else latent.of(own)
        lost = None if data.spread is None else data.spread[..., own]
        seen = error[:, :, own], jacobian[..., own]
        return score_of(*seen, noise, steps, inverse, *given, some, lost)

    for k, label in enumerate(labels):
        own = data.fold == label
        rest = data.weight * (~own if not own.all() else 1)
        steps = Transition.along(jacobian, rest, evaluation.predictions.late, latent)
        noise = estimate(error, rest, steps, mass, data.dt, estimated=False, known=data.known)
        levels[k] = noise.diffusion
        best = score(own, noise, steps)
        judged.append((own, rest, steps, best))
        for i in np.flatnonzero(believed > 0):
            other = noise.with_diffusion({int(i): believed[i]})
            gain[i, own] = best - score(own, other, steps)
    found, n = [], len(labels)
    for i in np.flatnonzero(believed > 0):
        if gain[i].sum() > least:
            for own, rest, steps, best in judged:
                held = {int(i): believed[i]}
                given = mass, data.dt, held, False, data.known
                other = estimate(error, rest, steps, *given)
                gain[i, own] = best - score(own, other, steps)
        spread = np.sqrt((n - 1) / n * np.sum((levels[:, i] - levels[:, i].mean()) ** 2))
        change = float(evaluation.noise.diffusion[i] / believed[i] - 1)
        error_of = {"change": float(max(spread, evaluation.noise.error[i]) / believed[i])}
        law = Law(LEVEL, AXES[i], {"change": change}, gain[i], errors=error_of)
        found.append(law)
    return found


def levels_with_slow_noise(
    levels: Sequence[Law], problem: DiagnosisProblem, evaluation: Evaluation, least: float
) -> list[Law]:
    """Levels that hold in a fit with slow disturbances, with the level estimated there.

    Holding the believed one loses more than `least` nats, and the change keeps its sign.
    """
    data, believed = problem.data, believed_levels(problem)
    p = evaluation.predictions
    steps = Transition.along(np.asarray(p.jacobian), data.weight, p.late, p.latent)
    inverse = np.linalg.inv(problem.mass(evaluation.theta))
    left, lost = fit_with_slow_noise(
        np.asarray(p.error),
        data.clean,
        steps,
        unit_processes(steps, inverse, data.dt),
        _pushed(steps, inverse, data.dt),
        data.dt,
        np.concatenate([evaluation.noise.record, evaluation.noise.diffusion]) ** 2,
        believed,
        [AXES.index(law.where) for law in levels],
    )
    found = []
    for law in levels:
        i = AXES.index(law.where)
        change = float(left[i] / believed[i] - 1)
        if lost[i] > least and change * law.parameters["change"] > 0:
            share = min(1.0, lost[i] / law.heldout_gain)
            found.append(replace(law, parameters={"change": change}, heldout=share * law.heldout))
    return found


def process_share(problem: DiagnosisProblem, evaluation: Evaluation) -> Float[np.ndarray, "6"]:
    """Share of the variance of each twist's innovation due to process noise on its axis."""
    p = evaluation.predictions
    steps = Transition.along(np.asarray(p.jacobian), problem.data.weight, p.late, p.latent)
    inverse = np.linalg.inv(problem.mass(evaluation.theta))
    own = unit_processes(steps, inverse, problem.data.dt)
    own *= evaluation.noise.diffusion[:, None, None] ** 2
    # whitened squares are divided by `memory`: undo that
    whiten = evaluation.kalman.whiten.mean(axis=-1) * np.sqrt(evaluation.kalman.memory)[:, None]
    P = np.zeros_like(own)
    for keep in evaluation.kalman.keep.mean(axis=-1):
        A = steps.mean @ keep
        P = A @ P @ A.T + own
    axis = np.arange(6)
    return np.clip((whiten[-1] @ P @ whiten[-1].T)[axis, 6 + axis, 6 + axis], 0.0, 1.0)


def _pushed(
    transition: Transition, mass_inverse: Float[np.ndarray, "6 6"], dt: float
) -> Float[np.ndarray, "6 12"]:
    """One-step error under a constant unit wrench: ∫ exp(J s) ds [0; M⁻¹]."""
    J = np.real(scipy.linalg.logm(transition.mean)) / dt
    both = np.zeros((18, 18))
    both[:12, :12] = J
    both[:6, 12:] = -transition.late[:, None] * mass_inverse
    both[6:12, 12:] = mass_inverse
    return scipy.linalg.expm(both * dt)[:12, 12:].T
