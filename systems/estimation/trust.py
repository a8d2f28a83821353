"""Fault detection for the sensors besides the IMU, and the covariance inflation that follows.

A reading that fails the gate is left out. After `patience` consecutive failures the sensor is
judged:

- A sensor that *jumped* by more than the IMU can have drifted since its previous reading, while the
  IMU is healthy and more of the other sensors agree with the filter than do not, is at fault. It is
  left out until `patience` readings in a row pass the gate again, or until more of the others
  disagree with the filter than agree: then it is the filter that is wrong.
- Otherwise filter and sensor drifted apart, and the faulty one cannot be identified: the sensor's
  readings are followed.

A sensor is *suspect* if it is at fault, stuck or followed, or if its innovations have a nonzero
mean: those of a consistent filter have zero mean (Mehra 1970). It remains so for a minute, or for a
few seconds if it was only stuck, as it was right until then. For each sensor the filter tracks its
*pull*: the shift of the estimate due to its readings. The reported covariance is inflated until it
covers the pull of every suspect; the filter's gains use the covariance without this inflation.

A sensor whose mean NIS is above its expected value has its noise variance raised by that mean
(covariance matching; Mehra 1970); if several do, the IMU's noise variance is raised instead.
"""

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...models.sensors import Imu, Sensor
from .error_state import INERTIAL, POSITION
from .measurement import Innovation, Update, small_inverse

_STUCK_TOGETHER = 2  # repeats of all values of a sensor with several
_OFF = 20.0  # bound on the IMU's error, in standard deviations of its bias
_SUSPECT = 60.0  # s: shortest time for which a sensor is suspect
_MOVES_AGAIN = 3.0  # s for which a sensor that was stuck is suspect: it was right before
_RECENT = 20.0  # memory, in readings, of the pulls of a sensor that is not suspect
_ALONE = {"velocity": 10.0, "position": 60.0, "attitude": 60.0}
"""Time (s) for which the IMU alone predicts velocity, depth and yaw accurately enough."""
_EXACT = 1e-12  # variance, as a share of the block's largest one, of what is said to be exact
_BIASED = 0.8  # mean of normalised innovations: white ones have a deviation of 0.16 over `_RECENT`
_OUTLIER = 2.0
"""Bound on each normalised innovation before it enters the mean. In ten hours of a DVL with 1 %
outliers the mean stays below `_BIASED`; with a bound of 5 it does not (`tests/test_trust.py`)."""
_MATCHED = 50.0  # readings over which NIS are averaged
_CLIPPED = 8.0  # bound on one reading's NIS relative to the mean, against outliers
_GROWTH = 1.05  # of the IMU's variances, per reading while several sensors scatter
_UNUSUAL = 1.6  # threshold of the mean NIS per value over `_MATCHED` readings, above chance


def sizes(aids: Sequence[Sensor]) -> tuple[int, ...]:
    """Numbers of values in the sensors' readings."""
    return tuple(each.value_size for each in aids)


def parts(aids: Sequence[Sensor]) -> list[slice]:
    """The sensors' places in their joined values."""
    return [slice(b - n, b) for n, b in zip(sizes(aids), accumulate(sizes(aids)), strict=True)]


def each_value(per_sensor: Array, aids: Sequence[Sensor]) -> Array:
    """A number or mark of each sensor, repeated for its values."""
    counts = sizes(aids)
    return jnp.repeat(per_sensor, jnp.array(counts), total_repeat_length=sum(counts))


