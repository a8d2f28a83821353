"""Healthy runs and new ones under one model and one noise, and the rate of false alarms."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ....models.config.errors import UserError
from ....models.dynamics import Dynamics
from ....models.effects.library import kind
from ....models.recordings.store import Recording
from ....models.se3 import CHANNELS
from ....models.vehicles.vehicle import Vehicle
from ..data.arrays import Data
from ..data.checks import problems, require_enough
from ..filter.gram import pooled
from ..filter.noise import Noise
from ..filter.problem import DiagnosisProblem, Evaluation
from ..selection.model_selection import Hypothesis, parameters_of
from .calibration import Calibration, calibrate
from .scatter import Change, Units, changes, directions, noise_changes

Unit = Literal["scenario", "run", "stretch"]
_ENOUGH = 6
"""Least number of units of a level for their scatter to be known; else the next finer level."""
_SPLITS = 40
"""Random splits of the healthy units whose smaller part is judged by the other."""
_RATE = 0.1
"""Relative difference of sample rates up to which data have the same noise from step to step."""


class Scores(NamedTuple):
    """The largest score over all causes, and over the sizes of errors on all channels."""

    causes: float
    noise: float


class Limits(NamedTuple):
    """Their thresholds; each has half of the rate of false alarms."""

    causes: Calibration
    noise: Calibration

    @property
    def rate(self) -> float:
        """Of false alarms of both together."""
        return self.causes.rate + self.noise.rate

    @property
    def counted(self) -> float:
        """The least rate that so many units can show by count."""
        return self.causes.counted + self.noise.counted

    def exceeded(self, scores: Scores) -> bool:
        """Whether one of them is exceeded."""
        return scores.causes > self.causes.threshold or scores.noise > self.noise.threshold


def units_of(data: Data, level: Unit) -> Int[np.ndarray, " R"]:
    """The unit of each piece."""
    own = {"scenario": data.scenario, "run": data.run, "stretch": data.cluster}[level]
    return np.unique(own, return_inverse=True)[1]


def level_of(data: Data) -> Unit:
    """The coarsest level with enough units: what repeats the same motion shares its errors."""
    for level in ("scenario", "run"):
        if units_of(data, level).max() + 1 >= _ENOUGH:
            return level
    return "stretch"


def in_noise(
    problem: DiagnosisProblem, theta: Float[np.ndarray, " p"], noise: Noise | None = None
) -> Evaluation:
    """θ with sensitivities to all parameters, in a given noise (by default that of the data)."""
    rows = parameters_of(problem.library, problem.library.hypotheses())
    rows = sorted({*rows, *np.flatnonzero(problem.believed).tolist()})
    if noise is None:
        return problem.evaluate(theta, rows)
    predictions = problem.predict(theta)[0]
    return problem.evaluate(theta, rows, problem.filter_in(noise, theta, predictions))


@dataclass(frozen=True)
class Side:
    """Runs under the healthy model, by unit.

    Attributes:
        seen: the evaluation.
        unit: of each piece.
        products: of innovations (column 0) and sensitivities per unit of each parameter (u, m, m).
        sizes: logarithm of the mean square of each measured channel's innovations (u, c).
    """

    seen: Evaluation
    unit: Int[np.ndarray, " R"]
    products: Float[np.ndarray, "u m m"]
    sizes: Float[np.ndarray, "u c"]

    @classmethod
    def of(cls, problem: DiagnosisProblem, seen: Evaluation, level: Unit) -> "Side":
        """Sums by unit of an evaluation."""
        unit, evidence = units_of(problem.data, level), seen.plain
        own = np.flatnonzero(problem.data.measured)
        square = (seen.z.astype(float) ** 2).sum(axis=0)[own]
        sums = np.stack([np.bincount(unit, row) for row in square], axis=1)
        count = np.bincount(unit, problem.data.weight.sum(axis=0))
        sizes = np.log(np.maximum(sums, 1e-300) / count[:, None])
        first = np.unique(problem.data.cluster, return_index=True)[1]
        return cls(seen, unit, pooled(evidence.runs, unit[first]), sizes)

    def columns(self, rows: Sequence[int]) -> list[int]:
        """Columns of parameters."""
        return [self.seen.plain.column(i) for i in rows]

    def units(
        self,
        rows: Sequence[int],
        weights: Float[np.ndarray, " m"],
        project: Float[np.ndarray, "k q"],
    ) -> Units:
        """Scores and information of the combinations `project` of parameters, at innovations that
        are the `weights` of the columns.
        """
        columns = self.columns(rows)
        score = -(self.products[:, columns] @ weights) @ project.T
        information = self.products[:, columns][:, :, columns]
        return Units(score, project @ information @ project.T)


class Baseline:
    """Healthy runs, a model of them, and new runs in the same terms.

    Attributes:
        level: what a unit is.
        healthy, new: the problems, with the healthy model as their belief.
        noise: of the healthy runs, in which both are judged.
        hypotheses: causes that both can show.
        shortest: change of a lag or delay (s) that is no change: integration error looks like it.
    """

    def __init__(
        self,
        healthy: Recording,
        new: Recording,
        vehicle: Vehicle,
        model: Dynamics,
        shortest: float = 0.0,
    ):
        self.shortest = shortest
        left_out, faulty = (problems(recording)[1] for recording in (healthy, new))
        first = DiagnosisProblem.of(new, vehicle, model, faulty)
        self.healthy = DiagnosisProblem.of(healthy, vehicle, model, left_out, first.data)
        self.new = DiagnosisProblem.of(new, vehicle, model, faulty, self.healthy.data)
        _check_alike(self.healthy.data, self.new.data)
        for problem in (self.healthy, self.new):
            require_enough(problem.data)
        self.level: Unit = level_of(self.healthy.data)
        seen = in_noise(self.healthy, self.healthy.believed)
        self.of_healthy = Side.of(self.healthy, seen, self.level)
        self.noise = self.of_healthy.seen.noise
        both = set(self.new.library.hypotheses())
        self.hypotheses = [h for h in self.healthy.library.hypotheses() if h in both]

    def side(self, theta: Float[np.ndarray, " p"]) -> Side:
        """The new runs under θ."""
        return Side.of(self.new, in_noise(self.new, theta, self.noise), self.level)

    @property
    def units(self) -> int:
        """Number of healthy units."""
        return len(self.of_healthy.products)

    @cached_property
    def fitted(self) -> list[int]:
        """Parameters of the healthy model that its runs have set."""
        return np.flatnonzero(self.healthy.believed).tolist()

    def tests(
        self,
        new: Side,
        taken: Sequence[Hypothesis] = (),
        kept: Bool[np.ndarray, " u"] | None = None,
    ) -> tuple[dict[Hypothesis, Change], Scores]:
        """Changes by cause with those `taken` free, and the largest scores.

        With `kept` healthy units, the model's coefficients are refitted to these by one step.
        """
        old = self.of_healthy
        weights = np.eye(old.products.shape[1])[0]
        if kept is not None:
            weights = weights + self._refitted(kept)
        ones = np.eye(new.products.shape[1])[0] if new is not old else weights
        names = [h for h in self.hypotheses if h not in taken]
        held, sets = [i for h in taken for i in self.new.library.at(*h)], []
        total = new.products.sum(axis=0)
        for h in names:
            rows = self.new.library.at(*h)
            project = _projection(total, new.columns(rows), new.columns(held))
            own = new.units([*rows, *held], ones, project)
            there = [self._row(i) for i in [*rows, *held]]
            others = old.units(there, weights, project)
            if kept is not None:
                own, others = own.select(~kept), others.select(kept)
            sets.append(directions(others, own))
        sizes = (old.sizes, new.sizes) if kept is None else (old.sizes[kept], old.sizes[~kept])
        off, width, of_noise = noise_changes(*sizes)
        found = changes(sets, float(np.exp(max(np.max(off - width), 0.0))))
        by_name = {
            h: c
            for h, c in zip(names, found, strict=True)
            if c is not None
            and not (kind(h[0]).timing and np.all(np.abs(c.change) < self.shortest))
        }
        most = max((c.score for c in by_name.values()), default=0.0)
        return by_name, Scores(most, float(of_noise.max()))

    def noise_tests(self, new: Side) -> dict[str, tuple[float, float, float]]:
        """Changes of the logarithm of error sizes by channel, half-widths (95 %), scores."""
        names = [n for n, there in zip(CHANNELS, self.new.data.measured, strict=True) if there]
        found = noise_changes(self.of_healthy.sizes, new.sizes)
        return {n: (float(a), float(b), float(c)) for n, a, b, c in zip(names, *found, strict=True)}

    def limits(self, rate: float, judged: int, seed: int = 0) -> Limits:
        """Thresholds at a rate of false alarms, from healthy units that are left out.

        Each is left out alone; thresholds are no lower than scores of the runs or scenarios that
        they belong to, and than those of random splits with as many units as are `judged`.
        """
        n, everything = self.units, np.arange(self.units)
        rng, size = np.random.default_rng(seed), min(judged, n // 2)
        alone = [[u] for u in range(n)]
        drawn = [rng.permutation(n)[:size] for _ in range(_SPLITS if size > 1 else 0)]
        scores = {
            name: np.array([self._score(~np.isin(everything, part)) for part in parts])
            for name, parts in (("alone", alone), ("grouped", self._groups()), ("split", drawn))
        }
        tried = len(self.hypotheses), int(self.new.data.measured.sum())
        return Limits(*(
            _limit({k: v[:, i] for k, v in scores.items() if len(v)}, rate / 2, count)
            for i, count in enumerate(tried)
        ))  # fmt: skip

    def _score(self, kept: Bool[np.ndarray, " u"]) -> Scores:
        return self.tests(self.of_healthy, kept=kept)[1]

    def _groups(self) -> list[Int[np.ndarray, " g"]]:
        """Units of each coarser unit, where there are several."""
        coarser: tuple[Unit, ...] = ("scenario", "run")
        found: dict[tuple[int, ...], np.ndarray] = {}
        for level in coarser[: {"scenario": 0, "run": 1, "stretch": 2}[self.level]]:
            above = units_of(self.healthy.data, level)
            for g in np.unique(above):
                own = np.unique(self.of_healthy.unit[above == g])
                if 1 < len(own) <= self.units // 2:
                    found[tuple(own.tolist())] = own
        return list(found.values())

    def _refitted(self, kept: Bool[np.ndarray, " u"]) -> Float[np.ndarray, " m"]:
        """Changes of the model's coefficients, as weights of columns, if fitted to units alone."""
        old, rows = self.of_healthy, self.fitted
        weights = np.zeros(old.products.shape[1])
        if not rows:
            return weights
        columns, evidence = old.columns(rows), old.seen.plain
        T = old.products[kept].sum(axis=0)
        lost = old.products[~kept].sum(axis=0)
        H = T[np.ix_(columns, columns)] + np.diag(evidence.prior(rows))
        # at the fit to all units, the score of those kept is minus that of the others
        weights[columns] = np.linalg.solve(H, lost[columns, 0])
        return weights

    def _row(self, i: int) -> int:
        """The healthy problem's row of a parameter of the new one."""
        entry = self.new.library.entries[i]
        return self.healthy.library.index(entry.cause, entry.where, entry.parameter.name)


