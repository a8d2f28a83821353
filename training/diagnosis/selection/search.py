"""Forward selection of causes with exact refits, and backward elimination."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from ....models.effects.library import kind
from ....models.effects.traits import Group
from ....models.effects.unknown import Unknown
from ....models.se3 import AXES
from ..disturbance.found import laws_of, won_by
from ..disturbance.waves import correlated_noise_of
from ..filter.noise import Filter
from ..filter.problem import DiagnosisProblem, Evaluation
from ..validation.validation import Contender, scores
from .correlated_noise import CorrelatedNoise
from .hypotheses import Chance, Fit
from .model_selection import (
    Choice,
    Hypothesis,
    admissible,
    choose,
    is_itself,
    margin,
    p_value,
    parameters_of,
)
from .refit_all import coefficients, is_coefficient

_CLOSE = 0.7
_TAKEN_BACK = 2
_OF_A_LAW = 0.02
"""Share of the best law's gain that a cause must win where the law wins more."""
_OF_A_DESCRIPTION = 0.02
"""Share of the gain of unmodelled structure that a further cause or law must win: a nonparametric
fit (a few bumps, one frequency) may leave a residual of that size."""
_LEFT = 0.05
"""Share of the laws' gain below which they count as explained."""
_OF_ESTIMATES = 0.05
"""Nats a sample that a cause must win where states were estimated: below that it may fit the
estimator's own errors."""
_HALVED = math.log(2.0)
"""Or nats a sample by which it makes one-step errors likelier: as if an axis' errors were halved.
Records of a noise-free simulation look like estimates too, until the cause is found."""


@dataclass
class Found:
    """State of a search.

    Attributes:
        base, first, current: evaluations of the believed model, refitted, and with the causes.
        accepted: causes in the order found.
        fits: of every cause alone, with the nuisance parameters free.
        left: fits of every further cause, with those accepted free.
        dropped: causes rejected or made redundant by others; they are not tried again.
        chance: distribution of the held-out gain (nats) of noise alone in the last round.
        threshold: what noise alone exceeds with the false-alarm rate (nats).
    """

    base: Evaluation
    first: Evaluation
    current: Evaluation
    accepted: list[Choice] = field(default_factory=list)
    fits: dict[Hypothesis, Fit] = field(default_factory=dict)
    left: dict[Hypothesis, Fit] = field(default_factory=dict)
    dropped: set[Hypothesis] = field(default_factory=set)
    chance: Chance = field(default_factory=lambda: Chance(0.0, 1.0))
    threshold: float = 0.0

    @property
    def hypotheses(self) -> list[Hypothesis]:
        """The causes accepted."""
        return [choice.hypothesis for choice in self.accepted]

    @property
    def left_undescribed(self) -> float:
        """Nats that accepted unmodelled structure may leave unexplained."""
        described = (c.fit.heldout_gain for c in self.accepted if c.hypothesis[0] == Unknown.name)
        return _OF_A_DESCRIPTION * sum(described)


def refitted(problem: DiagnosisProblem, refit: Group | Literal["none", "auto"]) -> list[int]:
    """Nuisance parameters: free in the fit of every cause."""
    if refit == "all":
        return [c.row for c in coefficients(problem)]
    if refit in ("none", "auto"):
        return []
    return [i for i, e in enumerate(problem.library.entries) if is_coefficient(e, refit)]


def _asks_for_commands(named: Hypothesis, quiet: Sequence[str]) -> bool:
    """Whether a cause is not identifiable because its axis, or no axis at all, was driven."""
    name, where = named
    if len(quiet) == len(AXES):
        return kind(name).family in ("actuation", "body") and not kind(name).at_rest
    return where in quiet and kind(name).family == "body"


