"""Velocities that were not measured: values that stand still, and values no vehicle has."""

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from ..build import Trajectory
from ..kinematics import increments, integrals
from ..resample import rotations
from ..store import Recording
from .finding import Finding
from .small_speeds import DeadZone

FASTEST = 15.0
"""m/s; above it a velocity is an instrument's mark of failure, such as -32.768 m/s."""
_HELD_S, _USUAL_HOLDS = 1.0, 10.0
"""A value held for this long, and for this many of the record's own holds, is not measured."""
_SAME, _STEP = 1e-9, 0.03
"""m/s: rounding of a held value, and the least jump with which a held zero begins or ends."""
_TURNS = 1e-3
"""rad/s: spread of the rates above which the vehicle moves."""
_STOPS, _APART = 1e-4, 0.1
"""Step of a quaternion or of rates (rad/s) with which a hold begins; rad between attitude and
integrated rates."""
_SHIFTED_S, _SHIFTS, _LEAST_SHIFT = 1.2, 10, 2
"""s and least samples of the shifts that are tried, and samples of the least that is told."""
_CLEAR, _LESS = 0.9, 0.3
"""Share of the poses' change that shifted velocities explain; what they may leave of the rest."""
_SPREAD = 2
"""Samples beside an impossible one that resampling may have mixed with it."""


def unmeasured(
    run: Trajectory, t: Float[np.ndarray, " N"], lost: Bool[np.ndarray, "N 3"]
) -> Iterator[tuple[str, str, Bool[np.ndarray, " N"]]]:
    """Word, columns and samples of each stretch of a run whose velocity was not measured.

    Small speeds that the DVL has `lost` are measured: they are known to be small.
    """
    V = run.V_WB_B[:, :3]
    known = np.asarray(np.isfinite(V).all(axis=0))
    for columns in ([0, 1, 2], [2]):
        if known[columns].all():
            fast = np.asarray(np.abs(V[:, columns]).max(axis=1) > FASTEST)
            if fast.any():
                reach = np.ones(2 * _SPREAD + 1)
                yield "velocity-impossible", _names(columns), np.convolve(fast, reach, "same") > 0
            break
    yield from _attitude_held(run, t)
    if not known[:2].all():
        return
    turned = rotations(run.X_WB[:, :4].T).apply(np.nan_to_num(V))
    frames = [(_names([0, 1]), V[:, :2]), (_names([0, 1]), turned[:, :2])]
    frames += [(f"velocity along the world's {'xyz'[n]}", turned[:, [n]]) for n in range(3)]
    for columns, held in _held(run, t, frames):
        if not lost[held, :2].all():
            yield "velocity-held", columns, held


def _attitude_held(
    run: Trajectory, t: np.ndarray
) -> Iterator[tuple[str, str, Bool[np.ndarray, " N"]]]:
    """Stretches in which attitude or rates stand still, and the other one contradicts it.

    Where both stand still, they stop from one sample to the next, as no vehicle does.
    """
    q, rates = run.X_WB[:, :4], run.V_WB_B[:, 3:]
    if not np.isfinite(rates).all():
        return
    done = np.zeros(len(run), bool)
    for x, name in ((q, "attitude"), (rates, "p,q,r")):
        for start, stop in _holds(x, t):
            if done[start:stop].all():
                continue
            stops = start > 0 and bool(np.abs(x[start] - x[start - 1]).max() > _STOPS)
            if stops or _turned_apart(q[start:stop], rates[start:stop], t[start:stop]):
                inside = np.zeros(len(run), bool)
                inside[start:stop] = True
                done |= inside
                yield "attitude-held", name, inside


def _turned_apart(q: np.ndarray, rates: np.ndarray, t: np.ndarray) -> bool:
    """Whether the integral of the rates is another rotation than that of the attitude."""
    R = rotations(q.T)
    turned = (R[:-1].inv() * R[1:]).as_rotvec()
    expected = 0.5 * (rates[1:] + rates[:-1]) * np.diff(t)[:, None]
    return bool(np.abs(np.cumsum(turned - expected, axis=0)).max() > _APART)


def _holds(x: np.ndarray, t: np.ndarray) -> Iterator[tuple[int, int]]:
    """Stretches of one value that are much longer than the usual ones."""
    edges = _edges(x)
    usual = float(np.median(np.diff(t[np.minimum(edges, len(x) - 1)])))
    least = max(_HELD_S, _USUAL_HOLDS * usual)
    for start, stop in pairwise(edges.tolist()):
        if t[stop - 1] - t[start] >= least:
            yield start, stop


