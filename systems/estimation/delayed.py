"""An error-state Kalman filter at a delayed time horizon, for measurements that arrive late.

A DVL's reading arrives 0.1 to 0.2 s after its time of validity. The filter therefore estimates the
state `horizon` seconds in the past. Inertial samples and readings are buffered in a ring of slots,
one for each inertial sample; a reading enters the slot of its time of validity. When a slot leaves
the ring the filter predicts over its sample and fuses its readings, in chronological order: the
estimate is that of an ordinary Kalman filter without delays. The present state follows by applying
the preintegrated increment of the buffered samples (the predictor of Khosravian et al. 2015).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...models import se3
from . import changes, error_state, inertial, jolts, measurement, recovery
from .error_state import Navigation
from .inertial import Motion, Samples
from .layout import SAMPLE, Layout
from .readings import Shown, offset_places
from .state import SUMS, FilterState, Readings, health, status
from .trust import Trust, counted, pulls

_NEGLECTED = 1.0  # s: correlation time of errors of second order, which turn with the body
_APPROXIMATE = 2.0  # factor on the covariance that is told while a sensor has changed
_LONGEST = 0.1  # s: longest interval between predictions of the covariance


class DelayedFilter(Layout):
    """Pure `init`, `step` and `present` of the filter whose constants it has."""

    def init(self, X_WB: Float[Array, "7"], V_WB_B: Float[Array, "6"]) -> FilterState:
        """The state at time 0 for an estimated pose and twist, biases unknown."""
        zero = jnp.zeros_like(V_WB_B[:3])
        sensors = jnp.zeros(self.errors - error_state.INERTIAL, zero.dtype)
        start = Navigation(X_WB, V_WB_B[:3], zero, zero, sensors)
        return FilterState(
            start,
            error_state.of_body_axes(jnp.diag(self.deviations() ** 2), start),
            jnp.zeros((self.slots, self.slot), V_WB_B.dtype),
            jnp.zeros(SUMS, V_WB_B.dtype),
            start,
            Samples.start(V_WB_B[3:]),
            Motion.start(V_WB_B.dtype),
            Shown.start(self.aids, V_WB_B.dtype),
            Trust.start(self.aids, V_WB_B.dtype, self.errors),
        )

    def step(self, state: FilterState, readings: Readings, k: Float[Array, ""]) -> FilterState:
        """Take in sample number k (of time k · period) and advance the horizon by one slot.

        Sample 0 is at the initial time and causes no prediction; before it, k is negative. Times
        here are those at which samples come; the state is that of `imu_latency` before. The
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
        rest = jnp.zeros((n, open_ - SAMPLE), dtype)
        new = jnp.concatenate([rows[:, :SAMPLE], rest, rows[:, SAMPLE:]], axis=1)
        ring = jnp.concatenate([state.ring, new])
        following = jnp.concatenate([ring[1:, 4:SAMPLE], ring[-1:, 4:SAMPLE]])
        shown, usable = state.shown.with_readings(self.aids, *readings.joined())

        def place(old: Array, reading: Array, i: int) -> Array:
            """The columns with [1, value] in the slot of a usable reading's time."""
            at = reading[-1] + self.config.imu_latency
            here = (number == jnp.round(at / h)) & usable[i]
            row = jnp.concatenate([jnp.ones(1, dtype), reading[:-2]])
            return jnp.where(here[:, None], row[None], old)

        columns = [
            ring[:, :SAMPLE],
            *(
                place(ring[:, flag : flag + reading.size - 1], reading, i)
                for i, (flag, reading) in enumerate(zip(self.flags, readings.aids, strict=True))
            ),
            (ring[:, 4:SAMPLE] + following) / 2,
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
            force, omega = values[1:4] - x.accel_bias, values[4:SAMPLE] - x.gyro_bias
            still = error_state.held_force(x, omega, self.imu.gravity)
            force = jnp.where(values[open_] > 0, still, force)
            known = jnp.all(values[open_:] <= 0)
            motion = motion.after(force - still, omega, jnp.where(known, dt, 0))
            sample = error_state.sample_increment(force, omega, dt)
            x = error_state.apply(x, sample, self.imu.gravity)
            x = x._replace(sensors=error_state.passed(self.aids, x.sensors, dt))
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
        used = jnp.stack([slot[flag] > 0 for flag in self.flags])
        time = (k - self.slots) * self.period
        stuck = state.shown.stuck(self.aids)
        trust, x, P, doubted = self._reopened(state, x, P, slot, used, stuck, time)

        plain = self._innovations(state, x, slot)
        found = measurement.raised(plain, trust.noise_factor, doubted)
        plain_nis, _, _ = measurement.plain_nis(plain, P)
        _, joined, S = measurement.plain_nis(found, P)
        done = measurement.update(x, P, found, used, self.gates)

        seen = measurement.Seen(time, used, joined, S, doubted)
        trust = pulls(self.aids, trust, F, seen, done)
        trust = trust._replace(
            unconfirmed=jnp.where(done.accepted, trust.predicted, trust.unconfirmed),
            stuck_at=jnp.where(stuck, time, trust.stuck_at),
        )
        trust = counted(self.aids, trust, seen, done, plain_nis, self.gates)
        trust, x, P = changes.settled(self.aids, trust, done, self.config.patience)
        return state._replace(
            nominal=x, P=P, since=jnp.zeros_like(state.since), before=x, trust=trust
        )

    def _reopened(
        self,
        state: FilterState,
        x: Navigation,
        P: Float[Array, "e e"],
        slot: Float[Array, "row"],
        used: Bool[Array, "n"],
        stuck: Bool[Array, "n"],
        time: Float[Array, ""],
    ) -> tuple[Trust, Navigation, Float[Array, "e e"], Bool[Array, "n"]]:
        """Trust, state and P with what the readings show to have changed uncertain.

        And which of the readings are doubted, as nothing confirmed the one before.
        """
        trust, limits = state.trust, jnp.asarray(self.gates, P.dtype)
        found = measurement.raised(self._innovations(state, x, slot), trust.noise_factor)
        nis, joined, S = measurement.plain_nis(found, P)
        fails = used & (nis > limits)
        doubted = recovery.contradict(found, trust.unconfirmed, limits) & fails
        seen = measurement.Seen(time, used, joined, S, doubted)
        age = jnp.maximum(time - trust.accepted_at, self.period)
        ahead = (self.slots + 1) * self.period
        velocity = jnp.asarray([each.observes == "velocity" for each in self.aids])
        unseen = jnp.min(jnp.where(velocity, age, jnp.inf))
        steps = jolts.consequences(x, state.samples, ahead, unseen, self.imu.gravity)
        fault = time - trust.jolted_at < jolts.MENDS
        explain, moves = jolts.explain(self.aids, found, P, steps, age, fault, limits)
        noisy = changes.noise_explains(self.imu, self.aids, joined.residual, state.samples)
        halts = stuck & ~trust.suspect(time, 0.0)
        signs = changes.Signs(fails, explain.any(axis=1), moves.any(axis=1), noisy, halts)
        change = changes.found_changes(self.aids, trust, seen, signs, self.config)
        for i, (each, sensor) in enumerate(zip(found, self.aids, strict=True)):
            marks = (doubted[i] & ~change.jolt[i], change.filter[i])
            P = recovery.opened(P, x, sensor, each, *marks, age[i], self.imu.gravity)
        P = jolts.opened(P, steps, (change.jolt[:, None] & (explain | moves)).any(axis=0))
        trust = trust._replace(
            predicted=recovery.unconfirmed(found, P),
            jolted_at=jnp.where(change.jolt.any(), time, trust.jolted_at),
            imu_factor=jnp.where(
                change.imu.any(),
                jnp.maximum(trust.imu_factor, state.samples.noisy(self.imu)),
                trust.imu_factor,
            ),
        )
        x, P = changes.taken_back(x, P, change)
        given = (x, self._rate(slot), self._values(slot), self._acceleration(state, x, slot))
        off = measurement.off(self.aids, *given)
        trust, x, P = changes.opened(self.aids, trust, x, P, change, off, seen)
        return trust, x, P, doubted & ~change.jolt

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
            self._rate(slot) - x.gyro_bias,
            state.motion.usual[0],
            self.imu.gravity,
        )
        return x, F, P

    def _rate(self, slot: Float[Array, "row"]) -> Float[Array, "3"]:
        """The gyroscope's rate at a slot's end, with its bias (rad/s)."""
        return slot[self.rate_column : self.rate_column + 3]

    def _values(self, slot: Float[Array, "row"]) -> list[Array]:
        """The sensors' readings in a slot."""
        return [
            slot[flag + 1 : flag + 1 + each.value_size]
            for each, flag in zip(self.aids, self.flags, strict=True)
        ]

    def _innovations(
        self, state: FilterState, x: Navigation, slot: Float[Array, "row"]
    ) -> list[measurement.Innovation]:
        """Those of a slot's readings at the sensors' configured noises."""
        between = state.samples.rate_covariance(self.imu.integrating)
        turning = slot[self.rate_column + 3 + inertial.LEFT_OPEN // 2] > 0  # without a rate
        between = between + jnp.where(turning, state.motion.usual[1], 0) * jnp.eye(3)
        given = (self.aids, x, self._rate(slot), between, self._values(slot))
        acceleration = self._acceleration(state, x, slot)
        return measurement.innovations(*given, acceleration, self.config.timing_std)

    def _acceleration(
        self, state: FilterState, x: Navigation, slot: Float[Array, "row"]
    ) -> Float[Array, "3"] | None:
        """Derivative of v_B at a slot (m/s²); none if the readings' times are exact."""
        if not self.config.latency_std and not self.config.timing_std:
            return None
        force, omega = slot[1:4] - x.accel_bias, self._rate(slot) - x.gyro_bias
        now = force - error_state.held_force(x, omega, self.imu.gravity)
        missing = slot[self.rate_column + 3] > 0
        return jnp.where(missing, state.motion.recent[:3], now)

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
            self.noisy_imu,
            self.aids,
            unmeasured,
            state.trust.imu_factor,
            between,
        )
        P = F @ state.P @ F.T + Q
        places, _ = offset_places(self.aids, self.errors)
        walk = jnp.zeros(self.errors, P.dtype).at[places].set(state.trust.walk)
        P = P + jnp.diag(walk * time)
        sinks = error_state.neglected_acceleration(state.before, state.P, self.imu.gravity)
        down = error_state.VELOCITY.stop - 1
        P = P.at[down, down].add(2 * _NEGLECTED * sinks * time)
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
        samples in one step, and beyond them grows by the recent one-step prediction errors. While
        a sensor has changed it is larger, as how that sensor is wrong is only approximated.
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
        # gravity turns in body axes, from the middle of those forces to the end
        up_B = error_state.held_force(now, jnp.zeros_like(rate), self.imu.gravity)
        since = ahead + (inertial.FEW - 1) / 2 * self.period
        force = foreseen[:3] - since * se3.cross(rate, up_B)
        beyond = error_state.sample_increment(force, rate, ahead * ring[-1, 0])
        now = error_state.apply(now, beyond, self.imu.gravity)
        P = error_state.in_body_axes(now, P)
        # over several samples the error of a force or rate that is held grows with the time
        steps = state.samples.steps * jnp.maximum(1, ahead / self.period)
        P = P + error_state.foreseen_covariance(steps, now.v_B, ahead, self.errors)
        doubtful = (state.trust.noise_factor > 1).any()
        P = jnp.where(doubtful, _APPROXIMATE, 1) * P
        return now.X_WB, jnp.concatenate([now.v_B, rate]), (P + P.T) / 2
