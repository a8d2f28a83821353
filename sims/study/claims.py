"""The paper's claims about simulation, each tested on the table of runs.

A claim is a function of the rows (`table.collect`) alone: `reproduced`, `not reproduced`, or `not
tested` if the runs that it needs are missing. Margins are stated with each claim.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .config import REGIMES
from .table import Row

State = Literal["reproduced", "not reproduced", "not tested"]

FDM = ("fdm-geodesic", "fdm-chordal")
GROUP_BASELINES = ("pinn", "moments")
EUCLIDEAN = ("euclidean-fdm", "euclidean-moments", "euclidean-distance-aware")
UNCONSTRAINED = "euclidean-unconstrained"
COLLAPSED = 0.5
"""Share of the true spread below which a law counts as nearly deterministic."""
ALIKE = 0.1
"""Relative difference below which two means count as equal."""


@dataclass(frozen=True)
class Verdict:
    """A claim, its state, and the numbers that it is based on."""

    claim: str
    state: State
    evidence: str


@dataclass(frozen=True)
class _Mean:
    """Mean over successful runs, its standard error and their number."""

    value: float
    error: float
    count: int

    def __str__(self) -> str:
        spread = f" ± {self.error * math.sqrt(self.count):.2g}" if self.count > 1 else ""
        return f"{self.value:.3g}{spread}"


def verdicts(rows: Sequence[Row]) -> list[Verdict]:
    """The verdict on every claim."""
    claims: tuple[Callable[[Sequence[Row]], Verdict], ...] = (
        fdm_is_best,
        errors_are_competitive,
        deterministic_and_moments_are_worse,
        moments_collapse,
        distance_aware_collapses,
        euclidean_fdm_is_unstable,
        geometric_training_succeeds,
        unconstrained_fails,
        gain_is_largest_in_sparse_data,
        kernels_are_alike,
    )
    return [claim(rows) for claim in claims]


# ------------------------------------------------------------------------------------- the claims


def fdm_is_best(rows: Sequence[Row]) -> Verdict:
    """Both FDM variants' mean W₂ lies below every baseline's, by more than the standard error."""
    text = "Finite dimensional matching on the group comes closest to the true law (W₂)."
    told, good, seen = [], [], False
    for regime, table in _by_regime(rows, "w2"):
        mine = [m for m in FDM if m in table]
        others = [m for m in (*GROUP_BASELINES, *EUCLIDEAN) if m in table]
        failed = [m for m in FDM if m not in table and _runs(rows, regime, m)]
        if failed:
            seen = True
            good += [False for _ in failed]
            told.append(f"{regime}: no run of {', '.join(failed)} succeeded")
        if not mine or not others:
            continue
        seen = True
        best = min(others, key=lambda m: table[m].value)
        good += [_below(table[m], table[best]) for m in mine]
        listed = ", ".join(f"{m} {table[m]}" for m in (*mine, best))
        told.append(f"{regime}: {listed} (the best baseline); floor {_floor(rows, regime, 'w2')}")
        debiased = {m: _mean(rows, regime, m, "w2_debiased") for m in (*mine, *others)}
        known = {m: v for m, v in debiased.items() if v is not None}
        if known:
            first = min(known, key=lambda m: known[m].value)
            told[-1] += f"; by debiased W₂ {first} is closest ({known[first]})"
    return _verdict(text, good, told, seen)


def errors_are_competitive(rows: Sequence[Row]) -> Verdict:
    """Each FDM variant's error of the mean path is at most a tenth above the best baseline's."""
    text = "FDM's errors (RMSE) are smaller than the baselines' or competitive with them."
    told, good, seen = [], [], False
    for quantity in ("rmse_mean_geodesic", "rmse_mean_velocity"):
        for regime, table in _by_regime(rows, quantity):
            mine = [m for m in FDM if m in table]
            others = [m for m in (*GROUP_BASELINES, *EUCLIDEAN) if m in table]
            if not mine or not others:
                continue
            seen = True
            best = min(others, key=lambda m: table[m].value)
            limit = (1 + ALIKE) * table[best].value
            good += [table[m].value <= limit for m in mine]
            part = quantity.rpartition("_")[2]
            listed = ", ".join(f"{m} {table[m]}" for m in (*mine, best))
            told.append(f"{regime}, {part} error of the mean path: {listed}")
    return _verdict(text, good, told, seen)


def deterministic_and_moments_are_worse(rows: Sequence[Row]) -> Verdict:
    """W₂ of the PINN and of moment matching lies above geodesic FDM's by the standard error."""
    text = "Geometry alone is not enough: W₂ of geometric PINN and moment matching is larger."
    told, good, seen = [], [], False
    for regime, table in _by_regime(rows, "w2"):
        others = [m for m in GROUP_BASELINES if m in table]
        mine = [table[m] for m in FDM if m in table]
        if not others or not mine:
            continue
        seen = True
        best = min(mine, key=lambda m: m.value)
        good += [_below(best, table[m]) for m in others]
        listed = ", ".join(f"{m} {table[m]}" for m in others)
        told.append(f"{regime}: W₂ {listed} against {best} for FDM")
    return _verdict(text, good, told, seen)


