"""How the filter regains what it lost: the vertical after a gap in the rates, and a quantity that
its sensor contradicts.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...models import se3
from ...models.sensors import Sensor
from . import error_state, measurement
from .error_state import Navigation
from .measurement import Innovation

_OBSERVED = {
    "velocity": error_state.VELOCITY,
    "position": error_state.POSITION,
    "attitude": error_state.ROTATION,
}
_ALONE = 9.0
"""Ratio of a prediction's variance to a reading's above which the reading decides alone."""


def levelled(
    x: Navigation,
    P: Float[Array, "e e"],
    F: Float[Array, "e e"],
    force: Float[Array, "3"],
    measured: Bool[Array, ""],
    omega: Float[Array, "3"],
    usual: Float[Array, ""],
    gravity: float,
) -> tuple[Navigation, Float[Array, "e e"], Float[Array, "e e"]]:
    """State, P and F after the accelerometer has shown where up is, if that was uncertain.

    The `measured` force without bias is that which keeps v_B constant, apart from an acceleration
    of the mean square `usual` (m²/s⁴). It is used where roll and pitch have twice the deviation
    with which it shows them, as after a gap in the rates. A velocity shows them as well, but later
    and by the sine of the tilt: with large errors a filter that is linear in them claims too much.
    """
    up_B = _up(x, gravity)
    H = jnp.zeros((3, P.shape[0]), P.dtype)
    H = H.at[:, error_state.ROTATION].set(error_state.skew(up_B))
    H = H.at[:, error_state.VELOCITY].set(error_state.skew(omega))
    H = H.at[:, error_state.ACCEL_BIAS].set(jnp.eye(3))
    H = H @ error_state.body_axes(x)[0]
    uncertain = jnp.max(jnp.diag(H @ P @ H.T)) > 4 * usual

    def level() -> tuple[Navigation, Array, Array]:
        residual = force - error_state.held_force(x, omega, gravity)
        found = Innovation(residual, H, usual * jnp.eye(3, dtype=P.dtype))
        done = measurement.update(x, P, [found], jnp.ones(1, bool), [math.inf])
        return done.nominal, done.P, F - done.gain @ (H @ F)

    return jax.lax.cond(uncertain & measured, level, lambda: (x, P, F))


def unconfirmed(found: Sequence[Innovation], P: Float[Array, "e e"]) -> Float[Array, "n"]:
    """For each reading the variance with which it was predicted, if nothing confirms it; else 0.

    Nothing does if the prediction is much worse than the reading, which then decides alone. A
    sensor's offset is none of the prediction.
    """
    own = P.shape[0] - 2 * sum(each.residual.size for each in found)
    slopes = [each.H[:, :own] for each in found]
    variances = [jnp.sum((H @ P[:own, :own]) * H, axis=1) for H in slopes]
    alone = [
        jnp.any(v > _ALONE * jnp.diag(each.R)) for v, each in zip(variances, found, strict=True)
    ]
    return jnp.where(jnp.stack(alone), jnp.stack([v.max() for v in variances]), 0)


def contradict(
    found: Sequence[Innovation], before: Float[Array, "n"], limits: Float[Array, "n"]
) -> Bool[Array, "n"]:
    """For each reading whether it is as probable as the sensor's last, if nothing confirms that.

    `before` are the variances with which those were predicted (`unconfirmed`). A reading that such
    a prediction would have rejected, too, is an outlier.
    """
    squares = jnp.stack([jnp.sum(each.residual**2) for each in found])
    noises = jnp.stack([jnp.max(jnp.diag(each.R)) for each in found])
    return (before > 0) & (squares <= limits * (before + noises))


def opened(
    P: Float[Array, "e e"],
    x: Navigation,
    sensor: Sensor,
    found: Innovation,
    conflict: Bool[Array, ""],
    follow: Bool[Array, ""],
    age: Float[Array, ""],
    gravity: float,
) -> Float[Array, "e e"]:
    """P with the observed quantity as uncertain as the residual is large, if either mark is set.

    A sensor that is to be followed shows that the filter went wrong since the last accepted
    reading, `age` (s) ago. That happened through a rate, which is as uncertain: a position through
    velocity, a velocity through gravity along a wrong vertical. Where two readings are in
    `conflict`, one of them is an outlier.
    """
    part = _OBSERVED[str(sensor.observes)]
    square = jnp.where(follow | conflict, found.residual**2, 0)
    H = found.H[:, part]
    P = P.at[part, part].add(H.T @ (square[:, None] * H))
    rates = jnp.where(follow, square, 0) / age**2
    if sensor.observes == "position":
        return P.at[error_state.VELOCITY, error_state.VELOCITY].add(H.T @ (rates[:, None] * H))
    if sensor.observes == "velocity":
        G = error_state.skew(_up(x, gravity) / gravity**2)
        tilt = jnp.max(rates) * (G @ G.T)
        P = P.at[error_state.ROTATION, error_state.ROTATION].add(tilt)
        moved = square * age**2 / 4  # meanwhile
        P = P.at[error_state.POSITION, error_state.POSITION].add(H.T @ (moved[:, None] * H))
    return P


def _up(x: Navigation, gravity: float) -> Float[Array, "3"]:
    """The specific force at rest, in body axes."""
    return se3.rotate_inverse(x.X_WB, jnp.asarray((0.0, 0.0, gravity), x.v_B.dtype))
