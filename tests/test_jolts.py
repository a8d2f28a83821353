"""Steps of the IMU as errors: what they do to an estimate, and what they explain."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from spinndrift.models import se3
from spinndrift.models.sensors import Compass, DepthSensor, Dvl, Imu
from spinndrift.systems.estimation import error_state as es
from spinndrift.systems.estimation import jolts
from spinndrift.systems.estimation.error_state import Navigation
from spinndrift.systems.estimation.inertial import FEW, Samples, take
from spinndrift.systems.estimation.measurement import innovations, off
from spinndrift.systems.estimation.readings import sizes

AIDS = (Dvl(), DepthSensor(), Compass())
SENSORS = len(AIDS) + 2 * sum(sizes(AIDS))
ERRORS = es.INERTIAL + SENSORS
GATES = jnp.array([16.3, 10.8, 10.8])
GRAVITY = 9.81
IMU = Imu()
NEW, BEFORE = 0, 1


def navigation() -> Navigation:
    X = se3.from_position_rpy(jnp.array([1.0, 2.0, -3.0]), jnp.array([0.2, -0.3, 1.0]))
    zero = jnp.zeros(3)
    return Navigation(X, jnp.array([0.5, -0.2, 0.1]), zero, zero, jnp.zeros(SENSORS))


def stepped(
    force: Array | None = None, rate: Array | None = None, ago: float = 0.4, place: int = NEW
) -> Samples:
    """Samples whose last or second last jolt was that of a force or a rate."""
    samples, found = Samples.start(jnp.zeros(3)), [force, rate]
    for kind, step in enumerate(found):
        if step is not None:
            steps = samples.jolts.at[place, kind].set(jnp.asarray(step))
            samples = samples._replace(jolts=steps, jolted=samples.jolted.at[place, kind].set(ago))
    return samples


@jax.jit
def consequences(samples: Samples, unseen: float | Array = jnp.inf) -> jolts.Jolts:
    return jolts.consequences(navigation(), samples, 0.0, jnp.asarray(unseen), GRAVITY)


# ------------------------------------------------------------------------------ what they have done


def flown(force_off: np.ndarray, rate_off: np.ndarray, T: float) -> Array:
    """δ after a time T with errors of force and rate; the estimate ends at `navigation`."""
    n, omega = 400, jnp.array([0.02, -0.03, 0.1])
    end = navigation()
    h = T / n

    def backwards(x: Navigation, _: None) -> tuple[Navigation, None]:
        force = es.held_force(x, omega, GRAVITY)
        back = es.sample_increment(force, omega, jnp.asarray(-h))
        return es.apply(x, back, GRAVITY), None

    def forwards(x: tuple[Navigation, Navigation], _: None) -> tuple:
        estimated, true = x
        force = es.held_force(estimated, omega, GRAVITY)
        move = es.sample_increment(force, omega, jnp.asarray(h))
        right = es.sample_increment(force - force_off, omega - rate_off, jnp.asarray(h))
        return (es.apply(estimated, move, GRAVITY), es.apply(true, right, GRAVITY)), None

    start, _ = jax.lax.scan(backwards, end, None, n)
    (estimated, true), _ = jax.lax.scan(forwards, (start, start), None, n)
    true = true._replace(accel_bias=jnp.asarray(force_off), gyro_bias=jnp.asarray(rate_off))
    return es.error(estimated, true)[: es.INERTIAL]


@pytest.mark.parametrize(("kind", "size"), [("force", 0.2), ("rate", 0.02)])
def test_a_step_that_is_an_error_moves_the_estimate_as_is_said(kind, size):
    """To a tenth, with a vehicle that turns meanwhile; the rest is allowed for (`_BESIDE`)."""
    step, T, none = size * np.array([0.6, -0.5, 0.4]), 0.4, np.zeros(3)
    pair = (step, none) if kind == "force" else (none, step)
    found = consequences(stepped(**{kind: jnp.asarray(step)}, ago=T))
    said = np.asarray(found.roots[0 if kind == "force" else 2, : es.INERTIAL, 0])
    for part in (es.POSITION, es.ROTATION, es.VELOCITY, es.ACCEL_BIAS, es.GYRO_BIAS):
        true = np.asarray(flown(*pair, T)[part])
        assert np.linalg.norm(said[part] - true) <= 0.1 * np.linalg.norm(true) + 1e-5


def test_position_is_wrong_for_no_longer_than_velocity_was_unseen():
    samples = stepped(force=jnp.array([1.0, 0, 0]), ago=0.8)
    position = [
        np.linalg.norm(consequences(samples, unseen).roots[0, es.POSITION, 0])
        for unseen in (jnp.inf, 0.2)
    ]
    np.testing.assert_allclose(position, [0.8**2 / 2, 0.2**2 / 2], rtol=1e-6)


# ------------------------------------------------------------------------------- what they explain


def explained(
    samples: Samples, residuals: list[float], ages: float = 0.2, *, fault: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Of a state that is known well, with residuals of the three sensors' values."""
    given = jnp.asarray(residuals, float), jnp.asarray(ages), jnp.asarray(fault)
    passes, moves = _explained(samples, *given)
    return np.asarray(passes), np.asarray(moves)