def moments_collapse(rows: Sequence[Row]) -> Verdict:
    """The mean spread of velocities is below half of the truth's for every moment-matched model."""
    text = "Moment matching collapses towards a deterministic model."
    return _collapse(rows, ("moments", "euclidean-moments"), text)


def distance_aware_collapses(rows: Sequence[Row]) -> Verdict:
    """The same for the distance-aware objective."""
    text = "The distance-aware objective collapses towards a deterministic model, too."
    return _collapse(rows, ("euclidean-distance-aware",), text)


def euclidean_fdm_is_unstable(rows: Sequence[Row]) -> Verdict:
    """At least one seed fails on sparse data."""
    text = "The Euclidean SPINN trained by FDM is unstable on sparse data (3 of 5 seeds succeed)."
    runs = _runs(rows, "sparse", "euclidean-fdm")
    good = [sum(r["success"] for r in runs) < len(runs)]
    return _verdict(text, good, [_rate(rows, "euclidean-fdm", ("sparse",))], bool(runs))


def geometric_training_succeeds(rows: Sequence[Row]) -> Verdict:
    """Every run of every method on the group is finite and converged."""
    text = "Training on the group always succeeds (100 %)."
    methods = dict.fromkeys(r["method"] for r in rows if not r["method"].startswith("euclidean"))
    runs = [r for r in rows if r["method"] in methods]
    told = [_rate(rows, m) for m in methods]
    return _verdict(text, [r["success"] for r in runs], told, bool(runs))


def unconstrained_fails(rows: Sequence[Row]) -> Verdict:
    """No run succeeds, in neither regime."""
    text = "The unconstrained distance-aware objective fails to train in both regimes."
    runs = [r for r in rows if r["method"] == UNCONSTRAINED]
    both = {r["regime"] for r in runs} == set(REGIMES)
    good = [not r["success"] for r in runs]
    told = [_rate(rows, UNCONSTRAINED)]
    if runs and all(good) and not both:
        return Verdict(text, "not tested", f"{told[0]}; only one regime was run")
    return _verdict(text, good, told, bool(runs))


def gain_is_largest_in_sparse_data(rows: Sequence[Row]) -> Verdict:
    """The best baseline's W₂ over the best FDM's is larger on sparse data than on rich."""
    text = "The improvement in W₂ is largest on sparse data."
    gains = {}
    for regime, table in _by_regime(rows, "w2"):
        mine = [table[m].value for m in FDM if m in table]
        others = [table[m].value for m in (*GROUP_BASELINES, *EUCLIDEAN) if m in table]
        if mine and others:
            gains[regime] = min(others) / min(mine)
    told = [f"{regime}: best baseline / best FDM = {gain:.3g}" for regime, gain in gains.items()]
    seen = len(gains) == len(REGIMES)
    return _verdict(text, [seen and gains["sparse"] > gains["rich"]], told, seen)


def kernels_are_alike(rows: Sequence[Row]) -> Verdict:
    """The two kernels' mean W₂ differ by at most a tenth, or by less than two standard errors."""
    text = "Chordal and geodesic FDM perform alike in simulation."
    told, good = [], []
    for regime, table in _by_regime(rows, "w2"):
        if not all(m in table for m in FDM):
            continue
        a, b = (table[m] for m in FDM)
        gap = abs(a.value - b.value)
        near = gap <= ALIKE * min(a.value, b.value)
        good.append(near or gap <= 2 * math.hypot(a.error, b.error))
        told.append(f"{regime}: geodesic {a}, chordal {b}")
    return _verdict(text, good, told, bool(good))


