"""Inertial navigation on SE(3) and the linear propagation of its error.

Nominal state: pose `X_WB`, velocity v of Bo in W expressed in B, biases of gyroscope and
accelerometer, one slow error of each other sensor (scale of the DVL, offset of the depth gauge,
wander of the compass), and of each value of theirs an offset that drifts, zero unless a fault is
suspected (`systems.estimation.trust`). The true state is `retract(nominal, δ)` with δ in R¹⁵⁺ⁿ⁺²ᵐ

    δ = [δp 3, δθ 3 | δv 3 | δb_g 3 | δb_a 3 | slow errors n | offsets m | their drifts m],
    p_WB = p̂_WB + δp,    R_WB = R̂_WB exp(δθ),    v_W = R_z(n̂ᵀ δθ) (v̂_W + δv),

n̂ the vertical in estimated body axes, R_z a rotation about it; the other errors are additive. So δp
and δv are in W, and δv is turned by the error of heading alone. Without a horizontal aid both grow
without bound along the horizontal, while a depth gauge keeps their vertical parts near zero. An
error whose axes tilt with the body's, such as exp([δp, δθ]) or δv in body axes, mixes the two by
the error of tilt, a product that a filter linear in δ neglects: the depth gauge then seems to
measure horizontal velocity. What no sensor observes stays so for all estimates (Huang et al. 2010):
a heading that is wrong alone leaves the velocity in body axes, which a DVL measures.

`body_axes` expresses δ as [δp, δθ, δv] in body axes, in which covariances are given and shown.
Functions take one state; `vmap` makes batches.
"""

import math
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...models import se3
from ...models.sensors import Imu, Sensor
from .readings import sizes

INERTIAL = 15
"""Components of δ without those of sensors besides the IMU."""
POSE, POSITION, ROTATION = slice(0, 6), slice(0, 3), slice(3, 6)
VELOCITY, GYRO_BIAS, ACCEL_BIAS = slice(6, 9), slice(9, 12), slice(12, 15)
SENSORS = slice(INERTIAL, None)


class Navigation(NamedTuple):
    """The nominal state."""

    X_WB: Float[Array, "7"]
    v_B: Float[Array, "3"]
    gyro_bias: Float[Array, "3"]
    accel_bias: Float[Array, "3"]
    sensors: Float[Array, "s"]
    """Slow errors, offsets, drifts."""


class Unmeasured(NamedTuple):
    """What an interval's missing inertial samples leave unknown."""

    held: Float[Array, ""]
    """Time for which v_B was held constant, as the force was missing (s)."""
    velocity: Float[Array, ""]
    """Variance of velocity (m²/s²)."""
    angle: Float[Array, ""]
    """Variance of angle (rad²)."""


class Increment(NamedTuple):
    """Preintegrated samples of an interval T: rotation, position and velocity increments.

    `X` holds ΔR and Δp, the position reached without initial velocity and gravity, `v` is Δv, both
    expressed in the frame at the interval's start (preintegration, Forster et al. 2017, eq. 33).
    """

    X: Float[Array, "7 *batch"]
    v: Float[Array, "3 *batch"]
    time: Float[Array, "*batch"]


def retract(nominal: Navigation, delta: Float[Array, "e"]) -> Navigation:
    """The state whose error relative to `nominal` is δ."""
    X = se3.retract(nominal.X_WB, delta.at[POSITION].set(0)[POSE])
    X = jnp.concatenate([X[:4], X[4:] + delta[POSITION]])
    v_W = se3.rotate(nominal.X_WB, nominal.v_B) + delta[VELOCITY]
    v_W = se3.rotate(_turn(_heading(nominal, delta[ROTATION])), v_W)
    return Navigation(
        X,
        se3.rotate_inverse(X, v_W),
        nominal.gyro_bias + delta[GYRO_BIAS],
        nominal.accel_bias + delta[ACCEL_BIAS],
        nominal.sensors + delta[SENSORS],
    )


def error(nominal: Navigation, true: Navigation) -> Float[Array, "e"]:
    """The δ for which `retract(nominal, δ)` is `true`."""
    turned = se3.local(nominal.X_WB, true.X_WB)[ROTATION]
    v_W = se3.rotate(true.X_WB, true.v_B)
    v_W = se3.rotate_inverse(_turn(_heading(nominal, turned)), v_W)
    rest = [a - b for a, b in zip(true[2:], nominal[2:], strict=True)]
    return jnp.concatenate(
        [
            true.X_WB[4:] - nominal.X_WB[4:],
            turned,
            v_W - se3.rotate(nominal.X_WB, nominal.v_B),
            *rest,
        ]
    )


def _heading(x: Navigation, turned: Float[Array, "3"]) -> Float[Array, ""]:
    """Error of heading due to a δθ, its part about the estimated vertical (rad)."""
    return se3.rotate(x.X_WB, turned)[2]


