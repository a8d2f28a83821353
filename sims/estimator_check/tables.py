"""The results of the check as tables."""

import math
from collections.abc import Sequence

import numpy as np

from ..diagnosis_benchmark.tables import Table
from ..run.estimate import BLOCKS, HEALTH, TRUSTED, average_bound
from ..run.log import FUSED
from .run import Result
from .scores import (
    FREEDOM,
    Average,
    average_nees,
    average_nis,
    time_averages,
    within_three_sigma,
)

PROMISED = 0.95
"""Required share of runs whose final error lies within three estimated standard deviations."""


def tables(results: Sequence[Result]) -> list[Table]:
    """All tables for which there are results."""
    healthy = [r for r in results if r.setting.table == "consistency"]
    faulty = [r for r in results if r.setting.table == "faults"]
    found = []
    if healthy:
        found += [_nees(healthy), _nis(healthy)]
    if faulty:
        found.append(_faults(faulty))
    return found


def _nees(results: Sequence[Result]) -> Table:
    count, seconds = _size(results)
    low, high = average_bound(3, count)
    averages = [[average_nees(r.scores, i) for i in range(3)] for r in results]
    good = sum(all(a.values.size and a.holds(a.values[-1]) for a in row) for row in averages)
    caption = (
        f"NEES, average of {count} runs of {seconds:g} s: value at the end, range over time, share "
        f"of times inside the 95 % bounds {low:.2f} to {high:.2f}. A consistent filter has 3; "
        f"values outside are bold. {good} of {len(results)} settings end with all three inside. "
        "Errors within a run are correlated in time: the value at one time averages over runs "
        "alone. After the semicolon: average over runs and time, with its standard error over runs."
    )
    header = ("setting", *BLOCKS, "not finite")
    rows = []
    of_runs = [time_averages(r.scores) for r in results]
    for result, row, each in zip(results, averages, of_runs, strict=True):
        cells = [_average(a, a.values[-1] if a.values.size else math.nan) for a in row]
        means = [_with_error(each[:, i]) for i in range(3)]
        joined = [f"{cell}; {mean}" for cell, mean in zip(cells, means, strict=True)]
        rows.append((result.setting.words, *joined, _lost(result)))
    if len(results) > 1:
        together = np.concatenate(of_runs)
        means = [_with_error(together[:, i]) for i in range(3)]
        rows.append((f"all {len(together)} runs", *means, ""))
    return Table(caption, header, rows)


def _nis(results: Sequence[Result]) -> Table:
    count, _ = _size(results)
    bounds = [(name, *average_bound(FREEDOM[name], count)) for name in FUSED]
    told = ", ".join(f"{name} {low:.2f} to {high:.2f}" for name, low, high in bounds)
    caption = (
        "NIS of fused readings: average over runs and time, range over time, share of times inside "
        f"the 95 % bounds ({told}). Gated: share of rejected readings. Drift: position error at "
        "the end relative to the length of the path."
    )
    header = ("setting", *(f"NIS {name}" for name in FUSED), *(f"gated {n}" for n in FUSED))
    rows = []
    for result in results:
        scores = result.scores
        averages = [average_nis(scores, name) for name in FUSED]
        taken, gated = scores["taken"].sum(axis=0), scores["gated"].sum(axis=0)
        shares = [f"{100 * g / max(t + g, 1):.2g} %" for t, g in zip(taken, gated, strict=True)]
        drift = np.linalg.norm(scores["error"][:, :3], axis=1) / np.maximum(scores["length"], 1e-9)
        cells = [_average(a, a.mean) for a in averages]
        rows.append((result.setting.words, *cells, *shares, _percent(_rms(drift))))
    return Table(caption, (*header, "drift, RMS"), rows)


