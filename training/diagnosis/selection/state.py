"""State of the selection of causes."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ....models.effects.unknown import Unknown
from ..filter.problem import DiagnosisProblem, Evaluation
from .correlated_noise import CorrelatedNoise
from .hypotheses import Chance, Fit
from .model_selection import Choice, Hypothesis

OF_ESTIMATES = 0.05
"""Nats a sample that a cause or structure must win where states were estimated: below that it may
fit the estimator's own errors."""
_OF_A_DESCRIPTION = 0.02
"""Share of the gain of unmodelled structure that a further cause or law must win: a nonparametric
fit (a few bumps, one frequency) may leave a residual of that size."""

Fits = Mapping[Hypothesis, Fit]


@dataclass(frozen=True)
class Selection:
    """What is known after some steps of a selection; a step makes a new one.

    Attributes:
        problem: with the correlated noise that causes are judged in.
        base, first, current: evaluations of the believed model, refitted, and with the causes.
        random: state of the generator of random numbers, after the draws so far.
        accepted: causes in the order found.
        fits: of every cause alone, with the nuisance parameters free.
        left: fits of every further cause, with those accepted free.
        dropped: causes rejected or made redundant by others; they are not tried again.
        chance: distribution of the held-out gain (nats) of noise alone in the last round.
        threshold: what noise alone exceeds with the false-alarm rate (nats).
        proposal: next cause, if any passes, and the fits of all causes; None if not known yet.
        redundant: causes in a row that the steps before found and dropped again.
        done: whether no further cause passes.
    """

    problem: DiagnosisProblem
    base: Evaluation
    first: Evaluation
    current: Evaluation
    random: Mapping[str, Any]
    accepted: tuple[Choice, ...] = ()
    fits: Fits = field(default_factory=dict)
    left: Fits = field(default_factory=dict)
    dropped: frozenset[Hypothesis] = frozenset()
    chance: Chance = field(default_factory=lambda: Chance(0.0, 1.0))
    threshold: float = 0.0
    proposal: tuple[Choice | None, Fits] | None = None
    redundant: int = 0
    done: bool = False

    @classmethod
    def start(
        cls, problem: DiagnosisProblem, base: Evaluation, first: Evaluation | None = None,
        seed: int = 0,
    ) -> "Selection":  # fmt: skip
        """Without causes: the believed model, perhaps refitted (`first`)."""
        first = base if first is None else first
        random = np.random.default_rng(seed).bit_generator.state
        return cls(problem, base, first, first, random)

    @property
    def proposed(self) -> tuple[Choice | None, Fits]:
        """The proposal, which must be there."""
        assert self.proposal is not None
        return self.proposal

    @property
    def hypotheses(self) -> list[Hypothesis]:
        """The causes accepted."""
        return [choice.hypothesis for choice in self.accepted]

    @property
    def left_undescribed(self) -> float:
        """Nats that accepted unmodelled structure may leave unexplained."""
        described = (c.fit.heldout_gain for c in self.accepted if c.hypothesis[0] == Unknown.name)
        return _OF_A_DESCRIPTION * sum(described)

    def generator(self) -> np.random.Generator:
        """Random numbers that continue after the draws so far."""
        rng = np.random.default_rng(0)
        rng.bit_generator.state = self.random
        return rng

    def drawn(self, rng: np.random.Generator) -> "Selection":
        """After further draws from its generator."""
        return replace(self, random=rng.bit_generator.state)

    def at(self, current: Evaluation, **changes: Any) -> "Selection":
        """At another evaluation, where no cause is proposed yet."""
        return replace(self, current=current, proposal=None, **changes)

    def accounting_for(self, noise: CorrelatedNoise | None) -> "Selection":
        """With another correlated noise to judge causes in."""
        problem = replace(self.problem, correlated_noise=noise)
        current = problem.evaluate(self.current.theta, previous=self.current)
        return self.at(current, problem=problem)
