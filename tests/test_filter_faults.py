"""The whole filter while a sensor fails: finite, honest in what it claims, and it says who failed.

Vehicles swing and swim, and what their sensors show is spoiled before the filter reads it: by hand,
so that a mistake in `models.sensors.faults` can't hide one of the filter.
"""

from collections.abc import Callable, Iterable
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from spinndrift.models import se3
from spinndrift.models.sensors import Compass, DepthSensor, Dvl, Imu, wrap
from spinndrift.sims.estimator_check.scores import within_three_sigma
from spinndrift.systems.estimation import error_state
from spinndrift.systems.estimation.config import EkfConfig
from spinndrift.systems.estimation.delayed import DelayedFilter
from spinndrift.systems.estimation.state import Readings, health_names

pytestmark = pytest.mark.whole

SEEDS = 10
EVERY = 20  # samples from one estimate that is kept to the next
BEGIN, LATER, END = 800, 1400, 2000  # samples of 10 ms: first and last of a fault, end of the run
GOOD, DEGRADED = 0, 1
AIDS = {"dvl": Dvl(dropout_share=0.0), "depth": DepthSensor(), "compass": Compass()}
FILTER = DelayedFilter(Imu(), tuple(AIDS.values()), EkfConfig())
HEALTH = health_names(tuple(AIDS))


class Dives(NamedTuple):
    """What sensors showed and what was true, one row a sample."""

    readings: Readings
    X_WB: Array
    V_WB_B: Array


