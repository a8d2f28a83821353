"""Fault detection for the sensors besides the IMU: what may be wrong becomes variance.

Each value of a sensor has an *offset*, a component of the filter's error state that is zero and has
no variance while nothing speaks against the sensor. A reading that fails the gate is left out. If
`patience` readings fail in a row, or if innovations are correlated with the one before (those of a
consistent filter are white; Mehra 1970) or have shifted the estimate by more than white ones do,
then something has changed (Willsky and Jones 1976), and what may have changed is given a variance:

- If two readings are explained by what a jolt of the IMU has done if it was an error, or if
  correlated innovations are no larger, then it was one (`jolts`).
- If the sensor was not heard for a while, or nothing confirmed its last reading, then the filter is
  wrong: what the sensor observes and what it follows from is uncertain; the reading corrects it.
- If innovations are correlated since the IMU's samples scatter by more and its noise explains that,
  that is larger than it says.
- If rejected readings differ among themselves the sensor's noise is larger than it says.
- Otherwise the sensor has changed. Its offset is that which explains the reading, and as uncertain;
  what its recent readings have shifted, the sensor's *pull*, is taken back if it is more than
  chance. Its further readings still tell of changes. A second change soon after the first is a
  drift, of the sensor or less likely of the IMU, and the offset is a random walk that follows the
  correlation of the innovations.

An offset that returns to zero after a clear one is zero again; a sensor whose offset is known to be
within its noise is trusted. No doubt ends by the clock: what covers a fault shrinks by
information alone.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float
from scipy.stats import chi2

from ...models.sensors import Imu, Sensor
from .config import EkfConfig
from .error_state import ACCEL_BIAS, GYRO_BIAS, INERTIAL, Navigation, moved, retract
from .inertial import Samples
from .measurement import Seen, Update, small_inverse
from .readings import each_value, noises, offset_places, parts, sizes
from .trust import FEW_READINGS, Trust, alike, trusted

_FALSE_ALARM = 1e-6  # probability that a consistent filter's pull is found to be too large
_BY_CHANCE = 1e-3  # that it is taken back where a sensor has changed
_CLEAR = 2.0  # standard deviations beyond which a residual of a changed sensor is an offset
_NEAR = 3.0  # standard deviations within which an offset is zero
_RETURNED = 5.0  # standard deviations of an offset from which a return to zero is no coincidence
_SOON = 10.0  # s within which a second change is a drift
_ERRATIC = 4.0
"""Least variance that offsets of a sensor gain per reading, as a share of its noise's, once it has
changed twice; each further change doubles it."""
_IMU_SHARE = 0.5
"""Deviation of a drift that the IMU causes, as a share of that which the sensor does: then either
is within some two deviations."""
_CORRELATED = 2.3
"""Such a mean of one value's innovations: that of white ones is larger once in a million readings,
and that of n values if it is less by n to the power of 3/4 (`tests/test_trust.py`)."""
_EXACT = 1e-12  # variance of an offset that is zero again, but for arithmetic


def noise_explains(
    imu: Imu,
    aids: Sequence[Sensor],
    residuals: Float[Array, "m"],
    samples: Samples,
) -> Bool[Array, "n"]:
    """For each sensor whether the IMU's noise over its last readings explains its residual.

    That is so if the samples scatter by more than they did (`Samples.noisy`). White noise of
    variance s² in samples of period h has an integral of variance s² h T over a time T.
    """
    ratio = samples.noisy(imu)
    force, rate = (ratio * std**2 / imu.rate for std in (imu.noise_std[0], imu.noise_std[3]))
    variances = {
        "velocity": lambda T: force * T + imu.gravity**2 * rate * T**3 / 3,
        "position": lambda T: force * T**3 / 3,
        "attitude": lambda T: rate * T,
    }
    found = []
    for each, part in zip(aids, parts(aids), strict=True):
        variance = variances[str(each.observes)](FEW_READINGS / each.rate)
        square = jnp.sum(residuals[part] ** 2)
        found.append(square <= _NEAR**2 * each.value_size * variance)
    return jnp.stack(found) & (ratio > 1)


class Signs(NamedTuple):
    """What the present readings show, for each sensor."""

    fails: Bool[Array, "n"]
    """Whether a reading does not pass the gate."""
    jolted: Bool[Array, "n"]
    """Whether jolts of the IMU explain it (`jolts.explain`)."""
    moved: Bool[Array, "n"]
    """Whether their effect is as large as its residual, so that they may explain correlation."""
    noisy: Bool[Array, "n"]
    """Whether the IMU's noise explains it (`noise_explains`)."""
    stuck: Bool[Array, "n"]
    """Whether values were just found to stand still: some of the last readings were wrong, too."""


