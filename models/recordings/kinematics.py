"""Consistency of poses and twists, and the wrong unit or frame that explains a contradiction.

Over windows of about half a second the displacement of the poses, expressed in the body, must equal
the integral of the body twist. Wrong conventions (degrees, scalar-last quaternions, velocities in
the world frame, other axes) leave a residual that one change of convention removes. So it is along
each of the world's axes alone, whose share in the whole may be small.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from .conventions import (
    ANGULAR,
    LINEAR,
    Axes,
    Reading,
    along_axis,
    as_given,
    exchanged,
    quaternions,
)
from .resample import continuous, rotations

_WINDOW_S, _LONGER_S = 0.5, (2.0, 5.0)
_MOVES_M, _TURNS_RAD = 0.02, 0.02  # rms displacement in a window below which nothing is compared
_EVIDENCE, _ROUNDING = 12.0, 1e-3
"""Nats by which a unit of one axis is more likely (6e-6 by chance), and what rounding may leave."""
_AGREED, _EXPLAINED, _DOUBTFUL, _CONTRADICTED = 0.98, 0.9, 0.8, 0.5
_SHORT = (0.1, 5.0)  # m/s, rad/s: largest second difference that is not an outlier
_MOST = 0.5  # share of the windows that must contradict; fewer are faults of an instrument
_LONG_STEP_S = 1.0
_SPIKE, _FEW = 20.0, 8  # factor on the median second difference; samples needed for a median
_SEVERAL = 4  # windows needed to separate noise from an unnamed wrong convention
UNNAMED = "check units, frames and the order of the quaternion"
"""What an error says where no known convention makes poses and twists agree."""
_BETTER = 0.3  # a convention that leaves less than this share of the residual is the right one

Arrays = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Agreement:
    """How well the integrated twist explains the displacement of the poses.

    Attributes:
        slope: least-squares factor from integrated twist to displacement, 1 if consistent.
        explained: 1 − |residual|²/|displacement|² with slope 1; NaN if there is too little motion.
    """

    slope: float
    explained: float


def agreement(
    t: Float[np.ndarray, " N"],
    X_WB: Float[np.ndarray, "7 N"],
    V_WB_B: Float[np.ndarray, "6 N"],
    window: float = _WINDOW_S,
) -> tuple[Agreement, Agreement]:
    """Compare poses and body twists; return the linear and the angular agreement."""
    moved, integrated = increments(t, X_WB, V_WB_B, window)
    return (
        _agree(moved[:3], integrated[:3], _MOVES_M),
        _agree(moved[3:], integrated[3:], _TURNS_RAD),
    )


def _agree(moved: np.ndarray, integrated: np.ndarray, least: float) -> Agreement:
    known = np.isfinite(moved).all(axis=1) & np.isfinite(integrated).all(axis=1)
    moved, integrated = moved[known], integrated[known]
    size = np.sum(moved**2)
    if not moved.size or np.sqrt(size / moved.shape[1]) < least:
        return Agreement(np.nan, np.nan)
    slope = float(np.sum(moved * integrated) / max(np.sum(integrated**2), 1e-12))
    return Agreement(slope, float(1 - np.sum((moved - integrated) ** 2) / size))


def increments(t: np.ndarray, X_WB: np.ndarray, V: np.ndarray, length: float = _WINDOW_S) -> Arrays:
    """Displacements in B (m, rad) and integrals of the twist over windows of `length` (s).

    Both (6, windows).
    """
    q = continuous(X_WB[:4])
    R, middle = rotations(q), rotations(q[:, 1:] + q[:, :-1])
    steps = middle.inv().apply(np.diff(X_WB[4:]).T), (R[:-1].inv() * R[1:]).as_rotvec()
    moved = np.concatenate(steps, axis=1).T
    return np.add.reduceat(moved, _edges(t, length), axis=1), integrals(t, V, length)


def integrals(t: np.ndarray, V: np.ndarray, length: float = _WINDOW_S) -> np.ndarray:
    """Integrals of the twist over windows of `length` (s), (6, windows)."""
    steps = 0.5 * (V[:, 1:] + V[:, :-1]) * np.diff(t)
    return np.add.reduceat(steps, _edges(t, length), axis=1)


def _edges(t: np.ndarray, length: float) -> np.ndarray:
    window = np.floor((t[1:] - t[0]) / length - 1e-9).astype(int)
    return np.flatnonzero(np.concatenate([[True], np.diff(window) > 0]))


def dead_reckoned(
    t: Float[np.ndarray, " N"], X_WB: Float[np.ndarray, "N 7"], V_WB_B: Float[np.ndarray, "N 6"]
) -> Float[np.ndarray, "N 7"]:
    """Poses with coordinates that were not measured (NaN) integrated from the twist, from zero.

    Velocities are rotated into W by the recorded attitude and integrated by the trapezoidal rule.
    """
    v_W = rotations(X_WB[:, :4].T).apply(V_WB_B[:, :3])
    moved = np.cumsum((v_W[1:] + v_W[:-1]) / 2 * np.diff(t)[:, None], axis=0)
    path = np.concatenate([np.zeros((1, 3)), moved])
    return np.concatenate([X_WB[:, :4], np.where(np.isnan(X_WB[:, 4:]), path, X_WB[:, 4:])], axis=1)


def _mostly(t: np.ndarray, X_WB: np.ndarray, V: np.ndarray, rows: slice) -> float:
    """Explained share in the half of the windows that agrees best."""
    moved, integrated = (a[rows] for a in increments(t, X_WB, V))
    off = np.sum((moved - integrated) ** 2, axis=0)
    kept = np.argsort(off)[: max(round(_MOST * off.size), 1)]
    size = np.sum(moved[:, kept] ** 2)
    return float(1 - off[kept].sum() / size) if size > 0 else -np.inf


def spikes(V: Float[np.ndarray, "6 N"]) -> Bool[np.ndarray, "6 N"]:
    """Single samples far from both neighbours, which agree: outliers of an instrument.

    A hull's rotation may be damped within one sample, so for rates the threshold is large.
    """
    found = np.zeros(V.shape, bool)
    if V.shape[1] < _FEW:
        return found
    curve, apart = np.abs(np.diff(V, 2, axis=1)), np.abs(V[:, 2:] - V[:, :-2])
    usual = np.nanmedian(np.nan_to_num(curve), axis=1, keepdims=True)
    least = np.where(np.arange(len(V)) < 3, *_SHORT)[:, None]
    found[:, 1:-1] = (curve > _SPIKE * usual + least) & (apart < 0.2 * curve)
    return found


def _without(V: np.ndarray, found: np.ndarray) -> np.ndarray:
    """V with spikes replaced by the mean of their neighbours."""
    mean = np.concatenate([V[:, :1], (V[:, 2:] + V[:, :-2]) / 2, V[:, -1:]], axis=1)
    return np.where(found, mean, V)


def _unit_of_time(t: np.ndarray, X_WB: np.ndarray, V: np.ndarray) -> str:
    """The unit of t that makes poses and twists agree where seconds do not; empty if none does."""
    if np.median(np.diff(t)) < _LONG_STEP_S or _agreed(t, X_WB, V):
        return ""
    units = {"milliseconds": 1e-3, "microseconds": 1e-6}
    return next((u for u, scale in units.items() if _agreed(scale * t, X_WB, V)), "")


def _agreed(t: np.ndarray, X_WB: np.ndarray, V: np.ndarray) -> bool:
    known = [a.explained for a in agreement(t, X_WB, V) if np.isfinite(a.explained)]
    return bool(known) and min(known) > _EXPLAINED


def _linear_axes(t: np.ndarray, X: np.ndarray, V: np.ndarray) -> list[Axes]:
    """Displacements and integrals in the body, in the world, and of velocities given there."""
    moved, integrated = increments(t, X, V)
    edges = _edges(t, _WINDOW_S)
    in_world = np.add.reduceat(np.diff(X[4:]), edges, axis=1)
    R = rotations(continuous(X[:4])[:, 1:] + continuous(X[:4])[:, :-1])
    turned = R.apply(0.5 * (V[:3, 1:] + V[:3, :-1]).T).T * np.diff(t)
    names, as_world = ("x", "y", "z"), "u,v,w look like velocities along the world's axes"
    body, world = "give u forward, v left, w up", "give x east, y north, z up of all, or all as NED"
    return [
        Axes(("u", "v", "w"), moved[:3], integrated[:3], right=body),
        Axes(names, in_world, np.add.reduceat(turned, edges, axis=1), right=world),
        Axes(names, in_world, integrated[:3], as_world, right=f"{body}, in the body's axes"),
    ]


def _angular_axes(t: np.ndarray, X: np.ndarray, V: np.ndarray) -> list[Axes]:
    """Turns and integrals of the rates in the body."""
    moved, integrated = increments(t, X, V)
    units = (("", 1.0), ("in deg/s", np.pi / 180))
    return [Axes(("p", "q", "r"), moved[3:], integrated[3:], units=units)]


def _along_axes(t: np.ndarray, X: np.ndarray, V: np.ndarray) -> str:
    """The unit or sign of one of the world's axes that contradicts the velocity; empty if none."""
    if not np.isfinite(V[:3]).all():
        return ""
    for length in (_WINDOW_S, *_LONGER_S):
        edges = _edges(t, length)
        R = rotations(continuous(X[:4])[:, 1:] + continuous(X[:4])[:, :-1])
        steps = R.apply(0.5 * (V[:3, 1:] + V[:3, :-1]).T).T * np.diff(t)
        moved, way = (np.add.reduceat(x, edges, axis=1) for x in (np.diff(X[4:]), steps))
        for axis in range(3):
            sizes = [np.sqrt(np.mean(x[axis] ** 2)) for x in (moved, way)]
            found = along_axis(axis, moved[axis], way[axis]) if max(sizes) > _MOVES_M else None
            if found is None:
                continue
            (best, given), left = found, 1 - found[0].share
            better = best.share > _EXPLAINED and left < _BETTER * (1 - given)
            if better and _clear(left, 1 - given, edges.size):
                return best.reading
    return ""


