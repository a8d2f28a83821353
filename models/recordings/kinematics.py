"""Consistency of poses and twists, and the wrong unit or frame that explains a contradiction.

Over windows of about half a second the displacement of the poses, expressed in the body, must equal
the integral of the body twist. Wrong conventions (degrees, scalar-last quaternions, velocities in
the world frame, other axes) leave a residual that one change of convention removes.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from .resample import continuous, rotations

_WINDOW_S, _LONGER_S = 0.5, (2.0, 5.0)
_MOVES_M, _TURNS_RAD = 0.02, 0.02  # rms displacement in a window below which nothing is compared
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


def _flip(x: np.ndarray, rows: tuple[int, ...]) -> np.ndarray:
    sign = np.ones((x.shape[0], 1))
    sign[list(rows)] = -1
    return x * sign


def _world(X: np.ndarray, V: np.ndarray, part: slice) -> Arrays:
    turned = V.copy()
    turned[part] = rotations(X[:4]).inv().apply(V[part].T).T
    return X, turned


def _mirrored(X: np.ndarray, V: np.ndarray, row: int) -> Arrays:
    """Velocities with the other sign along one of the world's axes."""
    R = rotations(X[:4])
    turned = V.copy()
    turned[:3] = R.inv().apply(_flip(R.apply(V[:3].T).T, (row,)).T).T
    return X, turned


_LINEAR: list[tuple[str, Callable[[np.ndarray, np.ndarray], Arrays]]] = [
    (
        "u,v,w look like velocities along the world's axes; rotate them into the body",
        lambda X, V: _world(X, V, slice(0, 3)),
    ),
    ("u,v,w look like mm/s; give m/s", lambda X, V: (X, V * 1e-3)),
    ("u,v,w look like cm/s; give m/s", lambda X, V: (X, V * 1e-2)),
    ("u,v,w look like km/h; give m/s", lambda X, V: (X, V / 3.6)),
    ("u,v,w look like knots; give m/s", lambda X, V: (X, V * 0.514444)),
    ("x,y,z look like mm; give m", lambda X, V: (X, V * 1e3)),
    ("x,y,z look like cm; give m", lambda X, V: (X, V * 1e2)),
    (
        "u,v,w look like forward-right-down while x,y,z and the quaternion do not; "
        "give all in one convention",
        lambda X, V: (X, _flip(V, (1, 2))),
    ),
    ("u seems to have the wrong sign; give forward as positive", lambda X, V: (X, _flip(V, (0,)))),
    ("v seems to have the wrong sign; give left as positive", lambda X, V: (X, _flip(V, (1,)))),
    (
        "the velocity along the world's x has the wrong sign; give all in one convention",
        lambda X, V: _mirrored(X, V, 0),
    ),
    (
        "the velocity along the world's y has the wrong sign; give all in one convention",
        lambda X, V: _mirrored(X, V, 1),
    ),
    (
        "z seems to have the wrong sign against w; give all in one convention",
        lambda X, V: (_flip(X, (6,)), V),
    ),
    (
        "x,y,z look like north-east-down while the quaternion does not; give all in one convention",
        lambda X, V: (np.concatenate([X[:4], X[[5]], X[[4]], -X[[6]]]), V),
    ),
]
_ANGULAR: list[tuple[str, Callable[[np.ndarray, np.ndarray], Arrays]]] = [
    ("p,q,r look like deg/s; give rad/s", lambda X, V: (X, np.deg2rad(V))),
    ("p seems to have the wrong sign", lambda X, V: (X, _flip(V, (3,)))),
    ("q seems to have the wrong sign", lambda X, V: (X, _flip(V, (4,)))),
    ("r seems to have the wrong sign", lambda X, V: (X, _flip(V, (5,)))),
    (
        "the quaternion's columns look like x,y,z,w; give w first",
        lambda X, V: (np.concatenate([X[[3, 0, 1, 2]], X[4:]]), V),
    ),
    (
        "p,q,r look like rates about the world's axes; rotate them into the body",
        lambda X, V: _world(X, V, slice(3, 6)),
    ),
    (
        "the quaternion looks like world-to-body; give body-to-world (its conjugate)",
        lambda X, V: (_flip(X, (1, 2, 3)), V),
    ),
    (
        "p,q,r look like forward-right-down while the quaternion does not; "
        "give all in one convention",
        lambda X, V: (X, _flip(V, (4, 5))),
    ),
]


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
        ("p,q,r", slice(3, 6), _ANGULAR),
        ("u,v,w", slice(0, 3), _LINEAR),
    ):
        part = 1 if rows.start == 3 else 0
        now = agreement(t, X_WB, V_WB_B)[part]
        if np.isnan(now.explained) or now.explained > _AGREED:
            continue
        source = "rotation" if part else "displacement"
        found = f"the integral of {what} explains {max(now.explained, 0):.0%} of the {source}"
        scores = [agreement(t, *change(X_WB, V_WB_B))[part].explained for _, change in readings]
        best = int(np.nanargmax([-np.inf if np.isnan(s) else s for s in scores]))
        if scores[best] > _EXPLAINED and 1 - scores[best] < _BETTER * (1 - now.explained):
            errors.append(f"{found}: {readings[best][0]}")
            break  # consequences of a wrong attitude are not reported again
        longer = (agreement(t, X_WB, V_WB_B, s)[part].explained for s in _LONGER_S)
        explained = [now.explained, _mostly(t, X_WB, V_WB_B, rows), *longer]
        if np.nanmax(explained) < _CONTRADICTED and t[-1] - t[0] > _SEVERAL * _WINDOW_S:
            errors.append(f"{found}: {UNNAMED}")
            break
        if now.explained < _DOUBTFUL:
            doubts.append(
                f"{found[0].upper()}{found[1:]}; noise, or units and frames to be checked."
            )
    return errors, doubts
