"""Fault detection for inertial samples, and the statistics of their one-step predictions.

A sample is left out if it is not finite, at or beyond the instrument's range, stuck (values repeat
bit for bit) or far from the samples before it. A sample that is left out adds to the covariance: by
the size of the rejected value, as it may have been right, and by the vehicle's usual motion.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...models import se3
from ...models.sensors import Imu
from ...models.sensors.base import velocity_at

FEW = 5
"""Number of samples whose mean force predicts the next."""

_REMEMBERED = 2.0  # s: time constant of the averages of the differences between samples
_MINUTE = 60.0  # s: the same of what is usual
_RECENT = 0.25  # s: time constant of the recent motion
_USUAL = 10.0  # s: time constant of the averages of the vehicle's motion
_KEPT_UP = 1.0  # s for which an acceleration or a rate of turn lasts
_FADES = 0.3  # s: time constant with which the last rate decays while rates are missing
_STUCK_TOGETHER = 5  # repeats of all three values of a triad: noise makes them improbable
_STUCK_ALONE = 50  # repeats of one value, whose resolution may be as coarse as its noise
_NOISIER = 2.0  # times the variance of the last minute
_SETTLES = 5.0  # s after which the last minute is known
_ODD = 10.0  # standard deviations beyond which a sample is odd
_ODD_RUN = 5  # more odd samples in a row than this are true motion


LEFT_OPEN = 4
"""Number of columns: for force, then rate: 2 T times the time it has been missing, at most a second
(s²), and the variance of velocity (m²/s²) or angle (rad²) due to the rejected value."""


class Samples(NamedTuple):
    """Statistics of the samples until now, in body axes."""

    shown: Float[Array, "6"]
    """Newest raw reading, in the sensor's axes."""
    repeats: Float[Array, "6"]
    """Number of readings for which each value has been the same."""
    missing: Float[Array, "2"]
    """Time for which force and rate have been missing (s)."""
    odd: Float[Array, ""]
    """Odd samples in a row."""
    calm: Float[Array, ""]
    """Time since a sample was last bad or a spike (s); what begins a motion is neither."""
    jolts: Float[Array, "2 2 3"]
    """The last two rare steps, newest first, of force (m/s²) and rate (rad/s)."""
    jolted: Float[Array, "2 2"]
    """Times since then (s)."""
    count: Float[Array, ""]
    """Number of samples until now."""
    forces: Float[Array, "few 3"]
    """The newest good forces (m/s²)."""
    rates: Float[Array, "2 3"]
    """The newest two rates (rad/s), biases included."""
    steps: Float[Array, "6 6"]
    """Mean square of the one-step prediction error of [force, rate]."""
    bends: Float[Array, "6 6"]
    """Mean square of the second differences of [force, rate]."""
    usual: Float[Array, "6"]
    """The same over a minute."""

    @classmethod
    def start(cls, rate: Float[Array, "3"]) -> "Samples":
        """Before the first sample, at an estimated rate."""
        zero = jnp.zeros((), rate.dtype)
        square = jnp.zeros((6, 6), rate.dtype)
        return cls(
            jnp.full(6, jnp.inf, rate.dtype),
            jnp.zeros(6, rate.dtype),
            jnp.zeros(2, rate.dtype),
            zero,
            jnp.full((), 1e3, rate.dtype),
            jnp.zeros((2, 2, 3), rate.dtype),
            jnp.full((2, 2), 1e3, rate.dtype),
            zero,
            jnp.zeros((FEW, 3), rate.dtype),
            jnp.stack([rate, rate]),
            square,
            square,
            jnp.zeros(6, rate.dtype),
        )

    @property
    def foreseen(self) -> Float[Array, "6"]:
        """Prediction of the next sample: mean of the last few forces, and the last rate."""
        known = jnp.clip(self.count, 1, FEW)
        return jnp.concatenate([jnp.sum(self.forces, axis=0) / known, self.rates[-1]])

    def interpolation(self, T: float) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
        """Covariances per second of angle and velocity, interpolated between point samples.

        Between two known values a Brownian rate of density σ² has an integral of variance
        σ² T³ / 12, and second differences of variance 2 σ² T. Independent forces of variance s²
        have second differences of variance 6 s² and add a variance of at most s² T² to velocity.
        Second differences of smooth motion are near zero. T is the period of the samples.
        """
        return self.bends[3:, 3:] * T / 24, self.bends[:3, :3] * T / 6

    def noisy(self, imu: Imu) -> Float[Array, ""]:
        """Variance that the samples have gained since the last minute, relative to their noise's.

        It is 1 where their second differences are not several times those of the last minute;
        those of independent samples of variance s² have a variance of 6 s².
        """
        now = jnp.diag(self.bends)
        gained = (now - self.usual) / 6 / jnp.asarray(imu.noise_std, now.dtype) ** 2
        return jnp.maximum(1, jnp.max(jnp.where(now > _NOISIER * self.usual, gained, 0)))

    def rate_covariance(self, integrating: bool) -> Float[Array, "3 3"]:
        """Covariance of the rate at a sample's end, taken as the mean of the rows before and after.

        For a Brownian rate of density σ², means over a period T have second differences of variance
        σ² T, and the mean of two neighbouring means is σ² T / 6 from the rate between them. For
        point samples the error is a quarter of their second difference.
        """
        return self.bends[3:, 3:] / (6 if integrating else 16)