def _projection(
    total: Float[np.ndarray, "m m"], own: Sequence[int], held: Sequence[int]
) -> Float[np.ndarray, "k q"]:
    """The combinations of scores of `own` and `held` parameters that are those with these free."""
    eye = np.eye(len(own))
    if not held:
        return eye
    H = total[np.ix_(held, held)]
    H = H + 1e-10 * np.diag(np.maximum(np.diag(H), 1e-300))
    return np.concatenate([eye, -np.linalg.solve(H, total[np.ix_(held, own)]).T], axis=1)


def _limit(scores: Mapping[str, Float[np.ndarray, " n"]], rate: float, tried: int) -> Calibration:
    """The threshold of one kind of tests, of which so many were `tried`."""
    found = calibrate(scores["alone"], rate, float(np.log(tried / rate)))
    threshold = max([found.threshold, *scores.get("grouped", ())])
    if "split" in scores:
        threshold = max(threshold, float(np.quantile(scores["split"], 1 - rate, method="higher")))
    alarms = int(np.sum(scores["alone"] > threshold))
    return found._replace(threshold=float(threshold), alarms=alarms)


def _check_alike(healthy: Data, new: Data) -> None:
    """Refuse data that can't be judged in the noise of the healthy ones."""
    if abs(np.log(new.dt / healthy.dt)) > np.log1p(_RATE):
        raise UserError(
            f"--against: healthy runs have {1 / healthy.dt:.3g} samples a second and the new ones "
            f"{1 / new.dt:.3g}; give both at one rate"
        )
    for name, a, b in (
        ("commands", healthy.command, new.command),
        ("channels that were not measured", healthy.unmeasured, new.unmeasured),
        ("number of thrusters", healthy.u.shape[1], new.u.shape[1]),
    ):
        if a != b:
            raise UserError(
                f"--against: {name} of healthy runs ({_told(a)}) and of new ones ({_told(b)}) "
                "differ; record both in the same way"
            )


def _told(value: object) -> str:
    return ", ".join(value) or "none" if isinstance(value, tuple) else str(value)
