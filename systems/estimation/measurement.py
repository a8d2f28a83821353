"""Measurement updates of an error-state filter: gate, gain, Joseph form."""

from collections.abc import Sequence
from functools import partial
from itertools import accumulate
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...models import se3
from ...models.sensors import Sensor
from ...models.sensors.base import Innovation as Predicted
from .error_state import (
    GYRO_BIAS,
    INERTIAL,
    POSE,
    VELOCITY,
    Navigation,
    body_axes,
    moved,
    retract,
)
from .readings import offsets, sizes


class Innovation(NamedTuple):
    """Residual y − h(x̂), its Jacobian in the error and the measurement's covariance."""

    residual: Float[Array, "m"]
    H: Float[Array, "m e"]
    R: Float[Array, "m m"]


def innovations(
    aids: Sequence[Sensor],
    nominal: Navigation,
    rate: Float[Array, "3"],
    rate_covariance: Float[Array, "3 3"],
    values: Sequence[Float[Array, "_"]],
    acceleration: Float[Array, "3"] | None = None,
    timing_std: float = 0.0,
) -> list[Innovation]:
    """The innovations of all sensors' readings; `rate` is the gyroscope's, with its bias.

    `rate_covariance` is that of the rate between samples, without the bias. With an `acceleration`,
    the derivative of v_B, a reading y whose time of validity is too late by τ is taken as y + ẏ τ:
    the latency τ is part of the state if that has one, and the noise covers a further `timing_std`
    (s).
    """
    V = jnp.concatenate([nominal.v_B, rate - nominal.gyro_bias])
    found = []
    for i, (sensor, place) in enumerate(
        zip(aids, offsets(aids, nominal.sensors.size), strict=True)
    ):
        seen = partial(sensor.innovation, nominal.X_WB, V, nominal.sensors[i : i + 1])
        right = values[i] - nominal.sensors[place]
        one = seen(right)
        H = jnp.zeros((sensor.value_size, INERTIAL + nominal.sensors.size), V.dtype)
        for part, slope in ((POSE, one.pose), (VELOCITY, one.velocity)):
            H = H if slope is None else H.at[:, part].set(slope)
        if one.rate is not None:
            H = H.at[:, GYRO_BIAS].set(-one.rate)
        if one.slow is not None:
            H = H.at[:, INERTIAL + i].set(one.slow)
        H = H @ body_axes(nominal)[0]
        of_offset = jax.jacfwd(lambda y, seen=seen: seen(y).residual)(right)
        H = H.at[:, INERTIAL + place.start : INERTIAL + place.stop].set(of_offset)
        R = jnp.diag(jnp.asarray([std**2 for std in sensor.noise_std], V.dtype))
        if one.rate is not None:
            R = R + one.rate @ rate_covariance @ one.rate.T
        residual = one.residual
        if acceleration is not None:
            changes = _derivative(sensor, one, V, acceleration)
            R = R + timing_std**2 * jnp.outer(changes, changes)
            late = _latency(aids, nominal, i)
            if late is not None:
                residual = residual + changes * late
                H = H.at[:, INERTIAL + len(aids) + i].set(-changes)
        found.append(Innovation(residual, H, R))
    return found


def _derivative(
    sensor: Sensor, one: Predicted, V: Float[Array, "6"], acceleration: Float[Array, "3"]
) -> Float[Array, "m"]:
    """ẏ of a sensor's values y, for a twist and the derivative of v_B."""
    changes = jnp.zeros(sensor.value_size, V.dtype)
    for slope, derivative in ((one.pose, V), (one.velocity, acceleration)):
        changes = changes if slope is None else changes + slope @ derivative
    return changes


def _latency(aids: Sequence[Sensor], nominal: Navigation, i: int) -> Float[Array, ""] | None:
    """Latency of sensor i (s), where latencies are part of the state."""
    known = nominal.sensors.size > len(aids) + 2 * sum(sizes(aids))
    return nominal.sensors[len(aids) + i] if known else None


