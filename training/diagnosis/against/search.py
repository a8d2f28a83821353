"""Selection of the causes that have changed: a search whose tests are those of healthy units."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from ....models.effects.library import kind
from ..filter.problem import DiagnosisProblem
from ..selection.hypotheses import Fit
from ..selection.model_selection import (
    Choice,
    Hypothesis,
    acts_unseen,
    admissible,
    choose,
    is_itself,
    parameters_of,
)
from ..selection.search import Search, asks_for_commands
from ..selection.state import Fits, Selection
from .baseline import Baseline, Limits


@dataclass(frozen=True, kw_only=True)
class ChangeSearch(Search):
    """Forward selection among causes whose change exceeds what healthy units show.

    Attributes:
        baseline: healthy and new runs.
        limits: of the scores of changes.
        scores: by cause accepted, filled by the steps.
    """

    baseline: Baseline
    limits: Limits
    scores: dict[Hypothesis, float] = field(default_factory=dict)

    def names(self, problem: DiagnosisProblem) -> list[Hypothesis]:
        """Causes that new and healthy data can show, those of single thrusters among them."""
        return [
            h
            for h in self.baseline.hypotheses
            if not asks_for_commands(h, self.quiet) and not acts_unseen(*h, problem.data.unseen)
        ]

    def propose(self, state: Selection) -> Selection:
        """The cause that explains most, of those that have changed by more than healthy units.

        Where the largest of all scores is an alarm, the first cause itself needs what theory asks:
        scores of causes with other numbers of parameters or units are not of one scale. What is
        named beside it must be an alarm itself.
        """
        if state.proposal is not None:
            return state
        side = self.baseline.side(state.current.theta)
        found, scores = self.baseline.tests(side, state.hypotheses)
        problem, theta = state.problem, state.current.theta
        free, evidence = parameters_of(problem.library, state.hypotheses), side.seen.evidence
        names = [h for h in self.names(problem) if h in found and h not in state.dropped]
        sets = {h: problem.library.at(*h) for h in names}
        fits = {h: evidence.fit(rows, free) for h, rows in sets.items()}
        rng = state.generator()
        chance = evidence.chance(list(sets.values()), free, rng)
        threshold = chance.exceeded(self.alpha)
        state = replace(state.drawn(rng), chance=chance, threshold=threshold)
        limit = self.limits.causes
        first = not state.accepted and scores.causes > limit.threshold
        needed = min(limit.theory, limit.threshold) if first else limit.threshold
        passing = {
            h: fit
            for h, fit in fits.items()
            if found[h].score > needed and self._holds_up(state, h, fit)
        }
        gains = {c.hypothesis[0]: c.fit.heldout_gain for c in state.accepted}
        choice = choose(problem.library, theta, passing, threshold, math.inf, gains)
        if choice is not None:
            self.scores[choice.hypothesis] = found[choice.hypothesis].score
            self.scores.update({h: found[h].score for h, _ in choice.rivals})
        return replace(state, proposal=(choice, fits))

    def _significance(self, state: Selection, choice: Choice, fits: Fits) -> tuple[float, bool]:
        """The p value of a score among all tried; exact predictions are always tested."""
        del state
        return min(1.0, math.exp(-self.scores[choice.hypothesis]) * len(fits)), False

    def _rejected(self, state: Selection, h: Hypothesis) -> Selection:
        """The selection without a change that does not hold; others are tried."""
        return replace(state, dropped=state.dropped | {h}, proposal=None)

    def _holds_up(self, state: Selection, h: Hypothesis, fit: Fit) -> bool:
        """Whether a change lies in its range, is one of the cause itself, and is no short time."""
        library, theta = state.problem.library, state.current.theta
        if kind(h[0]).timing and np.all(np.abs(fit.values) < self.shortest):
            return False
        return admissible(library, theta, fit) and is_itself(library, np.zeros_like(theta), fit)
