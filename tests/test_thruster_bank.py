import jax.numpy as jnp
import numpy as np
import pytest
from diagrams import connect, read
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from spinndrift.models.thruster_curves import T200Curve
from spinndrift.models.thrusters import Thrusters
from spinndrift.models.vehicle import load_vehicle
from spinndrift.systems.thruster_bank import ThrustAllocation, ThrusterBank


def thrusters(**settings) -> Thrusters:
    base = load_vehicle("bluerov2_heavy").thrusters()
    return Thrusters(
        np.asarray(base.positions),
        np.asarray(base.directions),
        T200Curve(),
        motor_directions=np.asarray(base.motor_directions),
        **settings,
    )


class Chain:
    """Wrench in, wrench out, with one context."""

    def __init__(self, **settings):
        builder = DiagramBuilder()
        self.mix = builder.AddSystem(ThrustAllocation(thrusters(**settings)))
        self.bank = builder.AddSystem(ThrusterBank(thrusters(**settings)))
        connect(builder, self.mix, self.bank, "pwm")
        builder.ExportInput(self.mix.GetInputPort("F_Bo_B"), "F_Bo_B")
        builder.ExportInput(self.bank.GetInputPort("voltage"), "voltage")
        self.diagram = builder.Build()

    def __call__(self, F: np.ndarray, end: float, voltage: float | None = None) -> np.ndarray:
        simulator = Simulator(self.diagram)
        self.context = simulator.get_mutable_context()
        self.diagram.GetInputPort("F_Bo_B").FixValue(self.context, F)
        if voltage is not None:
            self.diagram.GetInputPort("voltage").FixValue(self.context, [voltage])
        simulator.AdvanceTo(end)
        return self.read(self.bank, "F_Bo_B")

    def read(self, system, name: str) -> np.ndarray:
        return read(system, name, system.GetMyContextFromRoot(self.context))


@pytest.fixture(scope="module")
def prompt() -> Chain:
    """Thrusters without lag at a stiff 16 V."""
    return Chain(nominal_voltage=16.0)


@pytest.fixture(scope="module")
def slow() -> Chain:
    return Chain(nominal_voltage=16.0, time_constant=0.15)


@pytest.mark.parametrize("size", [0.05, 1.0, 20.0])
def test_a_wrench_within_limits_comes_out_as_it_went_in(prompt, size):
    # At 0.05 N most thrusters would stand still without the step over their dead band.
    F = size * np.array([1.0, -0.5, 0.7, 0.05, -0.03, 0.08])
    np.testing.assert_allclose(prompt(F, 0.02), F, atol=1e-9)


def test_zero_means_neutral(prompt):
    np.testing.assert_array_equal(prompt(np.zeros(6), 0.02), np.zeros(6))
    np.testing.assert_array_equal(prompt.read(prompt.mix, "pwm"), np.full(8, 1500))


@pytest.mark.parametrize("axis", range(6))
def test_a_wrench_beyond_the_limits_keeps_its_direction(prompt, axis):
    F = np.array([3.0, 1, 2, 0.2, -0.3, 0.4])
    F[axis] += 500
    got = prompt(F, 0.02)
    share = got @ F / (F @ F)
    assert 0 < share < 1
    np.testing.assert_allclose(got, share * F, atol=1e-8)
    forces = prompt.read(prompt.mix, "thruster_force")
    low, high = thrusters().force_limits(16.0)
    assert np.all(forces >= np.asarray(low) - 1e-9)
    assert np.all(forces <= np.asarray(high) + 1e-9)
    pwm = prompt.read(prompt.mix, "pwm")
    assert pwm.min() >= 1100
    assert pwm.max() <= 1900


def test_allocation_follows_its_input_without_delay(prompt):
    prompt(np.zeros(6), 0.0)
    F = np.array([10.0, 0, 0, 0, 0, 0])
    prompt.diagram.GetInputPort("F_Bo_B").FixValue(prompt.context, F)
    forces = prompt.read(prompt.mix, "thruster_force")
    np.testing.assert_allclose(thrusters().wrench(jnp.asarray(forces)), F, atol=1e-12)


def test_a_step_is_followed_with_the_time_constant(slow):
    F = np.array([20.0, 0, 5, 0, 0, 1])
    for time in (0.15, 0.45):
        # An update at t covers [t, t + period): half a period later the state is that of its end.
        got = slow(F, time - 0.005)
        np.testing.assert_allclose(got, (1 - np.exp(-time / 0.15)) * F, rtol=1e-9, atol=1e-9)


def test_a_low_battery_gives_less(prompt):
    F = np.array([40.0, 0, 0, 0, 0, 0])
    full, low = prompt(F, 0.02, voltage=16.0), prompt(F, 0.02, voltage=12.0)
    assert 0.5 * full[0] < low[0] < 0.9 * full[0]


def test_the_voltage_sags_under_load():
    chain = Chain(nominal_voltage=16.0, resistance=0.02)
    F = np.array([60.0, 0, 0, 0, 0, 0])
    weak = chain(F, 0.02)
    loaded = chain.read(chain.bank, "voltage_loaded")[0]
    assert 12 < loaded < 15.9
    assert weak[0] < 60
    chain(np.zeros(6), 0.02)
    np.testing.assert_allclose(chain.read(chain.bank, "voltage_loaded"), [16.0])


def test_a_start_from_rest_takes_its_pause():
    chain = Chain(nominal_voltage=16.0, start_delay=0.1)
    F = np.array([20.0, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(chain(F, 0.085), np.zeros(6))
    np.testing.assert_allclose(chain(F, 0.125), F, atol=1e-9)


def test_without_commands_the_thrusters_stand_still():
    bank = ThrusterBank(thrusters())
    simulator = Simulator(bank)
    simulator.AdvanceTo(0.1)
    wrench = read(bank, "F_Bo_B", simulator.get_context())
    np.testing.assert_array_equal(wrench, np.zeros(6))


def test_a_wrench_that_is_not_a_number_is_refused(prompt):
    with pytest.raises(FloatingPointError, match=r"wrench at t = 0\.0000 s is not finite"):
        prompt(np.full(6, np.nan), 0.1)


def test_impossible_settings_are_refused():
    with pytest.raises(ValueError, match="period"):
        ThrusterBank(thrusters(), 0.0)
    with pytest.raises(ValueError, match="voltage"):
        ThrustAllocation(thrusters(), -1.0)