def contradictions(
    t: Float[np.ndarray, " N"], X_WB: Float[np.ndarray, "7 N"], V_WB_B: Float[np.ndarray, "6 N"]
) -> tuple[list[str], list[str]]:
    """Return (errors, doubts): messages on poses and twists that contradict each other.

    An error names the convention that makes them agree, or says that none known does. Faults of an
    instrument are doubts: single outliers, contradictions in at most half of the windows, and those
    that do not grow with the length of the window, such as noise of the positions.
    """
    if t.size < 3:
        return [], []
    errors, doubts = [], []
    outliers = spikes(V_WB_B)
    V_WB_B = _without(V_WB_B, outliers)
    if unit := _unit_of_time(t, X_WB, V_WB_B):
        return [f"t looks like {unit}; give seconds"], []
    if outliers.any():
        count = int(outliers.any(axis=0).sum())
        doubts.append(f"{count} single velocities lie far from both their neighbours.")
    for what, rows, readings in (
        ("p,q,r", slice(3, 6), ANGULAR),
        ("u,v,w", slice(0, 3), LINEAR),
    ):
        part = 1 if rows.start == 3 else 0
        now = agreement(t, X_WB, V_WB_B)[part].explained
        source = "rotation" if part else "displacement"
        if not now <= _AGREED:
            one = _by_axes(t, X_WB, V_WB_B, part)
            errors += [f"{_found(what, now, source)}: {one}"] if one else []
            continue
        found = _found(what, now, source)
        reading = _reading(t, X_WB, V_WB_B, part, readings, now)
        if reading is not None:
            errors.append(f"{found}: {reading}")
            break  # consequences of a wrong attitude are not reported again
        longer = (agreement(t, X_WB, V_WB_B, s)[part].explained for s in _LONGER_S)
        explained = [now, _mostly(t, X_WB, V_WB_B, rows), *longer]
        if np.nanmax(explained) < _CONTRADICTED and t[-1] - t[0] > _SEVERAL * _WINDOW_S:
            errors.append(f"{found}: {UNNAMED}")
            break
        if now < _DOUBTFUL:
            doubts.append(
                f"{found[0].upper()}{found[1:]}; noise, or units and frames to be checked."
            )
    return errors, doubts


