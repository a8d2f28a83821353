"""Acceptance of `unknown`: structure that no cause, nor all causes together, explain as well."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ....models.effects.unknown import Unknown
from ..disturbance.found import best_law
from ..filter.problem import DiagnosisProblem, Evaluation
from ..filter.sensitivities import whitened_sensitivities
from ..findings import result
from ..selection.hypotheses import Design, Fit
from ..selection.model_selection import Choice, admissible, parameters_of
from ..selection.search import Found
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
    design = Design.of(problem.library, evaluation.theta, rows)
    first = [int(np.flatnonzero(design.owner == i)[0]) for i in rows]
    probes = design.probes[first]
    z = whitened_sensitivities(
        problem.model,
        problem.library,
        evaluation.theta,
        probes,
        problem.data,
        evaluation.predictions,
        evaluation.kalman,
    )
    return z[1:]


def screened(
    problem: DiagnosisProblem,
    evaluation: Evaluation,
    rows: list[int],
    alpha: float,
    rng: np.random.Generator,
    quiet: Sequence[str] = (),
) -> tuple[Screen, Matched, float] | None:
    """The structure that wins most with `rows` free, of those significant against noise alone."""
    screen = Screen(problem, evaluation, sensitivities_of(problem, evaluation, rows))
    share = problem.data.steps / problem.data.weight[:, screen.kept].sum()
    tried = list(groups(problem, evaluation, quiet))
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


def _best_name(problem: DiagnosisProblem, evaluation: Evaluation, fits: dict) -> float:
    gains = [
        f.heldout_gain for f in fits.values() if admissible(problem.library, evaluation.theta, f)
    ]
    return max([0.0, *gains])


def find_structure(
    problem: DiagnosisProblem,
    nuisance: list[int],
    found: Found,
    alpha: float,
    rng: np.random.Generator,
    quiet: Sequence[str] = (),
) -> FoundStructure | None:
    """Structure in the residual of the causes; where it wins more than they do, in place of them.

    In the second case `found` is reset to the model without causes. None is sought in estimated
    states, as their estimator adds structure of its own, nor in how `quiet` axes move.
    """
    if found.current.noise.estimated:
        return None
    rows = [*parameters_of(problem.library, found.hypotheses), *nuisance]
    left = screened(problem, found.current, rows, alpha, rng, quiet)
    if left is None:
        return None
    screen, best, gain = left
    name = _best_name(problem, found.current, found.left)
    law = best_law(problem, found.current)
    if gain < BEATS * name or gain < _OF_A_LAW * law:
        return None
    known = [h for h in found.hypotheses if h[0] != Unknown.name]
    if known and len(known) == len(found.hypotheses):
        at_first = screened(problem, found.first, nuisance, alpha, rng, quiet)
        evidence = found.first.evidence
        owned = set(evidence.design.owner.tolist())
        own = [i for i in parameters_of(problem.library, known) if i in owned]
        together = evidence.fit(own, nuisance).heldout_gain if own else np.inf
        alone = _best_name(problem, found.first, found.fits)
        if at_first is not None and at_first[2] > max(BEATS * alone, _TOGETHER * together):
            found.accepted, found.current = [], found.first
            return FoundStructure(*at_first, alone)
    return FoundStructure(screen, best, gain, name)


def add_structure(
    problem: DiagnosisProblem,
    nuisance: list[int],
    found: Found,
    found_structure: FoundStructure,
    rng: np.random.Generator,
) -> DiagnosisProblem:
    """Add the structure to the model, refit it with all that was accepted; the new problem."""
    effect = refined(found_structure.screen, found_structure.matched, rng)
    rivals = sorted(found.left.items(), key=lambda item: -item[1].heldout_gain)[:5]
    wider = problem.with_effect(effect)
    theta = wider.moved(found.current.theta, problem.library)
    hypothesis = (Unknown.name, effect.acts_on)
    own = wider.library.at(*hypothesis)
    free = [wider.library.index(*_key(problem.library.entries[i])) for i in nuisance]
    rows = [*own, *parameters_of(wider.library, found.hypotheses), *free]
    theta, _, joint = wider.polish(theta, rows, rounds=6)
    heldout = (
        found_structure.matched.heldout
        * found_structure.gain
        / max(found_structure.matched.gain, 1e-300)
    )
    p = found_structure.matched.p_value
    fit = Fit(
        tuple(own), theta[own], {}, joint.errors[: len(own)], found_structure.gain, heldout, p
    )
    ranked = tuple((h, f.heldout_gain) for h, f in rivals)
    found.accepted.append(Choice(hypothesis, fit, (), ranked, p))
    found.current = wider.evaluate(theta)
    return wider


def structure(
    problem: DiagnosisProblem, where: str, theta: np.ndarray, found_structure: FoundStructure
) -> result.Structure:
    """The structure that was found, in words."""
    effect = next(
        e for e in problem.library.effects if e.name == Unknown.name and e.places == (where,)
    )
    words = described(effect, theta[problem.library.at(Unknown.name, where)], problem)  # pyright: ignore[reportArgumentType]
    return result.Structure(
        **words, heldout_gain=found_structure.gain, best_name_gain=found_structure.name_gain
    )


def _key(entry: tuple) -> tuple[str, str, str]:
    return entry[0], entry[1], entry[2].name