class Shown(NamedTuple):
    """The sensors' last readings, their values joined."""

    values: Float[Array, "m"]
    stamps: Float[Array, "n"]
    repeats: Float[Array, "m"]
    """Number of readings for which each value has been the same."""

    @classmethod
    def start(cls, aids: Sequence[Sensor], dtype: jnp.dtype) -> "Shown":
        """Before the first reading."""
        never, m = jnp.full(len(aids), -jnp.inf, dtype), sum(sizes(aids))
        return cls(jnp.full(m, jnp.inf, dtype), never, jnp.zeros(m, dtype))

    def stuck(self, aids: Sequence[Sensor]) -> Bool[Array, "n"]:
        """Whether a sensor repeats the same values bit for bit in new readings."""
        found = []
        for each, part in zip(aids, parts(aids), strict=True):
            repeats = self.repeats[part]
            mark = repeats.max() >= each.stuck_after
            if each.value_size > 1:
                mark = mark | (repeats.min() >= _STUCK_TOGETHER)
            if each.observes == "velocity":  # lost bottom lock, reported as a zero velocity
                mark = mark | jnp.all(self.values[part] == 0)
            found.append(mark)
        return jnp.stack(found)

    def with_readings(
        self,
        aids: Sequence[Sensor],
        values: Float[Array, "m"],
        valid: Bool[Array, "n"],
        stamps: Float[Array, "n"],
    ) -> tuple["Shown", Bool[Array, "n"]]:
        """The memory with the present readings, and which of them are usable."""
        new = valid & (stamps != self.stamps) & jnp.isfinite(stamps)
        fresh = each_value(new, aids)
        again = jnp.where(values == self.values, self.repeats + 1, 0)
        after = Shown(
            jnp.where(fresh, values, self.values),
            jnp.where(new, stamps, self.stamps),
            jnp.where(fresh, again, self.repeats),
        )
        finite = jnp.stack([jnp.isfinite(values[part]).all() for part in parts(aids)])
        in_range = [
            jnp.sum(values[part] ** 2) <= each.largest**2
            for each, part in zip(aids, parts(aids), strict=True)
        ]
        usable = valid & finite & jnp.isfinite(stamps) & ~after.stuck(aids)
        return after, usable & jnp.stack(in_range)


class Trust(NamedTuple):
    """Statistics of the sensors besides the IMU."""

    nis: Float[Array, "n"]
    """Of the last reading."""
    rejected: Float[Array, "n"]
    """Readings in a row that failed the gate."""
    passed: Float[Array, "n"]
    """Readings in a row that passed it."""
    accepted_at: Float[Array, "n"]
    """When a reading was last used (s)."""
    jump: Float[Array, "n"]
    """Size of the residual with which the present rejections began."""
    distrusted: Float[Array, "n"]
    """1 where a sensor is at fault and left out."""
    scatter: Float[Array, "n"]
    """Mean NIS per value, at the sensor's configured noise."""
    mean: Float[Array, "m"]
    """Mean of the innovations divided by their standard deviations."""
    suspected_at: Float[Array, "n"]
    """When a sensor was last found suspect (s)."""
    stuck_at: Float[Array, "n"]
    """When its values were last stuck (s)."""
    pulled: Float[Array, "n e"]
    """Error δ of the estimate without a sensor's readings relative to the one with them."""
    unconfirmed: Float[Array, "n"]
    """Variance with which a sensor's last accepted reading was predicted, if it decided alone."""
    imu_factor: Float[Array, ""]
    """Factor on the variances of the IMU's noises."""

    @classmethod
    def start(cls, aids: Sequence[Sensor], dtype: jnp.dtype) -> "Trust":
        """No sensor is suspect."""
        n = len(aids)
        zero, one, never = jnp.zeros(n, dtype), jnp.ones(n, dtype), jnp.full(n, -1e9, dtype)
        mean, pulled = jnp.zeros(sum(sizes(aids)), dtype), jnp.zeros((n, INERTIAL + n), dtype)
        return cls(
            zero, zero, zero, zero, zero, zero, one, mean, never, never, pulled, zero, one[0]
        )

    @property
    def _scattered(self) -> Bool[Array, "n"]:
        return self.scatter > _UNUSUAL

    @property
    def noise_factor(self) -> Float[Array, "n"]:
        """Factors on the variances of the sensors' noises."""
        alone = jnp.sum(self._scattered) < 2
        return jnp.where(self._scattered & alone, self.scatter, 1)

    def suspect(self, time: Float[Array, ""], within: float = _SUSPECT) -> Bool[Array, "n"]:
        """Whether a sensor was found suspect `within` the last seconds before a time (s)."""
        stuck = time - self.stuck_at < min(within, _MOVES_AGAIN)
        return stuck | (time - self.suspected_at < within)


