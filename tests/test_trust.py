"""Which sensors are believed: stuck values, jumps, doubts, noise that is larger than said."""

import jax
import jax.numpy as jnp
import numpy as np

from spinndrift.models.sensors import Compass, DepthSensor, Dvl, Imu
from spinndrift.systems.filtering.trust import SIZES, Shown, Trust, counted, imu_off, judged

PATIENCE = 10
GATES = (16.3, 10.8, 10.8)
DVL = Dvl()
NONE, ALL = jnp.zeros(3, bool), jnp.ones(3, bool)


@jax.jit
def show(shown: Shown, values, valid, stamps):
    return shown.with_readings(DVL, values, valid, stamps)


def usable(values: list, stamps: list, valid=ALL) -> np.ndarray:
    """Which of the readings after each other could be used, (readings, sensors)."""
    shown, found = Shown.start(jnp.dtype("float64")), []
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
    np.testing.assert_array_equal(np.flatnonzero(~good[:, 2]), [18, 19])


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


def judge(rejected: float, jump: float, well: bool, **more) -> tuple:
    """The verdict on a compass of which a reading came."""
    start = Trust.start(jnp.dtype("float64"))
    trust = start._replace(
        rejected=start.rejected.at[2].set(rejected), jump=start.jump.at[2].set(jump), **more
    )
    used = jnp.array([False, False, True])
    off = imu_off(Imu(), DVL, DepthSensor(), Compass())
    residuals, spreads = jnp.full(3, 0.7), jnp.full(3, 1e-4)
    trust, left_out, follow = judged(
        trust, used, residuals, off, PATIENCE, jnp.full(3, well), spreads
    )
    return trust, bool(left_out[2]), bool(follow[2])


def test_a_sensor_that_jumped_is_at_fault_where_others_vouch_for_the_filter():
    assert judge(PATIENCE - 1, 0.7, well=True)[1:] == (False, False)
    assert judge(PATIENCE, 0.7, well=True)[1:] == (True, False)


def test_where_none_can_tell_the_reading_is_followed_and_doubted():
    for jump, well in ((0.7, False), (1e-4, True)):  # alone; or they drifted apart
        trust, left_out, follow = judge(PATIENCE, jump, well)
        assert (left_out, follow) == (False, True)
        np.testing.assert_allclose(trust.doubt, [0, 0, 0.49])


def test_a_sensor_comes_back_when_its_readings_pass_again():
    distrusted = jnp.array([0.0, 0, 1])
    passed = lambda n: {"distrusted": distrusted, "passed": jnp.array([0.0, 0, n])}  # noqa: E731
    assert judge(PATIENCE, 0.7, well=True, **passed(PATIENCE - 1))[1]
    trust, left_out, _ = judge(PATIENCE, 0.7, well=True, **passed(PATIENCE))
    assert not left_out
    assert trust.doubt[2] == 0  # the filter knew well what to expect
    trust, left_out, _ = judge(PATIENCE, 0.02, well=True, **passed(PATIENCE))
    assert not left_out
    np.testing.assert_allclose(trust.doubt[2], 0.02**2)  # it did not: agreement says little


def test_noise_is_raised_by_the_mean_nis_and_not_by_chance():
    rng = np.random.default_rng(1)
    zero = jnp.zeros(())
    count = jax.jit(
        lambda trust, nis: counted(trust, ALL, ALL, nis, nis, GATES, jnp.zeros(3), zero, zero)
    )
    usual = larger = Trust.start(jnp.dtype("float64"))
    factors = []
    for _ in range(400):
        nis = jnp.asarray(rng.chisquare(SIZES))
        usual, larger = count(usual, nis), count(larger, 3 * nis)
        factors.append(np.asarray(usual.noise_factor))
    assert np.mean(np.array(factors) > 1) < 0.01
    assert np.all(np.asarray(larger.noise_factor) > 2)
