"""Fault detection for the sensors besides the IMU, and the covariance inflation that follows.

A reading that fails the gate is left out. After `patience` consecutive failures the sensor is
judged:

- A sensor that *jumped* by more than the IMU can have drifted since its previous reading, while the
  IMU and another sensor are healthy, is at fault. It is left out until `patience` readings in a row
  pass the gate again.
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

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...models.sensors import Compass, DepthSensor, Dvl, Imu
from .measurement import small_inverse

SIZES = (3, 1, 1)
"""Values in a reading of DVL, depth gauge and compass."""

_PARTS = (slice(0, 3), slice(3, 4), slice(4, 5))
_STUCK_TOGETHER = 2  # repeats of all three velocities
_STUCK_ALONE = (4, 8, 4)  # repeats of one value; a gauge's resolution may be as coarse as its noise
_BEYOND = 1.1  # factor on the highest speed above which a velocity is invalid
_OFF = 20.0  # bound on the IMU's error, in standard deviations of its bias
_SUSPECT = 60.0  # s: shortest time for which a sensor is suspect
_MOVES_AGAIN = 3.0  # s for which a sensor that was stuck is suspect: it was right before
_RECENT = 20.0  # memory, in readings, of the pulls of a sensor that is not suspect
_ALONE = (10.0, 60.0, 60.0)
"""Time (s) for which the IMU alone predicts velocity, depth and yaw accurately enough."""
_BIASED = 0.8  # mean of normalised innovations: white ones have a deviation of 0.16 over `_RECENT`
_OUTLIER = 2.0
"""Bound on each normalised innovation before it enters the mean. In ten hours of a DVL with 1 %
outliers the mean stays below `_BIASED`; with a bound of 5 it does not (`tests/test_trust.py`)."""
_MATCHED = 50.0  # readings over which NIS are averaged
_CLIPPED = 8.0  # bound on one reading's NIS relative to the mean, against outliers
_GROWTH = 1.05  # of the IMU's variances, per reading while several sensors scatter
_UNUSUAL = 1.6  # threshold of the mean NIS per value over `_MATCHED` readings, above chance


class Shown(NamedTuple):
    """The sensors' last readings: v 3, depth, yaw."""

    values: Float[Array, "5"]
    stamps: Float[Array, "3"]
    repeats: Float[Array, "5"]
    """Number of readings for which each value has been the same."""

    @classmethod
    def start(cls, dtype: jnp.dtype) -> "Shown":
        """Before the first reading."""
        never = jnp.full(3, -jnp.inf, dtype)
        return cls(jnp.full(5, jnp.inf, dtype), never, jnp.zeros(5, dtype))

    @property
    def stuck(self) -> Bool[Array, "3"]:
        """Whether a sensor repeats the same values bit for bit in new readings."""
        longest = jnp.stack([self.repeats[part].max() for part in _PARTS])
        alone = longest >= jnp.asarray(_STUCK_ALONE, longest.dtype)
        zeros = jnp.all(self.values[:3] == 0)  # lost bottom lock, reported as a zero velocity
        return alone.at[0].set(alone[0] | (self.repeats[:3].min() >= _STUCK_TOGETHER) | zeros)

    def with_readings(
        self,
        dvl: Dvl,
        values: Float[Array, "5"],
        valid: Bool[Array, "3"],
        stamps: Float[Array, "3"],
    ) -> tuple["Shown", Bool[Array, "3"]]:
        """The memory with the present readings, and which of them are usable."""
        new = valid & (stamps != self.stamps) & jnp.isfinite(stamps)
        fresh = jnp.repeat(new, jnp.array(SIZES), total_repeat_length=5)
        again = jnp.where(values == self.values, self.repeats + 1, 0)
        after = Shown(
            jnp.where(fresh, values, self.values),
            jnp.where(new, stamps, self.stamps),
            jnp.where(fresh, again, self.repeats),
        )
        finite = jnp.stack([jnp.isfinite(values[part]).all() for part in _PARTS])
        in_range = jnp.sum(values[:3] ** 2) <= (_BEYOND * dvl.highest_speed) ** 2
        usable = valid & finite & jnp.isfinite(stamps) & ~after.stuck
        return after, usable.at[0].set(usable[0] & in_range)