# ---------------------------------------------------------------------------------------- targets


def targets(rows: Sequence[Row], method: str = "fdm-geodesic") -> list[Verdict]:
    """The project's own targets for sparse data: `reproduced` means that every run meets them."""
    runs = _runs(rows, "sparse", method)

    def each(text: str, name: str, low: float, high: float) -> Verdict:
        values = [float(r.get(name, math.nan)) for r in runs]
        good = [r["success"] and low <= v <= high for r, v in zip(runs, values, strict=True)]
        told = [f"{sum(good)} of {len(runs)} seeds", "values " + ", ".join(map(_short, values))]
        return _verdict(text, good, told, bool(runs))

    axes = sorted({k for r in runs for k in r if k.startswith("b_") and k.endswith("_ratio")})
    worst = [max((abs(float(r[k]) - 1) for k in axes if k in r), default=math.nan) for r in runs]
    within = [r["success"] and w <= 0.2 for r, w in zip(runs, worst, strict=True)]
    told = [
        f"{sum(within)} of {len(runs)} seeds",
        "largest deviation of an axis " + ", ".join(f"{w:.0%}" for w in worst),
    ]
    return [
        each(f"{method}: W₂ is at most 1.25 × the floor", "w2_ratio", 0.0, 1.25),
        each(f"{method}: the 90 % band covers 85 to 95 %", "coverage_90", 0.85, 0.95),
        _verdict(f"{method}: diffusion within 20 % on each axis", within, told, bool(runs)),
    ]


# ---------------------------------------------------------------------------------------- helpers


def _runs(rows: Sequence[Row], regime: str, method: str) -> list[Row]:
    return [r for r in rows if (r["regime"], r["method"]) == (regime, method)]


def _mean(rows: Sequence[Row], regime: str, method: str, name: str) -> _Mean | None:
    runs = [r for r in _runs(rows, regime, method) if r["success"]]
    values = np.array([r.get(name, math.nan) for r in runs], float)
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    error = float(values.std(ddof=1)) / math.sqrt(values.size) if values.size > 1 else 0.0
    return _Mean(float(values.mean()), error, int(values.size))


def _by_regime(rows: Sequence[Row], name: str) -> list[tuple[str, dict[str, _Mean]]]:
    """Means by method for every regime; methods without a successful run are left out."""
    found = []
    for regime in REGIMES:
        methods = dict.fromkeys(r["method"] for r in rows if r["regime"] == regime)
        means = {m: _mean(rows, regime, m, name) for m in methods}
        found.append((regime, {m: v for m, v in means.items() if v is not None}))
    return found


def _floor(rows: Sequence[Row], regime: str, name: str) -> str:
    values = [float(r.get(f"{name}_floor", math.nan)) for r in rows if r["regime"] == regime]
    known = [v for v in values if math.isfinite(v)]
    return _short(float(np.mean(known))) if known else "unknown"


def _below(a: _Mean, b: _Mean) -> bool:
    return a.value + math.hypot(a.error, b.error) < b.value


def _rate(rows: Sequence[Row], method: str, regimes: Sequence[str] = REGIMES) -> str:
    parts = []
    for regime in regimes:
        runs = _runs(rows, regime, method)
        if runs:
            parts.append(f"{sum(r['success'] for r in runs)} of {len(runs)} {regime}")
    return f"{method} succeeded in {', '.join(parts)}" if parts else f"{method} was not run"


def _collapse(rows: Sequence[Row], methods: Sequence[str], text: str) -> Verdict:
    told, good = [], []
    for regime, table in _by_regime(rows, "spread_velocity_ratio"):
        for method in methods:
            if method not in table:
                continue
            good.append(table[method].value < COLLAPSED)
            covered = _mean(rows, regime, method, "coverage_90")
            told.append(
                f"{regime} {method}: spread of velocities {table[method]} of the truth's, "
                f"90 % band covers {'–' if covered is None else f'{covered.value:.0%}'}"
            )
    return _verdict(text, good, told, bool(good))


def _verdict(text: str, good: Sequence[bool], told: Sequence[str], seen: bool) -> Verdict:
    if not seen:
        return Verdict(text, "not tested", "the runs that it needs are missing")
    state: State = "reproduced" if all(good) else "not reproduced"
    return Verdict(text, state, "; ".join(told))


def _short(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3g}"