class Change(NamedTuple):
    """What has changed, where the present readings contradict the filter."""

    sensor: Bool[Array, "n"]
    filter: Bool[Array, "n"]
    """Whether a sensor's reading shows that the filter is wrong, but not because of a jolt."""
    jolt: Bool[Array, "n"]
    """Whether it shows that a jolt of the IMU was an error."""
    noise: Bool[Array, "n"]
    """Whether a sensor's readings scatter more than it says."""
    imu: Bool[Array, "n"]
    """Whether the IMU's noise explains a sensor's innovations, as it is larger than it says."""
    taken: Bool[Array, "n"]
    """Whether what a sensor's readings have shifted is taken back where it is beyond chance."""
    back: Float[Array, "n p"]
    """Pulls that are taken back."""
    worth: Float[Array, "n p p"]
    """Covariances of what a consistent filter would lose with them."""


def found_changes(
    aids: Sequence[Sensor],
    trust: Trust,
    seen: Seen,
    signs: Signs,
    config: EkfConfig,
) -> Change:
    """Before an update: what changed.

    A rejected residual that is like one of the two before shows a change, several like none of
    them show noise. A jolt of the IMU is what two readings show: one alone may be an outlier.
    """
    fails, stuck = signs.fails, signs.stuck
    due = fails & (trust.rejected + 1 >= config.patience)
    lasting = jnp.asarray([_CORRELATED / size**0.75 for size in sizes(aids)])
    lasting = jnp.where(trust.changed > 0, lasting / 2, lasting)  # a change is more probable
    correlated = seen.used & (trust.correlation > lasting)
    unseen = (seen.time - trust.accepted_at > config.silence) | (trust.accepted_at <= 0)
    unseen |= trust.unconfirmed > 0
    jolted = fails & signs.jolted & (seen.doubted | (trust.rejected > 0))
    of_filter = jolted | (due | fails & correlated) & unseen
    same = alike(aids, trust, seen.joined.residual / jnp.sqrt(jnp.diag(seen.S)))
    noise = due & ~of_filter & ~same & (trust.unlike > 0)
    due = due & same
    drifted, back, worth = _shifted(aids, trust, seen.joined.H, correlated | stuck)
    slow = (correlated | seen.used & drifted) & ~due & ~of_filter
    jolted |= slow & signs.moved
    of_filter |= jolted
    slow &= ~jolted
    of_imu = slow & signs.noisy
    of_sensor = (due | slow) & ~of_filter & ~of_imu
    return Change(
        of_sensor,
        of_filter & ~jolted,
        jolted,
        noise,
        of_imu,
        of_sensor | stuck,
        jnp.where((of_sensor | stuck)[:, None], back, 0),
        jnp.where((of_sensor | stuck)[:, None, None], worth, 0),
    )


def _shifted(
    aids: Sequence[Sensor],
    trust: Trust,
    H: Float[Array, "m e"],
    takes: Bool[Array, "n"],
) -> tuple[Bool[Array, "n"], Float[Array, "n p"], Float[Array, "n p p"]]:
    """Which sensors have shifted the estimate by more than chance, and what would be taken back.

    That is the pull over the longest memory in which it is none of a consistent filter's, or over
    the shortest one for sensors of which it `takes` any. Last, what a consistent filter would lose.
    """
    H = H[:, : trust.pulled.shape[-1]]
    drifted, back, worth = [], [], []
    for i, (part, size) in enumerate(zip(parts(aids), sizes(aids), strict=True)):
        by_memory = []
        for pulled, usual in zip(trust.pulled[:, i], trust.usual[:, i], strict=True):
            shift = H[part] @ pulled
            inverse = small_inverse(H[part] @ usual @ H[part].T + 1e-12 * jnp.eye(size))
            by_memory.append(shift @ inverse @ shift)
        fast, slow = by_memory
        limit, alarm = (chi2.isf(q, size) for q in (_BY_CHANCE, _FALSE_ALARM))
        drifted.append(jnp.maximum(fast, slow) > alarm)
        longest = jnp.where(slow > limit, 1, 0)
        taken = (jnp.maximum(fast, slow) > limit) | takes[i]
        back.append(jnp.where(taken, trust.pulled[longest, i], 0))
        worth.append(jnp.where(taken, trust.usual[longest, i], 0))
    return jnp.stack(drifted), jnp.stack(back), jnp.stack(worth)


