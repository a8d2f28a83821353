"""Impacts that are no independent law: errors where thrust that acts in steps is about to step.

Of thrusters that follow their commands in steps, a command near an edge may be taken for the next
step, as the step's size is known to a share, and commands as they were logged. Such an error acts
for one step of the records and is as large as a step of the thrust: it looks like an impact.
Impacts from outside do not know the commands: half of their gain lies in the half of the samples
that are farther from the edges.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ....models.effects.noise import DisturbanceImpacts
from ....models.effects.unknown import Unknown
from ....models.se3 import AXES
from ..filter.problem import DiagnosisProblem, Evaluation
from .laws import Law, impacts


def without_rounding(
    laws: Sequence[Law], problem: DiagnosisProblem, evaluation: Evaluation, least: float
) -> list[Law]:
    """The laws without impacts that win less than `least` nats by what is far from edges, twice."""
    far = _far_from_edges(problem, evaluation.theta)
    if far is None:
        return list(laws)
    data, kept = problem.data, []
    for law in laws:
        if law.name == DisturbanceImpacts.name and law.heldout_gain > least:
            i = 6 + AXES.index(law.where)
            weight = data.weight * far
            weight = weight if data.known is None else weight * data.known[:, i]
            gain = impacts(evaluation.z[:, i].astype(float), weight, data.fold)[0]
            if 2 * float(gain.sum()) <= least:
                continue
        kept.append(law)
    return kept


def _far_from_edges(
    problem: DiagnosisProblem, theta: Float[np.ndarray, " p"]
) -> Float[np.ndarray, "N R"] | None:
    """1 for the half of the samples whose commands are far from edges; None without steps.

    A command acts on the errors of its own step and, through delays between instruments, of the
    next one.
    """
    library, data = problem.library, problem.data
    distance = np.full(data.weight.shape, np.inf)
    for effect in library.effects:
        if isinstance(effect, Unknown) and effect.kind == "steps":
            if not np.any(theta[library.at(effect.name, effect.acts_on)]):
                continue
            u, step = data.u, effect.numbers[0]
            if effect.acts_on != "thrusters":
                u = u[:, [int(effect.acts_on) - 1]]
            away = step * np.abs(u / step - np.floor(u / step) - 0.5)
            distance = np.minimum(distance, away.min(axis=1))
    if not np.isfinite(distance).any():
        return None
    distance[1:] = np.minimum(distance[1:], distance[:-1])
    return (distance > np.median(distance[data.weight > 0])).astype(float)