class Motion(NamedTuple):
    """Statistics of the vehicle's motion, for the covariance of a missing sample."""

    recent: Float[Array, "6"]
    """Acceleration (m/s²) and rate (rad/s) over the last quarter of a second, in body axes."""
    usual: Float[Array, "2"]
    """Their mean squares."""

    @classmethod
    def start(cls, dtype: jnp.dtype) -> "Motion":
        """Before the first sample."""
        return cls(jnp.zeros(6, dtype), jnp.asarray([0.3**2, 0.2**2], dtype))

    def after(
        self, acceleration: Float[Array, "3"], rate: Float[Array, "3"], dt: Float[Array, ""]
    ) -> "Motion":
        """Updated with the motion over dt; unchanged for a dt of zero."""
        now = jnp.concatenate([acceleration, rate])
        recent = self.recent + (1 - jnp.exp(-dt / _RECENT)) * (now - self.recent)
        squares = jnp.sum(recent.reshape(2, 3) ** 2, axis=1)
        usual = self.usual + (1 - jnp.exp(-dt / _USUAL)) * (squares - self.usual)
        floor = jnp.asarray([0.1**2, 0.05**2], usual.dtype)
        return Motion(recent, jnp.maximum(usual, floor))

    def variances(self, left_open: Float[Array, "4"]) -> Float[Array, "2"]:
        """Variances of velocity and angle from a row's `LEFT_OPEN`.

        An acceleration a with correlation time τ gives velocity a variance of a² t² at first and
        2 a² τ t later.
        """
        return left_open[0::2] * self.usual + left_open[1::2]


def take(
    imu: Imu,
    memory: Samples,
    sample: Float[Array, "6"],
    number: Float[Array, ""],
) -> tuple[Samples, Float[Array, "11"]]:
    """The memory after a sample and its row in body axes; unchanged where `number` is < 0.

    The row: 1 if it is predicted over, force 3, mean rate 3, then `LEFT_OPEN`. A missing force is
    zero: its replacement depends on the state.
    """
    dtype, T = sample.dtype, 1 / imu.rate
    limits = jnp.repeat(jnp.asarray([imu.accelerometer_range, imu.gyroscope_range], dtype), 3)
    repeats = jnp.where(sample == memory.shown, memory.repeats + 1, 0)
    within = jnp.isfinite(sample) & (jnp.abs(sample) < limits)
    by_triad = repeats.reshape(2, 3)
    stuck = (by_triad.min(axis=1) >= _STUCK_TOGETHER) | (by_triad.max(axis=1) >= _STUCK_ALONE)
    good = jnp.stack([within[:3].all(), within[3:].all()]) & ~stuck
    sample = jnp.where(within, sample, 0)

    X_BS = imu.mount(dtype)
    force, rate = se3.rotate(X_BS, sample[:3]), se3.rotate(X_BS, sample[3:])
    fading = memory.rates[-1] * jnp.exp(-(memory.missing[1] + T) / _FADES)
    rate = jnp.where(good[1], rate, fading)
    if any(imu.position):
        force = _at_origin(force, X_BS[4:], rate, (rate - memory.rates[-1]) * imu.rate)

    # its prediction error is compared with the standard deviation of such errors
    step = jnp.concatenate([force, rate]) - memory.foreseen
    rare = _ODD * jnp.sqrt(jnp.diag(memory.steps) + jnp.asarray(imu.noise_std, dtype) ** 2)
    bound = rare + jnp.asarray((2.0,) * 3 + (0.5,) * 3, dtype)
    # after a gap nothing is known of what the motion was before
    gap = (memory.missing > 0) & (memory.odd <= 0)
    judged = jnp.repeat(good & ~gap, 3) & (memory.count > FEW)
    far = (jnp.abs(step) > bound) & judged
    odd = jnp.where(far.any(), memory.odd + 1, 0.0).astype(dtype)
    refused = jnp.stack([far[:3].any(), far[3:].any()]) & (odd <= _ODD_RUN)
    spike = (odd < 1) & (memory.odd > 0) & (memory.odd <= _ODD_RUN)  # the odd samples ended
    believed = good & ~refused

    missing = jnp.where(believed, 0.0, memory.missing + T)
    held = 2 * T * jnp.minimum(missing, _KEPT_UP)
    doubted = jnp.where(refused, jnp.sum(step.reshape(2, 3) ** 2, axis=1) * T**2, 0.0)
    left_open = jnp.where(believed, 0.0, jnp.stack([held, doubted])).T.reshape(-1)
    rate = jnp.where(believed[1], rate, fading)
    force = jnp.where(believed[0], force, 0.0)
    mean_force, mean = _means(imu, memory, force, rate, believed[0])

    after = _learn(imu, memory, step, bound, force, rate, believed)
    after = after._replace(
        shown=jnp.where(within, sample, memory.shown),
        repeats=repeats,
        missing=missing,
        odd=odd,
        calm=jnp.where(good.all() & ~spike, memory.calm + T, 0.0),
        count=memory.count + 1,
    )
    after = _jolted(after, step, (jnp.abs(step) > rare) & judged, refused, T)
    row = jnp.concatenate([(number >= 1).astype(dtype)[None], mean_force, mean, left_open])
    return jax.tree.map(lambda new, old: jnp.where(number >= 0, new, old), after, memory), row