def taken_back(
    x: Navigation, P: Float[Array, "e e"], change: Change
) -> tuple[Navigation, Float[Array, "e e"]]:
    """State and P without what the changed sensors' recent readings have shifted.

    That is as uncertain as it is large, and what they were worth is lost.
    """
    n = change.back.shape[1]
    x = retract(x, jnp.pad(change.back.sum(axis=0), (0, P.shape[0] - n)))
    return x, P.at[:n, :n].add(change.back.T @ change.back + change.worth.sum(axis=0))


def opened(
    aids: Sequence[Sensor],
    trust: Trust,
    x: Navigation,
    P: Float[Array, "e e"],
    change: Change,
    off: Float[Array, "m"],
    seen: Seen,
) -> tuple[Trust, Navigation, Float[Array, "e e"]]:
    """Trust, state and P with the offsets of the changed sensors those that explain their readings.

    `off` are the errors that would explain the readings `seen`. An offset is as uncertain as it is
    large.
    """
    found, S, time = seen.joined, seen.S, seen.time
    own = each_value(change.sensor, aids)
    shift = jnp.where(own & (off**2 > _CLEAR**2 * jnp.diag(S)), off, 0)
    # a second change soon after one is a drift, or more: of the sensor, or less likely of the IMU
    elapsed = each_value(time - trust.changed_at, aids)
    again = (elapsed < _SOON) & (trust.shift != 0)
    elapsed = jnp.maximum(elapsed, 1e-3)
    steep = jnp.where(again, shift / elapsed, 0)
    rate = jnp.where(shift * trust.shift > 0, steep, 0)
    of_offsets, of_drifts = offset_places(aids, P.shape[0])
    P = P.at[of_offsets, of_offsets].add(shift**2).at[of_drifts, of_drifts].add(steep**2)
    for i, (each, part) in enumerate(zip(aids, parts(aids), strict=True)):
        if each.observes == "velocity":  # or its scale has changed
            slope = found.H[part, INERTIAL + i]
            scale = shift[part] @ slope / jnp.maximum(slope @ slope, jnp.sum(shift[part] ** 2))
            scale = jnp.where(change.sensor[i], jnp.nan_to_num(scale), 0)
            P = P.at[INERTIAL + i, INERTIAL + i].add(scale**2)
        bias = {"velocity": ACCEL_BIAS, "attitude": GYRO_BIAS}.get(str(each.observes))
        if bias is not None:
            size = (_IMU_SHARE * jnp.max(jnp.abs(steep[part]))) ** 2
            P = P.at[bias, bias].add(size * jnp.eye(3, dtype=P.dtype))
    erratic = each_value(jnp.stack([(own & again)[part].any() for part in parts(aids)]), aids)
    rates = each_value(jnp.asarray([each.rate for each in aids], off.dtype), aids)
    least = _ERRATIC * noises(aids, off.dtype) ** 2 * rates
    least = jnp.maximum(least, 2 * trust.walk)
    walk = jnp.where(erratic, jnp.maximum(jnp.where(again, shift**2 / elapsed, 0), least), 0)
    squares = (found.residual**2 / jnp.diag(S) + trust.last**2) / 2
    scatter = jnp.stack([jnp.mean(squares[part]) for part in parts(aids)]) * trust.noise_factor
    moves = jnp.zeros_like(x.sensors).at[of_offsets - INERTIAL].set(shift)
    moves = moves.at[of_drifts - INERTIAL].set(rate)
    at = x.sensors[of_offsets - INERTIAL]
    trust = trust._replace(
        changed=jnp.where(change.sensor, 1, trust.changed),
        changed_at=jnp.where(change.sensor, time, trust.changed_at),
        before=jnp.where(own, at, trust.before),
        shift=jnp.where(own, shift, trust.shift),
        walk=jnp.maximum(trust.walk, walk),
        correlation=jnp.where(change.sensor | change.imu, 0, trust.correlation),
        scatter=jnp.where(change.noise, jnp.maximum(trust.scatter, scatter), trust.scatter),
        pulled=jnp.where((change.taken | change.imu)[:, None], 0, trust.pulled),
        usual=jnp.where((change.taken | change.imu)[:, None, None], 0, trust.usual),
    )
    return trust, x._replace(sensors=x.sensors + moves), P


