"""Experiment design: the maneuver that separates a cause from its rivals, or measures it, best.

Every maneuver of `maneuver_library` is simulated by the final model of the diagnosis, without
noise, and passed through the filter of the data. Without a cause A with parameters θ_A the
innovations would be -J_A θ_A; another cause B and all free parameters explain a part of that. The
part that they can't, in the recorded data and a maneuver together,

    D = min_b ½ |J_A θ_A - J_B b|²,

is the expected log likelihood ratio of A against B (Hunter and Reiner 1965, with the filter's
innovations as responses). What the data have decided needs no experiment: the value of a maneuver
is the information on the size of that part, ½ ln((1 + 2 D) / (1 + 2 D₀)) with D₀ that of the data
alone (the logarithm by which the size's standard error shrinks), in a minute.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ....models.effects.library import kind
from ....models.effects.noise import DisturbanceStateDependence
from ..disturbance.laws import Law
from ..filter.gram import gram
from ..filter.innovations import predict
from ..filter.kalman import judging_filter
from ..filter.problem import WILD, DiagnosisProblem, Evaluation
from ..filter.sensitivities import whitened_sensitivities
from ..filter.transition import Transition
from ..filter.varying import acting
from ..selection.hypotheses import Evidence
from ..selection.model_selection import Choice, Hypothesis, parameters_of
from .maneuver_library import MANEUVERS, simulate_maneuvers

NOTHING = 0.05
"""Nats a minute below which a maneuver counts as uninformative: standard errors 5 % smaller."""
_MOST = 4
"""Most rivals that a cause is to be distinguished from."""
_BY_ITSELF = {
    "actuation": "measure the thrust at the bollard with a scale",
    "body": "weigh the vehicle in air and in water and measure where its weights are",
    "environment": "measure the water with an instrument of its own, or go where it is still",
    "disturbance": "record ten minutes without commands",
    "measurement": "hold the instrument against another one",
}
"""Measurements for causes that no maneuver informs on, by the family of a cause."""
_DEPTHS = "repeat at two depths and several headings"
"""Experiment that distinguishes moving water from slow disturbances."""


@dataclass(frozen=True)
class Experiment:
    """The next experiment for one cause.

    Attributes:
        text: in words.
        nats: expected nats a minute by maneuver, against the rivals of the cause; empty for
            laws of the disturbance, which depend on no maneuver.
    """

    text: str
    nats: dict[str, float]


def experiments(
    problem: DiagnosisProblem,
    final: Evaluation,
    accepted: Sequence[Choice],
    nuisance: Sequence[int],
) -> dict[Hypothesis, Experiment]:
    """The next experiment for every accepted cause; `final` is the evaluation with all of them.

    It distinguishes a cause from its ties, else from its closest rival, else from its absence.
    """
    if not accepted:
        return {}
    names = [choice.hypothesis for choice in accepted]
    against = {choice.hypothesis: _opponents(choice, names) for choice in accepted}
    tried = [*names, *(other for others in against.values() for other in others)]
    rows = sorted({*nuisance, *parameters_of(problem.library, tried)})
    there = problem.evaluate(final.theta, rows, final.kalman, previous=final).plain
    flown = _products_of_maneuvers(problem, final, there)
    change = final.theta - problem.believed
    found = {}
    for a in names:
        own = problem.library.at(*a)
        free_rows = [
            i for i in rows if i not in own and (i in nuisance or _of(problem, i) in names)
        ]
        opponents = against[a]
        value = {
            maneuver: min(
                _information(there, T, own, [*free_rows, *_rows(problem, b, free_rows)], change)
                for b in (opponents or [None])
            ) / minutes
            for maneuver, (T, minutes) in flown.items()
        }  # fmt: skip
        found[a] = Experiment(_advice(a, opponents, value), value)
    return found


def _of(problem: DiagnosisProblem, i: int) -> Hypothesis:
    return problem.library.entries[i][:2]


def _rows(problem: DiagnosisProblem, b: Hypothesis | None, taken: Sequence[int]) -> list[int]:
    return [] if b is None else [i for i in problem.library.at(*b) if i not in taken]


def _opponents(choice: Choice, named: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Ties that were not accepted themselves, or else the closest rival that was not.

    Rivals in which the cause is nested, which have more parameters, are left out: they explain it
    in any maneuver.
    """
    own = choice.hypothesis[0]

    def nested(other: str) -> bool:
        wider = kind(other)
        return own in wider.simpler and len(wider.parameters) > len(kind(own).parameters)

    def apart(h: Hypothesis) -> bool:
        return h not in named and h[0] != own and not nested(h[0])

    ties = [h for h in choice.ties if apart(h)]
    return ties[:_MOST] or [h for h, _ in choice.rivals if apart(h)][:1]


