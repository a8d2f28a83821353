"""Measurement updates of an error-state filter: gate, gain, Joseph form."""

import math
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...models import se3
from ...models.sensors import Compass, DepthSensor, Dvl, wrap
from .error_state import ERRORS, GYRO_BIAS, POSE, SENSORS, VELOCITY, Navigation, retract


class Innovation(NamedTuple):
    """Residual y − h(x̂), its Jacobian in the error and the measurement's covariance."""

    residual: Float[Array, "m"]
    H: Float[Array, "m 18"]
    R: Float[Array, "m m"]


def _along_pose(h: Callable[[Array], Array], X_WB: Float[Array, "7"]) -> tuple[Array, Array]:
    """Value of h at a pose and its Jacobian in the pose's error, by forward differentiation."""
    value, slope = jax.linearize(h, X_WB)
    return value, jax.vmap(slope, in_axes=1, out_axes=1)(_tangents(X_WB))


def _tangents(X_WB: Float[Array, "7"]) -> Float[Array, "7 6"]:
    """The derivative of X exp(ξ) at ξ = 0: q̇ = q (0, δθ) / 2, ṗ = R δp."""
    w, x, y, z = jnp.unstack(X_WB[:4] / 2)
    turns = jnp.stack([-x, -y, -z, w, -z, y, z, w, -x, -y, x, w]).reshape(4, 3)
    zero = jnp.zeros((3, 3), X_WB.dtype)
    moves = jnp.concatenate([se3.rotation_matrix(X_WB), zero], axis=1)
    return jnp.concatenate([jnp.concatenate([jnp.zeros_like(turns), turns], axis=1), moves])


def _noise(std: float, size: int, like: Array) -> Array:
    return std**2 * jnp.eye(size, dtype=like.dtype)


def dvl_innovation(
    dvl: Dvl, nominal: Navigation, rate: Float[Array, "3"], reading: Float[Array, "3"]
) -> Innovation:
    """(1 + scale) R_SB (v + ω × r); `rate` is the gyroscope's reading, its bias still in it."""
    V = jnp.concatenate([nominal.v_B, rate - nominal.gyro_bias])
    E = dvl.expected(jnp.eye(6, dtype=V.dtype))  # the measurement is linear in the twist
    EV, scale = E @ V, 1 + nominal.sensors[0]
    H = jnp.zeros((3, ERRORS), V.dtype)
    H = H.at[:, VELOCITY].set(scale * E[:, :3]).at[:, GYRO_BIAS].set(-scale * E[:, 3:])
    H = H.at[:, SENSORS.start].set(EV)
    return Innovation(reading - scale * EV, H, _noise(dvl.noise, 3, V))


def depth_innovation(
    depth: DepthSensor, nominal: Navigation, reading: Float[Array, "1"]
) -> Innovation:
    """Depth of the gauge and its offset."""
    expected, H = _along_pose(depth.expected, nominal.X_WB)
    residual = reading - expected - nominal.sensors[1:2]
    return Innovation(residual, _pose_row(H, 1), _noise(depth.noise, 1, residual))


def compass_innovation(
    compass: Compass, nominal: Navigation, reading: Float[Array, "1"]
) -> Innovation:
    """Component of the bow perpendicular to the compass heading, corrected for the wander.

    The component of the bow perpendicular to the true heading is zero at every attitude, and is
    differentiable where yaw is not. A yaw error Δ makes it cos θ sin Δ, so the residual is cos θ
    times that of yaw; beyond 90° it is clipped. The noise, cos θ times that of the compass, is
    taken as the compass' own: a compass is no more accurate than that while the bow is up.
    """
    yaw = compass.expected(nominal.X_WB)
    off = jnp.clip(wrap(reading - yaw - nominal.sensors[2:3]), -math.pi / 2, math.pi / 2)
    shown = yaw + off
    across = jnp.concatenate([-jnp.sin(shown), jnp.cos(shown), jnp.zeros_like(shown)])
    bow = jnp.eye(3, dtype=yaw.dtype)[0]
    h, H = _along_pose(lambda X: (across @ se3.rotate(X, bow))[None], nominal.X_WB)
    level = jnp.linalg.norm(se3.rotate(nominal.X_WB, bow)[:2]) * jnp.cos(off[0])
    return Innovation(-h, _pose_row(H, 2, level), _noise(compass.noise, 1, h))


