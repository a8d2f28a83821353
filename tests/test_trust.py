"""What innovations say of sensors: noise, correlation, pulls, and changes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from spinndrift.models import se3
from spinndrift.models.sensors import Compass, DepthSensor, Dvl, Imu
from spinndrift.systems.estimation import changes
from spinndrift.systems.estimation import error_state as es
from spinndrift.systems.estimation.config import EkfConfig
from spinndrift.systems.estimation.error_state import Navigation
from spinndrift.systems.estimation.inertial import Samples
from spinndrift.systems.estimation.measurement import Innovation, Seen, Update
from spinndrift.systems.estimation.readings import offset_places, parts, sizes
from spinndrift.systems.estimation.trust import Trust, counted, pulls, trusted

AIDS = (Dvl(), DepthSensor(), Compass())
SIZES = sizes(AIDS)
SHOWN = es.INERTIAL + len(AIDS)
VALUES = sum(SIZES)
ERRORS = SHOWN + 2 * VALUES
GATES = (16.3, 10.8, 10.8)
DTYPE = jnp.dtype("float64")
NONE, ALL = jnp.zeros(3, bool), jnp.ones(3, bool)
DVL, DEPTH, COMPASS = np.eye(3, dtype=bool)
OFFSETS, DRIFTS = offset_places(AIDS, ERRORS)
CORRELATED = np.array([changes._CORRELATED / size**0.75 for size in SIZES])


def update(nis: Array, accepted: Array) -> Update:
    """What came of an update, but for state and covariance."""
    none = jnp.zeros(0)
    return Update(navigation(), none, nis, accepted, jnp.zeros((ERRORS, VALUES)))


def navigation() -> Navigation:
    zero = jnp.zeros(3)
    X = se3.identity(jnp.float64)
    return Navigation(X, jnp.array([0.5, 0.0, 0.0]), zero, zero, jnp.zeros(3 + 2 * VALUES))


def seen(w: Array, time: float = 0.0) -> Seen:
    """Readings of all sensors, with normalised innovations w."""
    joined = Innovation(w, jnp.zeros((VALUES, ERRORS)), jnp.eye(VALUES))
    return Seen(jnp.asarray(time), ALL, joined, jnp.eye(VALUES), NONE)


@jax.jit
def _count(trust: Trust, nis: Array, w: Array, accepted: Array) -> Trust:
    return counted(AIDS, trust, seen(w), update(nis, accepted), nis, GATES)


def count(
    trust: Trust, nis: np.ndarray, w: np.ndarray, accepted: np.ndarray | Array = ALL
) -> Trust:
    """The trust after readings of all sensors, with normalised innovations w."""
    return _count(trust, jnp.asarray(nis), jnp.asarray(w), jnp.asarray(accepted))


# ------------------------------------------------------------------------------------------- noise


def test_noise_is_raised_by_the_mean_nis_and_not_by_chance():
    rng = np.random.default_rng(1)
    usual = larger = several = Trust.start(AIDS, DTYPE)
    factors = []
    only_dvl = np.array([5.0, 1, 1])
    for _ in range(400):
        nis, w = rng.chisquare(SIZES), rng.standard_normal(5)
        usual, larger = count(usual, nis, w), count(larger, only_dvl * nis, w)
        several = count(several, 5 * nis, w)
        factors.append(np.asarray(usual.noise_factor))
    assert np.mean(np.array(factors) > 1) < 0.01
    np.testing.assert_allclose(larger.noise_factor, [5, 1, 1], rtol=0.4)
    assert larger.imu_factor < 2
    # what all sensors say of the IMU is not held against them
    np.testing.assert_array_equal(several.noise_factor, 1)
    assert several.imu_factor > 100


# ------------------------------------------------------------------------------------- correlation


def correlations(w: np.ndarray) -> np.ndarray:
    """Of innovations (readings, runs, values), of each sensor."""
    nis = np.stack([np.sum(w[..., part] ** 2, -1) for part in parts(AIDS)], -1)

    def over(trust: Trust, given: tuple[Array, Array]) -> tuple[Trust, Array]:
        trust = jax.vmap(lambda *one: _count(*one, ALL))(trust, *given)
        return trust, trust.correlation

    start = jax.tree.map(lambda x: jnp.stack([x] * w.shape[1]), Trust.start(AIDS, DTYPE))
    return np.asarray(
        jax.jit(lambda *given: jax.lax.scan(over, start, given)[1])(
            jnp.asarray(nis), jnp.asarray(w)
        )
    )


def test_white_innovations_are_not_correlated_but_once_in_a_million():
    """1.5 million readings of each sensor: four more than expected have a probability of 2 %."""
    rng = np.random.default_rng(4)
    found = correlations(rng.standard_normal((1500, 1000, VALUES)))
    assert np.all(np.sum(found > CORRELATED, axis=(0, 1)) <= 5)


def test_outliers_do_not_look_like_a_correlation():
    """Ten hours of a DVL at 8 Hz with 1 % outliers, as 200 runs of three minutes."""
    rng, n, side = np.random.default_rng(4), 1440, 200
    w = rng.standard_normal((n, side, VALUES))
    w[rng.random((n, side)) < 0.01, :3] *= 10
    assert np.all(np.sum(correlations(w)[..., 0] > CORRELATED[0]) <= 10)


@pytest.mark.parametrize(("size", "least"), [(4.0, 0.4), (6.0, 0.9)])
def test_innovations_of_one_sign_are_correlated_within_ten_readings(size, least):
    rng = np.random.default_rng(5)
    w = rng.standard_normal((30, 200, VALUES))
    w[20:, :, 0] += size * 0.85 ** np.arange(10)[:, None]  # the filter follows
    w[20:, :, 4] += size * 0.85 ** np.arange(10)[:, None]
    seen = (correlations(w) > CORRELATED)[20:].any(axis=0).mean(axis=0)
    assert seen[0] > least
    assert seen[2] > least
    assert seen[1] == 0


# ------------------------------------------------------------------------------------------- pulls


def test_the_pulls_of_a_consistent_filter_are_as_large_as_is_usual():
    """White innovations of covariance S with any gains and transitions: NIS of mean 1 a value."""
    rng = np.random.default_rng(6)
    F = jnp.asarray(np.eye(ERRORS) + 0.02 * rng.standard_normal((ERRORS, ERRORS)))
    K = jnp.asarray(0.1 * rng.standard_normal((ERRORS, VALUES)))
    A = rng.standard_normal((VALUES, VALUES))
    S = jnp.asarray(A @ A.T + np.eye(VALUES))
    root = np.linalg.cholesky(S)
    at = seen(jnp.zeros(VALUES))

    def over(trust: Trust, w: Array) -> tuple[Trust, None]:
        done = update(jnp.ones(3), ALL)._replace(gain=K)
        now = at._replace(joined=at.joined._replace(residual=w), S=S)
        return pulls(AIDS, trust, F, now, done), None

    def run(w: Array) -> Array:
        trust, _ = jax.lax.scan(over, Trust.start(AIDS, DTYPE), w)
        d, U = trust.pulled[:, :, :3], trust.usual[:, :, :3, :3]
        return jnp.sum(d * jnp.linalg.solve(U, d[..., None])[..., 0], axis=-1) / 3

    w = rng.standard_normal((400, 60, VALUES)) @ root.T
    mean = np.asarray(jax.jit(jax.vmap(run))(jnp.asarray(w))).mean(axis=0)
    assert np.all(
        np.abs(mean[:, 0] - 1) < 4 * np.sqrt(2 / 3 / 400)
    )  # the DVL's three values span it


# ---------------------------------------------------------------------------------- what it may be


def change_of(
    trust: Trust,
    w: list[float],
    time: float = 1.2,
    doubted: np.ndarray | Array = NONE,
    **more: np.ndarray | Array,
) -> changes.Change:
    """What innovations of w standard deviations at a time show of a filter of the given trust."""
    fails = jnp.stack([jnp.sum(jnp.array(w)[part] ** 2) > 16 for part in parts(AIDS)])
    signs = changes.Signs(fails, NONE, NONE, NONE, NONE)._replace(**more)
    now = seen(jnp.array(w), time)._replace(doubted=jnp.asarray(doubted))
    return changes.found_changes(AIDS, trust, now, signs, EkfConfig())


def rejected(rows: list[list[float]]) -> Trust:
    trust = Trust.start(AIDS, DTYPE)._replace(accepted_at=jnp.ones(3))
    for w in rows:
        nis = np.array([np.sum(np.array(w)[part] ** 2) for part in parts(AIDS)])
        trust = count(trust, nis, np.array(w), nis < np.array(GATES))
    return trust


def test_rejections_that_are_alike_are_a_change_of_the_sensor():
    jump = [9.0, -6.0, 0.5, 0.2, 0.1]
    for rows, changed in (([jump], False), ([jump, jump], True)):
        found = change_of(rejected(rows), jump)
        np.testing.assert_array_equal(found.sensor, DVL & changed)
        assert not found.noise.any()
        assert not found.filter.any()


def test_rejections_that_differ_are_noise():
    rows = [[9.0, -6, 0, 0, 0], [-8.0, 2, 5, 0, 0]]
    found = change_of(rejected(rows), [3.0, 8, -7, 0, 0])
    np.testing.assert_array_equal(found.noise, DVL)
    assert not found.sensor.any()


def test_a_jolt_that_explains_two_readings_is_an_error_of_the_imu():
    jump = [9.0, -6.0, 0.5, 0.2, 0.1]
    assert not change_of(rejected([]), jump, jolted=DVL).jolt.any()  # an outlier?
    assert not change_of(rejected([jump]), jump).jolt.any()
    for found in (
        change_of(rejected([jump]), jump, jolted=DVL),
        change_of(rejected([]), jump, jolted=DVL, doubted=DVL),
    ):
        np.testing.assert_array_equal(found.jolt, DVL)
        assert not found.sensor.any()


def test_after_a_long_silence_the_filter_is_wrong():
    jump = [9.0, -6.0, 0.5, 0.2, 0.1]
    late = change_of(rejected([jump, jump]), jump, time=11.0)
    never = change_of(rejected([jump, jump])._replace(accepted_at=jnp.zeros(3)), jump)
    alone = change_of(rejected([jump, jump])._replace(unconfirmed=jnp.ones(3)), jump)
    for found in (late, never, alone):
        np.testing.assert_array_equal(found.filter, DVL)
        assert not found.sensor.any()


def test_a_reading_that_nothing_confirmed_does_not_end_a_run_of_rejections():
    jump = [9.0, -6.0, 0.5, 0.2, 0.1]
    right = [0.5, 0.5, 0.5, 0.2, 0.1]
    for unconfirmed, left in ((0.0, 0), (1.0, 1)):
        trust = rejected([jump])._replace(unconfirmed=jnp.full(3, unconfirmed))
        assert count(trust, np.ones(3), np.array(right)).rejected[0] == left


def test_correlated_innovations_are_laid_on_an_imu_that_scatters_or_jolted():
    trust = rejected([])._replace(correlation=jnp.array([5.0, 0, 0]))
    for noisy, sensor, imu in ((NONE, DVL, NONE), (ALL, NONE, DVL)):
        found = change_of(trust, [2.0, 0, 0, 0, 0], noisy=noisy)
        np.testing.assert_array_equal(found.sensor, sensor)
        np.testing.assert_array_equal(found.imu, imu)
    found = change_of(trust, [2.0, 0, 0, 0, 0], moved=ALL)
    np.testing.assert_array_equal(found.jolt, DVL)
    assert not found.sensor.any()
    jump = [9.0, -6.0, 0.5, 0.2, 0.1]  # no noise does that three times alike
    found = change_of(rejected([jump, jump]), jump, noisy=ALL)
    np.testing.assert_array_equal(found.sensor, DVL)


def test_noise_of_the_imu_explains_what_its_integral_reaches_and_no_more():
    imu, few = Imu(), 8.0
    s = np.asarray(imu.noise_std)
    usual = jnp.diag(jnp.asarray(6 * s**2))

    def explains(ratio: float, residuals: list[float]) -> np.ndarray:
        samples = Samples.start(jnp.zeros(3))._replace(
            bends=(1 + ratio) * usual, usual=jnp.diag(usual)
        )
        return np.asarray(changes.noise_explains(imu, AIDS, jnp.array(residuals), samples))

    deviation = 20 * s[0] * np.sqrt(few / AIDS[0].rate / imu.rate)
    assert explains(400.0, [2 * deviation, 0, 0, 1, 1])[0]
    assert not explains(400.0, [9 * deviation, 0, 0, 1, 1])[0]
    assert not explains(1.0, [1e-6, 0, 0, 0, 0]).any()  # no more noise than it says
    assert not explains(400.0, [1, 0, 0, 0, 0.05])[2]  # a compass three degrees off


# ------------------------------------------------------------------------------- what is made of it


def opened(trust: Trust, off: list[float], time: float, who: np.ndarray = DVL) -> tuple:
    P = jnp.zeros((ERRORS, ERRORS)).at[:SHOWN, :SHOWN].set(1e-6 * jnp.eye(SHOWN))
    x = navigation()
    H = jnp.zeros((VALUES, ERRORS)).at[0, es.INERTIAL].set(float(x.v_B[0]))
    found = Innovation(jnp.array(off), H, 1e-4 * jnp.eye(VALUES))
    nothing = jnp.zeros((3, SHOWN)), jnp.zeros((3, SHOWN, SHOWN))
    change = changes.Change(jnp.array(who), NONE, NONE, NONE, NONE, jnp.array(who), *nothing)
    now = Seen(jnp.asarray(time), ALL, found, found.R, NONE)
    return changes.opened(AIDS, trust, x, P, change, found.residual, now)


def test_a_change_becomes_an_offset_as_uncertain_as_it_is_large():
    trust, x, P = opened(Trust.start(AIDS, DTYPE), [0.3, 0.001, 0, 0.5, 0.7], 10.0)
    np.testing.assert_allclose(x.sensors[OFFSETS - es.INERTIAL], [0.3, 0, 0, 0, 0])
    np.testing.assert_allclose(jnp.diag(P)[OFFSETS], [0.09, 0, 0, 0, 0])
    np.testing.assert_allclose(jnp.diag(P)[DRIFTS], 0)
    np.testing.assert_allclose(
        P[es.INERTIAL, es.INERTIAL], 1e-6 + 0.6**2
    )  # or a scale of 0.3 / 0.5
    np.testing.assert_array_equal(trusted(AIDS, P, x), [False, True, True])
    np.testing.assert_array_equal(trust.suspect(jnp.asarray(12.0), 3.0), DVL)
    assert not trust.suspect(jnp.asarray(14.0), 3.0).any()


def test_a_sensor_is_trusted_again_once_its_offset_is_known_to_be_small():
    trust, x, P = opened(Trust.start(AIDS, DTYPE), [0.3, 0, 0, 0.5, 0.7], 10.0)
    trust = trust._replace(passed=jnp.full(3, 20.0))

    def settled(offset: float, std: float, walk: float = 0.0) -> Trust:
        at = x._replace(sensors=x.sensors.at[OFFSETS[0] - es.INERTIAL].set(offset))
        known = P.at[OFFSETS[0], OFFSETS[0]].set(std**2)
        moving = trust._replace(walk=trust.walk.at[0].set(walk))
        none = Update(at, known, jnp.zeros(3), ALL, jnp.zeros((ERRORS, VALUES)))
        return changes.settled(AIDS, moving, none, 3)[0]

    noise, rate = AIDS[0].noise_std[0], AIDS[0].rate
    assert trust.changed[0] == 1
    assert settled(noise, noise).changed[0] == 0
    assert settled(0, 10 * noise).changed[0] == 1  # not known
    assert settled(5 * noise, noise).changed[0] == 1  # not small
    assert settled(0, noise, walk=2 * noise**2 * rate).changed[0] == 1  # not for long


def test_a_second_change_in_the_same_direction_is_a_drift_of_sensor_or_imu():
    trust, _, _ = opened(Trust.start(AIDS, DTYPE), [0, 0, 0, 0, 0.1], 10.0, COMPASS)
    trust, x, P = opened(trust, [0, 0, 0, 0, 0.1], 12.0, COMPASS)
    np.testing.assert_allclose(x.sensors[DRIFTS - es.INERTIAL], [0, 0, 0, 0, 0.05])
    np.testing.assert_allclose(jnp.diag(P)[DRIFTS], [0, 0, 0, 0, 0.05**2])
    of_imu = jnp.sqrt(jnp.diag(P)[es.GYRO_BIAS])
    assert np.all(of_imu > 0.05 / 3)  # either hypothesis is within three deviations
    assert np.all(of_imu < 0.05)
    assert trust.walk[4] > 0
    assert not trust.walk[:4].any()


def test_an_offset_that_returned_is_zero_and_all_that_follows_from_it():
    """The Gaussian conditioned on an offset and a drift of zero."""
    rng = np.random.default_rng(7)
    A = rng.standard_normal((ERRORS, ERRORS)) * 0.1
    P = jnp.asarray(A @ A.T).at[OFFSETS[:4], :].set(0).at[:, OFFSETS[:4]].set(0)
    P = P.at[DRIFTS[:4], :].set(0).at[:, DRIFTS[:4]].set(0)
    which = np.array([OFFSETS[4], DRIFTS[4]])
    at = 0.01 * np.sqrt(np.diag(P)[which])
    x = navigation()
    x = x._replace(sensors=x.sensors.at[which - es.INERTIAL].set(at))
    trust = Trust.start(AIDS, DTYPE)._replace(
        passed=jnp.full(3, 5.0), before=jnp.zeros(VALUES).at[4].set(100.0)
    )
    done = update(jnp.zeros(3), ALL)._replace(nominal=x, P=P)
    after, settled, left = changes.settled(AIDS, trust, done, patience=3)
    K = P[:, which] @ np.linalg.inv(P[np.ix_(which, which)])
    gamma = es.moved(x, -K @ at)
    rest = np.delete(np.arange(ERRORS), [*OFFSETS, *DRIFTS])
    expected = gamma @ (P - K @ P[which]) @ gamma.T
    np.testing.assert_allclose(left[np.ix_(rest, rest)], expected[np.ix_(rest, rest)], atol=1e-9)
    np.testing.assert_allclose(es.error(x, settled)[:SHOWN], (-K @ at)[:SHOWN], atol=1e-8)
    assert not settled.sensors[which - es.INERTIAL].any()
    assert not left[which].any()
    assert not after.before.any()
    # without a clear offset before, nothing says that it was more than noise
    first = trust._replace(before=jnp.zeros(VALUES))
    np.testing.assert_array_equal(changes.settled(AIDS, first, done, patience=3)[2], P)


def test_a_sensor_that_was_stuck_is_suspect_for_a_short_time():
    """Until its values stood still it was right, and what repeats is not used."""
    trust = Trust.start(AIDS, DTYPE)._replace(stuck_at=jnp.array([10.0, -1e9, -1e9]))
    np.testing.assert_array_equal(trust.suspect(jnp.asarray(12.0), 1.0), DVL)
    assert not trust.suspect(jnp.asarray(14.0), 1.0).any()