def settled(
    aids: Sequence[Sensor], trust: Trust, done: Update, patience: int
) -> tuple[Trust, Navigation, Float[Array, "e e"]]:
    """Trust, state and P after an update, where offsets that have returned to zero are zero."""
    x, P = done.nominal, done.P
    right = _returned(aids, trust, P, x, patience)
    back = each_value(right, aids)
    values = jnp.concatenate([back, back])
    first = P.shape[0] - values.size

    def condition() -> tuple[Navigation, Float[Array, "e e"]]:
        both = values[:, None] & values[None]
        S = jnp.where(both, P[first:, first:], 0) + jnp.diag(jnp.where(values, _EXACT, 1.0))
        K = jnp.where(values[None], P[:, first:] @ jnp.linalg.inv(S), 0)
        delta = -K @ jnp.where(values, x.sensors[first - INERTIAL :], 0)
        gamma = moved(x, delta)
        after = gamma @ (P - K @ P[first:]) @ gamma.T
        known = jnp.concatenate([jnp.zeros(first, bool), values])
        after = jnp.where(known[:, None] | known[None], 0, (after + after.T) / 2)
        moved_to = retract(x, delta)
        sensors = jnp.where(known[INERTIAL:], 0, moved_to.sensors)
        return moved_to._replace(sensors=sensors), after

    x, P = jax.lax.cond(values.any(), condition, lambda: (x, P))
    as_before = _as_before(aids, trust, P, x) & (trust.passed >= patience)
    trust = trust._replace(
        changed=jnp.where(right | as_before, 0, trust.changed),
        before=jnp.where(back, 0, trust.before),
        shift=jnp.where(back, 0, trust.shift),
        walk=jnp.where(back, 0, trust.walk),
    )
    return trust, x, P


def _as_before(
    aids: Sequence[Sensor], trust: Trust, P: Float[Array, "e e"], x: Navigation
) -> Bool[Array, "n"]:
    """Sensors whose offsets are known to be within their noise and do not move.

    Another cause explained their readings, or taking back what they had shifted.
    """
    still = ~_moving(aids, trust)
    return trusted(aids, P, x) & jnp.stack([still[part].all() for part in parts(aids)])


def _moving(aids: Sequence[Sensor], trust: Trust) -> Bool[Array, "m"]:
    """Values whose offsets walk by more than their noise between two readings."""
    periods = each_value(jnp.asarray([1 / each.rate for each in aids], trust.walk.dtype), aids)
    return trust.walk * periods > noises(aids, trust.walk.dtype) ** 2


def _returned(
    aids: Sequence[Sensor],
    trust: Trust,
    P: Float[Array, "e e"],
    x: Navigation,
    patience: int,
) -> Bool[Array, "n"]:
    """Sensors whose offsets are zero again: zero within their deviations, after clear ones.

    Those that still move pass through zero.
    """
    of_offsets, of_drifts = offset_places(aids, P.shape[0])
    at, variance = x.sensors[of_offsets - INERTIAL], jnp.diag(P)[of_offsets]
    drift, spread = x.sensors[of_drifts - INERTIAL], jnp.diag(P)[of_drifts]
    moves = _moving(aids, trust) | (drift**2 > _NEAR**2 * spread)
    near = (at**2 <= _NEAR**2 * variance) & ~moves
    was = trust.before**2 > _RETURNED**2 * variance
    open_ = variance > 0
    found = [near[part].all() & (was & open_)[part].any() for part in parts(aids)]
    return jnp.stack(found) & (trust.passed >= patience)
