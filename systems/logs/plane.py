"""The horizontal velocity against the accelerometer: axes exchanged or mirrored, and its unit.

Position and velocity that are wrong in the same way fit each other. The specific force, turned into
the world by the attitude, tells the acceleration independently of both:

    Δv = H ∫ f dt + ∫ R dt b + c T

over windows of T, with the accelerometer's bias b in the body and a constant c in the world (tilt
that is off). H is the identity if all is right, else an exchange, signs, or a factor.
"""

import numpy as np
from jaxtyping import Float

from ...models.recordings.checks.finding import Finding
from ...models.recordings.conventions import SPEEDS
from ...models.recordings.resample import linear, rotations, slerp
from .signals import Series

_WINDOW_S, _FEWEST = 1.0, 10
"""Changes of velocity are compared over such windows, if there are as many."""
_FASTER = 0.02
"""m/s rms of these changes: below it they are the estimate's own corrections."""
_FITS, _BETTER, _EVIDENCE = 0.5, 0.3, 12.0
"""Shares of the squared change that the right axes may leave, and of what the recorded ones leave;
nats of evidence, as for commands."""
_AXES: dict[str, tuple[tuple[int, int], tuple[int, int]]] = {
    "": ((1, 0), (0, 1)),
    "north and east (x and y) look exchanged": ((0, 1), (1, 0)),
    "the velocity to the east has the other sign": ((-1, 0), (0, 1)),
    "the velocity to the north has the other sign": ((1, 0), (0, -1)),
    "north and east (x and y) look exchanged, and both have the other sign": ((0, -1), (-1, 0)),
    "both horizontal velocities have the other sign": ((-1, 0), (0, -1)),
    "it is turned by 90° to the left of the attitude": ((0, -1), (1, 0)),
    "it is turned by 90° to the right of the attitude": ((0, 1), (-1, 0)),
}
"""H by what is wrong; W has x to the east."""


def plane_findings(
    attitude: Series, velocity: Series | None, force: Series | None
) -> list[Finding]:
    """Where the horizontal velocity fits the accelerometer in other axes or units only."""
    if velocity is None or force is None or not np.isfinite(force.x).all():
        return []
    windows = _windows(attitude, velocity, force)
    if windows is None:
        return []
    changes, felt, free = windows
    size = float(np.sum(changes**2))
    if changes.size < 2 * _FEWEST or size < changes.size * _FASTER**2:
        return []
    Q = np.linalg.qr(free)[0]
    felt = felt - Q @ (Q.T @ felt)
    if float(np.sum(felt**2)) < felt.size * _FASTER**2:
        return []
    left: dict[str, float] = {}
    for how, H in _AXES.items():
        turned = (np.array(H).T @ changes.reshape(-1, 2).T).T.ravel()
        turned = turned - Q @ (Q.T @ turned)
        for unit, factor in {"": 1.0, **SPEEDS}.items():
            own = factor * turned
            said = " and ".join(x for x in (how, unit and f"it looks like {unit}") if x)
            left[said] = float(np.sum((own - felt) ** 2) / max(float(np.sum(felt**2)), 1e-12))
    best = min(left, key=lambda said: left[said])
    ratio = left[best] / max(left[""], 1e-12)
    evidence = -0.5 * (changes.size - free.shape[1]) * np.log(max(ratio, 1e-6))
    if not best or left[best] > _FITS or ratio > _BETTER or evidence < _EVIDENCE:
        return []
    return [
        Finding(
            "motion-contradiction",
            f"{velocity.source}, {force.source}",
            f"the velocity fits the accelerations that {force.source} feels only otherwise: {best}",
            "give x north, y east, z down in m and m/s (NED), as the autopilot does",
        )
    ]


def _windows(
    attitude: Series, velocity: Series, force: Series
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"], Float[np.ndarray, "m 5"]] | None:
    """Changes of the horizontal velocity, integrals of the force, and what is free of both.

    Each row is a window's x or y.
    """
    known = np.isfinite(velocity.x[:2]).all(axis=0)
    first = max(attitude.t[0], force.t[0])
    last = min(attitude.t[-1], force.t[-1])
    known &= (velocity.t >= first) & (velocity.t <= last)
    t, v = velocity.t[known], velocity.x[:2, known]
    inside = (force.t >= first) & (force.t <= last)
    own = force.t[inside]
    if t.size <= _FEWEST or own.size <= _FEWEST:
        return None
    _, index = np.unique(np.floor((t - t[0]) / _WINDOW_S), return_index=True)
    R = rotations(slerp(own, attitude.t, attitude.x)).as_matrix()
    f = np.einsum("nij,jn->ni", R[:, :2], force.x[:, inside])
    terms = np.concatenate([f, R[:, :2].reshape(own.size, 6), np.ones((own.size, 1))], axis=1)
    steps = 0.5 * (terms[1:] + terms[:-1]) * np.diff(own)[:, None]
    whole = np.concatenate([np.zeros((1, 9)), np.cumsum(steps, axis=0)]).T
    edges = t[index]
    sums = np.diff(linear(edges, own, whole), axis=1)
    kept = _kept(edges, own, t)
    sums, changes = sums[:, kept], np.diff(v[:, index], axis=1)[:, kept]
    n = changes.shape[1]
    free = np.zeros((n, 2, 5))
    free[:, 0, :3], free[:, 1, :3] = sums[2:5].T, sums[5:8].T
    free[:, 0, 3] = free[:, 1, 4] = sums[8]
    return changes.T.ravel(), sums[:2].T.ravel(), free.reshape(2 * n, 5)


def _kept(edges: np.ndarray, own: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Windows without a pause of either stream."""
    usual = np.diff(edges) < 1.5 * _WINDOW_S
    for times in (own, t):
        pauses = np.flatnonzero(np.diff(times) > 0.5 * _WINDOW_S)
        for i in pauses:
            usual &= (edges[1:] <= times[i]) | (edges[:-1] >= times[i + 1])
    return usual
