"""Conversion between NED/FRD and this project's ENU/FLU frames; NumPy, component first.

W is east, north, up and B is forward, left, up (`models/se3.py`). Every swap is its own inverse.
"""

import numpy as np
from jaxtyping import Float


def ned_to_enu(v_N: Float[np.ndarray, "3 *batch"]) -> Float[np.ndarray, "3 *batch"]:
    """Swap north-east-down and east-north-up (its own inverse)."""
    return np.stack([v_N[1], v_N[0], -v_N[2]])


def frd_to_flu(v_B: Float[np.ndarray, "3 *batch"]) -> Float[np.ndarray, "3 *batch"]:
    """Swap forward-right-down and forward-left-up (its own inverse)."""
    return np.stack([v_B[0], -v_B[1], -v_B[2]])


def twist_frd_to_flu(V: Float[np.ndarray, "6 *batch"]) -> Float[np.ndarray, "6 *batch"]:
    """Swap FRD and FLU for a twist [v, ω] or a wrench [f, τ] (its own inverse)."""
    return np.concatenate([frd_to_flu(V[:3]), frd_to_flu(V[3:])])


def quaternion_to_flu_enu(q: Float[np.ndarray, "4 *batch"]) -> Float[np.ndarray, "4 *batch"]:
    """Attitude FRD-to-NED (w x y z) as FLU-to-ENU: R_WB = P R Q with P, Q the two axis swaps.

    In quaternions P = (0, 1, 1, 0)/√2 and Q = (0, 1, 0, 0); their action is its own inverse.
    """
    w, x, y, z = q
    return np.stack([w + z, x + y, x - y, w - z]) / np.sqrt(2.0)


def pose_to_enu(X: Float[np.ndarray, "7 *batch"]) -> Float[np.ndarray, "7 *batch"]:
    """Pose of FRD in NED as pose X_WB of FLU in ENU (its own inverse)."""
    return np.concatenate([quaternion_to_flu_enu(X[:4]), ned_to_enu(X[4:])])