def _names(columns: list[int]) -> str:
    return ",".join("uvw"[c] for c in columns)


def _held(
    run: Trajectory, t: np.ndarray, frames: Sequence[tuple[str, np.ndarray]]
) -> Iterator[tuple[str, Bool[np.ndarray, " N"]]]:
    """Stretches of a value that is constant in the body or in the world while the rates vary."""
    N, done = len(run), np.zeros(len(run), bool)
    for name, v in frames:
        edges = _edges(v)
        usual = float(np.median(np.diff(t[np.minimum(edges, N - 1)])))
        least = max(_HELD_S, _USUAL_HOLDS * usual)
        for start, stop in pairwise(edges.tolist()):
            inside = np.zeros(N, bool)
            inside[start:stop] = True
            if t[stop - 1] - t[start] < least or (inside & done).any():
                continue
            if np.ptp(run.V_WB_B[start:stop, 3:], axis=0).max() < _TURNS:
                continue
            zero, one = np.abs(v[start]).max() < _SAME, v.shape[1] == 1
            if (zero or one) and not _jumps(v, start, stop):
                continue
            done |= inside
            yield name, inside


def _edges(v: np.ndarray) -> np.ndarray:
    """Indices at which a new value begins, and the length."""
    new = np.flatnonzero(np.abs(np.diff(v, axis=0)).max(axis=1) > _SAME) + 1
    return np.concatenate([[0], new, [len(v)]])


def _jumps(v: np.ndarray, start: int, stop: int) -> bool:
    """Whether a stretch begins or ends with a jump, within two samples of it."""
    before, after = (part - v[start] for part in (v[max(start - 2, 0) : start], v[stop : stop + 2]))
    return any(part.size > 0 and bool(np.abs(part).max() > _STEP) for part in (before, after))


def lag_findings(recording: Recording) -> list[Finding]:
    """Velocities or rates that are shifted in time against the change of the pose."""
    most = max(_SHIFTS, round(_SHIFTED_S / recording.dt))
    lags = np.arange(-most, most + 1)
    left, size = np.zeros((2, lags.size)), np.zeros(2)
    for j, k in np.argwhere(recording.lengths > 4 * most).tolist():
        t, length = recording.elapsed(j, k), int(recording.lengths[j, k])
        X, V = (recording.dataset[n].to_numpy()[j, k, :length].T for n in ("X_WB", "V_WB_B"))
        inner = slice(most, length - most)
        moved, _ = increments(t[inner], X[:, inner], V[:, inner])
        size += np.sum(moved.reshape(2, -1) ** 2, axis=1)
        for n, lag in enumerate(lags.tolist()):
            shifted = integrals(t[inner], V[:, inner.start + lag : inner.stop + lag])
            left[:, n] += np.sum((moved - shifted).reshape(2, -1) ** 2, axis=1)
    found = []
    for what, rest, whole in zip(("u,v,w", "p,q,r"), left, size, strict=True):
        if not np.isfinite(rest).all() or whole <= 0 or rest.min() > (1 - _CLEAR) * whole:
            continue
        lag = int(lags[rest.argmin()])
        if abs(lag) >= _LEAST_SHIFT and rest.min() < _LESS * rest[most]:
            seconds, how = abs(lag) * recording.dt, "after" if lag > 0 else "before"
            found.append(
                Finding(
                    "velocity-lag",
                    what,
                    f"{what} come {seconds:.2g} s {how} the motion that the poses show",
                    "align the clocks of the instruments",
                )
            )
    return found


def zone_finding(zone: DeadZone) -> Finding:
    """The sentence on a dead zone."""
    remedy = "look for a threshold in the settings of the DVL and of its driver"
    return Finding("velocity-dead-zone", ",".join("uvw"[i] for i in zone.axes), str(zone), remedy)


def held_finding(word: str, place: str, columns: str) -> Finding:
    """The sentence on one stretch."""
    if word == "attitude-held":
        text = f"{columns} {_stand(columns)} still at one value while the motion goes on"
        return Finding(word, place, f"{text}; the stretch is left out", "check the IMU's messages")
    if word == "velocity-held":
        still = f"{columns} {_stand(columns)} still at one value while the vehicle moves"
        text = f"{still}: a DVL without lock"
        return Finding(word, place, f"{text}; the stretch is left out", "check the DVL's status")
    return Finding(
        word,
        place,
        f"{columns} above {FASTEST:g} m/s, which marks a failure; the samples are left out",
        "leave such samples empty, cut there, or give m/s",
    )


def _stand(columns: str) -> str:
    return "stand" if "," in columns else "stands"
