"""Model selection among causes: vetoes, nesting, echoes, ties."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ....models.effects.library import Library, kind
from .hypotheses import Chance, Fit

Hypothesis = tuple[str, str]
"""(cause, where)"""

MARGIN_NATS, MARGIN_SHARE = 10.0, 0.02
ECHO_SHARE = 0.01
CLEAR, CLEAR_OF_FEW = 5.0, 1.5
"""Multiples of the threshold above which the robust p value is not required: with few clusters
(runs, or pieces of a few runs) it is bounded from below, and where only some of a few clusters show
an effect it has no power."""
_CLEARLY = 3.0
"""Standard errors beyond which a parameter clearly differs from zero."""
_FEW = 12
"""Number of clusters below which they count as few."""


@dataclass(frozen=True)
class Choice:
    """The cause chosen, others not distinguishable from it, rivals; p value over all tried."""

    hypothesis: Hypothesis
    fit: Fit
    ties: tuple[Hypothesis, ...]
    rivals: tuple[tuple[Hypothesis, float], ...]
    p_value: float = 1.0

    def apart_from(self, named: Sequence[Hypothesis]) -> "Choice":
        """Without ties to causes that are named themselves, or to other places of these."""
        taken = {h[0] for h in named if h != self.hypothesis}
        return replace(self, ties=tuple(h for h in self.ties if h[0] not in taken))


def acts_unseen(name: str, where: str, unseen: Sequence[str]) -> bool:
    """Whether a cause acts on an axis, or by motion along one, of which no instrument tells.

    The thrust along every axis is known from the commands.
    """
    axes = where.split("_from_")
    return any(axis in unseen for axis in (axes[:1] if kind(name).family == "actuation" else axes))


def admissible(library: Library, theta: Float[np.ndarray, " p"], fit: Fit) -> bool:
    """Whether every estimate lies in its range; a sign that physics forbids vetoes a cause."""
    for i, change, error in zip(fit.parameters, fit.values, fit.errors, strict=True):
        p = library.entries[i].parameter
        value = theta[i] + change
        one = len(fit.parameters) == 1
        slack = 0.0 if one else 2 * float(error)
        if not p.low - slack <= value <= p.high + slack or (one and value == 0):
            return False
    return True


def is_itself(library: Library, theta: Float[np.ndarray, " p"], fit: Fit) -> bool:
    """Whether an essential parameter of the cause clearly differs from zero, if it has any."""
    values = theta[list(fit.parameters)] + fit.values
    made_of = [
        abs(value) > _CLEARLY * error
        for i, value, error in zip(fit.parameters, values, fit.errors, strict=True)
        if library.entries[i].parameter.name in kind(library.entries[i].cause).essential
    ]
    return not made_of or any(made_of)


def margin(gain: float) -> float:
    """Nats by which a cause with more parameters must win."""
    return max(MARGIN_NATS, MARGIN_SHARE * gain)


def clearly_beaten(
    library: Library,
    simple: Hypothesis,
    other: Hypothesis,
    won: Float[np.ndarray, " R"],
    gain: float,
) -> bool:
    """Whether a simpler cause loses to another one, which wins `won` more nats on each run.

    With more parameters, the other one also fits what is neither's: it must win `margin`. With as
    many it can't: what counts is whether the data distinguish the two, by `MARGIN_NATS` and by two
    standard errors between runs.
    """
    if len(library.at(*other)) > len(library.at(*simple)):
        return bool(won.sum() >= margin(gain))
    return bool(won.sum() >= max(MARGIN_NATS, 2 * _error_of_sum(won)))


def choose(
    library: Library,
    theta: Float[np.ndarray, " p"],
    fits: Mapping[Hypothesis, Fit],
    threshold: float,
    alpha: float,
    accepted: Mapping[str, float] | None = None,
    strict: bool = False,
) -> Choice | None:
    """The cause that explains most, or None where nothing passes.

    To pass, a cause needs a held-out gain above `threshold` (calibrated for the number of causes),
    a robust p value that survives Bonferroni unless the gain is clear (`strict`: even then),
    admissible estimates, and an essential parameter that differs from zero.
    Echoes of causes accepted before must win one per cent of their gains (`accepted`). The largest
    held-out gain is chosen; a simpler cause replaces it unless clearly beaten. Ties are
    causes within two standard errors of the difference, clustered by run, and a few nats.
    """
    accepted = accepted or {}
    passing: dict[Hypothesis, Fit] = {}
    for hypothesis, fit in fits.items():
        name = hypothesis[0]
        needed = threshold
        for other, gain in accepted.items():
            if name in kind(other).echoes:
                needed = max(needed, ECHO_SHARE * gain)
        if (
            fit.heldout_gain > needed
            and (
                fit.p_value * len(fits) < alpha
                or (fit.heldout_gain > _clear(fit) * threshold and not strict)
            )
            and admissible(library, theta, fit)
            and is_itself(library, theta, fit)
        ):
            passing[hypothesis] = fit
    if not passing:
        return None
    order = sorted(passing, key=lambda h: (kind(h[0]).absorber, -passing[h].heldout_gain))
    top = order[0]
    best = passing[top].heldout_gain
    simpler = [
        h
        for h in order
        if h != top
        and _is_simpler(h, top)
        and not clearly_beaten(library, h, top, passing[top].heldout - passing[h].heldout, best)
    ]
    if simpler:
        top = simpler[0]
    ties = [h for h in order if h != top and _tied(passing[top], passing[h])]
    rivals = [(h, passing[h].heldout_gain) for h in order if h != top][:5]
    return Choice(top, passing[top], tuple(ties), tuple(rivals))


def p_value(fit: Fit, tried: int, chance: Chance) -> float:
    """Of the best of the causes tried: the robust one, or that of a clear gain in noise alone."""
    return min(1.0, fit.p_value * tried, chance.beyond(fit.heldout_gain / _clear(fit)))


def _clear(fit: Fit) -> float:
    return CLEAR_OF_FEW if len(fit.heldout) < _FEW else CLEAR


def _is_simpler(a: Hypothesis, b: Hypothesis) -> bool:
    return a[0] in kind(b[0]).simpler


def _tied(a: Fit, b: Fit) -> bool:
    difference = a.heldout - b.heldout
    return bool(difference.sum() < min(2 * _error_of_sum(difference), MARGIN_NATS))


def _error_of_sum(by_run: Float[np.ndarray, " R"]) -> float:
    """Standard error of a sum over runs."""
    return float(np.sqrt(len(by_run)) * by_run.std())


def parameters_of(library: Library, hypotheses: Sequence[Hypothesis]) -> list[int]:
    """Indices of all parameters of these causes."""
    return [i for h in hypotheses for i in library.at(*h)]
