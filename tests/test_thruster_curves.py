"""The T200 curve is the maker's, can be inverted, and the battery sags as Ohm's law says."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import shared_data
from spinndrift.models.rigid_body import GRAVITY
from spinndrift.models.thruster_curves import RESTING, QuadraticCurve, T200Curve
from spinndrift.models.vehicles.vehicle import load_vehicle

VOLTS = jnp.array([10.0, 12.0, 14.0, 16.0, 18.0, 20.0])
PWM = jnp.arange(1100.0, 1901.0)


def jitted(curve):
    names = ("force", "pwm", "limits", "current", "loaded_voltage")
    return SimpleNamespace(
        **{n: eqx.filter_jit(getattr(curve, n)) for n in names if hasattr(curve, n)}
    )


@pytest.fixture(scope="module")
def t200():
    return jitted(T200Curve())


def grid(t200, volts):
    """Forces (PWM, voltage)."""
    shape = (len(PWM), len(volts))
    return t200.force(jnp.broadcast_to(PWM[:, None], shape), jnp.broadcast_to(volts[None], shape))


@pytest.mark.parametrize(
    ("volts", "pwm", "kilograms"),
    [(10, 1100, -2.31), (12, 1700, 1.28), (14, 1400, -0.40), (16, 1900, 5.25), (20, 1300, -1.58)],
)
def test_makers_figures(t200, volts, pwm, kilograms):
    force = t200.force(jnp.array(float(pwm)), jnp.array(float(volts)))
    assert float(force) == pytest.approx(kilograms * GRAVITY, rel=1e-12)


def test_measured_curve_within_three_percent_of_full_thrust(t200):
    rows = np.genfromtxt(shared_data("data", "t200", "t200_bollard.csv"), delimiter=",", names=True)
    for volts in VOLTS:
        part = rows[rows["supply_V"] == volts]
        error = t200.force(jnp.asarray(part["pwm_us"]), volts) - part["force_N"]
        assert float(jnp.max(jnp.abs(error))) < 0.03 * part["force_N"].max()
        still = part["pwm_us"][part["force_N"] == 0]
        assert np.all(np.abs(t200.force(jnp.asarray(still), volts)) <= RESTING)


def test_monotone_in_pwm_with_dead_band_and_asymmetry(t200):
    force = grid(t200, jnp.linspace(9.0, 21.0, 25))
    assert jnp.all(jnp.diff(force, axis=0) > 0)
    assert not jnp.any(force[PWM == 1500])
    assert jnp.all(jnp.abs(force[(PWM >= 1476) & (PWM <= 1524)]) <= RESTING)
    assert jnp.all(force[PWM <= 1455] < -0.1)
    assert jnp.all(force[PWM >= 1545] > 0.1)
    ratio = -force[0] / force[-1]
    assert jnp.all((ratio > 0.74) & (ratio < 0.81))
    full = force[jnp.array([0, -1])]
    assert jnp.all(jnp.diff(jnp.abs(full), axis=1) >= 0)


def test_linear_between_voltages_and_held_outside(t200):
    force = grid(t200, jnp.array([14.0, 15.0, 16.0, 20.0, 25.0, 7.0, 10.0]))
    np.testing.assert_allclose(force[:, 1], (force[:, 0] + force[:, 2]) / 2, atol=1e-12)
    np.testing.assert_array_equal(force[:, 3], force[:, 4])
    np.testing.assert_array_equal(force[:, 5], force[:, 6])


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_inverse_returns_pwm_within_a_microsecond(dtype):
    curve = jitted(T200Curve(dtype))
    pwm = PWM.astype(dtype)
    for volts in jnp.linspace(10, 20, 11, dtype=dtype):
        force = curve.force(pwm, volts)
        back = curve.pwm(force, volts)
        assert back.dtype == dtype
        assert float(jnp.max(jnp.abs(back - pwm))) < 1


def test_inverse_gives_the_force_or_the_limit(t200):
    rng = np.random.default_rng(0)
    force = jnp.asarray(np.concatenate([rng.uniform(-90, 90, 500), rng.uniform(-1, 1, 500)]))
    volts = jnp.asarray(rng.uniform(8, 22, 1000))
    low, high = t200.limits(volts)
    reached = t200.force(t200.pwm(force, volts), volts)
    np.testing.assert_allclose(reached, jnp.clip(force, low, high), atol=1e-9)


def test_smallest_forces_start_at_the_edge_of_the_dead_band(t200):
    force = RESTING * jnp.array([-1.001, -0.5, 0.0, 0.5, 1.001])
    pwm = t200.pwm(force, jnp.array(16.0))
    np.testing.assert_allclose(pwm, [1472, 1486, 1500, 1514, 1528], atol=1e-3)


def test_derivatives_are_the_slopes_and_finite(t200):
    slope = jax.vmap(jax.grad(t200.force), (0, None))(jnp.array([1150.0, 1500.0, 1850.0]), VOLTS[3])
    expected = np.array([(4.07 - 2.71) / 100, 0, (5.25 - 3.42) / 100]) * GRAVITY
    np.testing.assert_allclose(slope, expected, rtol=1e-9, atol=RESTING / 20)
    force = jnp.array([-60.0, -1.0, 0.0, 1.0, 60.0])
    for argument in (0, 1):
        inverse = jax.vmap(jax.grad(t200.pwm, argument), (0, None))(force, jnp.array(15.0))
        assert jnp.all(jnp.isfinite(inverse))


def test_battery_obeys_ohm(t200):
    resistance = jnp.array(0.03)
    pwm = jnp.array([[1100.0], [1300.0], [1500.0], [1900.0]]) + jnp.zeros((4, 5))
    source = jnp.array([12.5, 14.0, 16.0, 20.0, 24.0])
    volts = t200.loaded_voltage(pwm, source, resistance)
    current = jnp.sum(t200.current(pwm, jnp.broadcast_to(volts[None], pwm.shape)), axis=0)
    np.testing.assert_allclose(volts, source - resistance * current, rtol=1e-12)
    assert jnp.all(volts < source)
    np.testing.assert_allclose(t200.loaded_voltage(0 * pwm + 1500, source, resistance), source)
    # eight thrusters flat out at 16 V at their terminals draw more than 190 A
    assert float(8 * t200.current(jnp.array(1900.0), jnp.array(16.0))) > 190


def test_quadratic_curve_is_the_simulators():
    curve, volts = jitted(QuadraticCurve(51.48)), jnp.array(12.0)
    pwm = jnp.array([900.0, 1000, 1100, 1300, 1474, 1475, 1525, 1526, 1700, 1900, 2000, 65535])
    u = (pwm - 1500) / 400
    expected = 51.48 * u * jnp.abs(u)
    expected = expected.at[jnp.array([0, 1, 10, 11])].set(0)
    expected = expected.at[jnp.array([5, 6])].set(jnp.array([-RESTING, RESTING]))
    np.testing.assert_allclose(curve.force(pwm, volts), expected, rtol=1e-12)


def test_quadratic_inverse_round_trips_clamps_and_takes_the_nearer_at_the_jump():
    curve, volts = jitted(QuadraticCurve(51.48)), jnp.array(12.0)
    np.testing.assert_allclose(curve.pwm(curve.force(PWM, volts), volts), PWM, atol=1e-9)
    jump = 51.48 / 256
    force = jnp.array([-99.0, -0.6 * jump, -0.4 * jump, 0.0, 0.4 * jump, 0.6 * jump, 99.0])
    np.testing.assert_array_equal(
        curve.pwm(force, volts), [1100, 1475, 1500, 1500, 1500, 1525, 1900]
    )
    assert jnp.all(jnp.isfinite(jax.vmap(jax.grad(curve.pwm), (0, None))(force, volts)))


@pytest.mark.parametrize(("full_force", "dead_band"), [(0.0, 25.0), (-1.0, 25.0), (5.0, 400.0)])
def test_quadratic_refuses_nonsense(full_force, dead_band):
    with pytest.raises(ValueError, match=r"full_force|dead_band"):
        QuadraticCurve(full_force, dead_band)


@pytest.mark.parametrize("name", ["bluerov2_heavy", "ardusub_sitl"])
def test_the_curve_in_numpy_is_the_compiled_one(name):
    curve = load_vehicle(name).thrusters().curve
    rng = np.random.default_rng(3)
    pwm, volts = rng.uniform(950, 2050, (8, 500)), rng.uniform(9, 21, (1, 500))
    expected = np.asarray(curve.force(jnp.asarray(pwm), jnp.asarray(volts)))
    np.testing.assert_allclose(curve.steady(pwm, volts), expected, atol=RESTING)
