"""Causes and unmodelled structure, in the order in which they are sought and as reported."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ...models.effects.base import Effect
from ...models.effects.library import Library
from ...models.effects.unknown import Unknown
from .candidates.unknowns import (
    FoundStructure,
    add_structure,
    described_structure,
    find_structure,
)
from .changes.accept import with_changes
from .disturbance.found import best_law, passing
from .disturbance.laws import Law
from .filter.problem import DiagnosisProblem, Evaluation
from .findings import reported, result
from .findings.experiments import experiments
from .selection.hypotheses import Fit
from .selection.model_selection import Hypothesis, parameters_of
from .selection.search import Refit, Search, refitted
from .selection.state import Selection

Progress = Callable[[float, str], None]
_MOST_UNKNOWN, _NAMES_FIRST = 2, 2
"""Most unmodelled structures, and number of causes after which the first is sought where more
causes pass: unmodelled structure can mimic several named causes."""
_RIVALS = 0.25
"""Share of the best law's gain below which unmodelled structure is sought before causes."""
LAW_MARGIN = 5.0
"""Extra nats that a law must win: margin for the grid search's multiple comparisons."""


def within(progress: Progress, low: float, high: float) -> Progress:
    """Progress of a part, from `low` to `high` of the whole."""
    return lambda fraction, remark: progress(low + (high - low) * fraction, remark)


def find_causes(
    state: Selection,
    nuisance: list[int],
    refit: Refit,
    search_for: Callable[[DiagnosisProblem, list[int]], Search],
    progress: Progress,
) -> tuple[Selection, list[int], dict[Hypothesis, result.Structure]]:
    """Causes, unmodelled structure (a new effect in the library), and further causes.

    Where a disturbance law wins far more than any cause, structure is sought first; where more
    than two causes are needed, it is sought before the third. Also returned are the nuisance
    parameters in the library that came about, and the structures by hypothesis.
    """
    structures: dict[Hypothesis, result.Structure] = {}
    search, part = search_for(state.problem, nuisance), within(progress, 0.1, 0.5)
    state, problem, seen = _first_causes(state, search, part)
    if seen is None:
        state, problem = _with_changes(state, search, part)
    for number in range(_MOST_UNKNOWN):
        progress(0.52 + 0.1 * number, "unmodelled structure")
        if seen is None:
            state, seen = find_structure(state, nuisance, search.alpha, search.quiet)
        taken = {e.places[0] for e in problem.library.effects if e.name == Unknown.name}
        if seen is None or seen.matched.group.effect.acts_on in taken:
            if number == 0 and not state.accepted:
                state = search.run(state, progress=part)
            break
        state = add_structure(replace(state, problem=problem), nuisance, seen)
        nuisance = refitted(state.problem, refit)
        structures[state.hypotheses[-1]] = described_structure(state, seen)
        search = search_for(state.problem, nuisance)
        part = within(progress, 0.55 + 0.1 * number, 0.6 + 0.1 * number)
        state, seen = search.run(state, progress=part), None
        problem = state.problem
    return state, nuisance, structures


def _with_changes(
    state: Selection, search: Search, progress: Progress
) -> tuple[Selection, DiagnosisProblem]:
    """With causes that act in a part of the data, and any further ones that then pass."""
    changed = with_changes(state, search)
    if changed is not state:
        changed = search.run(changed, progress=progress)
    return changed, changed.problem


