"""Forward selection of causes with exact refits, and backward elimination, in pure steps."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from ....models.effects.library import kind
from ....models.effects.traits import Group
from ....models.se3 import AXES
from ..disturbance.found import laws_of, won_by
from ..disturbance.waves import correlated_noise_of
from ..filter.kalman import Filter
from ..filter.problem import DiagnosisProblem, Evaluation
from ..validation.validation import Contender, scores
from .forecasting import forecast_better
from .hypotheses import Fit
from .kinematic import borne_out
from .model_selection import (
    Choice,
    Hypothesis,
    acts_unseen,
    admissible,
    choose,
    clearly_beaten,
    is_itself,
    p_value,
    parameters_of,
)
from .refit_all import coefficients, is_coefficient
from .state import OF_ESTIMATES, Fits, Selection

Refit = Group | Literal["none", "auto"]
_CLOSE = 0.7
_TAKEN_BACK = 2
_FORECAST = 4
"""Causes that are tried by their forecasts, in the order of their gains."""
_OF_A_LAW = 0.02
"""Share of the best law's gain that a cause must win where the law wins more."""
_LEFT = 0.05
"""Share of the laws' gain below which they count as explained."""
_HALVED = math.log(2.0)
"""Or nats a sample by which it makes one-step errors likelier: as if an axis' errors were halved.
Records of a noise-free simulation look like estimates too, until the cause is found."""


def refitted(problem: DiagnosisProblem, refit: Refit) -> list[int]:
    """Nuisance parameters: free in the fit of every cause."""
    if refit == "all":
        return [c.row for c in coefficients(problem)]
    if refit in ("none", "auto"):
        return []
    return [
        i
        for i, e in enumerate(problem.library.entries)
        if is_coefficient(e, refit) and not acts_unseen(e.cause, e.where, problem.data.unseen)
    ]


def asks_for_commands(named: Hypothesis, quiet: Sequence[str]) -> bool:
    """Whether a cause is not identifiable because its axis, or no axis at all, was driven."""
    name, where = named
    if len(quiet) == len(AXES):
        return kind(name).family in ("actuation", "body") and not kind(name).at_rest
    return where in quiet and kind(name).family == "body"


