"""An error-state Kalman filter at a delayed time horizon, for measurements that arrive late.

A DVL's reading arrives 0.1 to 0.2 s after its time of validity. The filter therefore estimates the
state `horizon` seconds in the past. Inertial samples and readings are buffered in a ring of slots,
one for each inertial sample; a reading enters the slot of its time of validity. When a slot leaves
the ring the filter predicts over its sample and fuses its readings, in chronological order: the
estimate is that of an ordinary Kalman filter without delays. The present state follows by applying
the preintegrated increment of the buffered samples (the predictor of Khosravian et al. 2015).
"""

import math
from dataclasses import replace
from itertools import accumulate

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.stats import chi2

from ...models.config.checks import require
from ...models.sensors import Imu, Sensor
from . import error_state, inertial, measurement, recovery
from .config import EkfConfig
from .error_state import Navigation
from .inertial import Motion, Samples
from .state import SUMS, FilterState, Readings, health, status
from .trust import (
    Shown,
    Trust,
    counted,
    imu_off,
    judged,
    others,
    pulls,
    sizes,
    suspected,
    with_doubt,
)

_SAMPLE = 7
"""Columns of a slot: has sample, force 3, mean rate 3 | has reading, values, for each sensor | rate
at the end 3 | `inertial.LEFT_OPEN`."""
_LONGEST = 0.1  # s: longest interval between predictions of the covariance


