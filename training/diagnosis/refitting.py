"""The believed model with coefficients refitted before any cause is sought (`refit`)."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from ...models.config.errors import UserError
from .filter.problem import DiagnosisProblem, Evaluation
from .selection.refit_all import identify
from .selection.search import Refit, refitted

_ALONG, _AGREE = 4, 0.01
"""Most simulations of latent velocities under refitted coefficients, and the change of velocities
(share) at which they agree with these."""


def believed(problem: DiagnosisProblem) -> Evaluation:
    """The believed model.

    Raises:
        UserError: it is unstable on these data.
    """
    try:
        return problem.evaluate(problem.believed)
    except FloatingPointError as error:
        raise UserError(
            f"{error} within a step of {problem.data.longest:.3g} s from recorded states: the "
            "believed model is unstable on these data; check units of commands and twists, or "
            "give a --vehicle or --model that is near"
        ) from error


def with_refitted(
    problem: DiagnosisProblem, how: Refit, progress: Callable[[float], None]
) -> tuple[DiagnosisProblem, Evaluation, Evaluation]:
    """The problem, and in it the believed model and the one with refitted coefficients.

    What has no record follows from the coefficients, and where the vehicle is tilted the heave
    velocity of a climb follows from it. Where velocities were not measured the problem is about
    those that agree with the coefficients that they lead to.
    """
    if not problem.data.latent:
        return problem, believed(problem), _fitted(problem, how, progress)
    first = _fitted(problem, how, _part(progress, 0))
    for number in range(1, _ALONG + 1):
        before = problem.data.V
        problem = problem.along(first.theta)
        first = _fitted(problem, how, _part(progress, number), first.theta)
        if np.std(problem.data.V - before) < _AGREE * np.std(before):
            break
    return problem, believed(problem), first


def _part(progress: Callable[[float], None], number: int) -> Callable[[float], None]:
    """Progress of a fit that is followed by others: each takes half of what is left."""
    return lambda fraction: progress(1 - 0.5**number * (1 - fraction / 2))


def _fitted(
    problem: DiagnosisProblem,
    how: Refit,
    progress: Callable[[float], None],
    start: Float[np.ndarray, " p"] | None = None,
) -> Evaluation:
    """The believed model with the coefficients fitted, from `start` on."""
    if how == "all":
        return problem.evaluate(identify(problem, progress, start))
    start = problem.believed if start is None else start
    return problem.evaluate(problem.polish(start, refitted(problem, how))[0])
