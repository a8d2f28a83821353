"""Which readings are usable: stuck values, sentinels, stamps."""

import jax
import jax.numpy as jnp
import numpy as np

from spinndrift.models.sensors import Compass, DepthSensor, Dvl
from spinndrift.systems.estimation.readings import Shown

AIDS = (Dvl(), DepthSensor(), Compass())
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
