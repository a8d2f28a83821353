"""The simulated station: everything between the commanded wrench and the estimated state."""

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Diagram, DiagramBuilder, System
from pydrake.systems.primitives import ConstantVectorSource, RandomSource

from ..estimation.ekf import Ekf
from ..own import check_ports
from ..plant.allocation import ThrustAllocation
from ..plant.disturbance_source import DisturbanceSource
from ..plant.learned_plant import LearnedPlant
from ..plant.sensor_suite import SensorSuite
from .config import StationConfig

INPUTS = {"F_Bo_B": 6}
"""Input ports and their sizes: the commanded wrench."""

OUTPUTS = {
    "X_WB": 7,
    "V_WB_B": 6,
    "covariance": 324,
    "imu": 6,
    "dvl": 7,
    "depth": 3,
    "compass": 3,
    "pwm": 8,
    "status": 10,
    "health": 5,
}
"""Output ports and their sizes, in simulation and on hardware: estimates, readings, commands."""

CHEATS = {
    "X_WB_cheat": 7,
    "V_WB_B_cheat": 6,
    "F_disturbance_cheat": 6,
    "flow_cheat": 6,
}
"""Output ports that only a simulation has: the truth."""

_NEEDED = {"X_WB": 7, "V_WB_B": 6}
_TOLD = {"covariance": 324, "status": 10, "health": 5}
_READ = {"imu": 6, "dvl": 7, "depth": 3, "compass": 3}
_NEVER = 1e9  # period (s) of noise that is drawn once
_WATER = 2  # periods of the plant per step of the water: waves have periods of seconds


def station_ports(hardware: bool = False) -> tuple[dict[str, int], dict[str, int]]:
    """Names and sizes of a station's input and output ports."""
    return dict(INPUTS), OUTPUTS | ({} if hardware else CHEATS)


def make_station(
    config: StationConfig, hardware: bool = False, estimator: System | None = None
) -> Diagram:
    """A diagram with `station_ports(hardware)`.

    In simulation: allocation, plant with thrusters, disturbances, sensors and filter, as subsystems
    `allocation`, `plant`, `disturbances`, `sensors` and `ekf`. All noise comes from random sources
    inside, which `SetRandomContext` seeds. `estimator`, if given, replaces the configured filter;
    `systems.own.OwnFilter` lists the ports it may have.

    Raises:
        NotImplementedError: `hardware` is true.
        UserError: a part of the configuration names what can't be read, or the estimator lacks a
            port.
    """
    if hardware:
        raise NotImplementedError(
            "this version has no link to a vehicle; build the station with hardware=False"
        )
    return _simulated(config, estimator)


def check_stand_in(system: System) -> None:
    """Check that a system can stand in for a station.

    Raises:
        UserError: it lacks `F_Bo_B`, `X_WB` or `V_WB_B`, or a port has another size than a
            station's.
    """
    known = {name: size for name, size in (OUTPUTS | CHEATS).items() if name != "pwm"}
    check_ports("station", system, (INPUTS, _NEEDED), ({}, known))


def add_noise(builder: DiagramBuilder, system: System, name: str, period: float) -> None:
    """Feed a system's noise port, unless it is empty, with unit Gaussians every `period` (s)."""
    port = system.GetInputPort(name)
    if port.size() == 0:
        return
    source = RandomSource(RandomDistribution.kGaussian, port.size(), period)
    builder.AddNamedSystem(f"{system.get_name()}_{name}", source)
    builder.Connect(source.get_output_port(), port)


