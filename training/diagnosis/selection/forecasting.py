"""Causes by their forecasts, for states that were estimated.

One-step errors of an estimator's states are partly the estimator's own, last, and depend on the
motion, so a significant gain in them may be no physics. Over seconds these errors stay bounded,
while those of forces add up: a cause counts if data left out of its fit are forecast better by a
practical size.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..filter.problem import Evaluation
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
        contender = Contender(problem.without_each(seen, rows))
        return forecast_square(problem, contender, horizon, in_use, estimated=True)

    before, found = square(state.current, taken), {}
    for h in names:
        rows = [*problem.library.at(*h), *taken]
        start = fits[h].added_to(state.current.theta)
        _, seen, _ = problem.polish(start, rows, None, origin=state.current)
        if improves(square(seen, rows), before, np.random.default_rng(0)):
            found[h] = fits[h]
    return found