@jax.jit
def _explained(
    samples: Samples, residuals: Array, ages: Array, fault: Array
) -> tuple[Array, Array]:
    x, rate = navigation(), jnp.zeros(3)
    zero = [jnp.zeros(size) for size in sizes(AIDS)]
    right = jnp.split(-off(AIDS, x, rate, zero), np.cumsum(sizes(AIDS))[:-1])
    shown = jnp.split(residuals, np.cumsum(sizes(AIDS))[:-1])
    values = [a + b for a, b in zip(right, shown, strict=True)]
    found = innovations(AIDS, x, rate, jnp.zeros((3, 3)), values)
    P = 1e-6 * jnp.eye(ERRORS)
    return jolts.explain(AIDS, found, P, consequences(samples), jnp.full(3, ages), fault, GATES)


X, FALL = jnp.array([1.0, 0, 0]), 0.2**2 / 2 * GRAVITY


def test_a_jolt_explains_what_it_can_have_done_since_and_no_more():
    DVL, DEPTH, COMPASS = range(3)
    FORCE, RATE = 0, 2
    ahead = [0.4, 0, 0, 0.0, 0.0]

    def passes(samples: Samples, residuals: list[float], **more: object) -> np.ndarray:
        return explained(samples, residuals, **more)[0]

    assert passes(stepped(force=2 * X, ago=0.2), ahead)[DVL, FORCE]  # 2 m/s² · 0.2 s
    assert not passes(stepped(force=0.3 * X, ago=0.2), ahead)[DVL].any()  # over four times as far
    assert not passes(stepped(force=2 * X, ago=0.2), [4.0, 0, 0, 0, 0])[DVL].any()
    assert not passes(stepped(force=2 * X, ago=0.2), [0, 0.8, 0, 0, 0])[DVL].any()  # across
    assert not passes(stepped(force=2 * X, ago=0.2), [0, 0, 0, 0.5, 0])[DEPTH].any()
    assert not passes(stepped(force=9 * X, ago=0.2), [0, 0, 0, 0, 0.7])[COMPASS].any()
    turn = jnp.array([0, 0, 0.4])
    assert passes(stepped(rate=turn, ago=0.2), [0, 0, 0, 0, 0.08])[COMPASS, RATE]
    falls = [0, FALL, 0, 0, 0]  # along a vertical that is wrong
    assert passes(stepped(rate=X, ago=0.2), falls)[DVL, RATE]
    assert passes(stepped(rate=X, ago=0.2, place=BEFORE), falls)[DVL, RATE + 1]


def test_a_jolt_explains_for_longer_if_the_imu_was_found_to_fail():
    late = stepped(force=2 * X, ago=3.0)
    for fault, seen in ((False, False), (True, True)):
        assert explained(late, [0.4, 0, 0, 0, 0], fault=fault)[0][0].any() == seen
    assert explained(late, [0.4, 0, 0, 0, 0], ages=4.0)[0][0].any()  # the DVL was silent since


def test_small_residuals_are_laid_on_a_jolt_that_moves_the_estimate_as_far():
    small = [0.02, 0, 0, 0, 0]
    moved = [explained(stepped(force=a * X, ago=0.5), small)[1][0, 0] for a in (1.0, 0.01)]
    assert moved == [True, False]


def test_the_covariance_is_opened_along_what_a_jolt_has_done():
    samples = stepped(force=2 * X, rate=X)
    found = consequences(samples)
    P = 1e-6 * jnp.eye(ERRORS)
    np.testing.assert_array_equal(jolts.opened(P, found, jnp.zeros(4, bool)), P)
    after = jolts.opened(P, found, jnp.array([True, False, False, False]))
    u = found.roots[0, :, 0]
    assert u @ jnp.linalg.solve(after, u) < 1  # it is within one deviation
    one = jnp.zeros(ERRORS).at[es.GYRO_BIAS].set(0.01)
    assert one @ jnp.linalg.solve(after, one) > 25  # and what it has not touched is as before


# ------------------------------------------------------------------------------- how they are found


@jax.jit
def remembered(samples: Array) -> Samples:
    numbers = jnp.arange(len(samples), dtype=samples.dtype)
    start = Samples.start(jnp.zeros(3))
    return jax.lax.scan(lambda m, row: (take(IMU, m, *row)[0], None), start, (samples, numbers))[0]


def test_the_last_two_steps_are_remembered_with_size_direction_and_time():
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((400, 6)) * np.repeat([0.01, 0.001], 3)
    samples = noise + np.array([0, 0, GRAVITY, 0, 0, 0])
    samples[200:300, 3] += 0.2  # begins and ends
    samples[250:, 1] += 1.0
    found = remembered(jnp.asarray(samples))
    (force, rate), (_, earlier) = found.jolts
    np.testing.assert_allclose(rate, [-0.2, 0, 0], atol=0.01)
    np.testing.assert_allclose(earlier, [0.2, 0, 0], atol=0.01)
    np.testing.assert_allclose(force, [0, 1.0, 0], atol=0.05)
    T = 1 / IMU.rate
    np.testing.assert_allclose(found.jolted[:, 1], [100 * T, 200 * T], atol=1.5 * T)
    np.testing.assert_allclose(found.jolted[NEW, 0], 150 * T, atol=FEW * T)


def test_a_step_over_several_samples_is_one_and_a_short_pulse_none():
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((400, 6)) * np.repeat([0.01, 0.001], 3)
    samples = noise + np.array([0, 0, GRAVITY, 0, 0, 0])
    slow, pulse = samples.copy(), samples.copy()
    slow[200:, 3] += 0.3 * np.clip(np.arange(200) / 3, 0, 1)
    pulse[200:202, 3] += 0.3
    np.testing.assert_allclose(remembered(jnp.asarray(slow)).jolts[NEW, 1], [0.3, 0, 0], atol=0.02)
    np.testing.assert_allclose(remembered(jnp.asarray(pulse)).jolts[NEW, 1], 0, atol=0.02)