def imu_off(imu: Imu, aids: Sequence[Sensor]) -> tuple[float, ...]:
    """Bounds on the IMU's error between two readings of each sensor: m/s, m or rad."""
    a, w = _OFF * imu.accelerometer_bias, _OFF * imu.gyroscope_bias
    bounds = {
        "velocity": lambda rate: a / rate,
        "position": lambda rate: a / rate**2 / 2,
        "attitude": lambda rate: w / rate,
    }
    return tuple(bounds[str(each.observes)](each.rate) for each in aids)


def others(
    trust: Trust, time: Float[Array, ""], patience: int, silence: float
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """For each sensor, how many of the others agree with the filter and how many do not."""
    against = (trust.rejected >= patience) | (trust.distrusted > 0)
    agree = (time - trust.accepted_at <= silence) & (trust.accepted_at > 0) & ~against
    for_, not_ = agree.astype(time.dtype), against.astype(time.dtype)
    return for_.sum() - for_, not_.sum() - not_


class Verdict(NamedTuple):
    """The judgement on the sensors before their readings are used."""

    left_out: Bool[Array, "n"]
    follow: Bool[Array, "n"]


def judged(
    trust: Trust,
    used: Bool[Array, "n"],
    off: tuple[float, ...],
    patience: int,
    well: Bool[Array, "n"],
    cleared: Bool[Array, "n"],
) -> tuple[Trust, Verdict]:
    """Before an update: which sensors to leave out and which to follow regardless of their NIS.

    `used` says which readings came, `well` whether the IMU and most other sensors are healthy,
    `cleared` whether most other sensors disagree with the filter too.
    """
    dtype = trust.nis.dtype
    cleared = (trust.distrusted > 0) & cleared
    back = (trust.distrusted > 0) & (trust.passed >= patience) | cleared
    limit = used & (trust.rejected >= patience) & (~back | cleared)
    fault = limit & (trust.jump > jnp.asarray(off, dtype)) & well
    distrusted = (fault | (trust.distrusted > 0)) & ~back
    after = trust._replace(
        distrusted=distrusted.astype(dtype),
        rejected=jnp.where(back & ~limit, 0, trust.rejected),
    )
    return after, Verdict(distrusted, limit & ~distrusted)


def counted(
    aids: Sequence[Sensor],
    trust: Trust,
    used: Bool[Array, "n"],
    accepted: Bool[Array, "n"],
    nis: Float[Array, "n"],
    plain_nis: Float[Array, "n"],
    gates: tuple[float, ...],
    innovations: tuple[Float[Array, "m"], Float[Array, "m"]],
    time: Float[Array, ""],
) -> Trust:
    """After an update: the trust with these readings counted.

    `nis` are those of the update, `plain_nis` those without raised noise; `innovations` are all
    residuals and their standard deviations.
    """
    residuals, deviations = innovations
    norms = jnp.stack([jnp.linalg.norm(residuals[part]) for part in parts(aids)])
    passes = used & (nis <= jnp.asarray(gates, nis.dtype))
    fails = used & ~passes
    begins = fails & (trust.rejected < 1)
    value = plain_nis / jnp.asarray(sizes(aids), nis.dtype)
    value = jnp.minimum(value, _CLIPPED * jnp.maximum(trust.scatter, 1))
    matched = trust.scatter + (value - trust.scatter) / _MATCHED
    normal = jnp.clip(residuals / deviations, -_OUTLIER, _OUTLIER)
    came = each_value(used, aids)
    mean = jnp.where(came, trust.mean + (normal - trust.mean) / _RECENT, trust.mean)
    several = jnp.sum(trust._scattered) > 1
    factor = jnp.where(several, trust.imu_factor * _GROWTH, trust.imu_factor / _GROWTH)
    return trust._replace(
        nis=jnp.where(used, nis, trust.nis),
        rejected=jnp.where(accepted, 0, trust.rejected + fails.astype(nis.dtype)),
        passed=jnp.where(passes, trust.passed + 1, jnp.where(fails, 0, trust.passed)),
        accepted_at=jnp.where(accepted, time, trust.accepted_at),
        jump=jnp.where(begins, norms, trust.jump),
        scatter=jnp.where(used & (trust.distrusted < 1), matched, trust.scatter),
        mean=mean,
        imu_factor=jnp.where(used.any(), jnp.clip(factor, 1, 1e4), trust.imu_factor),
    )


def suspected(
    aids: Sequence[Sensor],
    trust: Trust,
    found: Bool[Array, "n"],
    stuck: Bool[Array, "n"],
    came: Bool[Array, "n"],
    accepted: Bool[Array, "n"],
    pulled: Float[Array, "n e"],
    time: Float[Array, ""],
    elapsed: Float[Array, ""],
) -> Trust:
    """The trust with those sensors suspect that are `found` at fault or followed, stuck or biased.

    `pulled` holds the pulls after the present update. For a sensor that is not suspect they decay
    over the last readings. For a suspect they decay over the time for which the IMU alone is
    accurate, and not at all while its readings are left out. `elapsed` is the time since the
    previous update (s).
    """
    biased = jnp.stack([jnp.abs(trust.mean[part]).max() > _BIASED for part in parts(aids)])
    trust = trust._replace(
        suspected_at=jnp.where(found | biased, time, trust.suspected_at),
        stuck_at=jnp.where(stuck, time, trust.stuck_at),
    )
    lasting = [_ALONE[str(each.observes)] for each in aids]
    alone = jnp.exp(-elapsed / jnp.asarray(lasting, pulled.dtype))[:, None]
    fades = jnp.broadcast_to(jnp.where(accepted[:, None], alone, 1), pulled.shape)
    if not any(each.observes == "position" and each.value_size > 1 for each in aids):
        # no sensor corrects a horizontal position error: a velocity's pull on it does not decay
        for i, each in enumerate(aids):
            fades = fades.at[i, POSITION].set(1) if each.observes == "velocity" else fades
    of_others = jnp.where(came, 1 - 1 / _RECENT, 1)[:, None]
    fades = jnp.where(trust.suspect(time)[:, None], fades, of_others)
    return trust._replace(pulled=pulled * fades)


def pulls(
    aids: Sequence[Sensor],
    pulled: Float[Array, "n e"],
    done: Update,
    found: Innovation,
    used: Bool[Array, "n"],
) -> Float[Array, "n e"]:
    """The pulls after an update: a sensor's own correction adds, those of others reduce."""
    own = np.repeat(np.eye(len(aids), dtype=bool), sizes(aids), axis=1)
    read = jnp.where(used[:, None], found.residual[None], 0)
    return pulled - jnp.where(own, read, pulled @ found.H.T) @ done.gain.T


def with_doubt(
    P: Float[Array, "e e"], pulled: Float[Array, "n e"], suspect: Bool[Array, "n"]
) -> Float[Array, "e e"]:
    """P inflated so that it covers the pulls of all suspects.

    If s = dᵀ B⁻¹ d > 1 for a pull d and the block B of position, attitude, velocity or a bias, B is
    multiplied by s: the pull is then one standard deviation.
    """
    starts, n = range(0, INERTIAL, 3), pulled.shape[0]
    blocks = jnp.stack([P[k : k + 3, k : k + 3] for k in starts])
    largest = jnp.max(jnp.abs(blocks), axis=(1, 2), keepdims=True)
    # what is known exactly, such as a bias that is said to be zero, has no inverse and no pull
    blocks += _EXACT * jnp.where(largest > 0, largest, 1) * jnp.eye(3, dtype=P.dtype)[None]
    inverses = jax.vmap(small_inverse)(blocks)
    d = pulled[:, :INERTIAL].reshape(n, len(starts), 3)
    s = jnp.sum(jnp.sum(d[:, :, None] * inverses[None], axis=3) * d, axis=2)
    s = jnp.maximum(jnp.max(jnp.where(suspect[:, None], s, 1), axis=0), 1)
    scales = jnp.concatenate([jnp.repeat(jnp.sqrt(s), 3), jnp.ones(n, P.dtype)])
    return scales[:, None] * P * scales[None]