def _found(what: str, explained: float, source: str) -> str:
    share = max(explained, 0) if np.isfinite(explained) else 0.0
    return f"the integral of {what} explains {share:.0%} of the {source}"


def _reading(
    t: np.ndarray,
    X: np.ndarray,
    V: np.ndarray,
    part: int,
    readings: Sequence[Reading],
    now: float,
) -> str | None:
    """The convention that makes poses and twists agree, in words: named, or axes and signs."""
    named = _best(t, X, V, part, readings, now)
    if named is not None:
        return named
    groups = _angular_axes(t, X, V) if part else _linear_axes(t, X, V)
    found = exchanged(groups, max(_EXPLAINED, 1 - _BETTER * (1 - now)))
    if found is not None and _clear(1 - found.share, 1 - now, groups[0].moved.shape[1]):
        return found.reading
    turned = _best(t, X, V, part, list(quaternions()), now) if part else None
    return turned or _by_axes(t, X, V, part) or None


def _best(
    t: np.ndarray, X: np.ndarray, V: np.ndarray, part: int, readings: Sequence[Reading], now: float
) -> str | None:
    """The reading that explains most, if that is clearly more than now."""
    scores = [agreement(t, *change(X, V))[part].explained for _, change in readings]
    best = int(np.nanargmax([-np.inf if np.isnan(s) else s for s in scores]))
    clear = scores[best] > _EXPLAINED and 1 - scores[best] < _BETTER * (1 - now)
    return readings[best][0] if clear else None


def _by_axes(t: np.ndarray, X: np.ndarray, V: np.ndarray, part: int) -> str:
    """The reading that makes axes agree which make a small part of the motion; empty if none."""
    groups = _angular_axes(t, X, V) if part else _linear_axes(t, X, V)
    given, count = as_given(groups[0]), groups[0].moved.shape[1]
    if given < _AGREED:
        found = exchanged(groups, max(_EXPLAINED, 1 - _BETTER * (1 - given)), even=True)
        if found is not None and _clear(1 - found.share, 1 - given, count):
            return found.reading
    return "" if part else _along_axes(t, X, V)


def _clear(left: float, given: float, count: int) -> bool:
    """Whether a reading leaves so much less of `count` windows that chance does not."""
    return bool(-0.5 * count * np.log((left + _ROUNDING) / (given + _ROUNDING)) > _EVIDENCE)
