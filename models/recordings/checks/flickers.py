"""Poses of single samples that lie elsewhere than those before and after: flicker of markers.

Motion capture takes a wrong marker for a moment: the pose jumps to another place, or turns over,
and comes back. A body does not: between two samples it leaves the line (the geodesic of rotations)
through its neighbours by at most a T²/2, with the largest acceleration a and half their distance T.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from ..resample import continuous, linear, rotations, slerp
from .finding import Finding

_MOST, _LONGEST_S = 3, 0.5
"""Samples in a row, and s between their neighbours, beyond which it is no flicker."""
_LINEAR, _ANGULAR = 20.0, 50.0
"""m/s² and rad/s² that no underwater vehicle reaches: twice those of a BlueROV2's thrusters on its
mass and moments of inertia without added ones."""
_NOISE = 20.0
"""Times the usual distance from the line."""
_CLEAR = 3.0
"""Times the distance of the neighbours from the line: after a step that stays it is about once."""
_FEWEST = 8
"""Samples that tell the usual distance."""


@dataclass(frozen=True)
class Mended:
    """A run without flickers.

    Attributes:
        X: poses (7, N), the flickers replaced by the geodesic through their neighbours.
        V: twists (6, N), replaced where they show the jump too.
        bad: the samples that were replaced.
    """

    X: Float[np.ndarray, "7 N"]
    V: Float[np.ndarray, "6 N"]
    bad: Bool[np.ndarray, " N"]


def mended(
    t: Float[np.ndarray, " N"], X: Float[np.ndarray, "7 N"], V: Float[np.ndarray, "6 N"]
) -> Mended | None:
    """The run with flickers replaced; None if it has none.

    A twist that was derived from jumping poses shows the jump on both sides of them.
    """
    parts = flickers(t, X)
    bad = parts[0] | parts[1]
    if not bad.any():
        return None
    good = np.flatnonzero(~bad)
    q = slerp(t, t[good], X[:4, good])
    p = linear(t, t[good], X[4:, good])
    found = np.concatenate([np.where(bad, q, continuous(X[:4])), np.where(bad, p, X[4:])])
    found[:4] = continuous(found[:4])
    return Mended(found, _without_jumps(t, X, found, V, parts), bad)


def flickers(
    t: Float[np.ndarray, " N"], X: Float[np.ndarray, "7 N"]
) -> tuple[Bool[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """Samples, at most three in a row, whose position, and those whose attitude, no motion has."""
    none = np.zeros(t.size, bool)
    if t.size < _FEWEST or not np.isfinite(X[:4]).all():
        return none, none
    p = X[4:][np.isfinite(X[4:]).all(axis=1)]
    return _off_course(t, p, _LINEAR) if len(p) else none, _off_course(t, X[:4], _ANGULAR)


def _off_course(t: np.ndarray, x: np.ndarray, largest: float) -> Bool[np.ndarray, " N"]:
    inner = np.arange(1, t.size - 1)
    noise = _NOISE * float(np.median(_between(x, t, inner - 1, inner, inner + 1)))
    groups = [_jumps(t, x, largest, noise, count) for count in range(1, _MOST + 1)]
    return np.any(groups, axis=0)


def _jumps(
    t: np.ndarray, x: np.ndarray, largest: float, noise: float, count: int
) -> Bool[np.ndarray, " N"]:
    """Groups of some samples that are off the line, while the samples around them are on one."""
    first = np.arange(2, t.size - count - 1)
    bad = np.zeros(t.size, bool)
    if not first.size:
        return bad
    a, b = first - 1, first + count

    def limit(start: np.ndarray, stop: np.ndarray) -> np.ndarray:
        return noise + largest * ((t[stop] - t[start]) / 2) ** 2 / 2

    beside = [_between(x, t, a - 1, a, b), _between(x, t, a, b, b + 1)]
    jump = (t[b] - t[a] < _LONGEST_S) & (beside[0] < limit(a - 1, b))
    jump &= beside[1] < limit(a, b + 1)
    least = np.maximum(limit(a, b), _CLEAR * np.maximum(*beside))
    for n in range(count):
        jump &= _between(x, t, a, first + n, b) > least
    for start in first[jump].tolist():
        bad[start : start + count] = True
    return bad


def _between(
    x: np.ndarray, t: np.ndarray, a: np.ndarray, i: np.ndarray, b: np.ndarray
) -> np.ndarray:
    """Distance (m, rad) of samples i from the line or geodesic through samples a and b."""
    part = (t[i] - t[a]) / (t[b] - t[a])
    if len(x) < 4:
        return np.linalg.norm(x[:, i] - x[:, a] - part * (x[:, b] - x[:, a]), axis=0)
    R_a, R_i, R_b = (rotations(x[:, n]) for n in (a, i, b))
    turn = Rotation.from_rotvec((R_a.inv() * R_b).as_rotvec() * part[:, None])
    return np.asarray((turn.inv() * R_a.inv() * R_i).magnitude())


def _without_jumps(
    t: np.ndarray, X: np.ndarray, found: np.ndarray, V: np.ndarray, parts: tuple[np.ndarray, ...]
) -> np.ndarray:
    """Twists beside flickers, replaced by the line where they show at least half of the jump."""
    turned = (rotations(found[:4]).inv() * rotations(X[:4])).magnitude()
    jumps = np.nan_to_num(np.linalg.norm(X[4:] - found[4:], axis=0)), np.asarray(turned)
    mended_V = V.copy()
    for rows, jump, bad in zip((slice(0, 3), slice(3, 6)), jumps, parts, strict=True):
        beside = np.convolve(bad, np.ones(3), "same") > 0.5
        good = np.flatnonzero(np.convolve(bad, np.ones(5), "same") < 0.5)
        if not bad.any() or good.size < 2:
            continue
        own = np.where(bad, jump, 0.0)
        largest = np.max([np.roll(own, n) for n in (-1, 0, 1)], axis=0)
        line = linear(t, t[good], V[rows][:, good])
        off = np.linalg.norm(V[rows] - line, axis=0)
        shown = beside & (off > 0.5 * largest / (2 * np.gradient(t)))
        mended_V[rows] = np.where(shown, line, V[rows])
    return mended_V


def flicker_finding(place: str, t: Float[np.ndarray, " n"]) -> Finding:
    """The sentence on the samples at times t."""
    many = t.size > 1
    when = f"{t[0]:.1f} s" if not many else f"{t[0]:.1f} to {t[-1]:.1f} s"
    return Finding(
        "pose-flicker",
        f"{place}, {when}",
        f"{t.size} pose{'s' * many} {'jump' if many else 'jumps'} to another place or attitude and "
        f"back, as no vehicle moves; {'they were' if many else 'it was'} interpolated",
        "check the markers of the motion capture",
    )
