"""The filter in its system: ports, timing, the closed chain of plant, sensors and filter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diagrams import add_randomness, check_reproducible, connect, read, seeded
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder

from spinndrift.models import se3
from spinndrift.models.config.errors import UserError
from spinndrift.models.sensors import SHIPPED, DepthSensor, Dvl
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.estimation.config import EkfConfig
from spinndrift.systems.estimation.ekf import Ekf
from spinndrift.systems.estimation.state import Readings, status_names
from spinndrift.systems.plant.learned_plant import LearnedPlant
from spinndrift.systems.plant.sensor_suite import SensorSuite

X0 = np.array([1.0, 0, 0, 0, 0, 0, -3])
PORTS = tuple(SHIPPED)
STATUS = status_names(PORTS[1:])


def swimming(noise: bool = True) -> Diagram:
    """A vehicle pushed along a curve, its sensors and the filter."""
    builder = DiagramBuilder()
    b = [0.1, 0.1, 0.1, 0.01, 0.01, 0.01] if noise else np.zeros(6)
    dynamics = load_vehicle("bluerov2_heavy").dynamics(np.array(b))
    plant = builder.AddNamedSystem("plant", LearnedPlant(dynamics, X0_WB=X0))
    suite = builder.AddNamedSystem("sensors", SensorSuite())
    connect(builder, plant, suite, "X_WB", "V_WB_B", "A_WB_B")
    ekf = builder.AddNamedSystem("ekf", Ekf(X0_WB=X0))
    connect(builder, suite, ekf, *PORTS)
    exported = [(plant, "X_WB"), (plant, "V_WB_B")]
    exported += [(ekf, name) for name in ("X_WB", "V_WB_B", "covariance", "status")]
    if noise:
        add_randomness(builder, plant, suite, ekf)
    builder.ExportInput(plant.GetInputPort("F_Bo_B"), "F_Bo_B")
    for system, name in exported:
        builder.ExportOutput(system.GetOutputPort(name), f"{system.get_name()} {name}")
    return builder.Build()


def push(diagram: Diagram, simulator: Simulator) -> None:
    F = np.array([20.0, 5, -3, 0.1, 0.2, 0.3])
    diagram.GetInputPort("F_Bo_B").FixValue(simulator.get_mutable_context(), F)


def truth_and_estimate(diagram: Diagram, simulator: Simulator, time: float) -> list[np.ndarray]:
    """Pose and twist at `time`, then pose, twist, covariance and status for that time."""
    simulator.AdvanceTo(time)
    context = simulator.get_context()
    truth = [np.asarray(diagram.get_output_port(i).Eval(context)) for i in (0, 1)]
    simulator.AdvanceTo(time + 1e-4)  # past the updates at `time`
    return truth + [np.asarray(diagram.get_output_port(i).Eval(context)) for i in (2, 3, 4, 5)]


@pytest.fixture(scope="module")
def chain() -> Diagram:
    return swimming()


def test_without_noise_the_estimate_is_the_present_truth():
    diagram = swimming(noise=False)  # the filter does not know it
    simulator = Simulator(diagram)
    push(diagram, simulator)
    errors = []
    V = np.zeros(6)
    for n in range(1, 31):
        X, V, X_hat, V_hat, _, _ = truth_and_estimate(diagram, simulator, 0.1 * n)
        pose = np.asarray(se3.local(jnp.asarray(X), jnp.asarray(X_hat)))
        errors.append([np.linalg.norm(e) for e in (pose[:3], pose[3:], (V_hat - V)[:3])])
    assert np.linalg.norm(V[:3]) > 0.3  # it did move
    assert np.all(np.max(errors, axis=0) < [0.01, 0.01, 0.02])


def test_the_system_takes_the_steps_of_the_filter(chain):
    """Reading the ports by hand and calling `step` gives the state of the system."""
    simulator = seeded(chain, 3)
    push(chain, simulator)
    ekf = chain.GetSubsystemByName("ekf")
    suite = chain.GetSubsystemByName("sensors")
    core = ekf.filter
    step = jax.jit(core.step)
    state = ekf.filter_state(ekf.GetMyContextFromRoot(simulator.get_context()))
    for n in range(81):
        context = suite.GetMyContextFromRoot(simulator.get_context())
        shown = [jnp.asarray(read(suite, name, context)) for name in PORTS]
        shown[1] = jnp.concatenate([shown[1][:4], shown[1][6:]])
        state = step(state, Readings(shown[0], tuple(shown[1:])), jnp.asarray(n - 1.0))
        simulator.AdvanceTo((n + 0.5) * core.period)
    final = ekf.filter_state(ekf.GetMyContextFromRoot(simulator.get_context()))
    for a, b in zip(jax.tree.leaves(final), jax.tree.leaves(state), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [7.0, 50.0])
def test_every_reading_of_a_sensor_is_fused_whatever_its_rate(rate):
    """Also if a sensor reads faster than estimates appear, or at odd times."""
    builder = DiagramBuilder()
    depth = DepthSensor(rate=rate)
    suite = builder.AddSystem(SensorSuite({**SHIPPED, "depth": depth}))
    ekf = builder.AddSystem(Ekf({**SHIPPED, "depth": depth}))
    connect(builder, suite, ekf, *PORTS)
    add_randomness(builder, suite)  # readings that repeat to the last bit count as stuck
    diagram = builder.Build()
    simulator = Simulator(diagram)
    ages = []
    for n in range(40, 80):
        simulator.AdvanceTo(0.05 * n + 1e-4)
        status = read(ekf, "status", ekf.GetMyContextFromRoot(simulator.get_context()))
        ages.append(status[STATUS.index("age_depth")])
    assert max(ages) < 1 / rate + 1e-6


def test_estimates_appear_at_their_rate_and_are_held(chain):
    simulator = seeded(chain, 1)
    push(chain, simulator)
    shown = []
    for n in range(40):
        simulator.AdvanceTo((n + 0.5) * 0.01)
        shown.append(read(chain, "ekf X_WB", simulator.get_context()))
    changed = np.any(np.diff(shown, axis=0) != 0, axis=1)
    np.testing.assert_array_equal(np.flatnonzero(changed) + 1, np.arange(5, 40, 5))


@pytest.mark.slow
def test_the_errors_stay_within_their_covariance(chain):
    squares = []
    for seed in range(4):
        simulator = seeded(chain, seed)
        push(chain, simulator)
        X, V, X_hat, V_hat, P, status = truth_and_estimate(chain, simulator, 8.0)
        P = P.reshape(18, 18)
        np.testing.assert_array_equal(P, P.T)
        assert np.linalg.eigvalsh(P)[0] > 0
        pose = np.asarray(se3.local(jnp.asarray(X_hat), jnp.asarray(X)))
        error = np.concatenate([pose, V[:3] - V_hat[:3]])
        squares.append(error @ np.linalg.solve(P[:9, :9], error))
        status = dict(zip(STATUS, status, strict=True))
        assert status["time"] == pytest.approx(8.0 - 0.25)
        assert status["age_depth"] < 0.2
    # Mean of four chi-square numbers of 9 degrees of freedom: 9 ± 2.1. The bound is 5 sigma.
    assert np.mean(squares) < 20


def test_the_initial_error_is_drawn_from_the_noise_port():
    config = EkfConfig()
    ekf = Ekf(config=config, X0_WB=X0)
    simulator = Simulator(ekf)
    context = simulator.get_mutable_context()
    ekf.GetInputPort("initial_noise").FixValue(context, np.arange(1.0, 10))
    simulator.Initialize()
    X = read(ekf, "X_WB", context)
    error = np.asarray(se3.local(jnp.asarray(X0), jnp.asarray(X)))
    std = np.array([*config.position_std, *config.attitude_std])
    np.testing.assert_allclose(error, std * np.arange(1, 7), rtol=1e-9)
    V = read(ekf, "V_WB_B", context)
    np.testing.assert_allclose(V[:3], np.array(config.velocity_std) * np.arange(7, 10))


def test_impossible_settings_are_refused():
    with pytest.raises(UserError, match="give a rate that divides the IMU's 100 Hz"):
        Ekf(config=EkfConfig(output_rate=30.0))
    with pytest.raises(UserError, match=r"EkfConfig\.horizon.*0\.22 s"):
        Ekf(config=EkfConfig(horizon=0.1))
    with pytest.raises(UserError, match=r"Dvl\.noise"):
        Ekf({**SHIPPED, "dvl": Dvl(noise=0.0)})
    with pytest.raises(UserError, match=r"EkfConfig\.gate"):
        EkfConfig(gate=1.0)


def test_same_seed_same_bits(chain):
    def build():
        builder = DiagramBuilder()
        station = builder.AddSystem(swimming())
        for i in range(station.num_output_ports()):
            builder.ExportOutput(station.get_output_port(i))
        return builder.Build()

    check_reproducible(build, end=0.6)


def test_filters_share_programs_wherever_they_start_and_no_others():
    names = ("_start", "_take_in", "_move", "_fuse", "_show")

    def keys(ekf: Ekf) -> list:
        return [getattr(ekf, name)._key() for name in names]

    first = keys(Ekf())
    assert all(isinstance(key, tuple) for key in first)  # known, not the functions themselves
    assert keys(Ekf(X0_WB=X0, V0_WB_B=np.full(6, 0.1))) == first
    other = keys(Ekf(SHIPPED | {"depth": DepthSensor(noise=0.5)}))
    assert all(a != b for a, b in zip(first, other, strict=True))
