"""Bad data: what a diagnosis must find and name before anything else.

Each takes the runs of a case, spoils some and tells what it did:

    runs, told = spoil(case.logged(), "stuck", seed=3)
    write_folder(folder, runs)
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from .simulator import streams
from .write import Run, change

GROUPS = {
    "dvl": ("u", "v", "w"),
    "depth": ("z",),
    "gyro": ("p", "q", "r"),
    "attitude": ("qw", "qx", "qy", "qz"),
}
Told = dict[str, Any]


def _sections(run: Run, rng: np.random.Generator, seconds: float) -> tuple[int, int]:
    """First and last sample of a stretch in the middle of a run."""
    t = run.columns["t"]
    begin = rng.uniform(0.2, 0.5) * (t[-1] - t[0] - seconds) + t[0]
    return int(np.searchsorted(t, begin)), int(np.searchsorted(t, begin + seconds))


def stuck(run: Run, rng: np.random.Generator) -> tuple[Run, Told]:
    """A sensor repeats its last value for 3 s."""
    group = str(rng.choice(sorted(GROUPS)))
    a, b = _sections(run, rng, 3.0)
    columns = {name: run.columns[name].copy() for name in GROUPS[group]}
    for values in columns.values():
        values[a:b] = values[a]
    return change(run, **columns), {"columns": list(columns), "samples": [a, b]}


def lost_lock(run: Run, rng: np.random.Generator) -> tuple[Run, Told]:
    """The DVL tells exactly zero for 1 s, as was seen on loss of bottom lock."""
    a, b = _sections(run, rng, 1.0)
    columns = {name: run.columns[name].copy() for name in GROUPS["dvl"]}
    for values in columns.values():
        values[a:b] = 0.0
    return change(run, **columns), {"columns": list(columns), "samples": [a, b]}


def gap(run: Run, rng: np.random.Generator, seconds: float = 2.0) -> tuple[Run, Told]:
    """Lines are missing for 2 s."""
    a, b = _sections(run, rng, seconds)
    keep = np.ones(run.columns["t"].size, bool)
    keep[a:b] = False
    columns = {name: values[keep] for name, values in run.columns.items()}
    return replace(run, columns=columns), {"columns": ["t"], "samples": [a, a]}


def clock_jump(run: Run, rng: np.random.Generator, seconds: float = 0.4) -> tuple[Run, Told]:
    """All time stamps jump ahead by 0.4 s at some line; nothing is missing."""
    a, _ = _sections(run, rng, 1.0)
    t = run.columns["t"].copy()
    t[a:] += seconds
    return change(run, t=t), {"columns": ["t"], "samples": [a, a], "seconds": seconds}


def pose_jump(run: Run, rng: np.random.Generator, metres: float = 0.5) -> tuple[Run, Told]:
    """The estimator resets its position: x and y jump."""
    a, _ = _sections(run, rng, 1.0)
    angle = rng.uniform(-np.pi, np.pi)
    x, y = run.columns["x"].copy(), run.columns["y"].copy()
    x[a:] += metres * np.cos(angle)
    y[a:] += metres * np.sin(angle)
    return change(run, x=x, y=y), {"columns": ["x", "y"], "samples": [a, a], "metres": metres}


def outliers(run: Run, rng: np.random.Generator) -> tuple[Run, Told]:
    """Single DVL readings are off by metres a second."""
    N = run.columns["t"].size
    at = np.sort(rng.choice(np.arange(5, N - 5), max(N // 40, 2), replace=False))
    columns = {name: run.columns[name].copy() for name in GROUPS["dvl"]}
    for values in columns.values():
        values[at] += rng.normal(0, 3.0, at.size)
    return change(run, **columns), {"columns": list(columns), "samples": at.tolist()}


def missing_cells(run: Run, rng: np.random.Generator) -> tuple[Run, Told]:
    """Cells of one velocity are empty (NaN) for a few lines; a reader may refuse the file."""
    a, _ = _sections(run, rng, 1.0)
    name = str(rng.choice(GROUPS["dvl"]))
    values = run.columns[name].copy()
    values[a : a + 4] = np.nan
    return change(run, **{name: values}), {"columns": [name], "samples": [a, a + 4]}


def small_speeds(
    run: Run, columns: tuple[str, ...], width: float, holds: bool = False, speed: bool = False
) -> Run:
    """A DVL that loses speeds below a width: it tells zero, or what it told last (`holds`).

    Each column for itself, or all of them by their common `speed`. Unlike the faults above it is a
    setting of the instrument, so that it is the same in all runs.
    """
    values = np.stack([run.columns[name] for name in columns])
    size = np.linalg.norm(values, axis=0) if speed else np.abs(values)
    good = np.broadcast_to(size >= width, values.shape)
    shown = np.where(good, values, 0.0)
    if holds:
        last = np.maximum.accumulate(np.where(good, np.arange(values.shape[1]), 0), axis=1)
        shown = np.take_along_axis(shown, last, axis=1)
    return change(run, **dict(zip(columns, shown, strict=True)))


FAULTS: dict[str, Callable[[Run, np.random.Generator], tuple[Run, Told]]] = {
    "stuck": stuck,
    "lost_lock": lost_lock,
    "gap": gap,
    "clock_jump": clock_jump,
    "pose_jump": pose_jump,
    "outliers": outliers,
    "missing_cells": missing_cells,
}
"""By name; an axis that is never excited is `Plan(idle=(1,))` instead."""


def spoil(
    logged: list[Run], fault: str, seed: int, count: int = 1
) -> tuple[list[Run], list[dict[str, Any]]]:
    """Spoil `count` runs; return all runs, and of each spoilt one what, where and when."""
    rng = streams(seed, 8)
    out, told = list(logged), []
    for i in sorted(rng.choice(len(logged), count, replace=False).tolist()):
        out[i], what = FAULTS[fault](logged[i], rng)
        told.append({"fault": fault, "file": f"run_{i + 1:03d}.csv"} | what)
    return out, told
