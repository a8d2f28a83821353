"""What steps of the IMU's force and rate would have done if they were errors.

A step Δ that is an error is one of the bias. Since then, over a time T, it has changed angle,
velocity and position along one direction each, which is why a few readings tell how much of a step
was an error: the covariance grows along these directions, and little in the others.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...models import se3
from ...models.sensors import Sensor
from .error_state import Navigation, body_axes, skew
from .inertial import Samples
from .measurement import Innovation, normalized_squares
from .readings import sizes

_BESIDE = 0.3
"""Deviation of an error in the other directions, as a share of its size: readings have corrected
part of it meanwhile, and directions turn with the vehicle."""
_EXPLAINS = 2.0  # times its effect is the largest residual that a jolt explains by itself
_LATER = 5.0  # readings after a jolt whose rejection it may explain
_SLOWER = 20.0  # readings after a jolt whose correlation it may explain
_LATELY = 10.0  # s after a jolt for which it may explain readings after a fault of the IMU
MENDS = 5.0  # s within which the filter may still be wrong after a fault of the IMU
_LONGEST = 1.0  # s for which its effect grows unnoticed


class Jolts(NamedTuple):
    """The IMU's last jolts as errors: two of the force, then two of the rate."""

    roots: Float[Array, "4 e 16"]
    """L of the covariance L Lᵀ that δ gains; the first column is the error itself."""
    since: Float[Array, "4"]
    """Times since then (s)."""


def consequences(
    x: Navigation, samples: Samples, ahead: float, unseen: Float[Array, ""], gravity: float
) -> Jolts:
    """What the last jolts have done to an estimate x if they are errors.

    `ahead` is the time from x to the newest sample, `unseen` that since a velocity was measured
    (s): an error of position has grown for no longer. With the step Δ of a force or a rate, in body
    axes and to first order in T:

        δb_a = Δ, δv = − T Δ, δp = − T²/2 Δ;
        δb_g = Δ, δθ = − T Δ, δv = − (T v^ + T²/2 g_B^) Δ, δp = − T³/6 g_B^ Δ.
    """
    down = jnp.asarray((0.0, 0.0, -gravity), x.v_B.dtype)
    g_B = skew(se3.rotate_inverse(x.X_WB, down))
    since = samples.jolted - ahead
    lasting = jnp.clip(since, 0, _LONGEST)

    def of_force(step: Array, T: Array) -> Array:
        t, none = jnp.minimum(T, unseen), jnp.zeros_like(step)
        return jnp.concatenate([-(t**2) / 2 * step, none, -T * step, none, step])

    def of_rate(step: Array, T: Array) -> Array:
        t, none, falls = jnp.minimum(T, unseen), jnp.zeros_like(step), g_B @ step
        moves = -(T**2) / 2 * falls - T * se3.cross(x.v_B, step)
        return jnp.concatenate([-(t**3) / 6 * falls, -T * step, moves, step, none])

    def root(u: Array) -> Array:
        beside = _BESIDE * jnp.linalg.norm(u.reshape(-1, 3), axis=1)
        L = jnp.concatenate([u[:, None], jnp.diag(jnp.repeat(beside, 3))], axis=1)
        return jnp.pad(L, ((0, x.sensors.size), (0, 0)))

    (forces, rates), (T_f, T_r) = jnp.moveaxis(samples.jolts, 1, 0), lasting.T
    effects = [jax.vmap(of_force)(forces, T_f), jax.vmap(of_rate)(rates, T_r)]
    roots = jax.vmap(root)(jnp.concatenate(effects))
    return Jolts(body_axes(x)[1] @ roots, since.T.reshape(-1))


def explain(
    aids: Sequence[Sensor],
    found: Sequence[Innovation],
    P: Float[Array, "e e"],
    jolts: Jolts,
    ages: Float[Array, "n"],
    fault: Bool[Array, ""],
    gates: Float[Array, "n"],
) -> tuple[Bool[Array, "n 4"], Bool[Array, "n 4"]]:
    """Which jolts may explain each sensor's reading: recent ones with which it passes its gate.

    And those that moved it as far, which may explain innovations that are correlated.

    They are recent if they were at most five readings ago or since the sensor's last good reading,
    `ages` (s) ago, or if some were found to be a `fault` lately: what they have done may not be
    mended yet.
    """
    roots, since = jolts
    passing, moving = [], []
    for i, (sensor, one) in enumerate(zip(aids, found, strict=True)):
        ended = (since > 0) & (since < _LATELY)
        recent = ended & (fault | (since <= jnp.maximum(ages[i], _LATER / sensor.rate)))
        gained = jnp.where(recent[:, None, None], one.H @ roots, 0)
        S = one.H @ P @ one.H.T + one.R + jnp.sum(gained @ gained.mT, axis=0)
        (nis,) = normalized_squares(S, one.residual, sizes([sensor]))
        passing.append(recent & (nis <= gates[i]))
        along = jnp.sum((one.H @ roots)[:, :, 0] ** 2, axis=1)
        recent = ended & (since <= _SLOWER / sensor.rate)
        moving.append(recent & (_EXPLAINS**2 * along >= jnp.sum(one.residual**2)))
    return jnp.stack(passing), jnp.stack(moving)


def opened(P: Float[Array, "e e"], jolts: Jolts, errors: Bool[Array, "4"]) -> Float[Array, "e e"]:
    """P with what the jolts have done that are `errors`."""
    gained = jnp.where(errors[:, None, None], jolts.roots, 0)
    return P + jnp.sum(gained @ gained.mT, axis=0)
