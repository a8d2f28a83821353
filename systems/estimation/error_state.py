"""Inertial navigation on SE(3) and the linear propagation of its error.

Nominal state: pose `X_WB`, velocity v of Bo in W expressed in B, biases of gyroscope and
accelerometer, and one slow error of each other sensor: scale of the DVL, offset of the depth gauge,
wander of the compass. The true state is `retract(nominal, δ)` with the error δ in R¹⁵⁺ⁿ

    δ = [δp 3, δθ 3 | δv 3 | δb_g 3 | δb_a 3 | slow errors n],    X_WB = X̂_WB exp([δp, δθ]),

so the pose error is expressed in the body frame (left-invariant; Barrau and Bonnabel 2017) in the
order of a twist; the other errors are additive. Functions take one state; `vmap` makes batches.
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

INERTIAL = 15
"""Components of δ without the slow errors of sensors besides the IMU."""
POSE, POSITION, ROTATION = slice(0, 6), slice(0, 3), slice(3, 6)
VELOCITY, GYRO_BIAS, ACCEL_BIAS = slice(6, 9), slice(9, 12), slice(12, 15)
SENSORS = slice(INERTIAL, None)


class Navigation(NamedTuple):
    """The nominal state."""

    X_WB: Float[Array, "7"]
    v_B: Float[Array, "3"]
    gyro_bias: Float[Array, "3"]
    accel_bias: Float[Array, "3"]
    sensors: Float[Array, "n"]


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
    return Navigation(
        se3.retract(nominal.X_WB, delta[POSE]),
        nominal.v_B + delta[VELOCITY],
        nominal.gyro_bias + delta[GYRO_BIAS],
        nominal.accel_bias + delta[ACCEL_BIAS],
        nominal.sensors + delta[SENSORS],
    )


def error(nominal: Navigation, true: Navigation) -> Float[Array, "e"]:
    """The δ for which `retract(nominal, δ)` is `true`."""
    rest = [a - b for a, b in zip(true[1:], nominal[1:], strict=True)]
    return jnp.concatenate([se3.local(nominal.X_WB, true.X_WB), *rest])


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
    time: Float[Array, ""],
    imu: Imu,
    aids: Sequence[Sensor],
    unmeasured: Unmeasured | None = None,
    factor: float | Float[Array, ""] = 1.0,
) -> tuple[Float[Array, "e e"], Float[Array, "e e"]]:
    """F and Q of δ⁺ = F δ + noise over one sample (bias-free `force`, `rate`), first order in δ.

    `factor` is that on the variances of the IMU's white noise.

    With φ = rate · time, A = exp(φ)ᵀ and J = J_r(φ):

        δθ⁺ = A δθ − T J δb_g
        δv⁺ = A δv − T (A v)^ J δb_g + T g_B⁺^ δθ⁺ − T δb_a
        δp⁺ = A (δp + T δv − T v^ δθ) − T²/2 (f^ δθ⁺ + δb_a).

    While the force is missing v_B is held, whatever attitude and biases are: δv⁺ = δv + noise.
    Readings of velocity then tell nothing of the attitude.
    """
    eye = jnp.eye(3, dtype=force.dtype)
    nothing = jnp.zeros_like(time)
    held, of_velocity, of_angle = unmeasured or (nothing, nothing, nothing)
    m = jnp.clip(held / jnp.maximum(time, 1e-9), 0, 1)
    zero = jnp.zeros_like(eye)
    T = time
    W = skew(rate * T)
    W2 = W @ W
    A = eye - W + W2 / 2 - W @ W2 / 6  # exp(φ)ᵀ; the remainder is |φ|⁴/24
    J = eye - W / 2 + W2 / 6
    g_B = se3.rotate_inverse(after.X_WB, _gravity(after.X_WB, imu.gravity))
    G, H = T * skew(g_B), -(T * T / 2) * skew(force)
    C_v = -(1 - m) * (skew(A @ before.v_B) + G) @ J
    C_p = -H @ J
    rho = decays(aids, T)
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
    F = jax.scipy.linalg.block_diag(jnp.concatenate(rows), jnp.diag(jnp.stack(rho)))
    rest = jnp.zeros((6 + len(aids), 3), force.dtype)
    N_g = jnp.concatenate([C_p, -J, C_v, rest])
    N_a = jnp.concatenate([-(T / 2) * eye, zero, -eye, rest])
    s_g = factor * imu.gyroscope_density**2 / 2
    s_a = factor * imu.accelerometer_density**2 / 2
    Q = (s_g * T + of_angle) * (N_g @ N_g.T) + (s_a * T + of_velocity) * (N_a @ N_a.T)
    return F, Q + _moments(s_g, s_a, g_B, T, Q.shape[0]) + jnp.diag(_walks(imu, aids, rho, T))


def _moments(
    s_g: float | Array, s_a: float | Array, g_B: Float[Array, "3"], time: Array, size: int
) -> Float[Array, "e e"]:
    """What the first moments of white noise over a time (s) add to Q.

    The noise has a mean and an independent first moment of variance T³ / 12. The moment adds to
    position through the accelerometer and to velocity through the gyroscope and gravity.
    """
    moment = time**3 / 12
    Q = jnp.zeros((size, size), g_B.dtype)
    Q = Q.at[POSITION, POSITION].set(s_a * moment * jnp.eye(3, dtype=g_B.dtype))
    return Q.at[VELOCITY, VELOCITY].set(s_g * moment * (skew(g_B) @ skew(g_B).T))


def _walks(
    imu: Imu, aids: Sequence[Sensor], rho: Sequence[Array], time: Float[Array, ""]
) -> Float[Array, "e"]:
    """Variances that biases and slow errors, which decay by `rho`, gain over a time (s)."""
    dtype = time.dtype
    slow = (
        jnp.zeros(1, dtype)
        if math.isinf(each.slow_error[1])
        else (each.slow_error[0] ** 2 * (1 - r * r))[None]
        for each, r in zip(aids, rho, strict=True)
    )
    gyroscope = jnp.full(3, imu.gyroscope_walk**2, dtype) * time
    accelerometer = jnp.full(3, imu.accelerometer_walk**2, dtype) * time
    return jnp.concatenate([jnp.zeros(9, dtype), gyroscope, accelerometer, *slow])


def foreseen_covariance(
    steps: Float[Array, "6 6"],
    v_B: Float[Array, "3"],
    ahead: float | Float[Array, ""],
    size: int,
) -> Float[Array, "e e"]:
    """Covariance due to the error of a predicted mean force and rate over `ahead` (s).

    `steps` is the mean square of the errors of [force, rate].
    """
    a = ahead * jnp.eye(3, dtype=v_B.dtype)
    J = jnp.zeros((size, 6), v_B.dtype)
    J = J.at[POSITION, :3].set(ahead / 2 * a)
    J = J.at[ROTATION, 3:].set(a).at[VELOCITY, :3].set(a)
    J = J.at[VELOCITY, 3:].set(ahead * skew(v_B))
    return J @ steps @ J.T


def decays(aids: Sequence[Sensor], time: Float[Array, ""]) -> list[Float[Array, ""]]:
    """Factor on each sensor's slow error over a time (s)."""
    lasting = [each.slow_error[1] for each in aids]
    return [jnp.ones_like(time) if math.isinf(x) else jnp.exp(-time / x) for x in lasting]
