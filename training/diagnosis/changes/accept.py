"""Acceptance of causes that act in a part of the data."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ....models.effects.library import PART, kind, whole
from ....models.effects.unknown import Unknown
from ..disturbance.found import best_law
from ..filter.problem import DiagnosisProblem, Evaluation
from ..filter.varying import Part, parts_of
from ..selection.forecasting import part_forecasts_better
from ..selection.hypotheses import Design, Fit, is_curved, known_within
from ..selection.model_selection import (
    Choice,
    Hypothesis,
    acts_unseen,
    admissible,
    is_itself,
    margin,
    parameters_of,
)
from ..selection.search import Search, asks_for_commands
from ..selection.state import OF_ESTIMATES, Selection
from .scan import Change, Scan
from .session import Session, Span

_MOST = 3
"""Most parts: what changes more often is a random disturbance, or another cause."""
_MORE = 0.15
"""Share of a constant cause's gain that its change must win in addition, unless it replaces it."""
_ELSEWHERE = 0.3
"""Share of its gain that other causes may win in parts once it is accounted for: what is misfitted
in many parts is not local. So much may be left to a law of the disturbance, too."""
_REPEATED = 0.5
"""Share of its gain that values from every other block must win on the rest: a knock acts in one
of them."""
_ROUNDS = 5
"""Most fits of a part while its edges move."""
_UNDECIDED = 1.0
"""Nats within which edges of a part count as equally good."""


def with_changes(state: Selection, search: Search) -> Selection:
    """The selection with causes that act in a part of the data, if there are any.

    Such a cause must win more than noise in the best of all parts tried, clearly more than the same
    cause in all of the data or in its place, the same with values fitted to every other block, and
    leave little to other causes in parts or to a law of the disturbance. Constant causes that it
    makes redundant are dropped.
    """
    session = Session.of(state.problem.data)
    found = state
    for number in range(_MOST + 1):
        change = _best(found, search, session)
        if change is None:
            break
        if number == _MOST:
            return state
        wider = _accepted(found, search, session, change)
        if wider is None or not _forecasts_better(wider, found, search):
            break
        found = wider
    if found is state:
        return state
    if not found.current.noise.estimated:
        before, left = (best_law(s.problem, s.current) for s in (state, found))
        if left > max(_ELSEWHERE * before, state.threshold):
            return state
    return search.without_redundant(found)


def _forecasts_better(state: Selection, before: Selection, search: Search) -> bool:
    """Whether the last change improves forecasts, where states were estimated.

    Errors of an estimator last for seconds and look like a change.
    """
    if not state.current.noise.estimated:
        return True
    return part_forecasts_better(state, before, search.nuisance, search.horizon)


def _best(state: Selection, search: Search, session: Session) -> Change | None:
    """The best change, if it passes all tests of innovations."""
    problem, scan = state.problem, _scan(state, search, session)
    gains = {c.hypothesis: c.fit.heldout_gain for c in state.accepted}
    least = max(state.threshold, state.left_undescribed, margin(sum(gains.values(), 0.0)))
    if state.current.noise.estimated:
        least = max(least, OF_ESTIMATES * problem.data.steps)
    change = scan.best(least)
    if change is None or change.repeated < _REPEATED * change.gain:
        return None
    alone, constant = scan.constant_gain(change.hypothesis), gains.get(change.hypothesis, 0.0)
    if change.gain < (1 + _MORE) * alone:
        return None
    if change.gain < _MORE * constant and not _replaces(change, scan, state, margin(constant)):
        return None
    other = scan.with_change(change).best(least, without=[change.hypothesis])
    return None if other is not None and other.gain > _ELSEWHERE * change.gain else change


def _replaces(change: Change, scan: Scan, state: Selection, least: float) -> bool:
    """Whether the constant cause wins less than `least` nats beside a change of the same kind."""
    own, rows = scan.candidates[change.hypothesis], state.problem.library.at(*change.hypothesis)
    z = scan.z.copy()
    z[0] -= state.current.theta[rows].astype(z.dtype) @ z[own]  # as if it were not there
    without = replace(scan, z=z, free=[i for i in scan.free if i not in own])
    return without.with_change(change).constant_gain(change.hypothesis) < least


def _scan(state: Selection, search: Search, session: Session) -> Scan:
    """The search for changes with the causes found so far, and the coefficients, free."""
    problem, library, theta = state.problem, state.problem.library, state.current.theta
    candidates = {h: library.at(*h) for h in _candidates(problem, search)}
    free = [*search.nuisance, *parameters_of(library, state.hypotheses)]
    rows = list(dict.fromkeys([*free, *(i for own in candidates.values() for i in own)]))
    design = Design.one_each(library, theta, rows)
    z = problem.whitened(state.current, design.probes)
    scale = np.concatenate([[1.0], 1 / design.size])
    column = {i: 1 + k for k, i in enumerate(rows)}
    prior = [1 / known_within(library.entries[i].parameter) ** 2 for i in rows]
    return Scan(
        session.at_steps(z * scale[:, None, None].astype(z.dtype)).reshape(len(z), -1),
        session,
        {h: [column[i] for i in own] for h, own in candidates.items()},
        [column[i] for i in free],
        np.array([0.0, *prior]),
    )


