"""Simulated time per time of the diagram without controller and planner, part by part."""

import jax
import numpy as np
import pytest
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import RandomSource

from spinndrift.models.disturbances import preset
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.estimation.ekf import Ekf
from spinndrift.systems.plant.allocation import ThrustAllocation
from spinndrift.systems.plant.disturbance_source import DisturbanceSource
from spinndrift.systems.plant.learned_plant import LearnedPlant
from spinndrift.systems.plant.sensor_suite import SensorSuite

SIMULATED = 2.0


@pytest.fixture(autouse=True)
def _settings():
    """What the command line sets at its start."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def build(parts: set[str]) -> Simulator:
    """A diagram of the named parts at 100 Hz, after 0.5 s."""
    vehicle = load_vehicle("bluerov2_heavy")
    builder = DiagramBuilder()
    thrusters = vehicle.thrusters() if "thrusters" in parts else None
    dynamics = vehicle.dynamics(np.full(6, 0.1))
    body = LearnedPlant(dynamics, X0_WB=[1, 0, 0, 0, 0, 0, -2], thrusters=thrusters)
    plant = builder.AddNamedSystem("plant", body)
    systems = [plant]
    links = []
    if "disturbance" in parts:
        water = builder.AddNamedSystem("water", DisturbanceSource(preset("harbour")))
        systems.append(water)
        links += [(plant, "X_WB", water), (plant, "V_WB_B", water)]
        links += [(water, "F_disturbance_Bo_B", plant), (water, "flow_W", plant)]
    if "sensors" in parts:
        sensors = builder.AddNamedSystem("sensors", SensorSuite())
        systems.append(sensors)
        links += [(plant, name, sensors) for name in ("X_WB", "V_WB_B", "A_WB_B")]
        if "ekf" in parts:
            ekf = builder.AddNamedSystem("ekf", Ekf(X0_WB=[1, 0, 0, 0, 0, 0, -2]))
            systems.append(ekf)
            links += [(sensors, name, ekf) for name in ("imu", "dvl", "depth", "compass")]
    if thrusters is not None:
        allocation = builder.AddNamedSystem("mix", ThrustAllocation(thrusters))
        links.append((allocation, "pwm", plant))
        source = builder.AddNamedSystem(
            "command", RandomSource(RandomDistribution.kGaussian, 6, 0.02)
        )
        builder.Connect(source.get_output_port(), allocation.GetInputPort("F_Bo_B"))
    for source, name, sink in links:
        builder.Connect(source.GetOutputPort(name), sink.GetInputPort(name))
    for system in systems:
        for i in range(system.num_input_ports()):
            port = system.get_input_port(i)
            if port.get_name() in ("noise", "initial_noise"):
                period = 1e6 if port.get_name() == "initial_noise" else 0.01
                random = builder.AddSystem(
                    RandomSource(RandomDistribution.kGaussian, port.size(), period)
                )
                builder.Connect(random.get_output_port(), port)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    diagram.SetRandomContext(simulator.get_mutable_context(), RandomGenerator(1))
    simulator.Initialize()
    simulator.AdvanceTo(0.5)
    return simulator


@pytest.mark.parametrize(
    "parts",
    [
        "plant",
        "plant disturbance",
        "plant sensors",
        "plant sensors ekf",
        "plant thrusters",
        "plant disturbance sensors ekf thrusters",
    ],
)
def test_diagram(benchmark, parts):
    simulator = build(set(parts.split()))

    def advance():
        simulator.AdvanceTo(simulator.get_context().get_time() + SIMULATED)

    benchmark.pedantic(advance, rounds=5)
    benchmark.extra_info["times real time"] = SIMULATED / benchmark.stats["min"]
