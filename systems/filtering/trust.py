"""Which sensors besides the IMU are believed, and what doubt the covariance has to show.

A reading that fails the gate is left out. After `patience` of them in a row something is wrong, and
the question is what:

- A sensor that *jumped*, by more than the IMU can have been off since its reading before, while the
  IMU and another sensor are well, is at fault. It is left out until `patience` readings in a row
  pass the gate again.
- Otherwise filter and sensor drifted apart and nothing here can tell which of them is wrong. The
  readings are followed, and the covariance keeps the square of the disagreement as a *doubt*, which
  fades within minutes.

A sensor whose readings scatter more than the gate's law says, though they pass it, has its noise
raised by their mean NIS (covariance matching; Mehra 1970).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...models.sensors import Compass, DepthSensor, Dvl, Imu

SIZES = (3, 1, 1)
"""Values in a reading of DVL, depth gauge and compass."""

_PARTS = (slice(0, 3), slice(3, 4), slice(4, 5))
_STUCK_TOGETHER = 2  # repeats of all three velocities
_STUCK_ALONE = 8  # repeats of one value, whose steps may be as coarse as its noise
_BEYOND = 1.1  # times the highest speed is no velocity
_OFF = 20.0  # times the deviation of its bias is more than the IMU can be off
_FADING = 60.0  # s: time constant of a doubt
_MATCHED = 50.0  # readings over which NIS are averaged
_UNUSUAL = 1.6  # mean NIS a value that chance does not bring about over `_MATCHED` readings


class Shown(NamedTuple):
    """What the sensors last showed: v 3, depth, yaw."""

    values: Float[Array, "5"]
    stamps: Float[Array, "3"]
    repeats: Float[Array, "5"]
    """For how many readings each value has been the same."""

    @classmethod
    def start(cls, dtype: jnp.dtype) -> "Shown":
        """Before the first reading."""
        never = jnp.full(3, -jnp.inf, dtype)
        return cls(jnp.full(5, jnp.inf, dtype), never, jnp.zeros(5, dtype))

    @property
    def stuck(self) -> Bool[Array, "3"]:
        """Whether a sensor's values stand still, to the last bit, though readings come."""
        alone = jnp.stack([self.repeats[part].max() >= _STUCK_ALONE for part in _PARTS])
        zeros = jnp.all(self.values[:3] == 0)  # lock lost, shown as a velocity
        return alone.at[0].set(alone[0] | (self.repeats[:3].min() >= _STUCK_TOGETHER) | zeros)

    def with_readings(
        self,
        dvl: Dvl,
        values: Float[Array, "5"],
        valid: Bool[Array, "3"],
        stamps: Float[Array, "3"],
    ) -> tuple["Shown", Bool[Array, "3"]]:
        """The memory with the readings shown now, and which of them can be used at all."""
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
    """What is known of DVL, depth gauge and compass."""

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
    doubt: Float[Array, "3"]
    """Variance of what the sensor measures below which the covariance must not say it is."""
    scatter: Float[Array, "3"]
    """Mean NIS of a value, at the sensor's own noise."""

    @classmethod
    def start(cls, dtype: jnp.dtype) -> "Trust":
        """All is well."""
        zero, one = jnp.zeros(3, dtype), jnp.ones(3, dtype)
        return cls(zero, zero, zero, zero, zero, zero, zero, one)

    @property
    def noise_factor(self) -> Float[Array, "3"]:
        """By what the variances of the sensors' noises are raised."""
        return jnp.where(self.scatter > _UNUSUAL, self.scatter, 1)


def imu_off(imu: Imu, dvl: Dvl, depth: DepthSensor, compass: Compass) -> tuple[float, float, float]:
    """What the IMU can at most be off between two readings: m/s, m, rad."""
    a, w = _OFF * imu.accelerometer_bias, _OFF * imu.gyroscope_bias
    return a / dvl.rate, a / depth.rate**2 / 2, w / compass.rate


def judged(
    trust: Trust,
    used: Bool[Array, "3"],
    residuals: Float[Array, "3"],
    off: tuple[float, float, float],
    patience: int,
    well: Bool[Array, "3"],
    spreads: Float[Array, "3"],
) -> tuple[Trust, Bool[Array, "3"], Bool[Array, "3"]]:
    """Before an update: the trust, the sensors to leave out, those to follow in doubt.

    `residuals` are the sizes of the residuals of the readings `used`, `spreads` the variances of
    what they measure according to the filter, and `well` says where IMU and another sensor are
    well.
    """
    back = (trust.distrusted > 0) & (trust.passed >= patience)
    limit = used & (trust.rejected >= patience) & ~back
    jumped = trust.jump > jnp.asarray(off, residuals.dtype)
    fault = limit & jumped & well
    # Where the filter itself has become that unsure, agreement says little.
    unsure = back & (spreads > trust.jump**2 / 9)
    distrusted = (fault | (trust.distrusted > 0)) & ~back
    follow = limit & ~distrusted
    doubt = jnp.where(follow, jnp.maximum(trust.doubt, residuals**2), trust.doubt)
    doubt = jnp.where(unsure, jnp.maximum(doubt, trust.jump**2), doubt)
    after = trust._replace(
        distrusted=distrusted.astype(residuals.dtype),
        doubt=doubt,
        rejected=jnp.where(back, 0, trust.rejected),
    )
    return after, distrusted, follow


def counted(
    trust: Trust,
    used: Bool[Array, "3"],
    accepted: Bool[Array, "3"],
    nis: Float[Array, "3"],
    plain_nis: Float[Array, "3"],
    gates: tuple[float, float, float],
    residuals: Float[Array, "3"],
    time: Float[Array, ""],
    elapsed: Float[Array, ""],
) -> Trust:
    """After an update: the trust with these readings counted.

    `nis` are those of the update, `plain_nis` those without raised noise; `elapsed` is the time
    since the update before (s).
    """
    passes = used & (nis <= jnp.asarray(gates, nis.dtype))
    fails = used & ~passes
    begins = fails & (trust.rejected < 1)
    value = jnp.minimum(plain_nis, jnp.asarray(gates, nis.dtype)) / jnp.asarray(SIZES, nis.dtype)
    matched = trust.scatter + (value - trust.scatter) / _MATCHED
    return trust._replace(
        nis=jnp.where(used, nis, trust.nis),
        rejected=jnp.where(accepted, 0, trust.rejected + fails.astype(nis.dtype)),
        passed=jnp.where(passes, trust.passed + 1, jnp.where(fails, 0, trust.passed)),
        accepted_at=jnp.where(accepted, time, trust.accepted_at),
        jump=jnp.where(begins, residuals, trust.jump),
        doubt=trust.doubt * jnp.exp(-elapsed / _FADING),
        scatter=jnp.where(used & (trust.distrusted < 1), matched, trust.scatter),
    )
