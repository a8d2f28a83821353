"""Impacts that are no independent law: they come where the thrust steps, or may be wrong by a step.

Of thrusters that follow their commands in steps, a command near an edge may be taken for the next
step, as the step's size is known to a share, and commands as they were logged. Commands that were
logged as samples of faster ones may have stepped at any time between two of them, and states that
were recorded at some rate are interpolated where the vehicle jerks. Such an error acts for one step
of the records and is as large as a step of the thrust: it looks like an impact. Impacts from
outside do not know the commands: half of their gain lies in the half of the samples that are
farther from such places.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ....models.effects.noise import DisturbanceImpacts
from ....models.effects.unknown import Unknown
from ....models.se3 import AXES
from ..data.arrays import Data
from ..filter.problem import DiagnosisProblem, Evaluation
from .laws import Law, impacts


def without_commanded(
    laws: Sequence[Law], problem: DiagnosisProblem, evaluation: Evaluation, least: float
) -> list[Law]:
    """The laws, but of impacts only those that win half of `least` nats far from such places."""
    data, kept = problem.data, []
    places = [_from_edges(problem, evaluation.theta), _from_changes(data)]
    halves = [_farther_half(distance, data) for distance in places if distance is not None]
    for law in laws:
        if law.name == DisturbanceImpacts.name and law.heldout_gain > least:
            i = 6 + AXES.index(law.where)
            there = data.weight if data.known is None else data.weight * data.known[:, i]
            z = evaluation.z[:, i].astype(float)
            gains = [2 * float(impacts(z, there * far, data.fold)[0].sum()) for far in halves]
            if any(gain <= least for gain in gains):
                continue
        kept.append(law)
    return kept


def _farther_half(distance: Float[np.ndarray, "N R"], data: Data) -> Float[np.ndarray, "N R"]:
    """1 for the half of the samples at the greatest distances.

    A command acts on the errors of its own step and, through delays between instruments, of the
    next one.
    """
    distance = distance.copy()
    distance[1:] = np.minimum(distance[1:], distance[:-1])
    return (distance > np.median(distance[data.weight > 0])).astype(float)


def _from_edges(
    problem: DiagnosisProblem, theta: Float[np.ndarray, " p"]
) -> Float[np.ndarray, "N R"] | None:
    """Distances (N) of commands from edges of thrust that acts in steps; None without steps."""
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
    return distance if np.isfinite(distance).any() else None


def _from_changes(data: Data) -> Float[np.ndarray, "N R"] | None:
    """Minus the change (N) of sampled commands beside each step; None where they are exact."""
    if not data.sampled:
        return None
    change = np.linalg.norm(np.diff(data.u, axis=0), axis=1)
    none = np.zeros_like(change[:1])
    return -np.maximum(np.concatenate([none, change]), np.concatenate([change, none]))