@dataclass(frozen=True)
class Search:
    """Forward selection of causes in steps; all found so far are refitted together.

    Attributes:
        nuisance: parameters that are free in the fit of every cause.
        alpha: rate of false alarms over all causes together.
        most: causes at most.
        quiet: axes that were not driven.
        shortest: time (s) below which lags and delays are rejected.
        horizon: time (s) over which causes must forecast better where states were estimated.
    """

    nuisance: Sequence[int] = ()
    alpha: float = 0.01
    most: int = 6
    quiet: Sequence[str] = ()
    shortest: float = 0.0
    horizon: float = 4.0

    def names(self, problem: DiagnosisProblem) -> list[Hypothesis]:
        """Causes that are identifiable, of single thrusters none."""
        free = {problem.library.entries[i].cause for i in self.nuisance}
        return [
            h
            for h in problem.library.hypotheses(single=False)
            if h[0] not in free
            and not asks_for_commands(h, self.quiet)
            and not acts_unseen(*h, problem.data.unseen)
        ]

    def run(
        self,
        state: Selection,
        most: int | None = None,
        progress: Callable[[float, str], None] = lambda fraction, remark: None,
    ) -> Selection:
        """Steps until no cause passes, or `most` are found.

        It ends too where an exact fit rejects a cause, or `_TAKEN_BACK` in a row are redundant:
        linearised gains then do not hold for the rest either.
        """
        state = replace(state, redundant=0, done=False)
        for number in range(len(state.accepted), min(most or self.most, self.most)):
            progress(number / self.most, f"{number} causes so far")
            state = self.step(state)
            if state.done or state.redundant == _TAKEN_BACK:
                break
        return state

    def step(self, state: Selection) -> Selection:
        """One more cause, or none if no further one passes."""
        state = self.propose(state)
        choice, fits = state.proposed
        state = replace(state, fits=state.fits or fits, left=fits)
        if choice is None:
            return replace(state, done=True)
        choice, theta = self._refine(state, choice, fits)
        h, seen = choice.hypothesis, state.problem.evaluate(theta)
        p, sure = self._significance(state, choice, fits)
        if not (sure or self._holds(state, seen, h)):
            return self._rejected(state, h)
        state = state.at(seen, accepted=(*state.accepted, replace(choice, p_value=p)))
        state = self.without_redundant(state)
        return replace(state, redundant=state.redundant + 1 if h in state.dropped else 0)

    def _significance(self, state: Selection, choice: Choice, fits: Fits) -> tuple[float, bool]:
        """The p value of a choice, and whether it needs no test of exact predictions."""
        p = p_value(choice.fit, len(fits), state.chance)
        return p, choice.fit.p_value * len(fits) < self.alpha

    def _rejected(self, state: Selection, h: Hypothesis) -> Selection:
        """The selection without a cause that exact predictions do not bear out."""
        return replace(state, dropped=state.dropped | {h}, done=True)

    def propose(self, state: Selection) -> Selection:
        """The cause that explains most of the residual, and the fits of all causes."""
        if state.proposal is not None:
            return state
        state, choice, fits = self._proposed(state)
        return replace(state, proposal=(choice, fits))

    def _proposed(self, state: Selection) -> tuple[Selection, Choice | None, Fits]:
        """Where a law wins more than the best cause, causes must pass the robust test between runs.

        The exception is a cause whose fit leaves hardly any gain to the law: a few constants can't
        fit a random disturbance. Where the law is a slow one (its gain summed over axes), which
        causes can imitate, they are tested with it as correlated noise.
        """
        if state.problem.correlated_noise is not None:
            state = state.accounting_for(None)
        state, choice, fits = self._chosen(state)
        laws = laws_of(state.problem, state.current)
        if choice is None or not laws:
            return state, choice, fits
        lasting = max((won_by(w.name, laws) for w in laws if kind(w.name).slow), default=0.0)
        law = max(lasting, laws[0].heldout_gain)
        if law < choice.fit.heldout_gain:
            return state, choice, fits
        explains = self._explaining(state, choice, fits, law)
        if explains is not None:
            return state, explains, {**fits, explains.hypothesis: explains.fit}
        if law == lasting:
            noise = correlated_noise_of(state.problem, state.current, laws)
            state = state.accounting_for(noise)
        return self._chosen(state, _OF_A_LAW * law, strict=True)

    def _explaining(
        self, state: Selection, choice: Choice, fits: Fits, law: float
    ) -> Choice | None:
        """The first of the best causes that leaves hardly any gain to the laws.

        Each is fitted exactly first: causes whose parameters multiply each other (a force and its
        lever arm) win little in a linear fit.
        """
        names = [choice.hypothesis, *(h for h, _ in choice.rivals)]
        for h in names:
            theta, seen, _ = self._fitted(state, h, fits, None)
            left = laws_of(state.problem, seen)
            if left and max(won_by(w.name, left) for w in left) < _LEFT * law:
                exact = self._exact(state, fits[h], theta, seen)
                named = state.problem.library, state.current.theta, exact
                if not (admissible(*named) and is_itself(*named)):
                    continue
                gains = [(other, fits[other].heldout_gain) for other in names if other != h]
                return Choice(h, exact, (), tuple(gains))
        return None

    def _exact(
        self, state: Selection, fit: Fit, theta: Float[np.ndarray, " p"], seen: Evaluation
    ) -> Fit:
        """A fit with its exact values, and their gain in nats less one a parameter (AIC).

        Each side has its own filter: what a cause explains no longer counts as noise.
        """
        current, rows = state.current, list(fit.parameters)
        weight = state.problem.data.weight
        won = seen.likelihood(weight) - current.likelihood(weight)
        labels, index = np.unique(state.problem.data.cluster, return_inverse=True)
        heldout = np.bincount(index, won, len(labels)) - len(rows) / len(labels)
        change = theta - current.theta
        return replace(
            fit,
            values=change[rows],
            others={i: float(change[i]) for i in fit.others},
            gain=float(won.sum()),
            heldout=heldout,
        )

    def _chosen(
        self, state: Selection, least: float = 0.0, strict: bool = False
    ) -> tuple[Selection, Choice | None, Fits]:
        """The choice among linear fits that win `least` nats and what noise alone may win."""
        problem, current, taken = state.problem, state.current, state.hypotheses
        free = [*self.nuisance, *parameters_of(problem.library, taken)]
        untried = [h for h in self.names(problem) if h not in taken and h not in state.dropped]
        sets = [problem.library.at(*h) for h in untried]
        rng = state.generator()
        chance = current.evidence.chance(sets, free, rng)
        threshold = chance.exceeded(self.alpha)
        state = replace(state.drawn(rng), chance=chance, threshold=threshold)
        fits = {h: current.evidence.fit(s, free) for h, s in zip(untried, sets, strict=True)}
        for h in [h for h in untried if kind(h[0]).timing]:
            times = current.theta[list(fits[h].parameters)] + fits[h].values
            if np.all(np.abs(times) < self.shortest):
                del fits[h]
        gains = {c.hypothesis[0]: c.fit.heldout_gain for c in state.accepted}

        def best(least: float, among: Fits) -> Choice | None:
            needed = max(threshold, state.left_undescribed, least)
            return choose(problem.library, current.theta, among, needed, self.alpha, gains, strict)

        def chosen() -> Choice | None:
            first = best(least, fits)
            if first is None or not current.noise.estimated or _halves(state, first):
                return first
            enough = best(max(least, OF_ESTIMATES * problem.data.steps), fits)
            enough = enough or best(least, borne_out(state, fits, self.alpha))
            if enough is not None:
                return enough
            names = [first.hypothesis, *(h for h, _ in first.rivals)][:_FORECAST]
            return best(least, forecast_better(state, self.nuisance, names, fits, self.horizon))

        choice = chosen()
        if choice is not None and _about_thrust(problem, choice):
            fits |= _single_thrusters(state, free)
            choice = chosen()
        return state, choice, fits

    def _holds(self, state: Selection, seen: Evaluation, named: Hypothesis) -> bool:
        """Whether a cause improves exact predictions of data left out of its fit.

        Where few runs show it, the linearised gain may not hold: responses are nonlinear.
        """
        problem = state.problem
        rows = [*self.nuisance, *parameters_of(problem.library, state.hypotheses)]
        own = parameters_of(problem.library, [named])
        before, after = (
            scores(
                problem,
                Contender(problem.without_each(evaluation, used)),
                state.first.noise.estimated,
            )
            for evaluation, used in ((state.current, rows), (seen, [*rows, *own]))
        )
        return bool(after.density.sum() > before.density.sum())

    def _fitted(
        self, state: Selection, h: Hypothesis, fits: Fits, kalman: Filter | None
    ) -> tuple[Float[np.ndarray, " p"], Evaluation, Fit]:
        """A cause fitted with exact predictions, jointly with all accepted ones; the fit returned
        has its own parameters alone, as values and not as changes.
        """
        problem, own = state.problem, state.problem.library.at(*h)
        chosen = [*own, *self.nuisance, *parameters_of(problem.library, state.hypotheses)]
        start = fits[h].added_to(state.current.theta)
        theta, seen, joint = problem.polish(start, chosen, kalman, origin=state.current)
        return theta, seen, _of_one(own, theta, joint)

    def _refine(
        self, state: Selection, choice: Choice, fits: Fits
    ) -> tuple[Choice, Float[np.ndarray, " p"]]:
        """Fit the cause and its close rivals with exact predictions, and take the best."""
        library, problem = state.problem.library, state.problem
        free = [*self.nuisance, *parameters_of(library, state.hypotheses)]
        top = choice.hypothesis
        theta, seen, _ = self._fitted(state, top, fits, None)
        close = [h for h, g in choice.rivals[:2] if g > _CLOSE * choice.fit.heldout_gain]
        if not close:
            return choice, theta
        best = problem.polish(theta, [*library.at(*top), *free], seen.kalman, 2)[1]
        start_loss, back = best.loss, []
        for h in close:
            simpler = h[0] in kind(top[0]).simpler
            more = len(library.at(*top)) - len(library.at(*h))
            if simpler and more > 0:
                continue
            try:
                other, rival, alone = self._fitted(state, h, fits, seen.kalman)
            except FloatingPointError:  # no parameters of the rival suit the cause's filter
                continue
            named = library, np.zeros_like(other), alone
            won = _lost_by_run(best) - _lost_by_run(rival)
            if simpler:
                beats = not clearly_beaten(library, h, top, -won, choice.fit.heldout_gain)
            elif top[0] in kind(h[0]).simpler:
                beats = clearly_beaten(library, top, h, won, choice.fit.heldout_gain)
            else:
                # a cause nested in the rival stays unless clearly beaten; parameters cost a nat
                least = (2.0 if best.loss == start_loss else 0.0) + max(-more, 0)
                beats = rival.loss < best.loss - least
            if beats and admissible(*named) and is_itself(*named):
                back += [top] if simpler else []
                top, theta, best = h, other, rival
        if top == choice.hypothesis:
            return choice, theta
        rivals = ((choice.hypothesis, choice.fit.heldout_gain), *choice.rivals)
        others = tuple(rival for rival in rivals if rival[0] != top)
        ties = tuple(h for h in dict.fromkeys((*back, *choice.ties)) if h != top)
        return Choice(top, fits[top], ties, others), theta

    def without_redundant(self, state: Selection) -> Selection:
        """Drop causes that later ones have made redundant, and refit the rest."""
        problem, current = state.problem, state.current
        library, chosen = problem.library, parameters_of(problem.library, state.hypotheses)
        kept, dropped, theta = [], set(state.dropped), current.theta.copy()
        for choice in state.accepted:
            own = library.at(*choice.hypothesis)
            others = [i for i in chosen if i not in own]
            weight = 0.0
            change = current.theta[own] - problem.believed[own]
            if change.any():  # else the joint fit itself has set it to zero
                errors = current.evidence.fit(own, others).errors
                weight = float(np.sum((change / np.maximum(errors, 1e-300)) ** 2)) / 2
            if weight > state.threshold:
                kept.append(choice)
            else:
                dropped.add(choice.hypothesis)
                theta[own] = problem.believed[own]
        if len(kept) == len(state.accepted):
            return state
        state = replace(state, accepted=tuple(kept), dropped=frozenset(dropped))
        rest = [*self.nuisance, *parameters_of(library, state.hypotheses)]
        theta = problem.polish(theta, rest)[0] if rest else theta
        return state.at(problem.evaluate(theta))