class Trust(NamedTuple):
    """Statistics of DVL, depth gauge and compass."""

    nis: Float[Array, "3"]
    """Of the last reading."""
    rejected: Float[Array, "3"]
    """Readings in a row that failed the gate."""
    passed: Float[Array, "3"]
    """Readings in a row that passed it."""
    accepted_at: Float[Array, "3"]
    """When a reading was last used (s)."""
    jump: Float[Array, "3"]
    """Size of the residual with which the present rejections began."""
    distrusted: Float[Array, "3"]
    """1 where a sensor is at fault and left out."""
    scatter: Float[Array, "3"]
    """Mean NIS per value, at the sensor's configured noise."""
    mean: Float[Array, "5"]
    """Mean of the innovations divided by their standard deviations."""
    suspected_at: Float[Array, "3"]
    """When a sensor was last found suspect (s)."""
    stuck_at: Float[Array, "3"]
    """When its values were last stuck (s)."""
    pulled: Float[Array, "3 18"]
    """Error δ of the estimate without a sensor's readings relative to the one with them."""
    imu_factor: Float[Array, ""]
    """Factor on the variances of the IMU's noises."""

    @classmethod
    def start(cls, dtype: jnp.dtype) -> "Trust":
        """No sensor is suspect."""
        zero, one = jnp.zeros(3, dtype), jnp.ones(3, dtype)
        never = jnp.full(3, -1e9, dtype)
        five, pulled = jnp.zeros(5, dtype), jnp.zeros((3, 18), dtype)
        return cls(zero, zero, zero, zero, zero, zero, one, five, never, never, pulled, one[0])

    @property
    def _scattered(self) -> Bool[Array, "3"]:
        return self.scatter > _UNUSUAL

    @property
    def noise_factor(self) -> Float[Array, "3"]:
        """Factors on the variances of the sensors' noises."""
        alone = jnp.sum(self._scattered) < 2
        return jnp.where(self._scattered & alone, self.scatter, 1)

    def suspect(self, time: Float[Array, ""], within: float = _SUSPECT) -> Bool[Array, "3"]:
        """Whether a sensor was found suspect `within` the last seconds before a time (s)."""
        stuck = time - self.stuck_at < min(within, _MOVES_AGAIN)
        return stuck | (time - self.suspected_at < within)


def imu_off(imu: Imu, dvl: Dvl, depth: DepthSensor, compass: Compass) -> tuple[float, float, float]:
    """Bounds on the IMU's error between two readings: m/s, m, rad."""
    a, w = _OFF * imu.accelerometer_bias, _OFF * imu.gyroscope_bias
    return a / dvl.rate, a / depth.rate**2 / 2, w / compass.rate


class Verdict(NamedTuple):
    """The judgement on the sensors before their readings are used."""

    left_out: Bool[Array, "3"]
    follow: Bool[Array, "3"]


def judged(
    trust: Trust,
    used: Bool[Array, "3"],
    off: tuple[float, float, float],
    patience: int,
    well: Bool[Array, "3"],
) -> tuple[Trust, Verdict]:
    """Before an update: which sensors to leave out and which to follow regardless of their NIS.

    `used` says which readings came, `well` whether the IMU and another sensor are healthy.
    """
    dtype = trust.nis.dtype
    back = (trust.distrusted > 0) & (trust.passed >= patience)
    limit = used & (trust.rejected >= patience) & ~back
    fault = limit & (trust.jump > jnp.asarray(off, dtype)) & well
    distrusted = (fault | (trust.distrusted > 0)) & ~back
    after = trust._replace(
        distrusted=distrusted.astype(dtype), rejected=jnp.where(back, 0, trust.rejected)
    )
    return after, Verdict(distrusted, limit & ~distrusted)


