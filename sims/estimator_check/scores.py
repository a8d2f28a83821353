"""Scores of the estimator in a run, and over many runs."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import chi2

from ..run.estimate import average_bound, estimate_error, mahalanobis, nees
from ..run.log import FUSED
from ..run.loop import Run

Scores = dict[str, np.ndarray]
"""Arrays of one run, or of many runs with the run as the first axis."""

FREEDOM = {"dvl": 3, "depth": 1, "compass": 1}
"""Components of a reading of each of `FUSED`."""
_THREE_SIGMA = float(chi2.ppf(0.9973, 3))


def score(run: Run, start: float = 0.0) -> Scores:
    """The scores of a run; one row per sample, NaN after its end.

    - `nees` (n, 3): of position, attitude, velocity;
    - `nis` (n, 3): of the readings of `FUSED` that were fused at that time, NaN where none was;
    - `taken`, `gated` (3): numbers of readings that were fused and that were rejected;
    - `error` (9), `covariance` (27): at the end, NaN if the run ended early; `length`: of the path
      (m); `finite`: 1 if the estimate was always finite and the run did not end early;
    - `health` (n, 5), if the filter has that port, and `health_after` (6): the worst state after
      `start` (s), 1 where a sensor was not trusted after it, and the last state.
    """
    log, scenario = run.log, run.scenario
    n = round(scenario.duration * scenario.log.rate) + 1
    known = estimate_error(log)
    assert known is not None
    error, steps = known[0], np.diff(log["X_WB"][:, 4:], axis=0)
    nis, rejected = log["nis"], log["rejected"]
    new = _changed(nis) | _changed(rejected)
    fused, gated = new & (rejected == 0) & np.isfinite(nis), new & (rejected > 0)
    claimed, whole = log["error_covariance"], len(error) == n
    found = {
        "nees": _to_length(nees(log), n),
        "nis": _to_length(np.where(fused, nis, np.nan), n),
        "taken": fused.sum(axis=0),
        "gated": gated.sum(axis=0),
        "error": error[-1] if whole else np.full(9, np.nan),
        "covariance": claimed[-1] if whole else np.full(27, np.nan),
        "length": np.linalg.norm(steps, axis=1).sum(),
        "finite": whole and np.isfinite(error).all() and np.isfinite(claimed).all(),
    }
    if "health" in log:
        after = log["health"][min(np.searchsorted(log.time, start), len(error) - 1) :]
        doubted, state = after[:, 1:].min(axis=0) < 0.5, after[:, 0]
        found["health"] = _to_length(log["health"], n)
        found["health_after"] = np.array([state.max(), *doubted, state[-1]])
    long = ("nees", "nis", "health")  # in single precision
    return {k: np.asarray(v, np.float32 if k in long else float) for k, v in found.items()}


def stacked(scores: Sequence[Scores]) -> Scores:
    """Scores of many runs, with the run as the first axis."""
    return {name: np.stack([one[name] for one in scores]) for name in scores[0]}


class Average(NamedTuple):
    """Average over runs at each time with values, with its 95 % bounds."""

    values: Float[np.ndarray, " times"]
    inside: Bool[np.ndarray, " times"]
    bound: tuple[float, float]
    """Of the average over all runs."""

    @classmethod
    def of(cls, squares: Float[np.ndarray, "runs times"], freedom: int) -> "Average":
        """The average of chi-square values; NaN marks missing ones."""
        counts = np.isfinite(squares).sum(axis=0)
        there = counts > 0
        mean = np.nansum(squares, axis=0)[there] / counts[there]
        bounds = np.array([average_bound(freedom, int(c)) for c in counts[there]]).reshape(-1, 2)
        inside = (bounds[:, 0] <= mean) & (mean <= bounds[:, 1])
        return cls(mean, inside, average_bound(freedom, len(squares)))

    @property
    def mean(self) -> float:
        """Mean over all times; NaN if there is none."""
        return float(self.values.mean()) if self.values.size else float("nan")

    @property
    def share(self) -> float:
        """Share of the times inside the bounds."""
        return float(self.inside.mean()) if self.inside.size else float("nan")

    def holds(self, value: float) -> bool:
        """Whether an average over all runs is within its bounds."""
        return bool(self.bound[0] <= value <= self.bound[1])


def average_nees(scores: Scores, block: int) -> Average:
    """NEES of a block; three degrees of freedom."""
    return Average.of(scores["nees"][:, :, block].astype(float), 3)


def time_averages(scores: Scores) -> Float[np.ndarray, "runs 3"]:
    """Average over time of each run's NEES; NaN for a run without any."""
    squares = scores["nees"].astype(float)
    counts = np.isfinite(squares).sum(axis=1)
    return np.where(counts > 0, np.nansum(squares, axis=1) / np.maximum(counts, 1), np.nan)


def average_nis(scores: Scores, sensor: str) -> Average:
    """NIS of a sensor's fused readings."""
    column = FUSED.index(sensor)
    return Average.of(scores["nis"][:, :, column].astype(float), FREEDOM[sensor])


def within_three_sigma(scores: Scores) -> Bool[np.ndarray, "runs 3"]:
    """Whether the final errors lie in the ellipsoid of 99.73 % probability, that of ± 3σ in 1-D.

    That is δᵀ P⁻¹ δ ≤ 14.16 with three degrees of freedom. Errors that are not finite are outside.
    """
    squares = mahalanobis(scores["error"].astype(float), scores["covariance"].astype(float))
    return np.nan_to_num(squares, nan=np.inf) <= _THREE_SIGMA


def _changed(values: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n 3"]:
    """Where values differ from the previous ones; the first from zero."""
    return np.not_equal(values, np.vstack([np.zeros((1, 3)), values[:-1]]))


def _to_length(values: np.ndarray, n: int) -> np.ndarray:
    """Exactly n rows: truncated, or filled with NaN."""
    found = np.full((n, values.shape[1]), np.nan)
    found[: len(values)] = values[:n]
    return found