def off(
    aids: Sequence[Sensor],
    nominal: Navigation,
    rate: Float[Array, "3"],
    values: Sequence[Float[Array, "_"]],
    acceleration: Float[Array, "3"] | None = None,
) -> Float[Array, "m"]:
    """The errors that would explain the readings, beyond the sensors' estimated ones."""
    V = jnp.concatenate([nominal.v_B, rate - nominal.gyro_bias])
    found = []
    for i, (sensor, place) in enumerate(
        zip(aids, offsets(aids, nominal.sensors.size), strict=True)
    ):
        slow = nominal.sensors[i : i + 1]
        right, late = values[i] - nominal.sensors[place], _latency(aids, nominal, i)
        if acceleration is not None and late is not None:
            one = sensor.innovation(nominal.X_WB, V, slow, right)
            right = right + late * _derivative(sensor, one, V, acceleration)
        found.append(sensor.off(nominal.X_WB, V, slow, right))
    return jnp.concatenate(found)


def small_inverse(S: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Inverse of a positive matrix of any size in plain arithmetic, by blocks of 3."""
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


def raised(
    found: Sequence[Innovation],
    factors: Float[Array, " n"],
    doubted: Bool[Array, " n"] | None = None,
) -> list[Innovation]:
    """The innovations with noise variances times factors, and with the residual's square where
    a reading is doubted.
    """
    marks = jnp.zeros(len(found), bool) if doubted is None else doubted
    return [
        each._replace(R=f * each.R + jnp.diag(jnp.where(mark, each.residual**2, 0)))
        for each, f, mark in zip(found, jnp.unstack(factors), jnp.unstack(marks), strict=True)
    ]


def normalized_squares(
    S: Float[Array, "m m"], residual: Float[Array, "m"], sizes: Sequence[int]
) -> Float[Array, " n"]:
    """The NIS of each sensor by itself; `sizes` are their numbers of components."""
    scores = []
    for size, end in zip(sizes, accumulate(sizes), strict=True):
        own = slice(end - size, end)
        scores.append(residual[own] @ small_inverse(S[own, own]) @ residual[own])
    return jnp.stack(scores)


def plain_nis(
    found: Sequence[Innovation], P: Float[Array, "e e"]
) -> tuple[Float[Array, " n"], Innovation, Float[Array, "m m"]]:
    """The NIS of each sensor; all innovations stacked, and their covariance S."""
    joined = together(found)
    S = joined.H @ (P @ joined.H.T) + joined.R
    return normalized_squares(S, joined.residual, [each.residual.size for each in found]), joined, S


class Seen(NamedTuple):
    """The readings of one time and what was expected of them."""

    time: Float[Array, ""]
    """Of the readings (s)."""
    used: Bool[Array, "n"]
    """Which sensors' readings came and can be used."""
    joined: Innovation
    """The innovations of all sensors, stacked."""
    S: Float[Array, "m m"]
    """Their covariance."""
    doubted: Bool[Array, "n"]
    """Which readings contradict one before that nothing confirmed (`recovery.contradict`)."""


class Update(NamedTuple):
    """A corrected state, and the statistics of the update."""

    nominal: Navigation
    P: Float[Array, "e e"]
    nis: Float[Array, " n"]
    """Of each sensor."""
    accepted: Bool[Array, " n"]
    """Whether a sensor's reading was used and passed its gate."""
    gain: Float[Array, "e m"]
    """K, with zero columns for readings that were not used."""


def update(
    nominal: Navigation,
    P: Float[Array, "e e"],
    found: Sequence[Innovation],
    used: Bool[Array, " n"],
    gates: Sequence[float],
) -> Update:
    """Correct with the readings `used` of n sensors unless a sensor's NIS exceeds its gate.

    NIS = rᵀ S⁻¹ r with S = H P Hᵀ + R is chi-square with m degrees of freedom (Bar-Shalom et al.
    2001, section 5.4). The covariance takes Joseph's form (I − K H) P (I − K H)ᵀ + K R Kᵀ and
    moves to the corrected state (`error_state.moved`).
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
    eye = jnp.eye(P.shape[0], dtype=P.dtype)
    gamma = moved(nominal, delta)
    L = gamma @ (eye - K @ H)
    GK = gamma @ K
    P = L @ P @ L.T + GK @ R @ GK.T
    return Update(retract(nominal, delta), (P + P.T) / 2, nis, accepted, K)