def counted(
    trust: Trust,
    used: Bool[Array, "3"],
    accepted: Bool[Array, "3"],
    nis: Float[Array, "3"],
    plain_nis: Float[Array, "3"],
    gates: tuple[float, float, float],
    innovations: tuple[Float[Array, "5"], Float[Array, "5"]],
    time: Float[Array, ""],
) -> Trust:
    """After an update: the trust with these readings counted.

    `nis` are those of the update, `plain_nis` those without raised noise; `innovations` are all
    residuals and their standard deviations.
    """
    residuals, deviations = innovations
    sizes = jnp.stack([jnp.linalg.norm(residuals[part]) for part in _PARTS])
    passes = used & (nis <= jnp.asarray(gates, nis.dtype))
    fails = used & ~passes
    begins = fails & (trust.rejected < 1)
    value = plain_nis / jnp.asarray(SIZES, nis.dtype)
    value = jnp.minimum(value, _CLIPPED * jnp.maximum(trust.scatter, 1))
    matched = trust.scatter + (value - trust.scatter) / _MATCHED
    normal = jnp.clip(residuals / deviations, -_OUTLIER, _OUTLIER)
    came = jnp.repeat(used, jnp.array(SIZES), total_repeat_length=5)
    mean = jnp.where(came, trust.mean + (normal - trust.mean) / _RECENT, trust.mean)
    several = jnp.sum(trust._scattered) > 1
    factor = jnp.where(several, trust.imu_factor * _GROWTH, trust.imu_factor / _GROWTH)
    return trust._replace(
        nis=jnp.where(used, nis, trust.nis),
        rejected=jnp.where(accepted, 0, trust.rejected + fails.astype(nis.dtype)),
        passed=jnp.where(passes, trust.passed + 1, jnp.where(fails, 0, trust.passed)),
        accepted_at=jnp.where(accepted, time, trust.accepted_at),
        jump=jnp.where(begins, sizes, trust.jump),
        scatter=jnp.where(used & (trust.distrusted < 1), matched, trust.scatter),
        mean=mean,
        imu_factor=jnp.where(used.any(), jnp.clip(factor, 1, 1e4), trust.imu_factor),
    )


def suspected(
    trust: Trust,
    found: Bool[Array, "3"],
    stuck: Bool[Array, "3"],
    came: Bool[Array, "3"],
    accepted: Bool[Array, "3"],
    pulled: Float[Array, "3 18"],
    time: Float[Array, ""],
    elapsed: Float[Array, ""],
) -> Trust:
    """The trust with those sensors suspect that are `found` at fault or followed, stuck or biased.

    `pulled` holds the pulls after the present update. For a sensor that is not suspect they decay
    over the last readings. For a suspect they decay over the time for which the IMU alone is
    accurate, and not at all while its readings are left out. `elapsed` is the time since the
    previous update (s).
    """
    biased = jnp.stack([jnp.abs(trust.mean[part]).max() > _BIASED for part in _PARTS])
    trust = trust._replace(
        suspected_at=jnp.where(found | biased, time, trust.suspected_at),
        stuck_at=jnp.where(stuck, time, trust.stuck_at),
    )
    alone = jnp.exp(-elapsed / jnp.asarray(_ALONE, pulled.dtype))[:, None]
    # no sensor corrects a horizontal position error: the DVL's pull on it does not decay
    fades = jnp.broadcast_to(jnp.where(accepted[:, None], alone, 1), pulled.shape)
    fades = fades.at[0, :3].set(1)
    of_others = jnp.where(came, 1 - 1 / _RECENT, 1)[:, None]
    fades = jnp.where(trust.suspect(time)[:, None], fades, of_others)
    return trust._replace(pulled=pulled * fades)


def with_doubt(
    P: Float[Array, "18 18"], pulled: Float[Array, "3 18"], suspect: Bool[Array, "3"]
) -> Float[Array, "18 18"]:
    """P inflated so that it covers the pulls of all suspects.

    If s = dᵀ B⁻¹ d > 1 for a pull d and the block B of position, attitude, velocity or a bias, B is
    multiplied by s: the pull is then one standard deviation.
    """
    starts = range(0, 15, 3)
    inverses = jax.vmap(small_inverse)(jnp.stack([P[k : k + 3, k : k + 3] for k in starts]))
    d = pulled[:, :15].reshape(3, 5, 3)
    s = jnp.sum(jnp.sum(d[:, :, None] * inverses[None], axis=3) * d, axis=2)
    s = jnp.maximum(jnp.max(jnp.where(suspect[:, None], s, 1), axis=0), 1)
    scales = jnp.concatenate([jnp.repeat(jnp.sqrt(s), 3), jnp.ones(3, P.dtype)])
    return scales[:, None] * P * scales[None]
