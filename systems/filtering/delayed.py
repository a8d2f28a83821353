"""An error-state Kalman filter at a delayed horizon, so that late measurements need no tricks.

A DVL's reading arrives 0.1 to 0.2 s after its time of validity. The filter therefore stands
`horizon` seconds in the past: inertial samples and readings wait in a ring of slots, one for each
inertial sample, and a reading goes to the slot of its own time, whenever it arrives. When a slot
leaves the ring the filter predicts over its sample and fuses its readings, all in their true
order: the estimate is that of an ordinary Kalman filter without delays. The present follows by
applying the waiting samples' preintegrated increment (Khosravian et al. 2015 give this predictor).
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.stats import chi2

from ...models import se3
from ...models.checks import Vector3, check_numbers, require
from ...models.sensors import Compass, DepthSensor, Dvl, Imu
from ...models.sensors.base import velocity_at
from . import error_state, measurement
from .error_state import Navigation

SLOT = 18
"""Has sample, force 3, mean rate 3 | has dvl, v 3 | has depth, depth | has compass, yaw | rate at
the end 3."""
_DVL, _DEPTH, _COMPASS, _RATE = 7, 11, 13, 15
_FLAGS = np.array([_DVL, _DEPTH, _COMPASS])
_FEW = 5  # samples whose mean force is held beyond the newest one
_LONGEST = 0.1  # s that the covariance waits at most for a reading
_REMEMBERED = 2.0  # s: time constant of the averages of how samples differ

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
    """Alignment and gates of the filter; the sensors' own configurations give their noises.

    Attributes:
        position_std: of the initial position in body axes (m).
        attitude_std: of the initial attitude about the body axes (rad).
        velocity_std: of the initial velocity in body axes (m/s).
        imu_factor: the IMU's noise densities times this are the filter's. It covers errors of
            second order, of bias times attitude say: at 1 the NEES of all 18 errors after 3.5 s
            without a DVL is 21.6 in place of 18, at 1.5 within its bounds
            (`tests/test_filtering.py`).
        horizon: how long readings may take to arrive (s).
        gate: share of good readings that pass the chi-square gate.
        patience: after so many rejections in a row what the sensor measures counts as unknown, by
            the size of the residual, and its reading is taken: a filter that lost its way must not
            shut its sensors out for good.
        output_rate: estimates per second (Hz).
        silence: a sensor without an accepted reading for so long is not trusted (s).
        lost_velocity: the state is lost where velocity is known no better than this, 1 σ (m/s).
        lost_attitude: the same of roll, pitch and yaw (rad).
    """

    position_std: Vector3 = (0.02, 0.02, 0.02)
    attitude_std: Vector3 = (0.01, 0.01, 0.03)
    velocity_std: Vector3 = (0.02, 0.02, 0.02)
    imu_factor: float = 1.5
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
    """Everything that changes."""

    nominal: Navigation
    P: Float[Array, "18 18"]
    ring: Float[Array, "slots 18"]
    since: Float[Array, "10"]
    """Since P's time: the time, sums of force · dt and rate · dt, and v_B at its beginning."""
    rate: Float[Array, "3"]
    """Newest angular rate (rad/s) in body axes, its bias still in it."""
    rate_before: Float[Array, "3"]
    """The one before."""
    steps: Float[Array, "6 6"]
    """Mean square of what a sample of [force, rate] differs from the one foreseen."""
    bends: Float[Array, "6 6"]
    """Mean square of the second differences of [force, rate]."""
    nis: Float[Array, "3"]
    rejected: Float[Array, "3"]
    accepted_at: Float[Array, "3"]


class Readings(NamedTuple):
    """What the sensors show at one time; a reading's time tells which slot it belongs to."""

    imu: Float[Array, "6"]
    """Specific force (m/s²) and angular rate (rad/s) in the sensor's axes."""
    dvl: Float[Array, "5"]
    """Velocity (m/s) in the sensor's axes, valid, time of validity (s)."""
    depth: Float[Array, "3"]
    """Depth (m), valid, time (s)."""
    compass: Float[Array, "3"]
    """Yaw (rad), valid, time (s)."""


