"""Runs of CSV files in time: cut at gaps, and resampled to the recording's grid."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..config.errors import UserError
from .build import Trajectory
from .csv_columns import METADATA
from .resample import geodesic, grid, hold, linear, slerp
from .schema import UNEVEN

_SHORTEST_STEP, _LONGEST_STEP = 1e-5, 1e3
_UNIFORM, _GAP_STEPS, _GAP_S = 1e-3, 10.0, 1.0
_FEW_STEPS, _USUAL = 4.5, 0.9
"""Without resampling a run is cut at steps longer than 4.5 times the 90th percentile, so that files
whose lines come in bursts are not cut at each burst."""
_MOST_SAMPLES = 10_000_000
"""Largest number of samples of a run on its grid: a week at 16 Hz."""


@dataclass(frozen=True)
class Run:
    """One file's content in W and B, component first, at the times of its samples."""

    scenario: str
    t: np.ndarray
    X: np.ndarray
    V: np.ndarray
    commands: dict[str, np.ndarray]
    voltage: np.ndarray | None


def cut(run: Run, name: str, notes: list[str], resample: bool) -> list[Run]:
    """Cut a run at long gaps between samples."""
    step = np.diff(run.t)
    limit = max(_GAP_STEPS * np.median(step), _GAP_S)
    if not resample:
        limit = min(limit, _FEW_STEPS * float(np.quantile(step, _USUAL)))
    edges = np.flatnonzero(step > limit) + 1
    if not edges.size:
        return [run]
    notes.append(
        f"{name}: cut at {edges.size} gap{'s' * (edges.size > 1)} of up to "
        f"{step[edges - 1].max():.1f} s."
    )
    bounds = [0, *edges.tolist(), run.t.size]
    pieces = [slice(a, b) for a, b in pairwise(bounds) if b - a > 1]
    return [
        replace(
            run,
            t=run.t[part],
            X=run.X[:, part],
            V=run.V[:, part],
            commands={name: values[:, part] for name, values in run.commands.items()},
            voltage=None if run.voltage is None else run.voltage[part],
        )
        for part in pieces
    ]


def common_step(
    folder: Path,
    times: Sequence[np.ndarray],
    rate: float | None,
    notes: list[str],
    resample: bool,
) -> float:
    """Step of the recording (s), which all runs share."""
    dt = float(np.median(np.concatenate([np.diff(t) for t in times])))
    if rate is not None:
        dt = 1.0 / rate
    elif not _SHORTEST_STEP <= dt <= _LONGEST_STEP:
        raise UserError(
            f"{folder}: steps of {dt:g} s; `t` is in seconds, and steps last {_SHORTEST_STEP:g} to "
            f"{_LONGEST_STEP:g} s"
        )
    elif abs(1.0 / dt - round(1.0 / dt)) < 1e-2:
        dt = 1.0 / round(1.0 / dt)
    longest = max(float(t[-1] - t[0]) for t in times)
    if longest > _MOST_SAMPLES * dt:
        raise UserError(
            f"{folder}: a run of {longest:g} s has more than {_MOST_SAMPLES} samples at "
            f"{1 / dt:.4g} Hz; give a lower `rate` in {METADATA}, or cut the run"
        )
    if rate is not None:
        return dt
    if resample and not all(_even(t, dt) for t in times):
        notes.append(f"Uneven time steps were resampled to {1 / dt:.4g} Hz.")
    return dt


def _even(t: np.ndarray, dt: float) -> bool:
    return bool(np.abs(t - t[0] - dt * np.arange(t.size)).max() < _UNIFORM * dt)


def on_grid(run: Run, dt: float) -> Trajectory:
    """The run resampled to the grid of step `dt`, unless it is there already."""
    if _even(run.t, dt):
        return _trajectory(run, {})
    t = grid(run.t[0], run.t[-1], dt)
    if np.isfinite(run.X).all():
        X = geodesic(t, run.t, run.X)
    else:  # position incomplete: geodesic of the rotation, linear interpolation of the rest
        X = np.concatenate([slerp(t, run.t, run.X[:4]), linear(t, run.t, run.X[4:])])
    commands = {name: hold(t, run.t, values, dt) for name, values in run.commands.items()}
    voltage = None if run.voltage is None else linear(t, run.t, run.voltage)
    V = linear(t, run.t, run.V)
    return _trajectory(replace(run, X=X, V=V, commands=commands, voltage=voltage), {})


def as_recorded(run: Run, dt: float) -> Trajectory:
    """The samples without resampling, with their times if these are not on a grid."""
    return _trajectory(run, {} if _even(run.t, dt) else {UNEVEN: run.t - run.t[0]})


def _trajectory(run: Run, sensors: dict[str, np.ndarray]) -> Trajectory:
    if run.voltage is not None:
        sensors = {"voltage": run.voltage, **sensors}
    return Trajectory(
        run.scenario,
        run.X.T,
        run.V.T,
        {name: values.T for name, values in run.commands.items()},
        sensors,
        float(run.t[0]),
    )
