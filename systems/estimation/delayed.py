"""An error-state Kalman filter at a delayed time horizon, for measurements that arrive late.

A DVL's reading arrives 0.1 to 0.2 s after its time of validity. The filter therefore estimates the
state `horizon` seconds in the past. Inertial samples and readings are buffered in a ring of slots,
one for each inertial sample; a reading enters the slot of its time of validity. When a slot leaves
the ring the filter predicts over its sample and fuses its readings, in chronological order: the
estimate is that of an ordinary Kalman filter without delays. The present state follows by applying
the preintegrated increment of the buffered samples (the predictor of Khosravian et al. 2015).
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.stats import chi2

from ...models import se3
from ...models.config.checks import Vector3, check_numbers, require
from ...models.sensors import Compass, DepthSensor, Dvl, Imu
from . import error_state, inertial, measurement
from .error_state import Navigation
from .inertial import Motion, Samples
from .trust import SIZES, Shown, Trust, counted, imu_off, judged, suspected, with_doubt

SLOT = 22
"""Columns of a slot: has sample, force 3, mean rate 3 | has dvl, v 3 | has depth, depth | has
compass, yaw | rate at the end 3 | `inertial.LEFT_OPEN`."""
_DVL, _DEPTH, _COMPASS, _RATE, _OPEN = 7, 11, 13, 15, 18
_FLAGS = np.array([_DVL, _DEPTH, _COMPASS])
_SINCE = 9  # components of `FilterState.since` that are sums
_LONGEST = 0.1  # s: longest interval between predictions of the covariance

STATUS = (
    "time",
    "nis_dvl",
    "nis_depth",
    "nis_compass",
    "rejected_dvl",
    "rejected_depth",
    "rejected_compass",
    "age_dvl",
    "age_depth",
    "age_compass",
)
"""Components of the status vector: time of the horizon (s), last NIS of each sensor, rejections in
a row, and time since a reading was last accepted (s)."""

HEALTH = ("state", "imu", "dvl", "depth", "compass")
"""Components of the health vector: 0 good, 1 degraded, 2 lost; then 1 where a sensor is trusted."""


@dataclass(frozen=True)
class EkfConfig:
    """Initial covariance and gates of the filter; the sensors' configurations give their noises.

    Attributes:
        position_std: of the initial position in body axes (m).
        attitude_std: of the initial attitude about the body axes (rad).
        velocity_std: of the initial velocity in body axes (m/s).
        imu_factor: the filter multiplies the IMU's noise densities by this factor. It covers
            second-order errors such as bias times attitude error. Over 30 one-minute runs in calm
            water the NEES of attitude is 3.4 ± 0.2 at 1 and that of velocity 2.5 ± 0.1 at 1.5; a
            consistent filter has 3 (`spinndrift check estimator --only calm`, and
            `tests/test_filtering.py` without a DVL).
        horizon: longest latency of a reading (s).
        gate: probability that a good reading passes the chi-square gate.
        patience: number of consecutive rejections after which a sensor is judged. Either it is at
            fault and left out until as many readings pass in a row, or the filter may have
            diverged: then the covariance grows by the squared residual and the reading is fused
            (`systems.estimation.trust`).
        output_rate: estimates per second (Hz).
        silence: time without an accepted reading after which a sensor is not trusted (s).
        lost_velocity: standard deviation of velocity above which the state is lost (m/s).
        lost_attitude: the same for roll, pitch and yaw (rad).
    """

    position_std: Vector3 = (0.02, 0.02, 0.02)
    attitude_std: Vector3 = (0.01, 0.01, 0.03)
    velocity_std: Vector3 = (0.02, 0.02, 0.02)
    imu_factor: float = 1.2
    horizon: float = 0.24
    gate: float = 0.999
    patience: int = 10
    output_rate: float = 20.0
    silence: float = 3.0
    lost_velocity: float = 0.5
    lost_attitude: float = 0.5

    def __post_init__(self) -> None:
        """Check signs and ranges."""
        check_numbers(self)
        for field in ("position_std", "attitude_std", "velocity_std"):
            require(min(getattr(self, field)) >= 0, self, field, "give zero or more")
        above_zero = ("imu_factor", "horizon", "output_rate", "silence")
        for field in (*above_zero, "lost_velocity", "lost_attitude"):
            require(getattr(self, field) > 0, self, field, "give a number above zero")
        require(0 < self.gate < 1, self, "gate", "give a share between 0 and 1")
        require(self.patience >= 1, self, "patience", "give at least 1")


class FilterState(NamedTuple):
    """The filter's state."""

    nominal: Navigation
    P: Float[Array, "18 18"]
    ring: Float[Array, "slots 22"]
    since: Float[Array, "12"]
    """Since the time of P: elapsed time, sums of force · dt and rate · dt, variances due to missing
    forces and rates; and v_B at the time of P."""
    samples: Samples
    motion: Motion
    shown: Shown
    trust: Trust