class Told(NamedTuple):
    """What the filter said and how wrong it was, one row each `EVERY` samples; the seeds first."""

    error: np.ndarray
    covariance: np.ndarray
    """Of position, attitude and velocity, each by rows."""
    health: np.ndarray

    def worst(self, name: str, begin: int = BEGIN) -> np.ndarray:
        """Of the seeds, the lowest of a component of the health from a sample on."""
        return self.health[:, begin // EVERY :, HEALTH.index(name)].min(axis=1)


def twist(t: Array, phase: Array, lively: Array) -> Array:
    size = jnp.array([0.4, 0.3, 0.2, 0.15, 0.12, 0.25])
    swim = size * jnp.sin(jnp.array([0.62, 0.46, 0.8, 2.2, 1.8, 0.34]) * t + phase)
    size = lively * jnp.array([0.4, 0.35, 0.3, 0.3, 0.25, 0.5])
    return swim + size * jnp.sin(jnp.array([3.9, 4.3, 4.6, 3.1, 3.7, 2.9]) * t + 2 * phase + 1)


def dive(key: Array, lively: Array) -> Dives:
    """A motion with phases of its own and the readings along it.

    A `lively` one, of 1, has accelerations of up to 2 m/s² and 1.5 rad/s².
    """
    h, sensors = FILTER.period, (FILTER.imu, *FILTER.aids)
    every = [round(FILTER.imu.rate / sensor.rate) for sensor in sensors]
    motion, start, noises = jax.random.split(key, 3)
    phase = 2 * np.pi * jax.random.uniform(motion, (6,))
    states = [
        s.initial(jax.random.normal(k, (s.initial_noise_size,)))
        for s, k in zip(sensors, jax.random.split(start, 4), strict=True)
    ]
    sizes = [s.noise_size for s in sensors]
    X0 = se3.from_position_rpy(jnp.array([0.0, 0, -3]), jnp.array([0.0, 0, 1]))

    def sample(carry: tuple, n: Array) -> tuple[tuple, Dives]:
        X, V, states = carry
        t = n.astype(X.dtype) * h
        now = twist(t, phase, lively)
        X = jnp.where(n > 0, se3.retract(X, twist(t - h / 2, phase, lively) * h), X)
        A = jnp.where(n > 0, (now - V) / h, 0)
        w = jax.random.normal(jax.random.fold_in(noises, n), (sum(sizes),))
        parts = jnp.split(w, np.cumsum(sizes)[:-1])
        states = [
            jnp.where(n % m == 0, s.measure(old, X, now, A, t, part), old)
            for s, old, m, part in zip(sensors, states, every, parts, strict=True)
        ]
        imu, dvl, *others = (s.reading(x, t) for s, x in zip(sensors, states, strict=True))
        stamps = [(n // m * m).astype(t.dtype) * h for m in every[2:]]
        marked = [
            jnp.concatenate([x, jnp.stack([jnp.ones_like(t), stamp])])
            for x, stamp in zip(others, stamps, strict=True)
        ]
        readings = Readings(imu, (jnp.concatenate([dvl[:4], dvl[6:]]), *marked))
        return (X, now, states), Dives(readings, X, now)

    begin = (X0, twist(jnp.zeros(()), phase, lively), states)
    return jax.lax.scan(sample, begin, jnp.arange(END + 1))[1]


def follow(given: tuple[Dives, Array]) -> tuple[Array, Array, Array]:
    """What the filter makes of one dive; it starts with an error as large as it says."""
    truth, key = given
    state = FILTER.init(truth.X_WB[0], truth.V_WB_B[0])
    drawn = jnp.where(jnp.arange(FILTER.errors) < 9, jax.random.normal(key, (FILTER.errors,)), 0)
    off = drawn * FILTER.deviations()
    off = error_state.body_axes(state.nominal)[1] @ off
    state = state._replace(nominal=error_state.retract(state.nominal, off))

    def told(state, rows):
        readings, k, X, V = rows
        state, _ = jax.lax.scan(lambda s, row: (FILTER.step(s, *row), None), state, (readings, k))
        X_hat, V_hat, P = FILTER.present(state, FILTER.period)
        error = jnp.concatenate([se3.local(X_hat, X[-1]), (V[-1] - V_hat)[:3]])
        blocks = jnp.concatenate([P[i : i + 3, i : i + 3].reshape(-1) for i in (0, 3, 6)])
        return state, (error, blocks, FILTER.health(state, P, k[-1]))

    # As in the system: what is told after a sample is the state one sample later.
    readings = jax.tree.map(lambda leaf: leaf[:-1], truth.readings)
    rows = (readings, jnp.arange(float(END)), truth.X_WB[1:], truth.V_WB_B[1:])
    rows = jax.tree.map(lambda leaf: leaf.reshape(-1, EVERY, *leaf.shape[1:]), rows)
    return jax.lax.scan(told, state, rows)[1]


@cache
def compiled() -> Callable:
    return jax.jit(lambda dives, keys: jax.lax.map(follow, (dives, keys)))


@cache
def dives(lively: float = 0.0) -> Dives:
    keys = jax.random.split(jax.random.key(0), SEEDS)
    flown = jax.jit(jax.vmap(dive, in_axes=(0, None)))(keys, jnp.asarray(lively))
    return jax.tree.map(np.asarray, flown)


def spoiled(spoil: Callable[[Readings], None], lively: float = 0.0) -> Told:
    """What the filter tells of readings that were spoiled in place."""
    found = dives(lively)
    readings = jax.tree.map(np.array, found.readings)
    spoil(readings)
    keys = jax.random.split(jax.random.key(1), SEEDS)
    return Told(*map(np.asarray, compiled()(found._replace(readings=readings), keys)))


def frozen(values: np.ndarray, end: int) -> None:
    """The values (seed, sample, component) of the last sample before `BEGIN` until `end`."""
    values[:, BEGIN:end] = values[:, BEGIN - 1, None]


def imu_nan(readings: Readings) -> None:
    readings.imu[:, BEGIN, 2] = np.nan


def imu_frozen(readings: Readings) -> None:
    frozen(readings.imu, BEGIN + 100)


def imu_spike(readings: Readings) -> None:
    readings.imu[:, BEGIN, 0] += 1000


def imu_spike_in_range(readings: Readings) -> None:
    readings.imu[:, BEGIN, 0] += 100


def compass_frozen(readings: Readings) -> None:
    frozen(readings.aids[2][..., :1], LATER)


def compass_turned(readings: Readings) -> None:
    yaw = readings.aids[2][:, BEGIN:, 0]
    yaw[:] = wrap(jnp.asarray(yaw + np.deg2rad(40)))


def dvl_frozen(readings: Readings) -> None:
    frozen(readings.aids[0][..., :3], LATER)


def dvl_late(readings: Readings) -> None:
    readings.aids[0][:, BEGIN:, 4] += 0.15


def depth_jump(readings: Readings) -> None:
    readings.aids[1][:, BEGIN:, 0] += 0.5


def all_jump(readings: Readings) -> None:
    """At once and for good, so that no majority is right."""
    dvl, depth, compass = (each[:, BEGIN:] for each in readings.aids)
    dvl[..., 0] += 0.3
    depth[..., 0] += 0.5
    compass[..., 0] = wrap(jnp.asarray(compass[..., 0] + np.deg2rad(40)))


def accelerometer_off(readings: Readings) -> None:
    readings.imu[:, BEGIN : BEGIN + 100, 0] += 2


def gyroscope_off(readings: Readings) -> None:
    readings.imu[:, BEGIN : BEGIN + 100, 3] += 0.2


def dvl_mirrored(readings: Readings) -> None:
    readings.aids[0][:, BEGIN:, 0] *= -1


def dvl_short(readings: Readings) -> None:
    readings.aids[0][:, BEGIN:, :3] *= 0.8


PASSING = {
    imu_nan: "imu",
    imu_frozen: "imu",
    imu_spike: "imu",
    imu_spike_in_range: "imu",
    compass_frozen: "compass",
    dvl_frozen: "dvl",
}
LASTING = {
    compass_turned: "compass",
    dvl_late: "dvl",
    dvl_mirrored: "dvl",
    depth_jump: "depth",
}
NAMED = {**PASSING, **LASTING}
JOLTS = (accelerometer_off, gyroscope_off)
"""Others are trusted again only if no outlier of the DVL falls into the jolt."""
FAULTS = (*NAMED, *JOLTS, all_jump, dvl_short)
BESIDE = [fault for fault, sensor in NAMED.items() if sensor != "dvl"]
"""Faults that the other sensors make up for; horizontal velocity is the DVL's alone."""


@cache
def told(fault: Callable[[Readings], None] | None = None) -> Told:
    return spoiled(fault or (lambda readings: None))


@pytest.mark.parametrize("gaps", [(), (20,), (15, 15, 15)], ids=["none", "one", "three"])
def test_a_gap_in_the_samples_of_a_lively_motion_is_made_up_for(gaps):
    """What a link that hangs for some tenths of a second leaves out, once or each second.

    What the vehicle did in a gap is unknown, not known to have been nothing, and a step across one
    is no jolt of the IMU.
    """

    def hang(readings: Readings) -> None:
        for n, gap in enumerate(gaps):
            readings.imu[:, BEGIN + 100 * n : BEGIN + 100 * n + gap] = np.nan

    found = spoiled(hang, lively=1.0)
    for later in (300, 600, END - BEGIN):
        at = (BEGIN + later) // EVERY - 1
        now = {"error": found.error[:, at], "covariance": found.covariance[:, at]}
        assert np.all(within_three_sigma(now).sum(axis=0) >= 8)
        assert np.linalg.norm(found.error[:, at, 6:9], axis=1).max() < 0.1


def by_name(faults: Iterable[Callable]) -> pytest.MarkDecorator:
    names = {each.__name__: each for each in faults}
    return pytest.mark.parametrize("fault", names.values(), ids=names)


def test_healthy_sensors_are_not_doubted():
    healthy = told()
    np.testing.assert_array_equal(healthy.health[..., 0], GOOD)
    np.testing.assert_array_equal(healthy.health[..., 1:], 1)


@by_name(FAULTS)
def test_the_estimate_is_never_nan_nor_confidently_wrong(fault):
    """In 95 % of seeds the errors at the end are within three claimed sigma.

    Fewer than eight of ten are so with a probability of 1 %.
    """
    found = told(fault)
    assert np.isfinite(found.error).all()
    assert np.isfinite(found.covariance).all()
    end = {"error": found.error[:, -1], "covariance": found.covariance[:, -1]}
    assert np.all(within_three_sigma(end).sum(axis=0) >= 8)


@by_name(JOLTS)
def test_an_imu_that_jolts_is_not_trusted_and_the_estimate_follows_the_others(fault):
    found = told(fault)
    np.testing.assert_array_equal(found.worst("imu"), 0)
    speed = np.linalg.norm(found.error[:, -1, 6:9], axis=1)
    assert np.all(speed < 0.03)  # the IMU alone would be a metre a second off


def test_where_all_sensors_jump_at_once_the_imu_tells():
    found = told(all_jump)
    for sensor in HEALTH[2:]:
        np.testing.assert_array_equal(found.health[:, -1, HEALTH.index(sensor)], 0)
    error = np.linalg.norm(found.error[:, -1].reshape(SEEDS, 3, 3), axis=2)
    assert np.all(np.median(error, axis=0) < [0.15, 0.03, 0.02])


@by_name(NAMED)
def test_the_health_names_the_sensor_that_fails_and_no_other(fault):
    found = told(fault)
    assert np.all(found.health[:, : BEGIN // EVERY, 0] == GOOD)
    for sensor in HEALTH[1:]:
        np.testing.assert_array_equal(found.worst(sensor), sensor != NAMED[fault], sensor)
    assert np.all(found.health[:, BEGIN // EVERY :, 0].max(axis=1) >= DEGRADED)


@by_name(PASSING)
def test_all_is_good_again_after_a_fault_that_passes(fault):
    np.testing.assert_array_equal(told(fault).health[:, -1, 0], GOOD)


@by_name(LASTING)
def test_a_sensor_that_stays_at_fault_stays_doubted(fault):
    found = told(fault).health[:, -1]
    assert np.all(found[:, 0] >= DEGRADED)
    np.testing.assert_array_equal(found[:, HEALTH.index(LASTING[fault])], 0)


@by_name(BESIDE)
def test_what_others_make_up_for_costs_little(fault):
    """Large covariances would be honest, too: the claimed position is within twice the healthy."""

    def size(found: Told) -> np.ndarray:
        return np.sqrt(np.trace(found.covariance[:, -1, :9].reshape(-1, 3, 3), axis1=1, axis2=2))

    assert np.all(size(told(fault)) < 2 * size(told()))