def _candidates(problem: DiagnosisProblem, search: Search) -> list[Hypothesis]:
    """Causes whose values may change from step to step: without a memory, and no inertia."""
    library, found = problem.library, []
    for name, where in library.hypotheses():
        cls = kind(name)
        lasting = cls.random or cls.timing or cls.absorber or cls.refit_only or name == Unknown.name
        remembers = any(cls.acts(hook) for hook in ("inertia", "actuate", "feel"))
        curved = any(is_curved(library, i) for i in library.at(name, where))
        unseen = acts_unseen(name, where, problem.data.unseen)
        if not (lasting or remembers or curved or unseen) and not asks_for_commands(
            (name, where), search.quiet
        ):
            found.append((name, where))
    return found


def _accepted(
    state: Selection, search: Search, session: Session, change: Change
) -> Selection | None:
    """The selection with a change, fitted with exact predictions; None if it is not admissible."""
    name, where = change.hypothesis
    number = 1 + sum(whole(part.name) == name for part in parts_of(state.problem.library))
    hypothesis, span = (f"{name}{PART}{number}", where), change.span
    problem, theta, seen, joint = _fitted(state, search, session, hypothesis, span)
    for _ in range(_ROUNDS):
        moved = _refined(problem, seen, session, hypothesis, span)
        if moved == span:
            break
        fitted = _fitted(state, search, session, hypothesis, moved, theta)
        if fitted[0].loss_of(fitted[2]) > problem.loss_of(seen) + _UNDECIDED:
            break  # an instrument that changes within a run jumps, which gains by step do not tell
        span, (problem, theta, seen, joint) = moved, fitted
    library, own = problem.library, problem.library.at(*hypothesis)
    errors = np.array([joint.errors[joint.parameters.index(i)] for i in own])
    fit = Fit(tuple(own), theta[own], {}, errors, change.gain, np.array([change.gain]), 1.0)
    named = library, np.zeros_like(theta), fit
    if not (admissible(*named) and is_itself(*named)):
        return None
    choice = Choice(hypothesis, fit, (), (), state.chance.beyond(change.worth))
    found = state.at(problem.evaluate(theta), accepted=(*state.accepted, choice))
    return replace(found, problem=problem)


def _fitted(
    state: Selection,
    search: Search,
    session: Session,
    hypothesis: Hypothesis,
    span: Span,
    start: Float[np.ndarray, " p"] | None = None,
) -> tuple[DiagnosisProblem, Float[np.ndarray, " p"], Evaluation, Fit]:
    """The problem with a cause in a part of the session, and a fit with exact predictions.

    It begins at `start`, the fit in another part, or where the selection is.
    """
    data, before = state.problem.data, state.problem.library
    envelope = session.at_samples(session.envelope(span), data)
    lasts = session.ordered and span.last == len(session.run)
    part = Part(*hypothesis, envelope, float(lasts), session.when(span))
    problem = state.problem.with_part(part)
    free = [*search.nuisance, *parameters_of(problem.library, state.hypotheses)]
    start = problem.moved(state.current.theta, before) if start is None else start
    return problem, *problem.polish(start, [*problem.library.at(*hypothesis), *free], rounds=8)


def _refined(
    problem: DiagnosisProblem, seen: Evaluation, session: Session, h: Hypothesis, span: Span
) -> Span:
    """The part with its edges moved by up to a block each, to the median of where they may lie."""
    if span.kind == "drift":
        return span
    library, (name, where) = problem.library, h
    whole_session = library.at(whole(name), where)
    probe = np.zeros((1, library.size))
    probe[0, whole_session] = seen.theta[library.at(name, where)]
    z = session.at_steps(problem.whitened(seen, probe)).astype(float)
    own, moved = z
    inside = session.envelope(span)[:, None]
    without, with_it = own - inside * moved, own + (1 - inside) * moved
    won = ((without**2).sum(axis=1) - (with_it**2).sum(axis=1)) / 2
    block = int(np.diff(session.edges).max())
    run = np.flatnonzero(session.run == session.run[span.first])
    first, last = span.first, span.last
    low, high = max(first - block, run[0]), min(first + block, last - 2)
    if high > low:  # what the part wins from each start on
        gains = np.cumsum(won[low : high + 1][::-1])[::-1]
        first = low + _median(gains)
    if span.kind == "window" and last <= run[-1]:
        low, high = max(last - block, first + 2), min(last + block, run[-1] + 1)
        gains = np.concatenate([[0.0], np.cumsum(won[low:high])])
        last = low + _median(gains)
    return Span(span.kind, int(first), int(last))


def _median(gains: Float[np.ndarray, " n"]) -> int:
    """Where the probability of an edge reaches a half, from the nats of each place (Smith 1975)."""
    below = np.cumsum(np.exp(gains - gains.max()))
    return int(np.searchsorted(below, below[-1] / 2))