class DelayedFilter(eqx.Module):
    """The filter's constants, with pure `init`, `step` and `present`.

    `aids` are the sensors that are fused, besides the IMU: all that `observes` something.
    """

    imu: Imu = eqx.field(static=True)
    aids: tuple[Sensor, ...] = eqx.field(static=True)
    config: EkfConfig = eqx.field(static=True)

    def __check_init__(self) -> None:
        """Check that readings arrive within the horizon and that no noise is zero."""
        for sensor in self.aids:
            remedy = "give more than zero: a filter divides by it"
            require(min(sensor.noise_std) > 0, sensor, "noise", remedy)
            longest = sensor.latencies[1] + 2 * self.period
            require(
                not sensor.late or self.slots * self.period >= longest - 1e-9,
                self.config,
                "horizon",
                f"give at least the {type(sensor).__name__}'s latest latency and two samples, "
                f"{longest:.3g} s",
            )

    @property
    def period(self) -> float:
        """Time between inertial samples (s)."""
        return 1 / self.imu.rate

    @property
    def slots(self) -> int:
        """Number of buffered samples."""
        return math.ceil(self.config.horizon * self.imu.rate - 1e-9)

    @property
    def flags(self) -> np.ndarray:
        """Column of each sensor's flag in a slot; its values follow."""
        return np.array([*accumulate((n + 1 for n in sizes(self.aids)), initial=_SAMPLE)][:-1])

    @property
    def rate_column(self) -> int:
        """Column of the rate in a slot, after the sensors' values."""
        return _SAMPLE + sum(sizes(self.aids)) + len(self.aids)

    @property
    def slot(self) -> int:
        """Number of columns of a slot."""
        return self.rate_column + 3 + inertial.LEFT_OPEN

    @property
    def errors(self) -> int:
        """Number of components of the error state."""
        return error_state.INERTIAL + len(self.aids)

    def samples_at_once(self, most: int) -> int:
        """Largest divisor of `most` so that `take_in` of so many samples misses no reading."""
        gaps = [(1 / each.rate, each.latencies) for each in self.aids]
        shortest = min(period - (latest - earliest) for period, (earliest, latest) in gaps)
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

    def deviations(self) -> Float[Array, "e"]:
        """Standard deviations of the initial error."""
        c = self.config
        slow = (each.slow_error[0] for each in self.aids)
        biases = (self.imu.gyroscope_bias,) * 3 + (self.imu.accelerometer_bias,) * 3
        stds = (*c.position_std, *c.attitude_std, *c.velocity_std, *biases, *slow)
        return jnp.asarray(stds, jnp.result_type(float))

    def init(self, X_WB: Float[Array, "7"], V_WB_B: Float[Array, "6"]) -> FilterState:
        """The state at time 0 for an estimated pose and twist, biases unknown."""
        zero = jnp.zeros_like(V_WB_B[:3])
        start = Navigation(X_WB, V_WB_B[:3], zero, zero, jnp.zeros(len(self.aids), zero.dtype))
        return FilterState(
            start,
            error_state.of_body_axes(jnp.diag(self.deviations() ** 2), start),
            jnp.zeros((self.slots, self.slot), V_WB_B.dtype),
            jnp.zeros(SUMS, V_WB_B.dtype),
            start,
            Samples.start(V_WB_B[3:]),
            Motion.start(V_WB_B.dtype),
            Shown.start(self.aids, V_WB_B.dtype),
            Trust.start(self.aids, V_WB_B.dtype),
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
    ) -> tuple[FilterState, Float[Array, "n row"]]:
        """Put samples that end with number `last` into the ring; return the slots that leave it.

        `samples` are the IMU's, oldest first; the IMU's entry in `readings` is not used. The caller
        then alternates `move` and `fuse` until it has processed all slots: `step` for n samples.
        """
        dtype, h, n = state.ring.dtype, self.period, samples.shape[0]
        number = last - (self.slots + n - 1) + jnp.arange(self.slots + n, dtype=dtype)

        def over(memory: Samples, given: tuple[Array, Array]) -> tuple[Samples, Array]:
            return inertial.take(self.imu, memory, *given)

        memory, rows = jax.lax.scan(over, state.samples, (samples, number[self.slots :]))
        open_ = self.rate_column + 3
        rest = jnp.zeros((n, open_ - _SAMPLE), dtype)
        new = jnp.concatenate([rows[:, :_SAMPLE], rest, rows[:, _SAMPLE:]], axis=1)
        ring = jnp.concatenate([state.ring, new])
        following = jnp.concatenate([ring[1:, 4:_SAMPLE], ring[-1:, 4:_SAMPLE]])
        shown, usable = state.shown.with_readings(self.aids, *readings.joined())

        def place(old: Array, reading: Array, i: int) -> Array:
            """The columns with [1, value] in the slot of a usable reading's time."""
            here = (number == jnp.round(reading[-1] / h)) & usable[i]
            row = jnp.concatenate([jnp.ones(1, dtype), reading[:-2]])
            return jnp.where(here[:, None], row[None], old)

        columns = [
            ring[:, :_SAMPLE],
            *(
                place(ring[:, flag : flag + reading.size - 1], reading, i)
                for i, (flag, reading) in enumerate(zip(self.flags, readings.aids, strict=True))
            ),
            (ring[:, 4:_SAMPLE] + following) / 2,
            ring[:, open_:],
        ]
        ring = jnp.concatenate(columns, axis=1)
        return state._replace(ring=ring[n:], samples=memory, shown=shown), ring[:n]

    def move(
        self, state: FilterState, slots: Float[Array, "n row"], first: Float[Array, ""]
    ) -> tuple[FilterState, Float[Array, ""]]:
        """Predict the nominal state from slot `first` through the next one that needs `fuse`.

        Returns the number of that slot, or n.
        """
        n, h, order = slots.shape[0], self.period, jnp.arange(len(slots), dtype=slots.dtype)
        ahead = order >= first
        due = ahead & jnp.any(slots[:, self.flags] > 0, axis=1)
        late = state.since[0] + h * jnp.sum(jnp.where(ahead, slots[:, 0], 0)) > _LONGEST - h / 2
        due = due.at[-1].set(due[-1] | (late & ~jnp.any(due)))
        at = jnp.min(jnp.where(due, order, n))
        times = jnp.where(ahead & (order <= at), h * slots[:, 0], 0)
        open_ = self.rate_column + 3

        def over(
            given: tuple[Navigation, Motion, Array], slot: tuple[Array, Array]
        ) -> tuple[tuple[Navigation, Motion, Array], None]:
            x, motion, since = given
            dt, values = slot
            force, omega = values[1:4] - x.accel_bias, values[4:_SAMPLE] - x.gyro_bias
            still = error_state.held_force(x, omega, self.imu.gravity)
            force = jnp.where(values[open_] > 0, still, force)
            known = jnp.all(values[open_:] <= 0)
            motion = motion.after(force - still, omega, jnp.where(known, dt, 0))
            sample = error_state.sample_increment(force, omega, dt)
            decay = jnp.stack(error_state.decays(self.aids, dt))
            x = error_state.apply(x, sample, self.imu.gravity)
            x = x._replace(sensors=decay * x.sensors)
            left_open = jnp.where(dt > 0, motion.variances(values[open_:]), 0)
            held = jnp.where(values[open_] > 0, dt, 0)[None]
            gone = jnp.concatenate([dt[None], force * dt, omega * dt, held, left_open])
            return (x, motion, since + gone), None

        start = (state.nominal, state.motion, state.since)
        (x, motion, since), _ = jax.lax.scan(over, start, (times, slots))
        return state._replace(nominal=x, motion=motion, since=since), at

    def fuse(
        self, state: FilterState, slot: Float[Array, "row"], k: Float[Array, ""]
    ) -> FilterState:
        """Predict P and fuse the readings of the slot that left with sample number k."""
        x, F, P = self._predicted(state, slot)
        plain, trust = self._innovations(state, x, slot), state.trust
        used = jnp.stack([slot[flag] > 0 for flag in self.flags])
        time = (k - self.slots) * self.period

        off = imu_off(self.imu, self.aids)
        agree, against = others(trust, time, self.config.patience, self.config.silence)
        well = (agree > against) & (state.samples.calm > self.config.silence)
        trust, (left_out, follow) = judged(
            trust, used, off, self.config.patience, well, against > agree
        )
        gates = tuple(float(chi2.ppf(self.config.gate, size)) for size in sizes(self.aids))
        limits = jnp.asarray(gates, P.dtype)
        predicted = recovery.unconfirmed(plain, P)
        conflict = recovery.contradict(plain, trust.unconfirmed, limits)
        conflict = conflict & used & ~left_out & (measurement.plain_nis(plain, P)[0] > limits)
        age = jnp.maximum(time - trust.accepted_at, self.period)
        for i, (each, sensor) in enumerate(zip(plain, self.aids, strict=True)):
            marks = (conflict[i], follow[i])
            P = recovery.opened(P, x, sensor, each, *marks, age[i], self.imu.gravity)
        found = [
            each._replace(R=f * each.R + jnp.diag(jnp.where(mark, each.residual**2, 0)))
            for each, f, mark in zip(
                plain, jnp.unstack(trust.noise_factor), jnp.unstack(conflict), strict=True
            )
        ]
        plain_nis, together, S = measurement.plain_nis(plain, P)
        done = measurement.update(x, P, found, used & ~left_out, gates)

        innovations = (together.residual, jnp.sqrt(jnp.diag(S)))
        trust = counted(
            self.aids, trust, used, done.accepted, done.nis, plain_nis, gates, innovations, time
        )
        trust = trust._replace(unconfirmed=jnp.where(done.accepted, predicted, trust.unconfirmed))
        pulled = pulls(self.aids, trust.pulled @ F.T, done, together, used)
        trust = suspected(
            self.aids,
            trust,
            left_out | follow,
            state.shown.stuck(self.aids),
            used,
            done.accepted,
            pulled,
            time,
            state.since[0],
        )
        return state._replace(
            nominal=done.nominal,
            P=done.P,
            since=jnp.zeros_like(state.since),
            before=done.nominal,
            trust=trust,
        )

    def _predicted(
        self, state: FilterState, slot: Float[Array, "row"]
    ) -> tuple[Navigation, Float[Array, "e e"], Float[Array, "e e"]]:
        """State, F and P at the horizon, levelled where roll and pitch are uncertain."""
        F, P = self._covariance(state, state.nominal, state.since)
        x = state.nominal
        x, P, F = recovery.levelled(
            x,
            P,
            F,
            slot[1:4] - x.accel_bias,
            (slot[0] > 0) & (slot[self.rate_column + 3] <= 0),
            slot[self.rate_column : self.rate_column + 3] - x.gyro_bias,
            state.motion.usual[0],
            self.imu.gravity,
        )
        return x, F, P

    def _innovations(
        self, state: FilterState, x: Navigation, slot: Float[Array, "row"]
    ) -> list[measurement.Innovation]:
        """Those of a slot's readings at the sensors' configured noises."""
        rate = slot[self.rate_column : self.rate_column + 3]
        turning = slot[self.rate_column + 3 + inertial.LEFT_OPEN // 2] > 0  # without a rate
        between = state.samples.rate_covariance(self.imu.integrating)
        between = between + jnp.where(turning, state.motion.usual[1], 0) * jnp.eye(3)
        return [
            measurement.innovation(
                each, i, x, rate, between, slot[flag + 1 : flag + 1 + each.value_size]
            )
            for i, (each, flag) in enumerate(zip(self.aids, self.flags, strict=True))
        ]

    def covariance(self, state: FilterState) -> Float[Array, "e e"]:
        """P at the horizon, of δ (`systems.estimation.error_state`)."""
        return self._covariance(state, state.nominal, state.since)[1]

    def _covariance(
        self, state: FilterState, after: Navigation, gone: Float[Array, "10"]
    ) -> tuple[Float[Array, "e e"], Float[Array, "e e"]]:
        """F and P after an interval with the sums `gone` (as in `FilterState.since`)."""
        time = gone[0]
        some = jnp.maximum(time, self.period)
        turn, push = state.samples.interpolation(self.period)
        between = None if self.imu.integrating else (turn * time, push * time)
        unmeasured = error_state.Unmeasured(*jnp.unstack(gone[7:]))
        F, Q = error_state.transition(
            state.before,
            after,
            gone[1:4] / some,
            gone[4:7] / some,
            time,
            self._noisy_imu,
            self.aids,
            unmeasured,
            state.trust.imu_factor,
            between,
        )
        P = F @ state.P @ F.T + Q
        return F, (P + P.T) / 2

    def _time(self, k: Float[Array, ""]) -> Float[Array, ""]:
        """Time of the horizon (s) after `step` number k."""
        return jnp.maximum(k - self.slots, 0) * self.period

    def status(self, state: FilterState, k: Float[Array, ""]) -> Float[Array, "_"]:
        """The status vector after `step` number k; see `status_names`."""
        return status(state.trust, self._time(k))

    def health(
        self, state: FilterState, P: Float[Array, "e e"], k: Float[Array, ""]
    ) -> Float[Array, "_"]:
        """The health vector after `step` number k, for the covariance P that is shown."""
        return health(self.config, self.aids, state, P, self._time(k))

    def present(
        self, state: FilterState, ahead: float | Float[Array, ""]
    ) -> tuple[Float[Array, "7"], Float[Array, "6"], Float[Array, "e e"]]:
        """Pose, twist and error covariance in body axes `ahead` seconds after the newest sample.

        The buffered samples are applied to the state at the horizon; beyond the newest one its rate
        and the mean force of the last few are held. The covariance is predicted over the buffered
        samples in one step, and beyond them grows by the recent one-step prediction errors.
        """
        x, ring = state.nominal, state.ring
        time = ring[:, 0] * self.period
        open_ = ring[:, self.rate_column + 3 :]
        missing, left_open = open_[:, 0] > 0, jax.vmap(state.motion.variances)(open_)
        still = error_state.held_force(x, jnp.zeros_like(x.v_B), self.imu.gravity)[:, None]
        force = jnp.where(missing[None], still, ring[:, 1:4].T - x.accel_bias[:, None])
        omega = ring[:, 4:7].T - x.gyro_bias[:, None]
        increment = error_state.chain_all(error_state.sample_increment(force, omega, time))
        now = error_state.apply(x, increment, self.imu.gravity)
        parts = [jnp.ones_like(force[:1]), force, omega, missing[None].astype(force.dtype)]
        waiting = jnp.concatenate([(jnp.concatenate(parts) * time[None]).T, left_open], 1)
        _, P = self._covariance(state, now, state.since + jnp.sum(waiting, axis=0))
        foreseen = state.samples.foreseen - jnp.concatenate([x.accel_bias, x.gyro_bias])
        rate = foreseen[3:]
        beyond = error_state.sample_increment(foreseen[:3], rate, ahead * ring[-1, 0])
        now = error_state.apply(now, beyond, self.imu.gravity)
        suspect = state.trust.suspect((state.samples.count - 1 - self.slots) * self.period)
        P, pulled = error_state.in_body_axes(now, P, state.trust.pulled)
        P = P + error_state.foreseen_covariance(state.samples.steps, now.v_B, ahead, self.errors)
        P = with_doubt(P, pulled, suspect)
        return now.X_WB, jnp.concatenate([now.v_B, rate]), (P + P.T) / 2
