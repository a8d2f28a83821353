"""Resampling of uneven or faster samples to a uniform grid; NumPy float64, time on the last axis.

Commands are held (zero order), velocities interpolated linearly, poses along the geodesic: constant
body twist from one sample to the next. Arrays are component first, as in `models/se3.py`.
"""

from collections.abc import Callable

import numpy as np
import scipy.integrate
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

_PARTS = 16
"""Of a step, for moments of what changes within it."""
_SMALL = 1e-8


def grid(first: float, last: float, dt: float) -> Float[np.ndarray, " N"]:
    """Return first, first + dt, … up to last (within rounding)."""
    return first + dt * np.arange(int(np.floor((last - first) / dt + 1e-9)) + 1)


def linear(
    t_new: Float[np.ndarray, " N"], t: Float[np.ndarray, " n"], x: Float[np.ndarray, "*c n"]
) -> Float[np.ndarray, "*c N"]:
    """Linear interpolation; constant outside the samples, and the sample itself at its time."""
    i, s = _locate(t_new, t)
    between = x[..., i] + s * (x[..., i + 1] - x[..., i])
    return np.where(s == 0, x[..., i], np.where(s == 1, x[..., i + 1], between))


def hold(
    t_new: Float[np.ndarray, " N"],
    t: Float[np.ndarray, " n"],
    x: Float[np.ndarray, "*c n"],
    dt: float,
) -> Float[np.ndarray, "*c N"]:
    """Mean over [t_new, t_new + dt) of the zero-order hold of the samples.

    Where the source changes at most once per step, on the grid, this is the sample itself; where it
    is faster, the mean is the constant command with the same impulse.
    """
    widths = np.diff(t)
    area = np.concatenate(
        [np.zeros((*x.shape[:-1], 1)), np.cumsum(x[..., :-1] * widths, axis=-1)], axis=-1
    )

    def integral(times: np.ndarray) -> np.ndarray:
        i = np.clip(np.searchsorted(t, times, side="right") - 1, 0, t.size - 1)
        return area[..., i] + x[..., i] * (times - t[i])

    return (integral(t_new + dt) - integral(t_new)) / dt


def mean(
    t_new: Float[np.ndarray, " N"],
    t: Float[np.ndarray, " n"],
    x: Float[np.ndarray, "*c n"],
    width: float,
) -> Float[np.ndarray, "*c N"]:
    """Mean over t_new ± width/2 of the linear interpolant: for sensors faster than the grid."""
    path = integral(t, x)
    low = np.clip(t_new - width / 2, t[0], t[-1])
    high = np.clip(t_new + width / 2, t[0], t[-1])
    span = high - low
    inside = span > _SMALL
    averaged = (path(high) - path(low)) / np.where(inside, span, 1.0)
    return np.where(inside, averaged, linear(t_new, t, x))


def deviation(
    t_new: Float[np.ndarray, " N"],
    t: Float[np.ndarray, " n"],
    x: Float[np.ndarray, "*c n"],
    width: float,
) -> Float[np.ndarray, "*c N"]:
    """Standard deviation over t_new ± width/2 of a signal that may step between its samples.

    Its mean is that of lines. At a share s of the way from one sample to the next a signal that
    stepped at an unknown time has the variance s (1 - s) of the step, and a smooth one has none. A
    step bends the signal at its two samples in opposite ways, by half of it each.
    """
    change = np.abs(np.diff(x))
    bend = np.zeros_like(x)
    if t.size > 2:
        share = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
        bend[..., 1:-1] = x[..., 1:-1] - (1 - share) * x[..., :-2] - share * x[..., 2:]
    step = np.minimum(change, np.abs(np.diff(bend)))
    offsets = width * ((np.arange(_PARTS) + 0.5) / _PARTS - 0.5)
    at = np.clip(t_new + offsets[:, None], t[0], t[-1])
    i, s = _locate(at, t)
    line = x[..., i] + s * (x[..., i + 1] - x[..., i])
    square = (line**2 + s * (1 - s) * step[..., i] ** 2).mean(axis=-2)
    return np.sqrt(np.maximum(square - line.mean(axis=-2) ** 2, 0.0))


