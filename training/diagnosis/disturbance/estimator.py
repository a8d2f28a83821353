"""What errors of the estimator that recorded the states imitate.

Recorded velocities and attitudes of an estimator have errors that last for tenths of seconds to
seconds. Through drag, Munk's moment and the restoring moment they act in predictions like a slow
disturbance of that size, and no datum tells the two apart.
"""

import numpy as np
from jaxtyping import Float

from ....models.effects.noise import DisturbanceColour
from ....models.effects.water import CurrentVarying
from ....models.se3 import AXES
from ..filter.problem import DiagnosisProblem, Evaluation
from ..filter.transition import Transition
from .laws import Law, estimated

_VELOCITY = 0.02
"""Prior standard deviation of an estimator's velocity error (m/s): those of a DVL with an inertial
sensor are 0.3 to 2 cm/s."""
_LASTS = 4.0
"""Time (s) that its attitude error is taken to last; with the slip this gives the error's size."""


def is_estimators(law: Law, problem: DiagnosisProblem, evaluation: Evaluation) -> bool:
    """Whether errors of the estimator that recorded the states explain a slow law."""
    noise = evaluation.noise
    if not np.any(noise.slip > 0):
        return False
    if law.name == CurrentVarying.name:
        return law.parameters["std"] < _VELOCITY
    if law.name != DisturbanceColour.name or law.parameters["kappa"] <= 0:
        return False
    tau, kappa = np.exp(estimated(law, problem.data.cluster)[0])
    size = colour_size(tau, kappa, problem, evaluation, law.where)
    return bool(size < imitated_wrench(problem, evaluation)[AXES.index(law.where)])


def imitated_wrench(problem: DiagnosisProblem, evaluation: Evaluation) -> Float[np.ndarray, "6"]:
    """Standard deviation of the wrench that the estimator's errors imitate (N, N·m)."""
    p, data = evaluation.predictions, problem.data
    steps = Transition.along(np.asarray(p.jacobian), data.weight, p.late, p.latent)
    attitude = evaluation.noise.slip[3:] * np.sqrt(_LASTS / 2)
    errors = np.concatenate([np.zeros(3), attitude, np.full(3, _VELOCITY), np.zeros(3)])
    apart = steps.mean - np.eye(12)
    square = apart @ np.diag(errors**2) @ apart.T + steps.added(np.diag(errors**2))
    acceleration = square[6:, 6:] / data.dt**2
    mass = problem.mass(evaluation.theta)
    return np.sqrt(np.diag(mass @ acceleration @ mass.T))


def colour_size(
    tau: float, kappa: float, problem: DiagnosisProblem, evaluation: Evaluation, axis: str
) -> float:
    """Standard deviation (N, N·m) of a slow disturbance with an ARMA(1, 1)'s parameters."""
    kappa = min(kappa, 0.99)
    rho = np.exp(-problem.data.dt / tau)
    square = (kappa / (1 - kappa) - rho**2 * kappa) / (1 - rho**2)
    return float(np.sqrt(max(square, 0.0)) / unit_responses(problem, evaluation, axis)[1])


def unit_responses(
    problem: DiagnosisProblem, evaluation: Evaluation, axis: str
) -> tuple[float, float]:
    """Whitened innovation on an axis after a unit impulse; its steady state under a unit wrench."""
    if axis not in AXES:
        return 1.0, 1.0
    i, dt = AXES.index(axis), problem.data.dt
    a = np.linalg.inv(problem.mass(evaluation.theta))[:, i]
    d = np.concatenate([dt * dt / 2 * a, dt * a])
    w = problem.data.weight
    A = np.einsum("nijr,nr->ij", np.asarray(evaluation.predictions.jacobian), w) / w.sum()
    white, keep = (k[-1].mean(axis=-1) for k in (evaluation.kalman.whiten, evaluation.kalman.keep))
    lasting = np.linalg.solve(np.eye(12) - A @ keep, d)
    return abs(float((white @ d)[6 + i])) / dt, abs(float((white @ lasting)[6 + i]))
