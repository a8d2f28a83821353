import jax.numpy as jnp
import numpy as np
import pytest
from diagrams import read
from thruster_examples import prompt_thrusters

from spinndrift.systems.plant.allocation import ThrustAllocation

THRUSTERS = prompt_thrusters()


@pytest.fixture(name="allocation", scope="module")
def _allocation() -> ThrustAllocation:
    return ThrustAllocation(THRUSTERS)


def allocated(allocation: ThrustAllocation, F: np.ndarray) -> tuple[np.ndarray, ...]:
    """Pulse widths, forces, and the wrench of the pulse widths."""
    context = allocation.CreateDefaultContext()
    allocation.GetInputPort("F_Bo_B").FixValue(context, F)
    pwm = read(allocation, "pwm", context)
    wrench = THRUSTERS.wrench(THRUSTERS.force(jnp.asarray(pwm)))
    return pwm, read(allocation, "thruster_force", context), np.asarray(wrench)


@pytest.mark.parametrize("size", [0.05, 1.0, 20.0])
def test_a_wrench_within_limits_comes_out_as_it_went_in(allocation, size):
    # At 0.05 N most thrusters would stand still without the step over their dead band.
    F = size * np.array([1.0, -0.5, 0.7, 0.05, -0.03, 0.08])
    np.testing.assert_allclose(allocated(allocation, F)[2], F, atol=1e-9)


def test_zero_means_neutral(allocation):
    pwm, force, wrench = allocated(allocation, np.zeros(6))
    np.testing.assert_array_equal(pwm, np.full(8, 1500))
    np.testing.assert_array_equal(force, np.zeros(8))
    np.testing.assert_array_equal(wrench, np.zeros(6))


@pytest.mark.parametrize("axis", range(6))
def test_a_wrench_beyond_the_limits_keeps_its_direction(allocation, axis):
    F = np.array([3.0, 1, 2, 0.2, -0.3, 0.4])
    F[axis] += 500
    pwm, force, got = allocated(allocation, F)
    share = got @ F / (F @ F)
    assert 0 < share < 1
    np.testing.assert_allclose(got, share * F, atol=1e-8)
    low, high = THRUSTERS.force_limits()
    assert np.all(force >= np.asarray(low) - 1e-9)
    assert np.all(force <= np.asarray(high) + 1e-9)
    assert pwm.min() >= 1100
    assert pwm.max() <= 1900


def test_allocation_follows_its_input_without_delay(allocation):
    context = allocation.CreateDefaultContext()
    for F in (np.zeros(6), np.array([10.0, 0, 0, 0, 0, 0])):
        allocation.GetInputPort("F_Bo_B").FixValue(context, F)
        force = read(allocation, "thruster_force", context)
        np.testing.assert_allclose(THRUSTERS.wrench(jnp.asarray(force)), F, atol=1e-12)


def test_a_wrench_that_is_not_a_number_is_refused(allocation):
    with pytest.raises(FloatingPointError, match=r"wrench at t = 0\.0000 s is not finite"):
        allocated(allocation, np.full(6, np.nan))


def test_impossible_settings_are_refused():
    with pytest.raises(ValueError, match="voltage"):
        ThrustAllocation(THRUSTERS, -1.0)