def _means(
    imu: Imu,
    memory: Samples,
    force: Float[Array, "3"],
    rate: Float[Array, "3"],
    believed: Bool[Array, ""],
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Mean force, in the axes at the interval's end, and mean rate since the sample before.

    Those of instantaneous samples are by the trapezoidal rule, where both forces are known.
    """
    if imu.integrating:
        return force, rate
    mean = (rate + memory.rates[-1]) / 2
    turn = se3.exp(jnp.concatenate([jnp.zeros_like(mean), mean / imu.rate]))
    before = se3.rotate_inverse(turn, memory.forces[-1])
    both = believed & (memory.missing[0] <= 0) & (memory.count > 0)
    return jnp.where(both, (force + before) / 2, force), mean


def _jolted(
    memory: Samples,
    step: Float[Array, "6"],
    beyond: Bool[Array, "6"],
    refused: Bool[Array, "2"],
    T: float,
) -> Samples:
    """The memory after a step of which some values are `beyond` what is usual and not `refused`.

    A jolt lasts while the mean of the last few forces follows: its size is the largest difference
    from that mean, or the sum of the steps of the rate.
    """
    jolts = jnp.stack([beyond[:3].any(), beyond[3:].any()]) & ~refused
    old, since = memory.jolts, memory.jolted + T
    lasts = since[0] <= FEW * T
    force, rate = step[:3], step[3:]
    larger = jnp.sum(force**2) > jnp.sum(old[0, 0] ** 2)
    going_on = jnp.stack([jnp.where(larger, force, old[0, 0]), old[0, 1] + rate])
    newest = jnp.where(lasts[:, None], going_on, jnp.stack([force, rate]))
    moves_on = (jolts & ~lasts)[:, None]
    after = jnp.stack([newest, jnp.where(moves_on, old[0], old[1])])
    times = jnp.stack(
        [jnp.where(lasts, since[0], T), jnp.where(moves_on[:, 0], since[0], since[1])]
    )
    return memory._replace(
        jolts=jnp.where(jolts[:, None], after, old), jolted=jnp.where(jolts, times, since)
    )


def _at_origin(
    force: Float[Array, "3"],
    place: Float[Array, "3"],
    rate: Float[Array, "3"],
    turning: Float[Array, "3"],
) -> Float[Array, "3"]:
    """The specific force at Bo, of that at a sensor's place, by angular rate and acceleration."""
    spin = velocity_at(place, jnp.concatenate([jnp.zeros_like(rate), rate]))
    return force - se3.cross(rate, spin) - se3.cross(turning, place)


def _learn(
    imu: Imu,
    memory: Samples,
    step: Float[Array, "6"],
    bound: Float[Array, "6"],
    force: Float[Array, "3"],
    rate: Float[Array, "3"],
    believed: Bool[Array, "2"],
) -> Samples:
    """The averages after a sample; a sample that is left out does not change them."""
    known = believed.all() & (memory.count > FEW)

    def mean(old: Array, x: Array, time: float) -> Array:
        """Arithmetic mean over the first samples, then an exponential average."""
        fading = 1 - jnp.exp(-jnp.asarray(1 / (imu.rate * time), x.dtype))
        first = 1 / jnp.maximum(memory.count - FEW, 1)
        weight = jnp.where(memory.count < min(time, _SETTLES) * imu.rate, first, fading)
        return jnp.where(known, old + weight * (x - old), old)

    def mean_square(old: Array, x: Array) -> Array:
        return mean(old, x[:, None] * x[None], _REMEMBERED)

    step = jnp.clip(step, -bound, bound)
    forces = jnp.concatenate([memory.forces[1:], force[None]])
    rates = jnp.concatenate([memory.rates, rate[None]])
    bend = jnp.concatenate([forces[-1] - 2 * forces[-2] + forces[-3], jnp.diff(rates, 2, 0)[0]])
    return memory._replace(
        forces=jnp.where(believed[0], forces, memory.forces),
        rates=rates[1:],
        steps=mean_square(memory.steps, step),
        bends=mean_square(memory.bends, bend),
        usual=mean(memory.usual, bend**2, _MINUTE),
    )
