"""A smooth motion with known poses, twists and world velocity, for tests of importers."""

import numpy as np


def smooth_motion(t, *, seed=0, speed=1.0):
    """Return X_WB (7, n), V_WB_B (6, n), v_W (3, n) at times t (s): sums of two sines an axis."""
    rng = np.random.default_rng(seed)
    frequency = rng.uniform(0.3, 1.5, (6, 2)) * speed
    phase = rng.uniform(0, 6.3, (6, 2))
    size = np.concatenate([np.full((3, 2), 0.5), [[0.2, 0.1], [0.2, 0.1], [0.8, 0.3]]])
    angle = np.multiply.outer(frequency, t) + np.add.outer(phase, 0 * t)
    value = np.einsum("ij,ij...->i...", size, np.sin(angle))
    slope = np.einsum("ij,ij...->i...", size * frequency, np.cos(angle))
    value[2] -= 5.0
    p, v_W = value[:3], slope[:3]
    (roll, pitch, yaw), (droll, dpitch, dyaw) = value[3:], slope[3:]
    cr, cp, cy = np.cos(roll / 2), np.cos(pitch / 2), np.cos(yaw / 2)
    sr, sp, sy = np.sin(roll / 2), np.sin(pitch / 2), np.sin(yaw / 2)
    q = np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )
    omega = np.stack(
        [
            droll - dyaw * np.sin(pitch),
            dpitch * np.cos(roll) + dyaw * np.sin(roll) * np.cos(pitch),
            -dpitch * np.sin(roll) + dyaw * np.cos(roll) * np.cos(pitch),
        ]
    )
    w, u = q[:1], -q[1:]
    turn = 2 * np.cross(u, v_W, axis=0)
    v_B = v_W + w * turn + np.cross(u, turn, axis=0)
    return np.concatenate([q, p]), np.concatenate([v_B, omega]), v_W