def _faults(results: Sequence[Result]) -> Table:
    count, seconds = _size(results)
    shares = [within_three_sigma(r.scores).mean(axis=0) for r in results]
    kept = sum(bool((share >= PROMISED).all()) for share in shares)
    caption = (
        f"Faults from {seconds / 3:g} s on, {count} runs of {seconds:g} s each. Errors at the end: "
        "95th percentile, maximum, and median of the claimed error (root of the covariance's "
        "trace). Within 3σ: share of runs whose error lies in the 99.73 % ellipsoid of the claimed "
        "covariance (the probability of ± 3σ of one axis), for position, attitude and velocity. "
        f"{_percent(PROMISED)} are required of each; smaller shares are bold. {kept} of "
        f"{len(results)} rows meet this."
    )
    header = (
        "fault", "position (m)", "attitude (°)", "velocity (m/s)", "within 3σ", "not finite",
        "health",
    )  # fmt: skip
    rows = []
    for result, share in zip(results, shares, strict=True):
        errors = [_errors(result, i, unit) for i, unit in enumerate((1.0, 180 / np.pi, 1.0))]
        within = ", ".join(_marked(f"{100 * s:.0f}", s >= PROMISED) for s in share.tolist())
        rows.append((result.setting.words, *errors, f"{within} %", _lost(result), _health(result)))
    return Table(caption, header, rows)


def _size(results: Sequence[Result]) -> tuple[int, float]:
    return len(results[0].scores["finite"]), results[0].setting.scenario.duration


def _average(average: Average, value: float) -> str:
    if not average.values.size:
        return "–"
    ends = f"{_short(average.values.min())} to {_short(average.values.max())}"
    return f"{_marked(_short(value), average.holds(value))} ({ends}), {100 * average.share:.0f} %"


def _with_error(values: np.ndarray) -> str:
    """Mean and standard error of the finite ones."""
    values = values[np.isfinite(values)]
    if values.size < 2:
        return "–"
    return f"{values.mean():.2f} ± {values.std(ddof=1) / math.sqrt(values.size):.2f}"


def _errors(result: Result, block: int, unit: float) -> str:
    own = slice(3 * block, 3 * block + 3)
    norms = unit * np.linalg.norm(result.scores["error"][:, own], axis=1)
    norms = np.nan_to_num(norms, nan=np.inf)
    P = result.scores["covariance"].reshape(-1, 3, 3, 3)[:, block]
    claimed = unit * np.sqrt(np.maximum(np.trace(P, axis1=1, axis2=2), 0))
    below = np.percentile(norms, 95, method="higher")
    return f"{_short(below)}, {_short(norms.max())}, claimed {_short(np.median(claimed))}"


def _health(result: Result) -> str:
    """`degraded 100 % (dvl 100 %); at the end good 96 %, degraded 4 %`."""
    if "health_after" not in result.scores:
        return "–"
    found = result.scores["health_after"]
    doubted = zip(TRUSTED, found[:, 1:5].mean(axis=0), strict=True)
    names = ", ".join(f"{name} {100 * share:.0f} %" for name, share in doubted if share > 0)
    named = f" ({names})" if names else ""
    return f"{_states(found[:, 0])}{named}; at the end {_states(found[:, -1])}"


def _states(states: np.ndarray) -> str:
    """Share of runs in each state."""
    shares = [(name, 100 * np.mean(states == i)) for i, name in enumerate(HEALTH)]
    return ", ".join(f"{name} {share:.0f} %" for name, share in shares if share > 0)


def _lost(result: Result) -> str:
    """Number of runs in which the estimate was not finite."""
    lost = int((result.scores["finite"] < 0.5).sum())
    return _marked(str(lost), lost == 0)


def _marked(text: str, good: bool) -> str:
    return text if good else f"**{text}**"


def _short(value: float) -> str:
    if not math.isfinite(value):
        return "∞" if value > 0 else "–"
    return f"{value:.2g}" if abs(value) < 100 else f"{value:.0f}"


def _percent(value: float) -> str:
    return f"{100 * value:.2g} %" if math.isfinite(value) else "–"


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
