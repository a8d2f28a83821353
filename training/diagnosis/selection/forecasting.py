"""Causes by their forecasts, for states that were estimated.

One-step errors of an estimator's states are partly the estimator's own, last, and depend on the
motion, so a significant gain in them may be no physics. Over seconds these errors stay bounded,
while those of forces add up: a cause counts if data left out of its fit are forecast better by a
practical size.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..filter.problem import DiagnosisProblem, Evaluation
from ..filter.varying import parts_of
from ..validation.claims import improves
from ..validation.simulation import Contender
from ..validation.validation import forecast_square
from .model_selection import Hypothesis, parameters_of
from .state import Fits, Selection


def forecast_better(
    state: Selection,
    nuisance: Sequence[int],
    names: Sequence[Hypothesis],
    fits: Fits,
    horizon: float,
) -> Fits:
    """The fits of those causes that forecast better than the causes accepted so far without them.

    Each is fitted jointly with `nuisance` and the accepted causes; forecasts are over `horizon` s.
    """
    problem = state.problem
    taken = [*nuisance, *parameters_of(problem.library, state.hypotheses)]
    in_use = [*taken, *parameters_of(problem.library, names)]  # so that one program judges all

    def square(seen: Evaluation, rows: list[int]) -> Float[np.ndarray, "h g F"]:
        return _square(problem, seen, rows, horizon, in_use)

    before, found = square(state.current, taken), {}
    for h in names:
        rows = [*problem.library.at(*h), *taken]
        start = fits[h].added_to(state.current.theta)
        _, seen, _ = problem.polish(start, rows, None, origin=state.current)
        if improves(square(seen, rows), before, np.random.default_rng(0)):
            found[h] = fits[h]
    return found


def part_forecasts_better(
    state: Selection, before: Selection, nuisance: Sequence[int], horizon: float
) -> bool:
    """Whether the last cause, which acts in a part of the data, improves forecasts there.

    `before` is the selection without it.
    """
    problem = state.problem
    part = parts_of(problem.library)[-1]
    rows = [*nuisance, *parameters_of(problem.library, state.hypotheses)]
    taken = [*nuisance, *parameters_of(problem.library, before.hypotheses)]
    without = problem.evaluate(problem.moved(before.current.theta, before.problem.library), taken)
    acts = (np.abs(part.envelope[:-1]) * problem.data.weight).sum(axis=0) > 0
    labels = np.unique(problem.data.fold)
    here = np.isin(labels, problem.data.fold[acts])
    both = (problem.evaluate(state.current.theta, rows), rows), (without, taken)
    new, old = (_square(problem, seen, own, horizon, rows)[..., here] for seen, own in both)
    return improves(new, old, np.random.default_rng(0))


def _square(
    problem: DiagnosisProblem,
    seen: Evaluation,
    rows: list[int],
    horizon: float,
    in_use: Sequence[int],
) -> Float[np.ndarray, "h g F"]:
    contender = Contender(problem.without_each(seen, rows))
    return forecast_square(problem, contender, horizon, in_use, estimated=True)