class DelayedFilter(eqx.Module):
    """The filter's constants, with pure `init`, `step` and `present`."""

    imu: Imu = eqx.field(static=True)
    dvl: Dvl = eqx.field(static=True)
    depth: DepthSensor = eqx.field(static=True)
    compass: Compass = eqx.field(static=True)
    config: EkfConfig = eqx.field(static=True)

    def __check_init__(self) -> None:
        """Check that the DVL's readings arrive in time and that no sensor is perfect."""
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
        """Samples that wait."""
        return math.ceil(self.config.horizon * self.imu.rate - 1e-9)

    def samples_at_once(self, most: int) -> int:
        """How many samples `steps` may take, a divisor of `most`, so that no reading is missed."""
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
            jnp.concatenate([jnp.zeros(7, V_WB_B.dtype), V_WB_B[:3]]),
            V_WB_B[3:],
            V_WB_B[3:],
            jnp.zeros((6, 6), V_WB_B.dtype),
            jnp.zeros((6, 6), V_WB_B.dtype),
            zero,
            zero,
            zero,
        )

    def step(self, state: FilterState, readings: Readings, k: Float[Array, ""]) -> FilterState:
        """Take in sample number k (of time k · period) and advance the horizon by one slot.

        Sample 0 belongs to the start: it moves nothing. Before it, k is negative. The nominal state
        moves with every sample; the covariance follows, with the samples' mean, where a reading is
        fused and every 0.1 s.
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
    ) -> tuple[FilterState, Float[Array, "n 18"]]:
        """Put samples that end with number `last` into the ring; return the slots that leave it.

        `samples` are the IMU's, oldest first; of `readings` only the other sensors count. The slots
        are then passed by `move`, and where it stops `fuse`, until all are: `step` for n samples.
        """
        dtype, h, n = state.ring.dtype, self.period, samples.shape[0]
        X_BS = self.imu.mount(dtype)
        rate = se3.rotate(X_BS, samples[:, 3:].T)
        force = se3.rotate(X_BS, samples[:, :3].T)
        number = last - (self.slots + n - 1) + jnp.arange(self.slots + n, dtype=dtype)
        rate = jnp.where(number[None, self.slots :] >= 0, rate, state.rate[:, None])
        before = jnp.concatenate([state.rate[:, None], rate[:, :-1]], axis=1)
        if any(self.imu.position):  # from the sensor's place to Bo
            r = jnp.broadcast_to(X_BS[4:, None], rate.shape)
            spin = velocity_at(r, jnp.concatenate([jnp.zeros_like(rate), rate]))
            force = force - se3.cross(rate, spin) - se3.cross((rate - before) / h, r)
        moves = (number[None, self.slots :] >= 1).astype(dtype)
        mean = rate if self.imu.integrating else (rate + before) / 2
        new = [moves, force, mean, jnp.zeros((SLOT - _DVL, n), dtype)]
        ring = jnp.concatenate([state.ring, jnp.concatenate(new).T])
        following = jnp.concatenate([ring[1:, 4:_DVL], ring[-1:, 4:_DVL]])
        state = self._compared(state, ring, rate)

        def place(old: Array, reading: Array) -> Array:
            """The columns with [1, value] in the slot of a valid reading's time."""
            here = (number == jnp.round(reading[-1] / h)) & (reading[-2] > 0)
            row = jnp.concatenate([jnp.ones(1, dtype), reading[:-2]])
            return jnp.where(here[:, None], row[None], old)

        columns = [
            ring[:, :_DVL],
            place(ring[:, _DVL:_DEPTH], readings.dvl),
            place(ring[:, _DEPTH:_COMPASS], readings.depth),
            place(ring[:, _COMPASS:_RATE], readings.compass),
            (ring[:, 4:_DVL] + following) / 2,
        ]
        ring = jnp.concatenate(columns, axis=1)
        return state._replace(ring=ring[n:]), ring[:n]

    def _compared(
        self, state: FilterState, ring: Float[Array, "m 18"], rate: Float[Array, "3 n"]
    ) -> FilterState:
        """Compare the n newest samples, at the end of `ring`, with those before them."""
        n, m = rate.shape[1], ring.shape[0]
        rates = jnp.concatenate([state.rate_before[None], state.rate[None], rate.T])
        force = ring[m - n - _FEW :, 1:4]
        has = ring[m - n - _FEW :, :1]
        decay = jnp.exp(-jnp.asarray(self.period, ring.dtype) / _REMEMBERED)
        steps, bends = state.steps, state.bends
        for i in range(n):
            # both need two samples before them
            known = has[_FEW + i - 2, 0] * (1 - decay)
            foreseen = _mean(force[i : i + _FEW], has[i : i + _FEW])
            at, now = _FEW + i, i + 2
            step = jnp.concatenate([force[at] - foreseen, rates[now] - rates[now - 1]])
            bend = [force[at] - 2 * force[at - 1] + force[at - 2]]
            bend = jnp.concatenate([*bend, rates[now] - 2 * rates[now - 1] + rates[now - 2]])
            steps = steps + known * (step[:, None] * step[None] - steps)
            bends = bends + known * (bend[:, None] * bend[None] - bends)
        return state._replace(rate_before=rates[-2], rate=rates[-1], steps=steps, bends=bends)

    def move(
        self, state: FilterState, slots: Float[Array, "n 18"], first: Float[Array, ""]
    ) -> tuple[FilterState, Float[Array, ""]]:
        """Move the nominal state from slot `first` on over the next one that needs `fuse`.

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
            given: tuple[Navigation, Array], slot: tuple[Array, Array]
        ) -> tuple[tuple[Navigation, Array], None]:
            x, since = given
            dt, values = slot
            force, omega = values[1:4] - x.accel_bias, values[4:7] - x.gyro_bias
            sample = error_state.sample_increment(force, omega, dt)
            decay = jnp.exp(-dt / self.compass.wander_time)
            x = error_state.apply(x, sample, self.imu.gravity)
            x = x._replace(sensors=jnp.concatenate([x.sensors[:2], decay * x.sensors[2:]]))
            gone = jnp.concatenate([dt[None], force * dt, omega * dt])
            return (x, jnp.concatenate([since[:7] + gone, since[7:]])), None

        (x, since), _ = jax.lax.scan(over, (state.nominal, state.since), (times, slots))
        return state._replace(nominal=x, since=since), at

    def fuse(
        self, state: FilterState, slot: Float[Array, "18"], k: Float[Array, ""]
    ) -> FilterState:
        """Bring P up to date and use the readings of the slot that left with sample number k."""
        x = state.nominal
        P = self._covariance(state, x, state.since[:7])
        found = (
            measurement.dvl_innovation(self.dvl, x, slot[_RATE:], slot[_DVL + 1 : _DEPTH]),
            measurement.depth_innovation(self.depth, x, slot[_DEPTH + 1 : _COMPASS]),
            measurement.compass_innovation(self.compass, x, slot[_COMPASS + 1 : _RATE]),
        )
        used = jnp.stack([slot[flag] > 0 for flag in (_DVL, _DEPTH, _COMPASS)])
        # A filter that lost its way: what the sensor measures counts as unknown from here on.
        lost = used & (state.rejected >= self.config.patience)
        own = (error_state.VELOCITY, error_state.POSITION, error_state.ROTATION)
        for i, (each, part) in enumerate(zip(found, own, strict=True)):
            doubt = jnp.where(lost[i], each.residual**2, 0)
            H = each.H[:, part]
            P = P.at[part, part].add(H.T @ (doubt[:, None] * H))
        gates = [float(chi2.ppf(self.config.gate, each.residual.size)) for each in found]
        x, P, nis, accepted = measurement.update(x, P, found, used, gates)
        time = (k - self.slots) * self.period
        return state._replace(
            nominal=x,
            P=P,
            since=jnp.concatenate([jnp.zeros(7, P.dtype), x.v_B]),
            nis=jnp.where(used, nis, state.nis),
            rejected=jnp.where(accepted, 0, state.rejected + used.astype(P.dtype)),
            accepted_at=jnp.where(accepted, time, state.accepted_at),
        )

    def _covariance(
        self, state: FilterState, after: Navigation, gone: Float[Array, "7"]
    ) -> Float[Array, "18 18"]:
        """P after the time and the sums of force · dt and rate · dt of `gone`."""
        time = gone[0]
        some = jnp.maximum(time, self.period)
        before = state.nominal._replace(v_B=state.since[7:])
        F, Q = error_state.transition(
            before, after, gone[1:4] / some, gone[4:] / some, time, self._noisy_imu, self.compass
        )
        P = F @ state.P @ F.T + Q
        if not self.imu.integrating:
            P = P + time / self.period * self._between_samples(state)
        return (P + P.T) / 2

    def _between_samples(self, state: FilterState) -> Float[Array, "18 18"]:
        """What one sample of an IMU that does not integrate leaves open about its interval T.

        Between two known values a Brownian rate of density σ² has an integral of variance
        σ² T³ / 12, and second differences of variance 2 σ² T. Independent forces of variance s²,
        whose second differences have 6 s², leave at most s² T² open of the change of velocity.
        Of smooth motion second differences show next to nothing.
        """
        T = self.period
        open_ = jnp.zeros_like(state.P)
        turn, force = state.bends[3:, 3:], state.bends[:3, :3]
        open_ = open_.at[error_state.ROTATION, error_state.ROTATION].set(turn * T**2 / 24)
        return open_.at[error_state.VELOCITY, error_state.VELOCITY].set(force * T**2 / 6)

    def status(self, state: FilterState, k: Float[Array, ""]) -> Float[Array, "10"]:
        """The status vector after `step` number k; see `STATUS`."""
        time = jnp.maximum(k - self.slots, 0) * self.period
        age = time - state.accepted_at
        return jnp.concatenate([time[None], state.nis, state.rejected, age])

    def health(
        self, state: FilterState, P: Float[Array, "18 18"], k: Float[Array, ""]
    ) -> Float[Array, "5"]:
        """The health vector after `step` number k, for the covariance P that is shown."""
        c, variance = self.config, jnp.diag(P)
        age = jnp.maximum(k - self.slots, 0) * self.period - state.accepted_at
        trusted = (age <= c.silence) & (state.rejected < c.patience)
        trusted = jnp.concatenate([jnp.ones(1, P.dtype), trusted.astype(P.dtype)])
        lost = jnp.any(variance[error_state.VELOCITY] > c.lost_velocity**2)
        lost = lost | jnp.any(variance[error_state.ROTATION] > c.lost_attitude**2)
        state_ = jnp.where(lost, 2.0, jnp.where(jnp.all(trusted > 0), 0.0, 1.0))
        return jnp.concatenate([state_[None].astype(P.dtype), trusted])

    def present(
        self, state: FilterState, ahead: float | Float[Array, ""]
    ) -> tuple[Float[Array, "7"], Float[Array, "6"], Float[Array, "18 18"]]:
        """Pose, twist and error covariance `ahead` seconds after the newest sample.

        The waiting samples are applied to the horizon's state; beyond the newest one its rate and
        the mean force of the last few hold on. The covariance crosses the waiting time in one step,
        and grows beyond it by how far samples have lately been from what was foreseen of them.
        """
        x, ring = state.nominal, state.ring
        time = ring[:, 0] * self.period
        force, omega = ring[:, 1:4].T - x.accel_bias[:, None], ring[:, 4:7].T - x.gyro_bias[:, None]
        increment = error_state.chain_all(error_state.sample_increment(force, omega, time))
        now = error_state.apply(x, increment, self.imu.gravity)
        waiting = jnp.concatenate(
            [time[:, None], force.T * time[:, None], omega.T * time[:, None]], 1
        )
        P = self._covariance(state, now, state.since[:7] + jnp.sum(waiting, axis=0))
        rate = state.rate - x.gyro_bias
        mean = _mean(force[:, -_FEW:].T, ring[-_FEW:, :1])
        beyond = error_state.sample_increment(mean, rate, ahead * ring[-1, 0])
        now = error_state.apply(now, beyond, self.imu.gravity)
        P = P + self._foreseen(state, now, ahead)
        return now.X_WB, jnp.concatenate([now.v_B, rate]), P

    def _foreseen(
        self, state: FilterState, now: Navigation, ahead: float | Float[Array, ""]
    ) -> Float[Array, "18 18"]:
        """Covariance of what the mean force and rate of `ahead` are off what was foreseen."""
        a = ahead * jnp.eye(3, dtype=state.P.dtype)
        J = jnp.zeros((error_state.ERRORS, 6), state.P.dtype)
        J = J.at[error_state.POSITION, :3].set(ahead / 2 * a)
        J = J.at[error_state.ROTATION, 3:].set(a).at[error_state.VELOCITY, :3].set(a)
        J = J.at[error_state.VELOCITY, 3:].set(ahead * error_state.skew(now.v_B))
        return J @ state.steps @ J.T


def _mean(values: Float[Array, "n 3"], has: Float[Array, "n 1"]) -> Float[Array, "3"]:
    """Mean of the rows that there are, zero if there are none."""
    return jnp.sum(values * has, axis=0) / jnp.maximum(jnp.sum(has), 1)