def rise(
    t_new: Float[np.ndarray, " N"],
    t: Float[np.ndarray, " n"],
    x: Float[np.ndarray, "*c n"],
    width: float,
) -> Float[np.ndarray, "*c N"]:
    """Change over t_new ± width/2 of the line that fits the linear interpolant there best.

    12/h² ∫ (s - t) x ds over the width h, by parts. It is right in the mean for a signal that
    stepped at any time between two samples.
    """
    path = integral(t, x)
    offsets = np.linspace(-width / 2, width / 2, _PARTS + 1)
    at = path((t_new + offsets[:, None]).ravel()).reshape(*x.shape[:-1], _PARTS + 1, -1)
    area = scipy.integrate.simpson(at, offsets, axis=-2) / width
    return 12 / width * ((at[..., 0, :] + at[..., -1, :]) / 2 - area)


def integral(
    t: Float[np.ndarray, " n"], x: Float[np.ndarray, "*c n"]
) -> Callable[[Float[np.ndarray, " N"]], Float[np.ndarray, "*c N"]]:
    """Integral of the linear interpolant from t[0] on; constant outside the samples."""
    steps = 0.5 * (x[..., 1:] + x[..., :-1]) * np.diff(t)
    area = np.concatenate([np.zeros((*x.shape[:-1], 1)), np.cumsum(steps, axis=-1)], axis=-1)

    def path(times: np.ndarray) -> np.ndarray:
        i, s = _locate(times, t)
        h = t[i + 1] - t[i]
        return area[..., i] + h * s * (x[..., i] + 0.5 * s * (x[..., i + 1] - x[..., i]))

    return path


def hermite(
    t_new: Float[np.ndarray, " N"],
    t: Float[np.ndarray, " n"],
    p: Float[np.ndarray, "*c n"],
    v: Float[np.ndarray, "*c n"],
) -> Float[np.ndarray, "*c N"]:
    """Cubic through positions p with slopes v: for slow position fixes with velocity."""
    i, s = _locate(t_new, t)
    h = t[i + 1] - t[i]
    a, b = p[..., i], p[..., i + 1]
    da, db = h * v[..., i], h * v[..., i + 1]
    return (
        (1 + 2 * s) * (1 - s) ** 2 * a
        + s * (1 - s) ** 2 * da
        + s**2 * (3 - 2 * s) * b
        - s**2 * (1 - s) * db
    )


def slerp(
    t_new: Float[np.ndarray, " N"], t: Float[np.ndarray, " n"], q: Float[np.ndarray, "4 n"]
) -> Float[np.ndarray, "4 N"]:
    """Rotation at constant angular velocity between samples, unit and continuous in sign."""
    return geodesic(t_new, t, np.concatenate([q, np.zeros((3, t.size))]))[:4]


def geodesic(
    t_new: Float[np.ndarray, " N"], t: Float[np.ndarray, " n"], X: Float[np.ndarray, "7 n"]
) -> Float[np.ndarray, "7 N"]:
    """Pose at constant body twist between samples: X_i exp(s log(X_i⁻¹ X_i+1))."""
    i, s = _locate(t_new, t)
    before, after = X[:, i], X[:, i + 1]
    R = rotations(before[:4])
    moved = R.inv().apply((after - before)[4:].T)
    whole = RigidTransform.from_components(moved, R.inv() * rotations(after[:4]))
    part = RigidTransform.from_exp_coords(s[:, None] * whole.as_exp_coords())
    turned = (R * part.rotation).as_quat(scalar_first=True).T
    return np.concatenate([continuous(turned), before[4:] + R.apply(part.translation).T])


def continuous(q: Float[np.ndarray, "4 n"]) -> Float[np.ndarray, "4 n"]:
    """Unit quaternions with signs chosen so that neighbours are close; the first has w ≥ 0."""
    q = q / np.linalg.norm(q, axis=0)
    flips = np.concatenate([q[0, :1] < 0, (q[:, 1:] * q[:, :-1]).sum(axis=0) < 0])
    return q * np.where(np.cumsum(flips) % 2, -1.0, 1.0)


def rotations(q: Float[np.ndarray, "4 n"]) -> Rotation:
    """Finite quaternions w x y z of any length as SciPy's rotations."""
    return Rotation.from_quat(q.T, scalar_first=True)


def _locate(t_new: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the interval and the fraction along it, clipped at the ends."""
    i = np.clip(np.searchsorted(t, t_new, side="right") - 1, 0, t.size - 2)
    return i, np.clip((t_new - t[i]) / (t[i + 1] - t[i]), 0.0, 1.0)
