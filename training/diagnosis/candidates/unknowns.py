"""Acceptance of `unknown`: structure that no cause, nor all causes together, explain as well."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ....models.effects.unknown import Unknown
from ....models.se3 import AXES
from ..disturbance.found import best_law
from ..filter.problem import DiagnosisProblem, Evaluation
from ..findings import result
from ..selection.hypotheses import Design, Fit
from ..selection.model_selection import Choice, Hypothesis, admissible, parameters_of
from ..selection.state import OF_ESTIMATES, Fits, Selection
from .groups import described, groups, refined
from .structures import Matched, Screen

BEATS = 1.5
"""Multiple of the best cause's gain that unmodelled structure must win."""
_TOGETHER, _OF_A_LAW = 1.1, 0.7
"""Multiple of the joint gain of all causes, and share of the best law's gain, that it must win."""


@dataclass(frozen=True)
class FoundStructure:
    """The best structure at one θ, its gain in nats of all data, and the best cause's gain."""

    screen: Screen
    matched: Matched
    gain: float
    name_gain: float


def sensitivities_of(
    problem: DiagnosisProblem, evaluation: Evaluation, rows: list[int]
) -> Float[np.ndarray, "m N12 R"] | None:
    """Whitened sensitivities to parameters, one small probe each."""
    if not rows:
        return None
    probes = Design.one_each(problem.library, evaluation.theta, rows).probes
    return problem.whitened(evaluation, probes)[1:]


def screened(
    problem: DiagnosisProblem,
    evaluation: Evaluation,
    rows: list[int],
    alpha: float,
    rng: np.random.Generator,
    quiet: Sequence[str] = (),
) -> tuple[Screen, Matched, float] | None:
    """The structure that wins most with `rows` free, of those significant against noise alone.

    In estimated states it is sought on the way from commands to forces alone: the estimator adds
    structure of its own to motion, and none to commands.
    """
    screen = Screen(problem, evaluation, sensitivities_of(problem, evaluation, rows))
    share = problem.data.steps / problem.data.weight[:, screen.kept].sum()
    tried = list(groups(problem, evaluation, quiet, of_commands=evaluation.noise.estimated))
    best: Matched | None = None
    for group in tried:
        m = screen.match(group, alpha / len(tried), rng)
        if m.gain > m.threshold and (best is None or m.gain > best.gain):
            best = m
    if best is None:
        return None
    # Bonferroni over the groups tried
    best = replace(best, p_value=min(1.0, best.p_value * len(tried)))
    return screen, best, best.gain * share


def _best_name(problem: DiagnosisProblem, evaluation: Evaluation, fits: Fits) -> float:
    return max([0.0, *(gain for _, gain in _admissible(problem, evaluation, fits))])


def _admissible(
    problem: DiagnosisProblem, evaluation: Evaluation, fits: Fits
) -> list[tuple[Hypothesis, float]]:
    """Names with estimates in their ranges, and their held-out gains, largest first."""
    gains = [
        (h, f.heldout_gain)
        for h, f in fits.items()
        if admissible(problem.library, evaluation.theta, f)
    ]
    return sorted(gains, key=lambda item: -item[1])


def find_structure(
    state: Selection, nuisance: Sequence[int], alpha: float, quiet: Sequence[str] = ()
) -> tuple[Selection, FoundStructure | None]:
    """Structure in the residual of the causes; where it wins more than they do, in place of them.

    In the second case the selection is back at the model without causes. None is sought in how
    `quiet` axes and those without a measured velocity move.
    """
    problem, rng = state.problem, state.generator()
    quiet = [*quiet, *(AXES[i] for i in problem.data.latent)]
    rows = [*parameters_of(problem.library, state.hypotheses), *nuisance]
    left = screened(problem, state.current, rows, alpha, rng, quiet)
    if left is None:
        return state.drawn(rng), None
    screen, best, gain = left
    name = _best_name(problem, state.current, state.left)
    law = best_law(problem, state.current)
    least = OF_ESTIMATES * problem.data.steps if state.current.noise.estimated else 0.0
    if gain < max(BEATS * name, _OF_A_LAW * law, least):
        return state.drawn(rng), None
    known = [h for h in state.hypotheses if h[0] != Unknown.name]
    if known and len(known) == len(state.hypotheses):
        at_first = screened(problem, state.first, list(nuisance), alpha, rng, quiet)
        evidence = state.first.evidence
        owned = set(evidence.design.owner.tolist())
        own = [i for i in parameters_of(problem.library, known) if i in owned]
        together = evidence.fit(own, nuisance).heldout_gain if own else np.inf
        alone = _best_name(problem, state.first, state.fits)
        if at_first is not None and at_first[2] > max(BEATS * alone, _TOGETHER * together):
            bare = state.drawn(rng).at(state.first, accepted=())
            return bare, FoundStructure(*at_first, alone)
    return state.drawn(rng), FoundStructure(screen, best, gain, name)


def add_structure(
    state: Selection, nuisance: Sequence[int], structure: FoundStructure
) -> Selection:
    """Add the structure to the model's effects and refit it with all that was accepted."""
    problem, rng, matched = state.problem, state.generator(), structure.matched
    effect = refined(structure.screen, matched, rng)
    rivals = _admissible(problem, state.current, state.left)[:5]
    wider = problem.with_effect(effect)
    theta = wider.moved(state.current.theta, problem.library)
    hypothesis = (Unknown.name, effect.acts_on)
    own = wider.library.at(*hypothesis)
    free = [wider.library.index(*_key(problem.library.entries[i])) for i in nuisance]
    rows = [*own, *parameters_of(wider.library, state.hypotheses), *free]
    theta, _, joint = wider.polish(theta, rows, rounds=6)
    heldout = matched.heldout * structure.gain / max(matched.gain, 1e-300)
    p, errors = matched.p_value, joint.errors[: len(own)]
    fit = Fit(tuple(own), theta[own], {}, errors, structure.gain, heldout, p)
    accepted = (*state.accepted, Choice(hypothesis, fit, (), tuple(rivals), p))
    return state.drawn(rng).at(wider.evaluate(theta), problem=wider, accepted=accepted)


def described_structure(state: Selection, structure: FoundStructure) -> result.Structure:
    """The structure added last, in words."""
    library, (name, where) = state.problem.library, state.hypotheses[-1]
    effect = next(e for e in library.effects if isinstance(e, Unknown) and e.places == (where,))
    weights, choice = state.current.theta[library.at(name, where)], state.accepted[-1]
    words = described(effect, weights, choice.fit.errors, state.problem)
    best = max([structure.name_gain, *(gain for _, gain in choice.rivals)])
    return result.Structure(**words, heldout_gain=structure.gain, best_name_gain=best)


def _key(entry: tuple) -> tuple[str, str, str]:
    return entry[0], entry[1], entry[2].name
