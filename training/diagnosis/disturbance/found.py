"""Disturbance laws of the residual: which are found, and which are reported."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ....models.effects.library import kind
from ....models.effects.noise import (
    DisturbanceColour,
    DisturbanceImpacts,
    DisturbanceStateDependence,
)
from ....models.effects.water import CurrentSteady, CurrentVarying
from ....models.se3 import AXES
from ..data.repeats import repeating
from ..filter.noise import estimate
from ..filter.problem import DiagnosisProblem, Evaluation
from ..filter.transition import Transition
from ..selection.model_selection import margin
from ..validation.validation import white_part
from .edges import without_commanded
from .estimator import is_estimators
from .laws import Law, estimated, find_laws, growth_alone, run_constants
from .levels import LEVEL, find_levels, levels_with_slow_noise, process_share
from .waves import are_waves, find_current, find_waves

_IMPACT = 4.0
"""Standard deviations beyond which an error counts as an impact."""
_SHORTEST, _SMALLEST = 3.0, 0.1
"""Least time constant of a colour (steps), and least relative change of a level."""
_MOST_AXES = 3
"""Number of axes with repeating errors from which randomly moving water is ruled out."""
_AS_WELL = 1.0
"""Nats that growth with the speed may win less than a level and still explain it."""
OF_OTHERS = 1e-3
"""Share of other findings' gain that a law must win: they leave a residual of that order."""


def laws_of(problem: DiagnosisProblem, evaluation: Evaluation) -> list[Law]:
    """Disturbance laws of the residual, largest gain first.

    None where states were estimated: errors of an estimator are no disturbance.
    """
    if evaluation.noise.estimated:
        return []
    data = problem.data
    speed = np.linalg.norm(data.V[:-1, :3], axis=1)
    found = find_laws(
        evaluation.z.astype(float),
        speed,
        data.weight,
        data.fold,
        data.dt,
        process_share(problem, evaluation),
        data.known,
    )
    rows = problem.library.at(CurrentSteady.name, "W")
    evidence = evaluation.plain
    if rows and set(rows) <= set(evidence.design.owner.tolist()) and len(evidence.runs) > 2:
        columns = [evidence.column(i) for i in rows]
        sizes = np.array([problem.library.entries[i].parameter.probes[0] for i in rows])
        gain, values, loss = run_constants(evidence.runs, columns, sizes, evidence.fold)
        found.append(Law(CurrentVarying.name, "W", values, gain, loss))
    return sorted(found, key=lambda law: -law.heldout_gain)


def won_by(name: str, laws: Sequence[Law]) -> float:
    """Gain of a law on all axes together (nats)."""
    return sum((max(law.heldout_gain, 0.0) for law in laws if law.name == name), 0.0)


def best_law(problem: DiagnosisProblem, evaluation: Evaluation) -> float:
    """Held-out gain of the best disturbance law (nats)."""
    return max((law.heldout_gain for law in laws_of(problem, evaluation)), default=0.0)


def all_laws(problem: DiagnosisProblem, evaluation: Evaluation, least: float) -> list[Law]:
    """Disturbance laws of the residual, waves and level included, largest gain first.

    Slow laws that an estimator's errors imitate are left out, and laws of axes whose velocity was
    not measured: an accelerometer's own errors look like them.
    """
    unmeasured = {AXES[i] for i in problem.data.latent}
    found = [
        law
        for law in laws_of(problem, evaluation)
        if law.where not in unmeasured and not is_estimators(law, problem, evaluation)
    ]
    found = without_commanded(found, problem, evaluation, least)
    alike = repeating(evaluation.z, problem.data)
    slow = [law for law in found if law.name == DisturbanceColour.name]
    if not unmeasured and max((law.heldout_gain for law in slow), default=0.0) > least:
        waves, current = find_waves(problem, evaluation), find_current(problem, evaluation)
        if are_waves(waves, slow):
            found.append(waves)
        # one motion of the water against disturbances by axis, or against a constant current
        stays = won_by(CurrentVarying.name, found)
        if current.heldout_gain > max(won_by(DisturbanceColour.name, slow), stays + margin(stays)):
            found = [law for law in found if law.name != CurrentVarying.name]
            found.append(current)
    # errors that repeat with the commands are not random
    water = {"W"} if len(alike) >= _MOST_AXES else set()
    found = [law for law in found if not kind(law.name).slow or law.where not in {*alike, *water}]
    found += find_levels(problem, evaluation, least)
    return sorted(found, key=lambda law: -law.heldout_gain)


def passing(laws: Sequence[Law], problem: DiagnosisProblem, least: float) -> list[Law]:
    """Laws that win more than `least` nats and that errors of the noise levels can't imitate."""
    return [law for law in laws if law.heldout_gain > least and _is_apart(law, problem)]