class Readings(NamedTuple):
    """Sensor outputs at one time; the time of validity of a reading selects its slot."""

    imu: Float[Array, "6"]
    """Specific force (m/s²) and angular rate (rad/s) in the sensor's axes."""
    dvl: Float[Array, "5"]
    """Velocity (m/s) in the sensor's axes, valid, time of validity (s)."""
    depth: Float[Array, "3"]
    """Depth (m), valid, time (s)."""
    compass: Float[Array, "3"]
    """Yaw (rad), valid, time (s)."""

    def by_kind(self) -> tuple[Float[Array, "5"], Bool[Array, "3"], Float[Array, "3"]]:
        """Values, validity flags and times (s) of DVL, depth gauge and compass."""
        readings = (self.dvl, self.depth, self.compass)
        values = jnp.concatenate([each[:-2] for each in readings])
        marks = jnp.stack([each[-2] > 0 for each in readings])
        return values, marks, jnp.stack([each[-1] for each in readings])


class DelayedFilter(eqx.Module):
    """The filter's constants, with pure `init`, `step` and `present`."""

    imu: Imu = eqx.field(static=True)
    dvl: Dvl = eqx.field(static=True)
    depth: DepthSensor = eqx.field(static=True)
    compass: Compass = eqx.field(static=True)
    config: EkfConfig = eqx.field(static=True)

    def __check_init__(self) -> None:
        """Check that the DVL's readings arrive within the horizon and that no noise is zero."""
        for sensor in (self.dvl, self.depth, self.compass):
            require(
                sensor.noise > 0, sensor, "noise", "give more than zero: a filter divides by it"
            )
        longest = self.dvl.latest_latency + 2 * self.period
        require(
            self.slots * self.period >= longest - 1e-9,
            self.config,
            "horizon",
            f"give at least the DVL's latest latency and two samples, {longest:.3g} s",
        )

    @property
    def period(self) -> float:
        """Time between inertial samples (s)."""
        return 1 / self.imu.rate

    @property
    def slots(self) -> int:
        """Number of buffered samples."""
        return math.ceil(self.config.horizon * self.imu.rate - 1e-9)

    def samples_at_once(self, most: int) -> int:
        """Largest divisor of `most` so that `take_in` of so many samples misses no reading."""
        dvl = 1 / self.dvl.rate - (self.dvl.latest_latency - self.dvl.earliest_latency)
        shortest = min(dvl, 1 / self.depth.rate, 1 / self.compass.rate)
        fit = [
            n for n in range(1, most + 1) if most % n == 0 and n * self.period <= shortest + 1e-9
        ]
        return max(fit, default=1)

    @property
    def _noisy_imu(self) -> Imu:
        f, imu = self.config.imu_factor, self.imu
        return replace(
            imu,
            accelerometer_density=f * imu.accelerometer_density,
            gyroscope_density=f * imu.gyroscope_density,
        )

    def deviations(self) -> Float[Array, "18"]:
        """Standard deviations of the initial error."""
        c = self.config
        slow = (self.dvl.scale_std, self.depth.offset_std, self.compass.wander)
        biases = (self.imu.gyroscope_bias,) * 3 + (self.imu.accelerometer_bias,) * 3
        stds = (*c.position_std, *c.attitude_std, *c.velocity_std, *biases, *slow)
        return jnp.asarray(stds, jnp.result_type(float))

    def init(self, X_WB: Float[Array, "7"], V_WB_B: Float[Array, "6"]) -> FilterState:
        """The state at time 0 for an estimated pose and twist, biases unknown."""
        zero = jnp.zeros_like(V_WB_B[:3])
        return FilterState(
            Navigation(X_WB, V_WB_B[:3], zero, zero, zero),
            jnp.diag(self.deviations() ** 2),
            jnp.zeros((self.slots, SLOT), V_WB_B.dtype),
            jnp.concatenate([jnp.zeros(_SINCE, V_WB_B.dtype), V_WB_B[:3]]),
            Samples.start(V_WB_B[3:]),
            Motion.start(V_WB_B.dtype),
            Shown.start(V_WB_B.dtype),
            Trust.start(V_WB_B.dtype),
        )

    def step(self, state: FilterState, readings: Readings, k: Float[Array, ""]) -> FilterState:
        """Take in sample number k (of time k · period) and advance the horizon by one slot.

        Sample 0 is at the initial time and causes no prediction; before it, k is negative. The
        nominal state is predicted with every sample; the covariance is predicted with the mean of
        the samples, before a reading is fused and at least every 0.1 s.
        """
        state, slots = self.take_in(state, readings.imu[None], readings, k)
        state, at = self.move(state, slots, jnp.zeros((), k.dtype))
        return jax.lax.cond(at < 1, lambda s: self.fuse(s, slots[0], k), lambda s: s, state)

    def take_in(
        self,
        state: FilterState,
        samples: Float[Array, "n 6"],
        readings: Readings,
        last: Float[Array, ""],
    ) -> tuple[FilterState, Float[Array, "n 22"]]:
        """Put samples that end with number `last` into the ring; return the slots that leave it.

        `samples` are the IMU's, oldest first; the IMU's entry in `readings` is not used. The caller
        then alternates `move` and `fuse` until it has processed all slots: `step` for n samples.
        """
        dtype, h, n = state.ring.dtype, self.period, samples.shape[0]
        number = last - (self.slots + n - 1) + jnp.arange(self.slots + n, dtype=dtype)

        def over(memory: Samples, given: tuple[Array, Array]) -> tuple[Samples, Array]:
            return inertial.take(self.imu, memory, *given)

        memory, rows = jax.lax.scan(over, state.samples, (samples, number[self.slots :]))
        rest = jnp.zeros((n, _OPEN - _DVL), dtype)
        new = jnp.concatenate([rows[:, :_DVL], rest, rows[:, _DVL:]], axis=1)
        ring = jnp.concatenate([state.ring, new])
        following = jnp.concatenate([ring[1:, 4:_DVL], ring[-1:, 4:_DVL]])
        shown, usable = state.shown.with_readings(self.dvl, *readings.by_kind())

        def place(old: Array, reading: Array, i: int) -> Array:
            """The columns with [1, value] in the slot of a usable reading's time."""
            here = (number == jnp.round(reading[-1] / h)) & usable[i]
            row = jnp.concatenate([jnp.ones(1, dtype), reading[:-2]])
            return jnp.where(here[:, None], row[None], old)

        columns = [
            ring[:, :_DVL],
            place(ring[:, _DVL:_DEPTH], readings.dvl, 0),
            place(ring[:, _DEPTH:_COMPASS], readings.depth, 1),
            place(ring[:, _COMPASS:_RATE], readings.compass, 2),
            (ring[:, 4:_DVL] + following) / 2,
            ring[:, _OPEN:],
        ]
        ring = jnp.concatenate(columns, axis=1)
        return state._replace(ring=ring[n:], samples=memory, shown=shown), ring[:n]

    def _still(self, x: Navigation, omega: Float[Array, "3"]) -> Float[Array, "3"]:
        """The specific force without bias that keeps v_B constant at angular rate ω."""
        up = jnp.asarray((0.0, 0.0, self.imu.gravity), x.v_B.dtype)
        return se3.rotate_inverse(x.X_WB, up) + se3.cross(omega, x.v_B)

    def move(
        self, state: FilterState, slots: Float[Array, "n 22"], first: Float[Array, ""]
    ) -> tuple[FilterState, Float[Array, ""]]:
        """Predict the nominal state from slot `first` through the next one that needs `fuse`.

        Returns the number of that slot, or n.
        """
        n, h, dtype = slots.shape[0], self.period, slots.dtype
        order = jnp.arange(n, dtype=dtype)
        ahead = order >= first
        due = ahead & jnp.any(slots[:, _FLAGS] > 0, axis=1)
        late = state.since[0] + h * jnp.sum(jnp.where(ahead, slots[:, 0], 0)) > _LONGEST - h / 2
        due = due.at[-1].set(due[-1] | (late & ~jnp.any(due)))
        at = jnp.min(jnp.where(due, order, n))
        times = jnp.where(ahead & (order <= at), h * slots[:, 0], 0)

        def over(
            given: tuple[Navigation, Motion, Array], slot: tuple[Array, Array]
        ) -> tuple[tuple[Navigation, Motion, Array], None]:
            x, motion, since = given
            dt, values = slot
            force, omega = values[1:4] - x.accel_bias, values[4:_DVL] - x.gyro_bias
            still = self._still(x, omega)
            force = jnp.where(values[_OPEN] > 0, still, force)
            known = jnp.all(values[_OPEN:] <= 0)
            motion = motion.after(force - still, omega, jnp.where(known, dt, 0))
            sample = error_state.sample_increment(force, omega, dt)
            decay = jnp.exp(-dt / self.compass.wander_time)
            x = error_state.apply(x, sample, self.imu.gravity)
            x = x._replace(sensors=jnp.concatenate([x.sensors[:2], decay * x.sensors[2:]]))
            left_open = jnp.where(dt > 0, motion.variances(values[_OPEN:]), 0)
            gone = jnp.concatenate([dt[None], force * dt, omega * dt, left_open])
            return (x, motion, jnp.concatenate([since[:_SINCE] + gone, since[_SINCE:]])), None

        start = (state.nominal, state.motion, state.since)
        (x, motion, since), _ = jax.lax.scan(over, start, (times, slots))
        return state._replace(nominal=x, motion=motion, since=since), at

    def fuse(
        self, state: FilterState, slot: Float[Array, "22"], k: Float[Array, ""]
    ) -> FilterState:
        """Predict P and fuse the readings of the slot that left with sample number k."""
        x, trust = state.nominal, state.trust
        F, P = self._covariance(state, x, state.since[:_SINCE])
        plain = (
            measurement.dvl_innovation(self.dvl, x, slot[_RATE:_OPEN], slot[_DVL + 1 : _DEPTH]),
            measurement.depth_innovation(self.depth, x, slot[_DEPTH + 1 : _COMPASS]),
            measurement.compass_innovation(self.compass, x, slot[_COMPASS + 1 : _RATE]),
        )
        factors = jnp.unstack(trust.noise_factor)
        found = [each._replace(R=f * each.R) for each, f in zip(plain, factors, strict=True)]
        used = jnp.stack([slot[flag] > 0 for flag in (_DVL, _DEPTH, _COMPASS)])
        time = (k - self.slots) * self.period

        off = imu_off(self.imu, self.dvl, self.depth, self.compass)
        well = self._vouched_for(state, time)
        trust, (left_out, follow) = judged(trust, used, off, self.config.patience, well)
        own = (error_state.VELOCITY, error_state.POSITION, error_state.ROTATION)
        for i, (each, part) in enumerate(zip(plain, own, strict=True)):
            # a followed sensor's quantity is as uncertain as its residual is large
            H, unknown = each.H[:, part], jnp.where(follow[i], each.residual**2, 0)
            P = P.at[part, part].add(H.T @ (unknown[:, None] * H))
        gates = tuple(float(chi2.ppf(self.config.gate, size)) for size in SIZES)
        together = measurement.together(plain)
        S = together.H @ (P @ together.H.T) + together.R
        plain_nis = measurement.normalized_squares(S, together.residual, SIZES)
        done = measurement.update(x, P, found, used & ~left_out, gates)

        innovations = (together.residual, jnp.sqrt(jnp.diag(S)))
        trust = counted(trust, used, done.accepted, done.nis, plain_nis, gates, innovations, time)
        pulled = self._pulled(trust.pulled @ F.T, done, together, used)
        trust = suspected(
            trust,
            left_out | follow,
            state.shown.stuck,
            used,
            done.accepted,
            pulled,
            time,
            state.since[0],
        )
        return state._replace(
            nominal=done.nominal,
            P=done.P,
            since=jnp.concatenate([jnp.zeros(_SINCE, P.dtype), done.nominal.v_B]),
            trust=trust,
        )

    @staticmethod
    def _pulled(
        pulled: Float[Array, "3 18"],
        done: measurement.Update,
        found: measurement.Innovation,
        used: Bool[Array, "3"],
    ) -> Float[Array, "3 18"]:
        """The pulls after an update: a sensor's own correction adds, those of others reduce."""
        own = np.repeat(np.eye(len(SIZES), dtype=bool), SIZES, axis=1)
        read = jnp.where(used[:, None], found.residual[None], 0)
        return pulled - jnp.where(own, read, pulled @ found.H.T) @ done.gain.T

    def _vouched_for(self, state: FilterState, time: Float[Array, ""]) -> Bool[Array, "3"]:
        """For each sensor, whether the IMU and another sensor are well."""
        c, trust = self.config, state.trust
        well = (time - trust.accepted_at <= c.silence) & (trust.distrusted < 1)
        well = well & (trust.rejected < c.patience) & (trust.accepted_at > 0)
        others = jnp.sum(well) - well.astype(int)
        return (others > 0) & (state.samples.calm > c.silence)

    def covariance(self, state: FilterState) -> Float[Array, "18 18"]:
        """P at the horizon."""
        return self._covariance(state, state.nominal, state.since[:_SINCE])[1]

    def _covariance(
        self, state: FilterState, after: Navigation, gone: Float[Array, "9"]
    ) -> tuple[Float[Array, "18 18"], Float[Array, "18 18"]]:
        """F and P after an interval with the sums `gone` (as in `FilterState.since`)."""
        time = gone[0]
        some = jnp.maximum(time, self.period)
        before = state.nominal._replace(v_B=state.since[_SINCE:])
        F, Q = error_state.transition(
            before, after, gone[1:4] / some, gone[4:7] / some, time, self._noisy_imu, self.compass
        )
        moves = slice(0, error_state.VELOCITY.stop)
        Q = Q.at[moves, moves].multiply(state.trust.imu_factor)
        P = F @ state.P @ F.T + Q
        open_ = jnp.zeros_like(jnp.diag(P)).at[error_state.VELOCITY].set(gone[7])
        P = P + jnp.diag(open_.at[error_state.ROTATION].set(gone[8]))
        if not self.imu.integrating:
            P = P + time / self.period * self._between_samples(state)
        return F, (P + P.T) / 2

    def _between_samples(self, state: FilterState) -> Float[Array, "18 18"]:
        """Covariance of the interpolation over a period T of an IMU that does not integrate.

        Between two known values a Brownian rate of density σ² has an integral of variance
        σ² T³ / 12, and second differences of variance 2 σ² T. Independent forces of variance s²
        have second differences of variance 6 s² and add a variance of at most s² T² to velocity.
        Second differences of smooth motion are near zero.
        """
        T = self.period
        open_ = jnp.zeros_like(state.P)
        turn, force = state.samples.bends[3:, 3:], state.samples.bends[:3, :3]
        open_ = open_.at[error_state.ROTATION, error_state.ROTATION].set(turn * T**2 / 24)
        return open_.at[error_state.VELOCITY, error_state.VELOCITY].set(force * T**2 / 6)

    def status(self, state: FilterState, k: Float[Array, ""]) -> Float[Array, "10"]:
        """The status vector after `step` number k; see `STATUS`."""
        time = jnp.maximum(k - self.slots, 0) * self.period
        age, trust = time - state.trust.accepted_at, state.trust
        return jnp.concatenate([time[None], trust.nis, trust.rejected, age])

    def health(
        self, state: FilterState, P: Float[Array, "18 18"], k: Float[Array, ""]
    ) -> Float[Array, "5"]:
        """The health vector after `step` number k, for the covariance P that is shown."""
        c, variance, trust = self.config, jnp.diag(P), state.trust
        age = jnp.maximum(k - self.slots, 0) * self.period - trust.accepted_at
        fit = (age <= c.silence) & (trust.rejected < c.patience) & (trust.distrusted < 1)
        time = jnp.maximum(k - self.slots, 0) * self.period
        fit = fit & ~state.shown.stuck & ~trust.suspect(time, c.silence) & (trust.noise_factor <= 1)
        imu = (state.samples.calm > 1) & (trust.imu_factor < 2)
        fit = jnp.concatenate([imu[None], fit])
        lost = jnp.any(variance[error_state.VELOCITY] > c.lost_velocity**2)
        lost = lost | jnp.any(variance[error_state.ROTATION] > c.lost_attitude**2)
        overall = jnp.where(lost, 2.0, jnp.where(jnp.all(fit), 0.0, 1.0))
        return jnp.concatenate([overall[None].astype(P.dtype), fit.astype(P.dtype)])

    def present(
        self, state: FilterState, ahead: float | Float[Array, ""]
    ) -> tuple[Float[Array, "7"], Float[Array, "6"], Float[Array, "18 18"]]:
        """Pose, twist and error covariance `ahead` seconds after the newest sample.

        The buffered samples are applied to the state at the horizon; beyond the newest one its rate
        and the mean force of the last few are held. The covariance is predicted over the buffered
        samples in one step, and beyond them grows by the recent one-step prediction errors.
        """
        x, ring = state.nominal, state.ring
        time = ring[:, 0] * self.period
        missing, left_open = ring[:, _OPEN] > 0, jax.vmap(state.motion.variances)(ring[:, _OPEN:])
        still = self._still(x, jnp.zeros_like(x.v_B))[:, None]
        force = jnp.where(missing[None], still, ring[:, 1:4].T - x.accel_bias[:, None])
        omega = ring[:, 4:7].T - x.gyro_bias[:, None]
        increment = error_state.chain_all(error_state.sample_increment(force, omega, time))
        now = error_state.apply(x, increment, self.imu.gravity)
        waiting = jnp.concatenate(
            [time[:, None], force.T * time[:, None], omega.T * time[:, None], left_open], 1
        )
        _, P = self._covariance(state, now, state.since[:_SINCE] + jnp.sum(waiting, axis=0))
        foreseen = state.samples.foreseen - jnp.concatenate([x.accel_bias, x.gyro_bias])
        rate = foreseen[3:]
        beyond = error_state.sample_increment(foreseen[:3], rate, ahead * ring[-1, 0])
        now = error_state.apply(now, beyond, self.imu.gravity)
        P = P + self._foreseen(state, now, ahead)
        time = (state.samples.count - 1 - self.slots) * self.period
        P = with_doubt(P, state.trust.pulled, state.trust.suspect(time))
        return now.X_WB, jnp.concatenate([now.v_B, rate]), P

    def _foreseen(
        self, state: FilterState, now: Navigation, ahead: float | Float[Array, ""]
    ) -> Float[Array, "18 18"]:
        """Covariance due to the error of the predicted mean force and rate over `ahead`."""
        a = ahead * jnp.eye(3, dtype=state.P.dtype)
        J = jnp.zeros((error_state.ERRORS, 6), state.P.dtype)
        J = J.at[error_state.POSITION, :3].set(ahead / 2 * a)
        J = J.at[error_state.ROTATION, 3:].set(a).at[error_state.VELOCITY, :3].set(a)
        J = J.at[error_state.VELOCITY, 3:].set(ahead * error_state.skew(now.v_B))
        return J @ state.samples.steps @ J.T