def _first_causes(
    state: Selection, search: Search, progress: Progress
) -> tuple[Selection, DiagnosisProblem, FoundStructure | None]:
    """Causes before any structure, or the structure that replaces them.

    The problem returned has the noise of the causes found, and not of one that was proposed only:
    structure is added in that noise.
    """
    problem, state = state.problem, search.propose(state)
    choice, fits = state.proposed
    state = replace(state, fits=fits, left=fits)
    best = 0.0 if choice is None else choice.fit.heldout_gain
    if _RIVALS * best_law(problem, state.first) >= max(best, state.threshold + LAW_MARGIN):
        return state, problem, None
    state, seen = search.run(state, _NAMES_FIRST, progress), None
    problem = state.problem
    if len(state.accepted) == _NAMES_FIRST:
        state = search.propose(state)
        choice, fits = state.proposed
        if choice is not None:
            state = replace(state, left=fits)
            state, seen = find_structure(state, search.nuisance, search.alpha, search.quiet)
    if seen is not None and not state.accepted:
        return state, problem, seen
    state = search.run(state, progress=progress)
    return state, state.problem, None


def reported_causes(
    found: Selection,
    nuisance: Sequence[int],
    structures: Mapping[Hypothesis, result.Structure],
    final: Evaluation,
    joint: Fit | None,
    progress: Progress,
) -> list[result.Cause]:
    """The causes found, each with the experiment that would confirm it; none without a fit."""
    if joint is None:
        return []
    progress(0.8, "what to do next")
    problem = found.problem
    following = experiments(problem, final, found.accepted, nuisance)
    return [
        reported.cause(
            a.apart_from(found.hypotheses),
            problem,
            final,
            joint,
            following[a.hypothesis],
            structures.get(a.hypothesis),
        )
        for a in found.accepted
    ]


JointFit = tuple[np.ndarray, Evaluation, Fit | None]
"""θ, its evaluation, and the fit; None without parameters."""


def supported(
    found: Selection,
    nuisance: Sequence[int],
    rows: list[int],
    together: Callable[[Selection, list[int]], JointFit],
) -> tuple[Selection, list[int], JointFit]:
    """The causes that a joint fit bears out, all parameters, and the fit."""
    problem, fit = found.problem, together(found, rows)
    while dropped := unsupported(problem.library, found.hypotheses, fit[0], fit[2]):
        theta = found.current.theta.copy()
        theta[parameters_of(problem.library, dropped)] = 0.0
        kept = tuple(a for a in found.accepted if a.hypothesis not in dropped)
        found = found.at(problem.evaluate(theta), accepted=kept)
        rows = reported.joint_rows(found, nuisance, problem)
        fit = together(found, rows)
    return found, rows, fit


def unsupported(
    library: Library, named: Sequence[Hypothesis], theta: Float[np.ndarray, " p"], joint: Fit | None
) -> list[Hypothesis]:
    """Causes that the joint fit does not bear out.

    Every interval includes no effect, or a parameter lies at a bound of its range other than no
    effect: then it stands for something else. Weights of terms without a range are no parameters.
    """
    if joint is None:
        return []
    t = reported.quantile(joint)
    dropped: list[Hypothesis] = []
    for h in named:
        rows = library.at(*h)
        if h[0] == Unknown.name and not all(library.entries[i].parameter.low == 0 for i in rows):
            continue
        values = theta[rows]
        errors = np.array([joint.errors[joint.parameters.index(i)] for i in rows])
        ranges = [library.entries[i].parameter for i in rows]
        ends = np.array([(p.low, p.high) for p in ranges])
        at_end = (ends != 0) & np.isclose(values[:, None], ends, rtol=1e-6)
        if np.all(np.abs(values) < t * errors) or at_end.any():
            dropped.append(h)
    return dropped


def law_causes(
    groups: Sequence[Sequence[Law]],
    laws: Sequence[Law],
    least: float,
    final: Evaluation,
    problem: DiagnosisProblem,
) -> tuple[list[result.Cause], tuple[Effect, ...]]:
    """Groups of laws as causes and effects, with the other laws that pass as rivals."""
    causes, effects, passed = [], [], passing(laws, problem, least)
    for group in groups:
        rivals = [law for law in passed if law.name != group[0].name]
        cause, effect = reported.law_cause(group, rivals, problem, final)
        causes.append(cause)
        effects.append(effect)
    return causes, tuple(effects)
