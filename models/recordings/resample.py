"""Resampling of uneven or faster samples to a uniform grid; NumPy float64, time on the last axis.

Commands are held (zero order), velocities interpolated linearly, poses along the geodesic: constant
body twist from one sample to the next. Arrays are component first, as in `models/se3.py`.
"""

import numpy as np
from jaxtyping import Float

_SMALL = 1e-8


def grid(first: float, last: float, dt: float) -> Float[np.ndarray, " N"]:
    """Return first, first + dt, … up to last (within rounding)."""
    return first + dt * np.arange(int(np.floor((last - first) / dt + 1e-9)) + 1)


def linear(
    t_new: Float[np.ndarray, " N"], t: Float[np.ndarray, " n"], x: Float[np.ndarray, "*c n"]
) -> Float[np.ndarray, "*c N"]:
    """Linear interpolation; constant outside the samples."""
    i, s = _locate(t_new, t)
    return x[..., i] + s * (x[..., i + 1] - x[..., i])


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
    steps = 0.5 * (x[..., 1:] + x[..., :-1]) * np.diff(t)
    area = np.concatenate([np.zeros((*x.shape[:-1], 1)), np.cumsum(steps, axis=-1)], axis=-1)

    def integral(times: np.ndarray) -> np.ndarray:
        i, s = _locate(times, t)
        h = t[i + 1] - t[i]
        return area[..., i] + h * s * (x[..., i] + 0.5 * s * (x[..., i + 1] - x[..., i]))

    low = np.clip(t_new - width / 2, t[0], t[-1])
    high = np.clip(t_new + width / 2, t[0], t[-1])
    span = high - low
    inside = span > _SMALL
    averaged = (integral(high) - integral(low)) / np.where(inside, span, 1.0)
    return np.where(inside, averaged, linear(t_new, t, x))


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
    i, s = _locate(t_new, t)
    turned = multiply(conjugate(q[:, i]), q[:, i + 1])
    return continuous(multiply(q[:, i], rotation_exp(s * rotation_log(turned))))


def geodesic(
    t_new: Float[np.ndarray, " N"], t: Float[np.ndarray, " n"], X: Float[np.ndarray, "7 n"]
) -> Float[np.ndarray, "7 N"]:
    """Pose at constant body twist between samples: X_i exp(s log(X_i⁻¹ X_i+1))."""
    i, s = _locate(t_new, t)
    q, p = X[:4, i], X[4:, i]
    omega = rotation_log(multiply(conjugate(q), X[:4, i + 1]))
    travelled = rotate(conjugate(q), X[4:, i + 1] - p)
    # p = V(ω) v with V = 1 + b ω̂ + c ω̂²; solve for v, then move by the fraction s of it
    v = np.linalg.solve(_left_jacobian(omega), travelled.T[..., None])[..., 0]
    moved = np.einsum("nij,nj->in", _left_jacobian(s * omega), s[:, None] * v)
    turned = continuous(multiply(q, rotation_exp(s * omega)))
    return np.concatenate([turned, p + rotate(q, moved)])


def continuous(q: Float[np.ndarray, "4 n"]) -> Float[np.ndarray, "4 n"]:
    """Unit quaternions with signs chosen so that neighbours are close; the first has w ≥ 0."""
    q = q / np.linalg.norm(q, axis=0)
    flips = np.concatenate([[q[0, 0] < 0], (q[:, 1:] * q[:, :-1]).sum(axis=0) < 0])
    return q * np.where(np.cumsum(flips) % 2, -1.0, 1.0)


def multiply(
    a: Float[np.ndarray, "4 *batch"], b: Float[np.ndarray, "4 *batch"]
) -> Float[np.ndarray, "4 *batch"]:
    """Quaternion product a b, components w x y z."""
    return np.stack(
        [
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        ]
    )


def conjugate(q: Float[np.ndarray, "4 *batch"]) -> Float[np.ndarray, "4 *batch"]:
    """The inverse of a unit quaternion."""
    return np.concatenate([q[:1], -q[1:]])


def rotate(
    q_AB: Float[np.ndarray, "4 *batch"], v_B: Float[np.ndarray, "3 *batch"]
) -> Float[np.ndarray, "3 *batch"]:
    """v_A = R_AB v_B."""
    t = 2 * np.cross(q_AB[1:], v_B, axis=0)
    return v_B + q_AB[:1] * t + np.cross(q_AB[1:], t, axis=0)


def rotation_log(q: Float[np.ndarray, "4 *batch"]) -> Float[np.ndarray, "3 *batch"]:
    """Rotation vector (rad) of at most half a turn."""
    q = q * np.where(q[:1] < 0, -1.0, 1.0)
    n = np.linalg.norm(q[1:], axis=0)
    safe = np.where(n > _SMALL, n, 1.0)
    return q[1:] * np.where(n > _SMALL, 2 * np.arctan2(n, q[0]) / safe, 2.0)


def rotation_exp(omega: Float[np.ndarray, "3 *batch"]) -> Float[np.ndarray, "4 *batch"]:
    """Unit quaternion of a rotation vector (rad)."""
    angle = np.linalg.norm(omega, axis=0)
    half = 0.5 * np.sinc(angle / (2 * np.pi))
    return np.concatenate([np.cos(angle / 2)[None], half * omega])


def _left_jacobian(omega: np.ndarray) -> np.ndarray:
    angle2 = (omega**2).sum(axis=0)
    angle = np.sqrt(angle2)
    near = angle2 < 1e-6
    safe = np.where(near, 1.0, angle2)
    b = np.where(near, 0.5 - angle2 / 24, (1 - np.cos(angle)) / safe)
    c = np.where(near, 1 / 6 - angle2 / 120, (angle - np.sin(angle)) / (safe * np.sqrt(safe)))
    x, y, z = omega
    zero = np.zeros_like(x)
    hat = np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), -1, 0)
    return np.eye(3) + b[:, None, None] * hat + c[:, None, None] * (hat @ hat)


def _locate(t_new: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the interval and the fraction along it, clipped at the ends."""
    i = np.clip(np.searchsorted(t, t_new, side="right") - 1, 0, t.size - 2)
    return i, np.clip((t_new - t[i]) / (t[i + 1] - t[i]), 0.0, 1.0)