def _lost_by_run(seen: Evaluation) -> Float[np.ndarray, " R"]:
    """Negative log likelihood of each run, up to a constant (nats)."""
    return seen.evidence.runs[:, 0, 0] / 2


def _halves(state: Selection, choice: Choice) -> bool:
    """Whether a cause makes the one-step errors much smaller."""
    problem, theta = state.problem, choice.fit.added_to(state.current.theta)
    won = problem.loss_of(state.current) - problem.loss(theta)
    return bool(won >= _HALVED * problem.data.steps)


def _about_thrust(problem: DiagnosisProblem, choice: Choice) -> bool:
    """Whether the best causes so far leave it possible that a single thruster is at fault."""
    names = [choice.hypothesis[0], *(h[0] for h, _ in choice.rivals[:2])]
    level = problem.data.command != "F_Bo_B"
    return level and any(kind(name).family == "actuation" for name in names)


def _single_thrusters(state: Selection, free: Sequence[int]) -> dict[Hypothesis, Fit]:
    """Fits of causes in one thruster each, with the filter of the other causes."""
    problem, library = state.problem, state.problem.library
    tried = {*state.hypotheses, *state.dropped}
    names = [h for h in library.hypotheses(single=True) if h not in tried]
    chosen = sorted({*parameters_of(library, names), *free})
    seen = problem.evaluate(state.current.theta, chosen, previous=state.current)
    return {h: seen.evidence.fit(library.at(*h), free) for h in names}


def _of_one(rows: Sequence[int], theta: Float[np.ndarray, " p"], joint: Fit) -> Fit:
    """Parameters of one cause as values (no changes), with their errors in a joint fit."""
    errors = np.array([joint.errors[joint.parameters.index(i)] for i in rows])
    return Fit(tuple(rows), theta[list(rows)], {}, errors, 0.0, np.zeros(1), 1.0)