def _turn(angle: Float[Array, ""]) -> Float[Array, "7"]:
    """A rotation about the vertical by an angle (rad)."""
    return se3.exp(jnp.zeros(6, angle.dtype).at[5].set(angle))


def body_axes(x: Navigation) -> tuple[Float[Array, "e e"], Float[Array, "e e"]]:
    """C and C⁻¹ with δ_B = C δ: p_WB = p̂_WB + R̂_WB δp_B and v_B = v̂_B + δv_B to first order."""
    R = se3.rotation_matrix(x.X_WB)
    eye = jnp.eye(3, dtype=R.dtype)
    tilting = skew(x.v_B) @ (eye - jnp.outer(R[2], R[2]))
    C = jnp.eye(INERTIAL + x.sensors.size, dtype=R.dtype)
    C, C_inverse = (
        C.at[POSITION, POSITION].set(turn).at[VELOCITY, VELOCITY].set(turn) for turn in (R.T, R)
    )
    C = C.at[VELOCITY, ROTATION].set(tilting)
    return C, C_inverse.at[VELOCITY, ROTATION].set(-R @ tilting)


def in_body_axes(x: Navigation, P: Float[Array, "e e"]) -> Float[Array, "e e"]:
    """The covariance of δ_B, of that of δ."""
    C = body_axes(x)[0]
    return C @ P @ C.T


def of_body_axes(P: Float[Array, "e e"], x: Navigation) -> Float[Array, "e e"]:
    """The covariance of δ, of that of δ_B."""
    C_inverse = body_axes(x)[1]
    return C_inverse @ P @ C_inverse.T


def moved(nominal: Navigation, delta: Float[Array, "e"]) -> Float[Array, "e e"]:
    """Γ, which takes the covariance about `nominal` to that about `retract(nominal, delta)`.

    It is the derivative of the error to the latter in that to the former, at δ, but for squares of
    the correction.
    """
    by = -skew(delta[ROTATION]) / 2
    up_B = se3.rotate_inverse(nominal.X_WB, jnp.zeros(3, by.dtype).at[2].set(1))
    turn = _turn(_heading(nominal, delta[ROTATION]))
    v_W = se3.rotate(nominal.X_WB, nominal.v_B) + delta[VELOCITY]
    around = jnp.stack([-v_W[1], v_W[0], jnp.zeros_like(v_W[0])])
    gamma = jnp.eye(delta.size, dtype=delta.dtype)
    gamma = gamma.at[ROTATION, ROTATION].add(by)
    gamma = gamma.at[VELOCITY, VELOCITY].set(se3.rotation_matrix(turn))
    return gamma.at[VELOCITY, ROTATION].set(jnp.outer(around, up_B @ by))


def sample_increment(
    force: Float[Array, "3 *batch"], rate: Float[Array, "3 *batch"], time: Float[Array, "*batch"]
) -> Increment:
    """Increment of one sample: specific force (m/s²) and mean angular rate (rad/s) over `time`.

    The force is in the body axes at the end of the interval, when it is sampled.
    """
    X = se3.exp(jnp.concatenate([jnp.zeros_like(rate), rate * time[None]]))
    v = se3.rotate(X, force) * time[None]
    return Increment(jnp.concatenate([X[:4], v * time[None] / 2]), v, time)


def chain(first: Increment, second: Increment) -> Increment:
    """The increment over both intervals, one after the other."""
    X = se3.compose(first.X, second.X)
    p = X[4:] + first.v * second.time[None]
    v = first.v + se3.rotate(first.X, second.v)
    return Increment(jnp.concatenate([X[:4], p]), v, first.time + second.time)


def chain_all(increments: Increment) -> Increment:
    """The increment over a batch (n,) of consecutive intervals, as √n runs in parallel."""
    n = increments.time.shape[0]
    runs = math.isqrt(n - 1) + 1
    length = -(-n // runs)
    rest = Increment(
        jnp.broadcast_to(se3.identity(increments.v.dtype)[:, None], (7, runs * length - n)),
        jnp.zeros((3, runs * length - n), increments.v.dtype),
        jnp.zeros(runs * length - n, increments.v.dtype),
    )

    def spread(all_of: Array, none: Array) -> Array:
        """Reorder the axes to: place in the run, component, run."""
        together = jnp.concatenate([all_of, none], axis=-1)
        return jnp.moveaxis(together.reshape(*all_of.shape[:-1], runs, length), -1, 0)

    def over(first: Increment, second: Increment) -> tuple[Increment, None]:
        return chain(first, second), None

    steps = jax.tree.map(spread, increments, rest)
    ends = _chained(over, steps)
    return _chained(over, jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), ends))