def _products_of_maneuvers(
    problem: DiagnosisProblem, final: Evaluation, there: Evidence
) -> dict[str, tuple[Float[np.ndarray, "m m"], float]]:
    """Products of sensitivities in each maneuver, with the design of `there`, and its minutes."""
    inverse, design = np.linalg.inv(problem.mass(final.theta)), there.design
    products: dict[str, np.ndarray] = {}
    minutes: dict[str, float] = {}
    for names, data in simulate_maneuvers(problem, final.theta):
        library = acting(problem.library, data)
        p = predict(problem.model, library, final.theta, data)
        tame = (np.abs(np.asarray(p.jacobian)) < WILD).all(axis=(0, 1, 2))
        jacobian = np.where(tame, np.asarray(p.jacobian), 0.0)
        data = replace(data, weight=data.weight * tame)
        if not data.weight.any():
            continue
        steps = Transition.along(jacobian, data.weight, p.late, p.latent)
        kalman = judging_filter(final.noise, steps, inverse, data.dt, data.step, jacobian, p.latent)
        z = whitened_sensitivities(
            problem.model, library, final.theta, design.probes, data, p, kalman
        )
        seconds = (data.step * data.weight).sum(axis=0)
        for r, (name, G) in enumerate(zip(names, there.scaled(gram(z)), strict=True)):
            if name and np.isfinite(G).all():
                products[name] = products.get(name, 0.0) + G
                minutes[name] = minutes.get(name, 0.0) + seconds[r] / 60
    return {name: (G, minutes[name]) for name, G in products.items() if minutes[name] > 0}


def _information(
    there: Evidence,
    flown: Float[np.ndarray, "m m"],
    own: Sequence[int],
    free: Sequence[int],
    change: Float[np.ndarray, " p"],
) -> float:
    """Nats that a maneuver tells of a cause's size, beyond what the data have told."""
    before, added = _ratios(there, flown, own, free, change)
    return float(np.log1p(2 * added / (1 + 2 * before)) / 2)


def _ratios(
    there: Evidence,
    flown: Float[np.ndarray, "m m"],
    own: Sequence[int],
    free: Sequence[int],
    change: Float[np.ndarray, " p"],
) -> tuple[float, float]:
    """Nats by which the cause `own` beats all `free` parameters in the data; what a maneuver adds.

    `change` is the difference of the parameters from those without the cause.
    """
    rows = [i for i in own if there.shows(i)]
    absent = np.eye(len(flown))
    absent[0, 0] = 0.0
    absent[0, [there.column(i) for i in rows]] = -change[rows]
    before, new = (absent @ T @ absent.T for T in (there.total, flown))
    decided = max(there.least(before, free), 0.0)
    return decided, max(there.least(before + new, free) - decided, 0.0)


def _advice(a: Hypothesis, opponents: Sequence[Hypothesis], value: Mapping[str, float]) -> str:
    best = max(value, key=lambda maneuver: value[maneuver])
    family = kind(a[0]).family
    names = list(dict.fromkeys(name for name, _ in opponents))
    apart = f"to distinguish it from {', '.join(names)}" if names else "to measure it better"
    if value[best] < NOTHING:
        return f"{apart}: {_BY_ITSELF[family]}; no maneuver of the set does"
    return f"{apart}: {MANEUVERS[best].text} ({_shrinks(value[best])})"


def _shrinks(nats: float) -> str:
    """What so many nats a minute mean for the standard error of a cause."""
    times = "over 100" if nats > np.log(100) else f"{np.exp(nats):.2g}"
    return f"expected: a standard error {times} times smaller after a minute"


def of_law(
    law: Law, rivals: Sequence[Law], problem: DiagnosisProblem, final: Evaluation
) -> Experiment:
    """The next experiment for a law of the disturbance.

    Noise does not depend on the maneuver, except for growth with the speed: there the maneuver is
    taken whose speeds vary most, by the expected likelihood ratio ½ E[ρ - 1 - log ρ] of a variance
    that grows with the speed against a constant one.
    """
    slow = [r.name for r in rivals if kind(r.name).slow]
    if kind(law.name).slow and slow:
        return Experiment(f"to distinguish it from {slow[0]}: {_DEPTHS}", {})
    if law.name == DisturbanceStateDependence.name:
        k = law.parameters["growth"]
        value = {
            t: _of_growth(k, v) / problem.data.dt * 60 for t, v in _speeds(problem, final).items()
        }
        best = max(value, key=lambda maneuver: value[maneuver])
        text = f"{MANEUVERS[best].text} (expected: odds of e^{value[best]:.0f} to 1 after a minute)"
        return Experiment(f"to measure it better: {text}", value)
    return Experiment(_BY_ITSELF[kind(law.name).family], {})


def _of_growth(k: float, speed: Float[np.ndarray, " n"]) -> float:
    grown = 1 + k * speed**2
    ratio = grown / grown.mean()
    return float(np.mean(ratio - 1 - np.log(ratio)) / 2)


def _speeds(problem: DiagnosisProblem, final: Evaluation) -> dict[str, Float[np.ndarray, " n"]]:
    found: dict[str, list[np.ndarray]] = {}
    for names, data in simulate_maneuvers(problem, final.theta):
        speed = np.linalg.norm(data.V[:-1, :3], axis=1)
        for r, name in enumerate(names):
            if name:
                found.setdefault(name, []).append(speed[data.weight[:, r] > 0, r])
    joined = {name: np.concatenate(parts) for name, parts in found.items()}
    return {name: v for name, v in joined.items() if len(v)}
