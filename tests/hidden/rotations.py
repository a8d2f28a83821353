"""Unit quaternions (4, B), w first, that turn body components into world components."""

import numpy as np

Array = np.ndarray


def cross(a: Array, b: Array) -> Array:
    """Return a × b of (3, B)."""
    a, b = np.concatenate((a, a[:2])), np.concatenate((b, b[:2]))
    return a[1:4] * b[2:] - a[2:] * b[1:4]


def product(p: Array, q: Array) -> Array:
    """Hamilton's product: first q, then p."""
    return np.array(
        [
            p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
            p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
            p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
            p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
        ]
    )


def conjugate(q: Array) -> Array:
    return np.array([q[0], -q[1], -q[2], -q[3]])


def to_world(q: Array, v: Array) -> Array:
    """R_WB v."""
    t = 2.0 * cross(q[1:], v)
    return v + q[0] * t + cross(q[1:], t)


def to_body(q: Array, v: Array) -> Array:
    """R_WBᵀ v."""
    t = 2.0 * cross(q[1:], v)
    return v - q[0] * t + cross(q[1:], t)


def up_in_body(q: Array) -> Array:
    """World's z axis in B: the third row of R_WB."""
    w, x, y, z = q
    return np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])


def rate(q: Array, omega: Array) -> Array:
    """q̇ = ½ q ∘ (0, ω), ω in B (Fossen 2011, eq. 2.67)."""
    w, x, y, z = q
    p, r, s = 0.5 * omega
    return np.array(
        [
            -x * p - y * r - z * s,
            w * p + y * s - z * r,
            w * r + z * p - x * s,
            w * s + x * r - y * p,
        ]
    )


def exponential(phi: Array) -> Array:
    """Quaternion of the rotation vector φ (rad)."""
    angle = np.sqrt(np.sum(phi * phi, axis=0))
    half = np.sinc(angle / (2 * np.pi)) / 2  # sin(θ/2)/θ
    return np.concatenate([np.cos(angle / 2)[None], half * phi])


def logarithm(q: Array) -> Array:
    """Rotation vector of a unit quaternion, at most π long."""
    q = np.where(q[:1] < 0, -q, q)
    s = np.sqrt(np.sum(q[1:] ** 2, axis=0))
    angle = 2 * np.arctan2(s, q[0])
    return q[1:] * np.where(s > 1e-12, angle / np.maximum(s, 1e-300), 2.0)


def from_rpy(roll: Array, pitch: Array, yaw: Array) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    zero = np.zeros(np.broadcast_shapes(np.shape(roll), np.shape(pitch), np.shape(yaw)))
    about = [exponential(np.stack([zero, zero, zero + yaw]))]
    about += [exponential(np.stack([zero, zero + pitch, zero]))]
    about += [exponential(np.stack([zero + roll, zero, zero]))]
    return product(product(about[0], about[1]), about[2])


def heading(q: Array) -> Array:
    """Yaw in rad, counter-clockwise from east."""
    w, x, y, z = q
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def skew(v: Array) -> Array:
    """S(v) with S(v) a = v × a, for one vector."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