def _chained(over: Callable, steps: Increment) -> Increment:
    first, others = (jax.tree.map(itemgetter(part), steps) for part in (0, slice(1, None)))
    return jax.lax.scan(over, first, others)[0]


def apply(nominal: Navigation, increment: Increment, gravity: float) -> Navigation:
    """The nominal state after an increment: v_B and X_WB with gravity, the biases unchanged."""
    T = increment.time
    g_B = se3.rotate_inverse(nominal.X_WB, _gravity(nominal.X_WB, gravity))
    start = increment.X[4:] + nominal.v_B * T + g_B * T * T / 2
    X = se3.normalize(se3.compose(nominal.X_WB, jnp.concatenate([increment.X[:4], start])))
    v = se3.rotate_inverse(increment.X, nominal.v_B + increment.v + g_B * T)
    return nominal._replace(X_WB=X, v_B=v)


def held_force(nominal: Navigation, omega: Float[Array, "3"], gravity: float) -> Float[Array, "3"]:
    """The specific force without bias that keeps v_B constant at angular rate ω."""
    up = -_gravity(nominal.X_WB, gravity)
    return se3.rotate_inverse(nominal.X_WB, up) + se3.cross(omega, nominal.v_B)


def _gravity(like: Array, gravity: float) -> Float[Array, "3"]:
    return jnp.asarray((0.0, 0.0, -gravity), like.dtype)


