"""Measurement updates of an error-state filter: gate, gain, Joseph form."""

from collections.abc import Callable
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
    zero = jnp.zeros(6, X_WB.dtype)

    def along(direction: Array) -> tuple[Array, Array]:
        return jax.jvp(lambda xi: h(se3.retract(X_WB, xi)), (zero,), (direction,))

    return jax.vmap(along, out_axes=(None, 1))(jnp.eye(6, dtype=X_WB.dtype))


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
    """Yaw and the compass' wander; the residual is taken the short way round."""
    expected, H = _along_pose(compass.expected, nominal.X_WB)
    residual = wrap(reading - expected - nominal.sensors[2:3])
    return Innovation(residual, _pose_row(H, 2), _noise(compass.noise, 1, residual))


def _pose_row(H: Float[Array, "1 6"], sensor: int) -> Float[Array, "1 18"]:
    """The row of a reading of the pose plus one sensor's slow error."""
    row = jnp.zeros((1, ERRORS), H.dtype).at[:, POSE].set(H)
    return row.at[:, SENSORS.start + sensor].set(1)


def small_inverse(S: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Inverse of a 1 × 1 or 3 × 3 matrix in plain arithmetic."""
    if S.shape[0] == 1:
        return 1 / S
    adjugate = jnp.stack([se3.cross(S[1], S[2]), se3.cross(S[2], S[0]), se3.cross(S[0], S[1])], 1)
    return adjugate / (S[0] @ adjugate[:, 0])


def update(
    nominal: Navigation,
    P: Float[Array, "18 18"],
    innovation: Innovation,
    gate: Float[Array, ""] | float,
) -> tuple[Navigation, Float[Array, "18 18"], Float[Array, ""], Bool[Array, ""]]:
    """Correct with a measurement unless its NIS exceeds `gate`; returns the NIS and if it passed.

    NIS = rᵀ S⁻¹ r with S = H P Hᵀ + R is chi-square with m degrees of freedom (Bar-Shalom et al.
    2001, section 5.4). The covariance takes Joseph's form (I − K H) P (I − K H)ᵀ + K R Kᵀ and
    moves to the corrected state with Γ = I − ½ ad(δ) on the pose's error.
    """
    r, H, R = innovation
    PH = P @ H.T
    S_inverse = small_inverse(H @ PH + R)
    nis = r @ S_inverse @ r
    accepted = nis <= gate
    K = jnp.where(accepted, PH @ S_inverse, 0)
    delta = K @ r
    eye = jnp.eye(ERRORS, dtype=P.dtype)
    gamma = eye.at[POSE, POSE].add(-se3.ad(delta[POSE]) / 2)
    L = gamma @ (eye - K @ H)
    GK = gamma @ K
    P = L @ P @ L.T + GK @ R @ GK.T
    return retract(nominal, delta), (P + P.T) / 2, nis, accepted
