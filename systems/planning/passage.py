"""Whether any path to a goal keeps clear of the obstacles.

A planner with a horizon of a few seconds can't distinguish a goal that is enclosed by pylons from
one behind a corner. This module does so before the run: it finds the widest path on a grid.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import label
from scipy.special import ndtr

from .obstacles import Pylon

_CELL = 0.04  # m
_CELLS = 400_000
_ABOUT = 1.0  # m of free water around start, goal and obstacles
_REACH = 2.0  # m above and below start and goal that are searched
_HALVINGS = 16
_NEIGHBOURS = np.stack([np.diag([0, 1, 0]), np.ones((3, 3)), np.diag([0, 1, 0])])


class Passage(NamedTuple):
    """The widest path to a goal.

    Attributes:
        clearance: largest minimum distance (m) to the obstacles that a path can have.
        std: assumed standard deviation of the clearance (m).
        allowed: allowed probability of a collision; None requires that the vehicle fits through.
    """

    clearance: float
    std: float = 0.0
    allowed: float | None = None

    @property
    def risk(self) -> float:
        """Probability of a collision on the widest path: on any other it is higher."""
        if self.std > 0:
            return float(ndtr(-self.clearance / self.std))
        return float(self.clearance < 0)

    @property
    def safe(self) -> bool:
        """Whether a path with the allowed risk may exist."""
        return self.clearance >= 0 if self.allowed is None else self.risk <= self.allowed


def widest_way(
    start: Float[np.ndarray, "3"],
    goal: Float[np.ndarray, "3"],
    goal_radius: float,
    pylons: Sequence[Pylon],
    size: tuple[float, float, float],
    bed: float = -np.inf,
    enough: float = np.inf,
) -> float:
    """Upper bound (m) on the clearance of paths to within `goal_radius` of a goal; inf if no pylon.

    The vehicle is taken as an upright cylinder as wide as the narrower side of its hull, which fits
    into a level hull of any heading. Paths may rise to the surface and dive to `bed` (z, m), no
    more than 2 m above or below both start and goal. Each grid cell has the clearance of its best
    point: the bound is never too low, and too high by at most the diagonal of a cell (of 4 cm in a
    harbour, more in a wide field). A start with less clearance than `enough` is extended by the
    missing distance: the way out is not judged.
    """
    if not pylons:
        return np.inf
    low_z = max(bed, min(start[2], goal[2]) - _REACH)
    high_z = max(low_z + 1e-3, min(0.0, max(start[2], goal[2]) + _REACH))
    ends = [z for p in pylons for z in (p.bottom, p.top)]
    levels = np.unique(np.clip([*ends, low_z, high_z], low_z, high_z))
    slabs = list(pairwise(levels))
    x, y, radius = np.array([(p.x, p.y, p.diameter / 2) for p in pylons]).T
    hull, about = min(size[:2]) / 2, _ABOUT + max(size[:2])
    points = np.array([start[:2], goal[:2]])
    low = np.minimum(points.min(axis=0), [(x - radius).min(), (y - radius).min()]) - about
    high = np.maximum(points.max(axis=0), [(x + radius).max(), (y + radius).max()]) + about
    cell = max(_CELL, float(np.sqrt(np.prod(high - low) * len(slabs) / _CELLS)))
    xs, ys = (np.arange(a, b + cell, cell) for a, b in zip(low, high, strict=True))
    X, Y = np.meshgrid(xs, ys, indexing="ij")

    around = _clearances(pylons, slabs, X, Y, size, cell)

    def near(point: np.ndarray, reach: float) -> np.ndarray:
        """Cells with a point within `reach` of the given one, and the cell that contains it."""
        off = np.array([max(a - point[2], point[2] - b, 0.0) for a, b in slabs])[:, None, None]
        flat = np.hypot(X - point[0], Y - point[1])[None]
        inside = np.hypot(np.maximum(flat - cell / np.sqrt(2), 0), off) <= reach
        return inside | (flat + off == (flat + off).min())

    at_start = near(start, 0.0)
    missing = enough - around[at_start].max()
    if 0 < missing < np.inf:
        at_start = near(start, missing)
    at_goal = near(goal, goal_radius)

    return _widest(around, at_start, at_goal, -hull - float(radius.max()))


def _widest(
    around: Float[np.ndarray, "slab x y"],
    at_start: Bool[np.ndarray, "slab x y"],
    at_goal: Bool[np.ndarray, "slab x y"],
    worst: float,
) -> float:
    """Largest minimum of the cells' clearance (m) along a path, at least `worst`, by bisection."""

    def passes(clearance: float) -> bool:
        parts: Any = label(around >= clearance, structure=_NEIGHBOURS)
        parts = parts[0]
        return bool(np.intersect1d(parts[at_start & (parts > 0)], parts[at_goal]).size)

    best = min(around[at_start].max(), around[at_goal].max())
    if passes(best):
        return float(best)
    for _ in range(_HALVINGS):
        middle = (worst + best) / 2
        worst, best = (middle, best) if passes(middle) else (worst, middle)
    return best


def _clearances(
    pylons: Sequence[Pylon],
    slabs: Sequence[tuple[float, float]],
    X: Float[np.ndarray, "x y"],
    Y: Float[np.ndarray, "x y"],
    size: tuple[float, float, float],
    cell: float,
) -> Float[np.ndarray, "slab x y"]:
    """Upper bound on the clearance (m) of the upright cylinder in each cell of each slab."""
    around = np.full((len(slabs), *X.shape), np.inf)
    for p in pylons:
        gap = np.hypot(X - p.x, Y - p.y) - p.diameter / 2 - min(size[:2]) / 2
        for k, (bottom, top) in enumerate(slabs):
            past = float(max(top - p.top, p.bottom - bottom)) - size[2] / 2
            if p.bottom <= bottom and p.top >= top:
                past = -np.inf
            around[k] = np.minimum(around[k], _signed(gap + cell / np.sqrt(2), past))
    return around


def upright_gap(
    p_WB: Float[np.ndarray, "3"], pylon: Pylon, size: tuple[float, float, float]
) -> float:
    """Clearance (m) of the upright cylinder by which `widest_way` represents the hull."""
    away = np.hypot(p_WB[0] - pylon.x, p_WB[1] - pylon.y)
    beside = np.asarray(away - pylon.diameter / 2 - min(size[:2]) / 2)
    past = float(max(p_WB[2] - pylon.top, pylon.bottom - p_WB[2])) - size[2] / 2
    return float(_signed(beside, past))


def _signed(beside: Float[np.ndarray, "*cells"], past: float) -> Float[np.ndarray, "*cells"]:
    """Signed distance of two upright cylinders from their horizontal and vertical gaps."""
    outside = np.hypot(np.maximum(beside, 0), max(past, 0.0))
    return np.asarray(outside + np.minimum(np.maximum(beside, past), 0))