def skew(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The matrix of v × ."""
    return se3.ad(jnp.concatenate([jnp.zeros_like(v), v]))[:3, :3]


def transition(
    before: Navigation,
    after: Navigation,
    force: Float[Array, "3"],
    rate: Float[Array, "3"],
    T: Float[Array, ""],
    imu: Imu,
    aids: Sequence[Sensor],
    unmeasured: Unmeasured | None = None,
    factor: float | Float[Array, ""] = 1.0,
    between: tuple[Float[Array, "3 3"], Float[Array, "3 3"]] | None = None,
) -> tuple[Float[Array, "e e"], Float[Array, "e e"]]:
    """F and Q of δ⁺ = F δ + noise over T (s) of a bias-free `force` and `rate`, first order in δ.

    `factor` is that on the variances of the IMU's white noise; `between` are the covariances of
    angle and velocity due to motion between samples, in body axes.

    In `body_axes`, with A = R_WB⁺ᵀ R_WB, φ = rate · T and J = J_r(φ):

        δθ⁺ = A δθ − T J δb_g
        δv⁺ = A δv − T (A v)^ J δb_g + T g_B⁺^ δθ⁺ − T δb_a
        δp⁺ = A (δp + T δv − T v^ δθ) − T²/2 (f^ δθ⁺ + δb_a).

    While the force is missing v_B is held, whatever attitude and biases are: δv⁺ = δv + noise.
    Readings of velocity then tell nothing of the attitude.
    """
    eye = jnp.eye(3, dtype=force.dtype)
    held, of_velocity, of_angle = unmeasured or jnp.zeros(3, T.dtype)
    m = jnp.clip(held / jnp.maximum(T, 1e-9), 0, 1)
    zero = jnp.zeros_like(eye)
    W = skew(rate * T)
    J = eye - W / 2 + W @ W / 6
    A = se3.rotation_matrix(after.X_WB).T @ se3.rotation_matrix(before.X_WB)
    g_B = se3.rotate_inverse(after.X_WB, _gravity(after.X_WB, imu.gravity))
    G, H = T * skew(g_B), -(T * T / 2) * skew(force)
    C_v = -(1 - m) * (skew(A @ before.v_B) + G) @ J
    C_p = -H @ J
    rho = decays(aids, before.sensors.size, T)
    rows = [
        jnp.concatenate(
            [A, H @ A - T * A @ skew(before.v_B), T * A, T * C_p, -(T * T / 2) * eye], 1
        ),
        jnp.concatenate([zero, A, zero, -T * J, zero], 1),
        jnp.concatenate(
            [zero, (1 - m) * G @ A, (1 - m) * A + m * eye, T * C_v, -(1 - m) * T * eye], 1
        ),
        jnp.concatenate([zero, zero, zero, eye, zero], 1),
        jnp.concatenate([zero, zero, zero, zero, eye], 1),
    ]
    values = sum(sizes(aids))
    drifting = jnp.diag(rho) + T * jnp.eye(rho.size, k=values).at[: -2 * values].set(0)
    F = jax.scipy.linalg.block_diag(jnp.concatenate(rows), drifting)
    rest = jnp.zeros((6 + rho.size, 3), force.dtype)
    N_g = jnp.concatenate([C_p, -J, C_v, rest])
    N_a = jnp.concatenate([-(T / 2) * eye, zero, -eye, rest])
    s_g, s_a = (factor * x**2 / 2 for x in (imu.gyroscope_density, imu.accelerometer_density))
    Q = (s_g * T + of_angle) * (N_g @ N_g.T) + (s_a * T + of_velocity) * (N_a @ N_a.T)
    Q = _with_moments(Q, s_g, s_a, g_B, T, between) + jnp.diag(_walks(imu, aids, rho, T))
    return body_axes(after)[1] @ F @ body_axes(before)[0], of_body_axes(Q, after)


def neglected_acceleration(
    x: Navigation, P: Float[Array, "e e"], gravity: float
) -> Float[Array, ""]:
    """Mean square (m²/s⁴) of the vertical acceleration that is of second order in δ.

    A tilt θ of variances p, q and covariance c about two horizontal axes takes g θ² / 2, with a
    mean square of g² (3 p² + 3 q² + 2 p q + 4 c²) / 4 if it is Gaussian; and it turns an error of
    the accelerometer into the vertical. A depth gauge resolves both.
    """
    R = se3.rotation_matrix(x.X_WB)
    (p, c, _), (_, q, _), _ = R @ P[ROTATION, ROTATION] @ R.T
    (u, _, _), (_, v, _), _ = R @ P[ACCEL_BIAS, ACCEL_BIAS] @ R.T
    return gravity**2 * (3 * p * p + 3 * q * q + 2 * p * q + 4 * c * c) / 4 + p * v + q * u


def _with_moments(
    Q: Float[Array, "e e"],
    s_g: float | Array,
    s_a: float | Array,
    g_B: Float[Array, "3"],
    time: Array,
    between: tuple[Float[Array, "3 3"], Float[Array, "3 3"]] | None,
) -> Float[Array, "e e"]:
    """Q with the first moments of white noise over a time (s), and with motion `between` samples.

    The noise has a mean and an independent first moment of variance T³ / 12. The moment adds to
    position through the accelerometer and to velocity through the gyroscope and gravity.
    """
    moment = time**3 / 12
    Q = Q.at[POSITION, POSITION].add(s_a * moment * jnp.eye(3, dtype=g_B.dtype))
    Q = Q.at[VELOCITY, VELOCITY].add(s_g * moment * (skew(g_B) @ skew(g_B).T))
    if between is None:
        return Q
    return Q.at[ROTATION, ROTATION].add(between[0]).at[VELOCITY, VELOCITY].add(between[1])


def _walks(
    imu: Imu, aids: Sequence[Sensor], rho: Float[Array, "s"], time: Float[Array, ""]
) -> Float[Array, "e"]:
    """Variances that biases and slow errors, which decay by `rho`, gain over a time (s)."""
    dtype = time.dtype
    stds = [0.0 if math.isinf(each.slow_error[1]) else each.slow_error[0] for each in aids]
    stds += [0.0] * (rho.size - len(stds))
    slow = jnp.asarray(stds, dtype) ** 2 * (1 - rho**2)
    gyroscope = jnp.full(3, imu.gyroscope_walk**2, dtype) * time
    accelerometer = jnp.full(3, imu.accelerometer_walk**2, dtype) * time
    return jnp.concatenate([jnp.zeros(9, dtype), gyroscope, accelerometer, slow])


def foreseen_covariance(
    steps: Float[Array, "6 6"],
    v_B: Float[Array, "3"],
    ahead: float | Float[Array, ""],
    size: int,
) -> Float[Array, "e e"]:
    """Covariance, in body axes, due to the error of a predicted mean force and rate (s `ahead`).

    `steps` is the mean square of the errors of [force, rate].
    """
    a = ahead * jnp.eye(3, dtype=v_B.dtype)
    J = jnp.zeros((size, 6), v_B.dtype)
    J = J.at[POSITION, :3].set(ahead / 2 * a)
    J = J.at[ROTATION, 3:].set(a).at[VELOCITY, :3].set(a)
    J = J.at[VELOCITY, 3:].set(ahead * skew(v_B))
    return J @ steps @ J.T


def passed(
    aids: Sequence[Sensor], sensors: Float[Array, "s"], time: Float[Array, ""]
) -> Float[Array, "s"]:
    """The sensors' errors after a time (s): slow ones decay, offsets drift."""
    m = sum(sizes(aids))
    still = jnp.zeros(sensors.size - 2 * m, sensors.dtype)
    drifts = jnp.concatenate([still, sensors[still.size + m :], jnp.zeros(m)])
    return decays(aids, sensors.size, time) * sensors + time * drifts


def decays(aids: Sequence[Sensor], size: int, time: Float[Array, ""]) -> Float[Array, "s"]:
    """Factors on the sensors' `size` errors over a time (s): slow ones decay, others last."""
    lasting = [each.slow_error[1] for each in aids]
    lasting += [math.inf] * (size - len(aids))
    return jnp.exp(-time / jnp.asarray(lasting, time.dtype))