def reported_laws(
    laws: Sequence[Law], problem: DiagnosisProblem, evaluation: Evaluation, least: float
) -> list[list[Law]]:
    """Which of the laws that pass are reported, in groups of one name each, largest first.

    Of laws with a structure one name is reported. Each of them changes levels: a slow one biases
    the estimate of b, an intermittent one is part of it. A level is reported with a slow law if the
    believed level loses more than `least` nats in a fit with slow disturbances; with growth with
    the speed if growth alone explains less than the level alone, with impacts if it holds between
    them, and with either only if it is the larger part of the change. A structure must win more
    than the residual that the level leaves.
    """
    passed = passing(laws, problem, least)
    levels = [law for law in passed if law.name == LEVEL]
    shaped = [law for law in passed if law.name != LEVEL]
    if not shaped:
        return [levels] if levels else []
    shaped = [law for law in shaped if law.name == shaped[0].name]
    if shaped[0].name == DisturbanceStateDependence.name:
        shaped, levels = _grown(laws, shaped, levels, problem, evaluation)
    if levels and kind(shaped[0].name).slow:
        levels = levels_with_slow_noise(levels, problem, evaluation, least)
    kept = []
    for law in levels:
        rest = _remaining_level(law, shaped, problem, evaluation)
        if rest is not None and _is_apart(rest, problem):
            kept.append(rest)
    if not kept:
        return [shaped]
    least = OF_OTHERS * sum(law.heldout_gain for law in kept)
    structured = [law for law in shaped if law.heldout_gain > least]
    both = [kept, structured] if structured else [kept]
    return sorted(both, key=lambda group: -group[0].heldout_gain)


def _remaining_level(
    law: Law, shaped: Sequence[Law], problem: DiagnosisProblem, evaluation: Evaluation
) -> Law | None:
    """A level with the change that laws of one name leave to it, or None if they explain it."""
    i, name = AXES.index(law.where), shaped[0].name
    if kind(name).slow:
        return law
    own = [other for other in shaped if other.where == law.where]
    if not own:
        return law
    all_of_it = 1 + law.parameters["change"]
    if name == DisturbanceImpacts.name:
        rest = all_of_it * _without_impacts(problem, evaluation)[i] / evaluation.noise.diffusion[i]
    else:
        rest = all_of_it * float(white_part(own, problem)[i])
    if abs(np.log(rest)) < abs(np.log(all_of_it / rest)):
        return None
    return replace(law, parameters={"change": float(rest - 1)})


def _grown(
    laws: Sequence[Law],
    shaped: Sequence[Law],
    levels: Sequence[Law],
    problem: DiagnosisProblem,
    evaluation: Evaluation,
) -> tuple[list[Law], list[Law]]:
    """Laws of growth with the speed, and the levels that remain.

    Where growth from the believed levels wins more than levels without it, levels of these axes are
    part of it, and so are those of other axes that growth explains as well. Growth is reported on
    those others where it wins on data left out.
    """
    data = problem.data
    speed = np.linalg.norm(data.V[:-1, :3], axis=1)
    share, won = process_share(problem, evaluation), {}
    for law in levels:
        i, rest = AXES.index(law.where), 1 / (1 + law.parameters["change"])
        z = evaluation.z[:, 6 + i].astype(float)
        weight = data.weight if data.known is None else data.weight * data.known[:, 6 + i]
        won[law.where] = growth_alone(z, speed, weight, rest, share[i])
    grows = {law.where for law in shaped}
    if sum(won.get(axis, 0.0) for axis in grows) <= 0:
        return list(shaped), list(levels)
    also = {axis for axis, gain in won.items() if gain > -_AS_WELL} - grows
    of_others = [law for law in laws if law.name == shaped[0].name and law.where in also]
    more = [law for law in of_others if law.heldout_gain > 0 and law.parameters["growth"] > 0]
    return [*shaped, *more], [law for law in levels if law.where not in grows | also]


def _without_impacts(problem: DiagnosisProblem, evaluation: Evaluation) -> Float[np.ndarray, "6"]:
    """Diffusion estimated from steps without an impact in them or in a neighbouring step."""
    data = problem.data
    error, jacobian = (
        np.asarray(evaluation.predictions.error),
        np.asarray(evaluation.predictions.jacobian),
    )
    exists = data.weight > 0
    spread = 1.4826 * np.median(np.abs(error[:, 6:].swapaxes(1, 2)[exists]), axis=0)
    hit = np.any(np.abs(error[:, 6:]) > _IMPACT * spread[:, None], axis=1)
    near = hit.copy()
    near[1:] |= hit[:-1]
    near[:-1] |= hit[1:]
    weight = data.weight * ~near
    steps = Transition.along(
        jacobian, weight, evaluation.predictions.late, evaluation.predictions.latent
    )
    mass = problem.mass(evaluation.theta)
    given = mass, data.dt, None, False, data.known
    return estimate(error, weight, steps, *given).diffusion


def _is_apart(law: Law, problem: DiagnosisProblem) -> bool:
    """Whether errors of the noise levels alone can't imitate a law."""
    if law.name == DisturbanceColour.name and law.loss is not None:
        return (
            float(np.exp(estimated(law, problem.data.cluster)[0][0])) > _SHORTEST * problem.data.dt
        )
    if law.name == LEVEL:
        return abs(law.parameters["change"]) > _SMALLEST
    return True
