"""Axes of W whose position was dead-reckoned: it follows the recorded velocities, right or wrong.

An error of the DVL or of the heading moves such a position as it moves the velocity, so that poses
and twists agree, and only the forces contradict them. A position that an instrument of its own has
measured shows errors that are independent from sample to sample, or drifts from the velocities as
an error of DVL or heading makes it.
"""

import numpy as np
from jaxtyping import Float

from ....models.recordings.resample import rotations

INDEPENDENT = -0.15
"""Correlation of neighbouring kinematic errors below which a pose has independent errors (−0.5 for
them alone)."""
OVER = 4.0
"""Time (s) over which slip of poses against twists is measured: an estimator's errors last for
seconds."""
_ROUNDED = 1e-4
"""Size (m) of independent errors below which they may be rounding."""
_FOLLOWS, _EXPLAINED = 0.1, 0.5
"""Drift of a position that follows the velocity, as a share of the way at most, and the share of it
that errors of DVL and heading may explain."""


def dead_reckoned_axes(
    X: Float[np.ndarray, "M 7 R"],
    V: Float[np.ndarray, "M 6 R"],
    step: Float[np.ndarray, "N R"],
    weight: Float[np.ndarray, "N R"],
) -> tuple[int, ...]:
    """Axes of W (0 to 2) along which the position is an integral of the recorded velocity."""
    length = max(1, round(OVER * weight.sum() / max(float((step * weight).sum()), 1e-9)))
    square, product = np.zeros(3), np.zeros(3)
    drifts, patterns, ways = [], [], []
    for r in range(X.shape[2]):
        n = int(weight[:, r].sum())
        off, rates = _of_piece(X[: n + 1, :, r], V[: n + 1, :, r], step[:n, r])
        square += (off**2).sum(axis=0)
        product += (off[1:] * off[:-1]).sum(axis=0)
        ends = np.arange(0, n + 1, min(length, max(n, 1)))
        drifts.append(_sums(off, ends))
        patterns.append(_sums(rates, ends))
        ways.append(np.diff(X[ends, 4:, r], axis=0))
    alone = (product < INDEPENDENT * square) & (square > _ROUNDED**2 * weight.sum())
    axes = np.flatnonzero(~alone)
    if not len(axes):
        return ()
    drift, pattern, way = (np.concatenate(a) for a in (drifts, patterns, ways))
    drift = drift[:, axes]
    if np.sum(drift**2) > _FOLLOWS**2 * np.sum(way**2):
        return ()
    A, b = pattern[:, axes].reshape(drift.size, -1), drift.ravel()
    spare = b.size - A.shape[1]
    left = b - A @ np.linalg.lstsq(A, b, rcond=1e-9)[0]
    if spare > 0 and left @ left / spare < (1 - _EXPLAINED) * (b @ b) / b.size:
        return ()
    return tuple(axes.tolist())


def _of_piece(
    X: Float[np.ndarray, "M 7"], V: Float[np.ndarray, "M 6"], step: Float[np.ndarray, " N"]
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3 p"]]:
    """Steps of the position less those of the velocity, and what errors make of them, in W.

    The errors are those of scale, mounting angles and lever arm of a DVL, and of a heading (sine,
    cosine, constant), each of size one.
    """
    R, (v, w) = rotations(X[:, :4].T), (V[:, :3], V[:, 3:])
    v_W = R.apply(v)
    psi = R.as_euler("ZYX")[:, 0]
    turned = np.stack([-v_W[:, 1], v_W[:, 0], np.zeros(len(v))], axis=1)
    rates = [v_W]
    for turn in (v, w):
        rates += [R.apply(np.cross(turn, e)) for e in np.eye(3)]
    rates += [turned * s[:, None] for s in (np.sin(psi), np.cos(psi), np.ones(len(psi)))]
    each = np.stack(rates, axis=2)
    half = step / 2
    off = np.diff(X[:, 4:], axis=0) - half[:, None] * (v_W[1:] + v_W[:-1])
    return off, half[:, None, None] * (each[1:] + each[:-1])


def _sums(steps: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Sums of steps between neighbouring `ends`."""
    total = np.concatenate([np.zeros_like(steps[:1]), np.cumsum(steps, axis=0)])
    return np.diff(total[ends], axis=0)
