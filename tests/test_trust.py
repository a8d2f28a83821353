"""Which sensors are believed: stuck values, jumps, doubts, noise that is larger than said."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models.sensors import Compass, DepthSensor, Dvl, Imu
from spinndrift.systems.estimation.trust import (
    Shown,
    Trust,
    counted,
    imu_off,
    judged,
    others,
    sizes,
    suspected,
    with_doubt,
)

PATIENCE = 10
GATES = (16.3, 10.8, 10.8)
AIDS = (Dvl(), DepthSensor(), Compass())
SIZES = sizes(AIDS)
NONE, ALL = jnp.zeros(3, bool), jnp.ones(3, bool)


@jax.jit
def show(shown: Shown, values, valid, stamps):
    return shown.with_readings(AIDS, values, valid, stamps)


def usable(values: list, stamps: list, valid=ALL) -> np.ndarray:
    """Which of the readings after each other could be used, (readings, sensors)."""
    shown, found = Shown.start(AIDS, jnp.dtype("float64")), []
    for value, stamp in zip(values, stamps, strict=True):
        given = jnp.asarray(value, float), valid, jnp.full(3, float(stamp))
        shown, good = show(shown, *given)
        found.append(np.asarray(good))
    return np.array(found)


def changing(n: int) -> np.ndarray:
    return np.random.default_rng(0).standard_normal((n, 5)) * 0.1


def test_readings_that_change_are_used():
    assert usable(changing(20), range(20)).all()


def test_a_held_reading_is_no_repetition():
    """The same value with the same stamp is what a port holds between readings."""
    values = np.repeat(changing(4), 20, axis=0)
    assert usable(values, np.repeat(np.arange(4), 20)).all()


def test_values_that_stand_still_are_stuck():
    values = changing(30)
    values[10:20] = values[10]
    good = usable(values, range(30))
    np.testing.assert_array_equal(np.flatnonzero(~good[:, 0]), np.arange(12, 20))  # three at once
    np.testing.assert_array_equal(np.flatnonzero(~good[:, 1]), [18, 19])  # one alone: eight times
    np.testing.assert_array_equal(np.flatnonzero(~good[:, 2]), np.arange(14, 20))


def test_zeros_of_lost_lock_sentinels_and_what_is_not_finite_are_not_used():
    for bad in (0.0, -32.768, np.nan, np.inf):
        values = changing(5)
        values[2, :3] = bad
        good = usable(values, range(5))
        np.testing.assert_array_equal(good[:, 0], [True, True, False, True, True])
        assert good[:, 1:].all()
    values = changing(5)
    values[3, 3:] = np.nan
    assert not usable(values, range(5))[3, 1:].any()
    assert not usable(changing(5), [0, 1, np.nan, 3, 4])[2].any()
    assert not usable(changing(5), range(5), NONE).any()


def judge(rejected: float, jump: float, well: bool, cleared: bool = False, **more) -> tuple:
    """The verdict on a compass of which a reading came."""
    start = Trust.start(AIDS, jnp.dtype("float64"))
    trust = start._replace(
        rejected=start.rejected.at[2].set(rejected), jump=start.jump.at[2].set(jump), **more
    )
    used = jnp.array([False, False, True])
    off = imu_off(Imu(), AIDS)
    trust, (left_out, follow) = judged(
        trust, used, off, PATIENCE, jnp.full(3, well), jnp.full(3, cleared)
    )
    return trust, bool(left_out[2]), bool(follow[2])


def test_a_sensor_that_jumped_is_at_fault_where_others_vouch_for_the_filter():
    assert judge(PATIENCE - 1, 0.7, well=True)[1:] == (False, False)
    assert judge(PATIENCE, 0.7, well=True)[1:] == (True, False)


def test_where_none_can_tell_the_reading_is_followed():
    for jump, well in ((0.7, False), (1e-4, True)):  # alone; or they drifted apart
        assert judge(PATIENCE, jump, well)[1:] == (False, True)


def test_a_sensor_comes_back_when_its_readings_pass_again():
    distrusted = jnp.array([0.0, 0, 1])
    passed = lambda n: {"distrusted": distrusted, "passed": jnp.array([0.0, 0, n])}  # noqa: E731
    assert judge(PATIENCE, 0.7, well=True, **passed(PATIENCE - 1))[1]
    trust, left_out, follow = judge(PATIENCE, 0.7, well=True, **passed(PATIENCE))
    assert not left_out
    assert not follow
    assert trust.rejected[2] == 0


def test_a_sensor_at_fault_is_followed_once_most_others_contradict_the_filter_too():
    distrusted = {"distrusted": jnp.array([0.0, 0, 1])}
    assert judge(PATIENCE, 0.7, well=False, **distrusted)[1:] == (True, False)
    assert judge(PATIENCE, 0.7, well=False, cleared=True, **distrusted)[1:] == (False, True)


def test_silent_sensors_vouch_for_nothing():
    start = Trust.start(AIDS, jnp.dtype("float64"))
    at = jnp.asarray(100.0)

    def counted_others(accepted_at: list[float], rejected: list[float]) -> list[list[float]]:
        trust = start._replace(accepted_at=jnp.array(accepted_at), rejected=jnp.array(rejected))
        return [x.tolist() for x in others(trust, at, PATIENCE, 3.0)]

    assert counted_others([99.0, 99, 99], [0.0, 0, 0]) == [[2, 2, 2], [0, 0, 0]]
    assert counted_others([99.0, 90, 99], [0.0, 0, 0]) == [[1, 2, 1], [0, 0, 0]]
    assert counted_others([90.0, 90, 99], [10.0, 10, 0]) == [[1, 1, 0], [1, 1, 2]]


def test_noise_is_raised_by_the_mean_nis_and_not_by_chance():
    rng = np.random.default_rng(1)
    usual = larger = several = Trust.start(AIDS, jnp.dtype("float64"))
    factors, biases = [], []
    only_dvl = np.array([5.0, 1, 1])
    for _ in range(400):
        nis, w = rng.chisquare(SIZES), rng.standard_normal(5)
        usual, larger = count(usual, nis, w), count(larger, only_dvl * nis, w)
        several = count(several, 5 * nis, w)
        factors.append(np.asarray(usual.noise_factor))
        biases.append(np.abs(usual.mean).max())
    assert np.mean(np.array(factors) > 1) < 0.01
    assert max(biases) < 0.8
    np.testing.assert_allclose(larger.noise_factor, [5, 1, 1], rtol=0.4)
    assert larger.imu_factor < 2
    # what all sensors say of the IMU is not held against them
    np.testing.assert_array_equal(several.noise_factor, 1)
    assert several.imu_factor > 100


@jax.jit
def _count(trust, nis, w):
    zero = jnp.zeros(())
    return counted(AIDS, trust, ALL, ALL, nis, nis, GATES, (w, jnp.ones(5)), zero)


def count(trust: Trust, nis: np.ndarray, w: np.ndarray) -> Trust:
    """Readings of all sensors, with normalised innovations w."""
    return _count(trust, jnp.asarray(nis), jnp.asarray(w))


def test_innovations_with_a_mean_make_a_suspect():
    trust, time = Trust.start(AIDS, jnp.dtype("float64")), jnp.asarray(10.0)
    rng = np.random.default_rng(2)
    for _ in range(60):
        w = rng.standard_normal(5)
        w[4] += 1.5
        trust = count(trust, rng.chisquare(SIZES), w)
    pulled = jnp.ones((3, 18))
    trust = suspected(AIDS, trust, NONE, NONE, ALL, ALL, pulled, time, jnp.asarray(0.1))
    np.testing.assert_array_equal(trust.suspect(time + 50), [False, False, True])
    assert not trust.suspect(time + 70).any()
    np.testing.assert_allclose(trust.pulled[:2], 0.95)  # only recent pulls of others are kept
    np.testing.assert_allclose(trust.pulled[2], np.exp(-0.1 / 60))


def test_outliers_do_not_look_like_a_bias():
    """Ten hours of a DVL at 8 Hz with 1 % outliers, as 200 runs of three minutes."""
    rng, n, side = np.random.default_rng(4), 1440, 200
    w = rng.standard_normal((n, side, 5))
    w[rng.random((n, side)) < 0.01, :3] *= 10
    nis = np.stack([np.sum(w[..., :3] ** 2, -1), w[..., 3] ** 2, w[..., 4] ** 2], -1)

    def over(trust, given):
        trust = jax.vmap(_count)(trust, *given)
        return trust, jnp.abs(trust.mean).max(axis=1)

    start = jax.tree.map(lambda x: jnp.stack([x] * side), Trust.start(AIDS, jnp.dtype("float64")))
    _, largest = jax.jit(lambda: jax.lax.scan(over, start, (jnp.asarray(nis), jnp.asarray(w))))()
    assert largest.max() < 0.8


def test_a_sensor_that_was_stuck_is_suspect_for_a_short_time_alone():
    """Until its values stood still it was right, and what repeats is not used."""
    trust, time = Trust.start(AIDS, jnp.dtype("float64")), jnp.asarray(10.0)
    stuck = jnp.array([True, False, False])
    trust = suspected(AIDS, trust, NONE, stuck, ALL, ALL, jnp.ones((3, 18)), time, jnp.asarray(0.1))
    np.testing.assert_array_equal(trust.suspect(time + 2), [True, False, False])
    assert not trust.suspect(time + 4).any()


def test_a_pull_of_a_suspect_is_one_deviation_and_the_shape_stays():
    A = np.random.default_rng(3).standard_normal((18, 18)) * 0.1
    P = A @ A.T
    pulled = np.zeros((3, 18))
    pulled[1, :3] = [5.0, 1.0, 0.0]
    pulled[2, 6:9] = 1e-6
    suspect = jnp.array([False, True, True])
    after = np.asarray(with_doubt(jnp.asarray(P), jnp.asarray(pulled), suspect))
    d = pulled[1, :3]
    np.testing.assert_allclose(d @ np.linalg.solve(after[:3, :3], d), 1)
    np.testing.assert_allclose(after[:3, :3] / P[:3, :3], after[0, 0] / P[0, 0])
    np.testing.assert_allclose(after[3:, 3:], P[3:, 3:])
    assert np.linalg.eigvalsh(after).min() > 0
    healthy = with_doubt(jnp.asarray(P), jnp.asarray(pulled), NONE)
    np.testing.assert_allclose(healthy, P)


@pytest.mark.parametrize("exact", [slice(9, 12), slice(3, 6), slice(4, 5)])
def test_what_is_known_exactly_stays_so_under_doubt(exact):
    """A bias that is said to be zero has no variance; the covariance is not NaN for it."""
    A = np.random.default_rng(3).standard_normal((18, 18)) * 0.1
    A[exact] = 0.0
    pulled = np.random.default_rng(4).standard_normal((3, 18)) @ A.T  # corrections are in P's range
    after = np.asarray(with_doubt(jnp.asarray(A @ A.T), jnp.asarray(pulled), ALL))
    assert np.isfinite(after).all()
    assert not after[exact].any()
    assert after[0, 0] >= (A @ A.T)[0, 0]
