import jax.numpy as jnp
import numpy as np
import pytest
from diagrams import add_randomness, check_reproducible, connect, read, seeded
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder

from spinndrift.models import se3
from spinndrift.models.rigid_body import FossenDynamics, spatial_inertia
from spinndrift.models.sensors import SHIPPED, Compass, DepthSensor, Dvl, Imu
from spinndrift.systems.plant.learned_plant import LearnedPlant
from spinndrift.systems.plant.sensor_suite import SensorSuite

PORTS = tuple(SHIPPED)
X = np.asarray(se3.from_position_rpy(jnp.array([1.0, 2, -3]), jnp.array([0.1, -0.2, 0.7])))
V = np.array([0.5, -0.2, 0.1, 0.2, -0.1, 0.3])
A = np.array([0.1, 0.2, -0.3, 0.4, -0.5, 0.6])


def diagram() -> Diagram:
    """A tumbling vehicle with its default sensors."""
    body = FossenDynamics(
        rigid_inertia=spatial_inertia(11.5, np.zeros(3), np.diag([0.26, 0.23, 0.37])),
        added_mass=np.zeros((6, 6)),
        linear_drag=np.eye(6),
        quadratic_drag=np.eye(6),
        weight=112.8,
        buoyancy=114.8,
        p_BoBcm_B=np.zeros(3),
        p_BoCb_B=np.array([0, 0, 0.02]),
    )
    builder = DiagramBuilder()
    plant = builder.AddSystem(LearnedPlant(body, X0_WB=X, V0_WB_B=V))
    sensors = builder.AddSystem(SensorSuite())
    connect(builder, plant, sensors, "X_WB", "V_WB_B", "A_WB_B")
    add_randomness(builder, plant, sensors)
    for name in PORTS:
        builder.ExportOutput(sensors.GetOutputPort(name), name)
    return builder.Build()


@pytest.fixture(scope="module")
def history() -> dict[str, np.ndarray]:
    """What a reader with the IMU's period sees for 6 s, sample by sample."""
    station = diagram()
    simulator = seeded(station, 5)
    rows = {name: [] for name in PORTS}
    for n in range(600):
        simulator.AdvanceTo((n + 0.5) * 0.01)
        for name in PORTS:
            rows[name].append(read(station, name, simulator.get_context()))
    return {name: np.stack(values) for name, values in rows.items()}


def still(sensors: SensorSuite, time: float) -> dict[str, np.ndarray]:
    """Outputs at `time` for a constant motion and no noise."""
    simulator = Simulator(sensors)
    for name, value in (("X_WB", X), ("V_WB_B", V), ("A_WB_B", A)):
        sensors.GetInputPort(name).FixValue(simulator.get_mutable_context(), value)
    simulator.AdvanceTo(time)
    return {name: read(sensors, name, simulator.get_context()) for name in PORTS}


def test_without_noise_the_readings_are_the_expected_ones():
    imu = Imu(position=(0.1, 0.2, -0.1), rpy=(0.1, 0.2, 0.3), integrating=False)
    dvl = Dvl(dropout_share=0.0, outlier_share=0.0)
    depth, compass = DepthSensor(), Compass()
    on_board = {"imu": imu, "dvl": dvl, "depth": depth, "compass": compass}
    shown = still(SensorSuite(on_board), 1.05)
    x, v, a = jnp.asarray(X), jnp.asarray(V), jnp.asarray(A)
    np.testing.assert_allclose(shown["imu"], imu.expected(x, v, a), rtol=1e-12)
    np.testing.assert_allclose(shown["dvl"][:4], [*dvl.expected(v), 1], rtol=1e-12)
    np.testing.assert_allclose(shown["depth"], [*depth.expected(x), 1, 1.0], rtol=1e-12)
    np.testing.assert_allclose(shown["compass"], [*compass.expected(x), 1, 1.0], rtol=1e-12)


def test_nothing_is_valid_before_the_first_measurement():
    sensors = SensorSuite()
    simulator = Simulator(sensors)
    simulator.Initialize()
    for name, mark in (("dvl", 3), ("depth", 1), ("compass", 1)):
        assert read(sensors, name, simulator.get_context())[mark] == 0


def test_every_sensor_keeps_its_rate_and_holds_between(history):
    rates = {"imu": 100, "depth": 10, "compass": 10}
    for name, rate in rates.items():
        changed = np.any(np.diff(history[name], axis=0) != 0, axis=1)
        at = np.flatnonzero(changed) + 1
        np.testing.assert_array_equal(at, np.arange(100 // rate, 600, 100 // rate))
    for name in ("depth", "compass"):  # the time is that of the measurement
        np.testing.assert_allclose(history[name][:, 2], np.arange(600) // 10 * 0.1, atol=1e-9)


def test_the_dvl_is_late_by_its_latency_and_says_so(history):
    dvl = Dvl()
    validity = history["dvl"][:, 6]
    assert set(np.round(validity, 9)) <= set(np.round(np.arange(0, 6, 0.2), 9))
    appeared = np.flatnonzero(np.diff(validity) > 0) + 1
    late = appeared * 0.01 - validity[appeared]
    assert len(appeared) > 25
    assert np.all(late >= dvl.earliest_latency - 1e-9)
    assert np.all(late <= dvl.latest_latency + 0.01 + 1e-9)
    assert late.std() > 0.01
    # An invalid reading shows no velocity.
    bad = history["dvl"][:, 3] == 0
    np.testing.assert_array_equal(history["dvl"][bad, :3], 0)


def test_biases_are_drawn_at_the_start():
    imu, depth = Imu(accelerometer_bias=1.0), DepthSensor(offset_std=0.5)
    sensors = SensorSuite({**SHIPPED, "imu": imu, "depth": depth})
    simulator = Simulator(sensors)
    context = simulator.get_mutable_context()
    sensors.GetInputPort("X_WB").FixValue(context, X)
    w = np.arange(1.0, 1 + sensors.GetInputPort("initial_noise").size())
    sensors.GetInputPort("initial_noise").FixValue(context, w)
    simulator.AdvanceTo(0.0)
    simulator.AdvanceTo(0.05)
    gravity = np.asarray(se3.rotate_inverse(jnp.asarray(X), jnp.array([0, 0, 9.80665])))
    force = read(sensors, "imu", context)[:3]
    np.testing.assert_allclose(force, gravity + w[:3], rtol=1e-12)
    offset = read(sensors, "depth", context)[0]
    expected = DepthSensor().expected(jnp.asarray(X))[0] + 0.5 * w[6 + 2]
    np.testing.assert_allclose(offset, expected, rtol=1e-12)


def test_same_seed_same_bits():
    check_reproducible(diagram)