def _pose_row(
    H: Float[Array, "1 6"], sensor: int, times: float | Float[Array, ""] = 1.0
) -> Float[Array, "1 18"]:
    """The row of H of a measurement of the pose plus `times` one sensor's slow error."""
    row = jnp.zeros((1, ERRORS), H.dtype).at[:, POSE].set(H)
    return row.at[:, SENSORS.start + sensor].set(times)


def small_inverse(S: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Inverse of a positive matrix of 1, 3 or up to 6 rows in plain arithmetic, by blocks."""
    m = S.shape[0]
    if m == 1:
        return 1 / S
    if m == 2:
        (a, b), (c, d) = S
        return jnp.stack([d, -b, -c, a]).reshape(2, 2) / (a * d - b * c)
    if m == 3:
        columns = [se3.cross(S[1], S[2]), se3.cross(S[2], S[0]), se3.cross(S[0], S[1])]
        adjugate = jnp.stack(columns, 1)
        return adjugate / (S[0] @ adjugate[:, 0])
    A, B, C = S[:3, :3], S[:3, 3:], S[3:, 3:]
    A = small_inverse(A)
    AB = A @ B
    rest = small_inverse(C - B.T @ AB)
    corner = AB @ rest
    return jnp.concatenate(
        [
            jnp.concatenate([A + corner @ AB.T, -corner], axis=1),
            jnp.concatenate([-corner.T, rest], axis=1),
        ]
    )


def together(found: Sequence[Innovation]) -> Innovation:
    """Several sensors' innovations stacked; their noises are independent."""
    sizes = [each.residual.size for each in found]
    R = jnp.zeros((sum(sizes), sum(sizes)), found[0].R.dtype)
    for each, end in zip(found, accumulate(sizes), strict=True):
        own = slice(end - each.residual.size, end)
        R = R.at[own, own].set(each.R)
    residuals, rows = [each.residual for each in found], [each.H for each in found]
    return Innovation(jnp.concatenate(residuals), jnp.concatenate(rows), R)


def normalized_squares(
    S: Float[Array, "m m"], residual: Float[Array, "m"], sizes: Sequence[int]
) -> Float[Array, " n"]:
    """The NIS of each sensor by itself; `sizes` are their numbers of components."""
    scores = []
    for size, end in zip(sizes, accumulate(sizes), strict=True):
        own = slice(end - size, end)
        scores.append(residual[own] @ small_inverse(S[own, own]) @ residual[own])
    return jnp.stack(scores)


class Update(NamedTuple):
    """A corrected state, and the statistics of the update."""

    nominal: Navigation
    P: Float[Array, "18 18"]
    nis: Float[Array, " n"]
    """Of each sensor."""
    accepted: Bool[Array, " n"]
    """Whether a sensor's reading was used and passed its gate."""
    gain: Float[Array, "18 m"]
    """K, with zero columns for readings that were not used."""


def update(
    nominal: Navigation,
    P: Float[Array, "18 18"],
    found: Sequence[Innovation],
    used: Bool[Array, " n"],
    gates: Sequence[float],
) -> Update:
    """Correct with the readings `used` of n sensors unless a sensor's NIS exceeds its gate.

    NIS = rᵀ S⁻¹ r with S = H P Hᵀ + R is chi-square with m degrees of freedom (Bar-Shalom et al.
    2001, section 5.4). The covariance takes Joseph's form (I − K H) P (I − K H)ᵀ + K R Kᵀ and
    moves to the corrected state with Γ = I − ½ ad(δ) on the pose's error.
    """
    r, H, R = together(found)
    PH = P @ H.T
    S = H @ PH + R
    sizes = [each.residual.size for each in found]
    nis = normalized_squares(S, r, sizes)
    accepted = used & (nis <= jnp.asarray(gates, nis.dtype))
    mark = jnp.repeat(accepted, jnp.array(sizes), total_repeat_length=r.size)
    both = mark[:, None] & mark[None]
    S_inverse = small_inverse(jnp.where(both, S, jnp.eye(r.size, dtype=P.dtype)))
    # Rows that are not used have zero gain: the inverse is block-diagonal in them.
    K = jnp.where(mark[None], PH @ jnp.where(both, S_inverse, 0), 0)
    delta = K @ jnp.where(mark, r, 0)
    eye = jnp.eye(ERRORS, dtype=P.dtype)
    gamma = eye.at[POSE, POSE].add(-se3.ad(delta[POSE]) / 2)
    L = gamma @ (eye - K @ H)
    GK = gamma @ K
    P = L @ P @ L.T + GK @ R @ GK.T
    return Update(retract(nominal, delta), (P + P.T) / 2, nis, accepted, K)