def _simulated(config: StationConfig, estimator: System | None) -> Diagram:
    thrusters = config.load_vehicle().thrusters()
    X0, V0 = config.initial_state()
    s = config.sensing
    water_period = _WATER * config.period
    builder = DiagramBuilder()
    add = builder.AddNamedSystem
    allocation = add("allocation", ThrustAllocation(thrusters, config.voltage))
    body = LearnedPlant(config.dynamics(), config.period, config.substeps, X0, V0, thrusters)
    plant = add("plant", body)
    water = add("disturbances", DisturbanceSource(config.disturbance(), water_period))
    sensors = add("sensors", SensorSuite(s.imu, s.dvl, s.depth, s.compass, s.faults))
    ekf = add("ekf", estimator or _filter(config))
    commands = {"pwm": allocation.GetOutputPort("pwm").size()}
    check_ports("filter", ekf, ({}, _NEEDED), (_READ | commands, _TOLD))

    def connect(source, output: str, target, name: str | None = None) -> None:
        builder.Connect(source.GetOutputPort(output), target.GetInputPort(name or output))

    connect(allocation, "pwm", plant)
    connect(water, "F_disturbance_Bo_B", plant)
    connect(water, "flow_W", plant)
    for reader, seen in ((water, ""), (sensors, "_seen")):
        connect(plant, f"X_WB{seen}", reader, "X_WB")
        connect(plant, f"V_WB_B{seen}", reader, "V_WB_B")
    connect(plant, "A_WB_B", sensors)
    for source, names in ((sensors, _READ), (allocation, ("pwm",))):
        for name in names:
            if ekf.HasInputPort(name):
                connect(source, name, ekf)
    nominal = float(thrusters.nominal_voltage)
    volts = nominal if config.voltage is None else config.voltage
    battery = add("battery", ConstantVectorSource([volts]))
    builder.Connect(battery.get_output_port(), plant.GetInputPort("voltage"))

    add_noise(builder, plant, "noise", config.period)
    add_noise(builder, water, "noise", water_period)
    add_noise(builder, sensors, "noise", 1 / s.imu.rate)
    for system in (water, sensors, ekf):
        if system.HasInputPort("initial_noise"):
            add_noise(builder, system, "initial_noise", _NEVER)
    if sensors.HasInputPort("fault_noise"):  # last: the other sources keep their seeds
        add_noise(builder, sensors, "fault_noise", 1 / s.imu.rate)

    builder.ExportInput(allocation.GetInputPort("F_Bo_B"), "F_Bo_B")
    for name in ("X_WB", "V_WB_B"):
        builder.ExportOutput(ekf.GetOutputPort(name), name)
    for name in _READ:
        builder.ExportOutput(sensors.GetOutputPort(name), name)
    builder.ExportOutput(allocation.GetOutputPort("pwm"), "pwm")
    for name, size in _TOLD.items():
        if ekf.HasOutputPort(name):
            builder.ExportOutput(ekf.GetOutputPort(name), name)
        else:
            value = np.array([0.0, 1, 1, 1, 1]) if name == "health" else np.full(size, np.nan)
            untold = add(f"no_{name}", ConstantVectorSource(value))
            builder.ExportOutput(untold.get_output_port(), name)
    builder.ExportOutput(plant.GetOutputPort("X_WB"), "X_WB_cheat")
    builder.ExportOutput(plant.GetOutputPort("V_WB_B"), "V_WB_B_cheat")
    builder.ExportOutput(water.GetOutputPort("F_disturbance_Bo_B"), "F_disturbance_cheat")
    builder.ExportOutput(water.GetOutputPort("flow_W"), "flow_cheat")
    station = builder.Build()
    station.set_name("station")
    return station


def _filter(config: StationConfig) -> System:
    """The configured filter."""
    s, (X0, V0) = config.sensing, config.initial_state()
    if s.filter is None:
        return Ekf(s.imu, s.dvl, s.depth, s.compass, s.ekf, X0, V0)
    return s.filter.make(
        {
            "vehicle": config.load_vehicle,
            "imu": lambda: s.imu,
            "dvl": lambda: s.dvl,
            "depth": lambda: s.depth,
            "compass": lambda: s.compass,
            "X0_WB": lambda: X0,
            "V0_WB_B": lambda: V0,
            "station": lambda: config,
        }
    )