class Search:
    """Forward selection of causes; `rng` draws the gains of noise alone."""

    def __init__(
        self,
        problem: DiagnosisProblem,
        nuisance: list[int],
        alpha: float,
        most: int,
        rng: np.random.Generator,
        progress: Callable[[float, str], None],
        quiet: Sequence[str] = (),
        shortest: float = 0.0,
    ):
        """`quiet` axes are not identifiable; lags and delays below `shortest` (s) are rejected."""
        self.problem, self.nuisance, self.alpha, self.most = problem, nuisance, alpha, most
        self.rng, self.progress = rng, progress
        free = {problem.library.entries[i].cause for i in nuisance}
        self.names = [
            h
            for h in problem.library.hypotheses(single=False)
            if h[0] not in free and not _asks_for_commands(h, quiet)
        ]
        self.shortest = shortest
        self._asked: tuple[Evaluation, tuple[Choice | None, dict[Hypothesis, Fit]]] | None = None

    def run(self, found: Found, most: int | None = None) -> "Search":
        """Add causes to `found` until none passes, or `most` are found; all are refitted together.

        It ends where exact fits reject `_TAKEN_BACK` causes in a row: linearised gains then do not
        hold for the rest either.
        """
        taken_back = 0
        for number in range(len(found.accepted), min(most or self.most, self.most)):
            self.progress(number / self.most, f"{number} causes so far")
            choice, fits = self.next(found)
            found.fits = found.fits or fits
            found.left = fits
            if choice is None:
                break
            choice, theta = self._refine(choice, fits, found)
            p = p_value(choice.fit, len(fits), found.chance)
            seen = self.problem.evaluate(theta)
            doubtful = choice.fit.p_value * len(fits) >= self.alpha
            if doubtful and not self._holds(seen, choice.hypothesis, found):
                found.dropped.add(choice.hypothesis)
            else:
                found.accepted.append(replace(choice, p_value=p))
                found.current = seen
                self._backward(found)
            taken_back = taken_back + 1 if choice.hypothesis in found.dropped else 0
            if taken_back == _TAKEN_BACK:
                break
        return self

    def next(self, found: Found) -> tuple[Choice | None, dict[Hypothesis, Fit]]:
        """The cause that explains most of the residual, and the fits of all causes.

        The answer is cached as long as `found.current` is the same evaluation.
        """
        if self._asked is None or self._asked[0] is not found.current:
            answer = self._next(found)
            self._asked = (found.current, answer)
        return self._asked[1]

    def _next(self, found: Found) -> tuple[Choice | None, dict[Hypothesis, Fit]]:
        """Where a law wins more than the best cause, causes must pass the robust test between runs.

        The exception is a cause whose fit leaves hardly any gain to the law: a few constants can't
        fit a random disturbance. Where the law is a slow one (its gain summed over axes), which
        causes can imitate, they are tested with it as correlated noise.
        """
        if self.problem.correlated_noise is not None:
            self._account_for(None, found)
        choice, fits = self._chosen(found)
        laws = laws_of(self.problem, found.current)
        if choice is None or not laws:
            return choice, fits
        lasting = max((won_by(law.name, laws) for law in laws if kind(law.name).slow), default=0.0)
        law = max(lasting, laws[0].heldout_gain)
        if law < choice.fit.heldout_gain:
            return choice, fits
        explains = self._explaining(choice, fits, found, law)
        if explains is not None:
            return explains, {**fits, explains.hypothesis: explains.fit}
        if law == lasting:
            self._account_for(correlated_noise_of(self.problem, found.current, laws), found)
        return self._chosen(found, _OF_A_LAW * law, strict=True)

    def _explaining(
        self, choice: Choice, fits: dict[Hypothesis, Fit], found: Found, law: float
    ) -> Choice | None:
        """The first of the best causes that leaves hardly any gain to the laws.

        Each is fitted exactly first: causes whose parameters multiply each other (a force and its
        lever arm) win little in a linear fit.
        """
        names = [choice.hypothesis, *(h for h, _ in choice.rivals)]
        for h in names:
            theta, seen, _ = self._fitted(h, fits, found, None)
            left = laws_of(self.problem, seen)
            if left and max(won_by(w.name, left) for w in left) < _LEFT * law:
                exact = self._exact(fits[h], theta, seen, found)
                named = self.problem.library, found.current.theta, exact
                if not (admissible(*named) and is_itself(*named)):
                    continue
                gains = [(other, fits[other].heldout_gain) for other in names if other != h]
                return Choice(h, exact, (), tuple(gains))
        return None

    def _exact(
        self, fit: Fit, theta: Float[np.ndarray, " p"], seen: Evaluation, found: Found
    ) -> Fit:
        """A fit with its exact values, and their gain in nats less one a parameter (AIC).

        Each side has its own filter: what a cause explains no longer counts as noise.
        """
        current, rows = found.current, list(fit.parameters)
        weight = self.problem.data.weight
        won = seen.likelihood(weight) - current.likelihood(weight)
        labels, index = np.unique(self.problem.data.cluster, return_inverse=True)
        heldout = np.bincount(index, won, len(labels)) - len(rows) / len(labels)
        change = theta - current.theta
        return replace(
            fit,
            values=change[rows],
            others={i: float(change[i]) for i in fit.others},
            gain=float(won.sum()),
            heldout=heldout,
        )

    def _account_for(self, structure: CorrelatedNoise | None, found: Found) -> None:
        self.problem = replace(self.problem, correlated_noise=structure)
        found.current = self.problem.evaluate(found.current.theta, previous=found.current)

    def _chosen(
        self, found: Found, least: float = 0.0, strict: bool = False
    ) -> tuple[Choice | None, dict[Hypothesis, Fit]]:
        problem, current, taken = self.problem, found.current, found.hypotheses
        free = self.nuisance + parameters_of(problem.library, taken)
        open_names = [h for h in self.names if h not in taken and h not in found.dropped]
        sets = [problem.library.at(*h) for h in open_names]
        found.chance = current.evidence.chance(sets, free, self.rng)
        found.threshold = found.chance.exceeded(self.alpha)
        fits = {h: current.evidence.fit(s, free) for h, s in zip(open_names, sets, strict=True)}
        for h in [h for h in open_names if kind(h[0]).timing]:
            times = current.theta[list(fits[h].parameters)] + fits[h].values
            if np.all(np.abs(times) < self.shortest):
                del fits[h]
        gains = {c.hypothesis[0]: c.fit.heldout_gain for c in found.accepted}

        def best(least: float) -> Choice | None:
            needed = max(found.threshold, found.left_undescribed, least)
            return choose(problem.library, current.theta, fits, needed, self.alpha, gains, strict)

        def chosen() -> Choice | None:
            found_ = best(least)
            if found_ is None or not current.noise.estimated or self._halves(found_, current):
                return found_
            return best(max(least, _OF_ESTIMATES * problem.data.steps))

        choice = chosen()
        if choice is not None and self._about_thrust(choice):
            fits |= self._single_thrusters(current, free, [*taken, *found.dropped])
            choice = chosen()
        return choice, fits

    def _halves(self, choice: Choice, current: Evaluation) -> bool:
        """Whether a cause makes the one-step errors much smaller."""
        theta = self._start(choice.fit, current.theta)
        won = self.problem.loss_of(current) - self.problem.loss(theta)
        return bool(won >= _HALVED * self.problem.data.steps)

    def _about_thrust(self, choice: Choice) -> bool:
        """Whether the best causes so far leave it possible that a single thruster is at fault."""
        names = [choice.hypothesis[0], *(h[0] for h, _ in choice.rivals[:2])]
        level = self.problem.data.command != "F_Bo_B"
        return level and any(kind(name).family == "actuation" for name in names)

    def _single_thrusters(
        self, current: Evaluation, free: list[int], taken: list[Hypothesis]
    ) -> dict[Hypothesis, Fit]:
        """Fits of causes in one thruster each, with the filter of the other causes."""
        library = self.problem.library
        names = [h for h in library.hypotheses(single=True) if h not in taken]
        chosen = sorted({*parameters_of(library, names), *free})
        seen = self.problem.evaluate(current.theta, chosen, previous=current)
        return {h: seen.evidence.fit(library.at(*h), free) for h in names}

    def _holds(self, seen: Evaluation, named: Hypothesis, found: Found) -> bool:
        """Whether a cause improves exact predictions of data left out of its fit.

        Where few runs show it, the linearised gain may not hold: responses are nonlinear.
        """
        problem, names = self.problem, found.hypotheses
        rows = self.nuisance + parameters_of(problem.library, names)
        own = parameters_of(problem.library, [named])
        before, after = (
            scores(
                problem,
                Contender(problem.without_each(evaluation, used)),
                found.first.noise.estimated,
            )
            for evaluation, used in ((found.current, rows), (seen, [*rows, *own]))
        )
        return bool(after.density.sum() > before.density.sum())

    def _start(self, fit: Fit, theta: np.ndarray) -> np.ndarray:
        moved = theta.copy()
        moved[list(fit.parameters)] += fit.values
        for i, change in fit.others.items():
            moved[i] += change
        return moved

    def _fitted(
        self, h: Hypothesis, fits: dict[Hypothesis, Fit], found: Found, kalman: Filter | None
    ) -> tuple[Float[np.ndarray, " p"], Evaluation, Fit]:
        """A cause fitted with exact predictions, jointly with all accepted ones; the fit returned
        has its own parameters alone, as values and not as changes.
        """
        free = self.nuisance + parameters_of(self.problem.library, found.hypotheses)
        chosen = [*self.problem.library.at(*h), *free]
        start = self._start(fits[h], found.current.theta)
        theta, seen, joint = self.problem.polish(start, chosen, kalman, origin=found.current)
        return theta, seen, _of_one(self.problem.library.at(*h), theta, joint)

    def _refine(
        self, choice: Choice, fits: dict[Hypothesis, Fit], found: Found
    ) -> tuple[Choice, Float[np.ndarray, " p"]]:
        """Fit the cause and its close rivals with exact predictions, and take the best."""
        library, problem = self.problem.library, self.problem
        free = self.nuisance + parameters_of(library, found.hypotheses)
        top = choice.hypothesis
        theta, seen, _ = self._fitted(top, fits, found, None)
        close = [h for h, g in choice.rivals[:2] if g > _CLOSE * choice.fit.heldout_gain]
        if not close:
            return choice, theta
        best = problem.polish(theta, [*library.at(*top), *free], seen.kalman, 2)[1]
        start_loss = best.loss
        for h in close:
            if h[0] in kind(top[0]).simpler:
                continue
            other, rival, alone = self._fitted(h, fits, found, seen.kalman)
            named = library, np.zeros_like(other), alone
            within = admissible(*named) and is_itself(*named)
            # a cause nested in the rival stays unless clearly beaten; parameters cost a nat each
            least = 2.0 if best.loss == start_loss else 0.0
            least += max(len(library.at(*h)) - len(library.at(*top)), 0)
            if top[0] in kind(h[0]).simpler:
                least = margin(choice.fit.heldout_gain)
            if within and rival.loss < best.loss - least:
                top, theta, best = h, other, rival
        if top == choice.hypothesis:
            return choice, theta
        rivals = ((choice.hypothesis, choice.fit.heldout_gain), *choice.rivals)
        others = tuple(rival for rival in rivals if rival[0] != top)
        ties = tuple(h for h in choice.ties if h != top)
        return Choice(top, fits[top], ties, others), theta

    def _backward(self, found: Found) -> None:
        """Drop causes that later ones have made redundant, and refit the rest."""
        library, current = self.problem.library, found.current
        chosen = parameters_of(library, found.hypotheses)
        kept, theta = [], current.theta.copy()
        for choice in found.accepted:
            own = library.at(*choice.hypothesis)
            others = [i for i in chosen if i not in own]
            weight = 0.0
            if current.theta[own].any():  # else the joint fit itself has set it to zero
                errors = current.evidence.fit(own, others).errors
                weight = float(np.sum((current.theta[own] / np.maximum(errors, 1e-300)) ** 2)) / 2
            if weight > found.threshold:
                kept.append(choice)
            else:
                found.dropped.add(choice.hypothesis)
                theta[own] = 0.0
        if len(kept) < len(found.accepted):
            found.accepted = kept
            rest = self.nuisance + parameters_of(library, found.hypotheses)
            theta = self.problem.polish(theta, rest)[0] if rest else theta
            found.current = self.problem.evaluate(theta)


def _of_one(rows: Sequence[int], theta: Float[np.ndarray, " p"], joint: Fit) -> Fit:
    """Parameters of one cause as values (no changes), with their errors in a joint fit."""
    errors = np.array([joint.errors[joint.parameters.index(i)] for i in rows])
    return Fit(tuple(rows), theta[list(rows)], {}, errors, 0.0, np.zeros(1), 1.0)
