"""The simulated station: everything between the commanded wrench and the estimated state."""

from pydrake.systems.framework import Diagram, DiagramBuilder, System

from ...models.disturbances import Combined, Surface
from ...models.sensors import Sensor
from ..drake import constant
from ..mavlink.config import Mavlink
from ..own import check_ports
from ..plant.allocation import PulseWidths, ThrustAllocation
from ..plant.disturbance_source import DisturbanceSource
from ..plant.learned_plant import LearnedPlant
from ..plant.sensor_suite import SensorSuite
from .config import Sensing, StationConfig
from .hardware import hardware_station
from .parts import add_noise, check_filter, configured_filter, export_reported
from .ports import CHEATS, ESTIMATES, station_ports

_NEVER = 1e9  # period (s) of noise that is drawn once
_WATER = 2  # periods of the plant per step of the water: waves have periods of seconds


def make_station(
    config: StationConfig,
    hardware: bool = False,
    estimator: System | None = None,
    link: Mavlink | None = None,
) -> Diagram:
    """A diagram with `station_ports(config, hardware)`.

    With `hardware` it is that of a vehicle (`systems.station.hardware`), which `link` says how to
    use; it connects when it is told to begin.

    In simulation: allocation, plant with thrusters, disturbances, sensors and filter, as subsystems
    `allocation`, `plant`, `disturbances`, `sensors` and `ekf`. All noise comes from random sources
    inside, which `SetRandomContext` seeds. `estimator`, if given, replaces the configured filter;
    `systems.own.OwnFilter` lists the ports it may have.

    Raises:
        UserError: a part of the configuration names what can't be read, or the estimator lacks a
            port.

    Example:
        >>> station = make_station(StationConfig(disturbance_set="harbour"))
        >>> station.GetOutputPort("X_WB").size()
        7
    """
    if hardware:
        return hardware_station(config, link, estimator)
    return _simulated(config, estimator)


def make_driven_station(config: StationConfig) -> Diagram:
    """The simulated station with pulse widths as its input `pwm` (µs) in place of `F_Bo_B`.

    Its thrusters have another driver, an autopilot, under which the vehicle may rest for long: its
    water has a surface.

    Raises:
        UserError: as `make_station`.
    """
    return _simulated(config, None, driven=True)


def make_driven_plant(config: StationConfig) -> Diagram:
    """The driven station without sensors and filter: input `pwm`, the cheats as outputs.

    Raises:
        UserError: as `make_station`.
    """
    builder = DiagramBuilder()
    allocation, plant, water = _add_body(builder, config, driven=True)
    add_noise(builder, plant, "noise", config.period)
    add_noise(builder, water, "noise", _WATER * config.period)
    add_noise(builder, water, "initial_noise", _NEVER)
    builder.ExportInput(allocation.get_input_port(0), "pwm")
    _export_truth(builder, plant, water)
    diagram = builder.Build()
    diagram.set_name("plant")
    return diagram


def check_stand_in(system: System, config: StationConfig) -> None:
    """Check that a system can stand in for the station of a configuration.

    Raises:
        UserError: it lacks `F_Bo_B`, `X_WB` or `V_WB_B`, or a port has another size than a
            station's.
    """
    inputs, known = station_ports(config)
    needed = {port.name: known.pop(port.name) for port in ESTIMATES}
    del known["pwm"]
    check_ports("station", system, (inputs, needed), ({}, known))


class StationBuilder:
    """Takes in the sensors of a station: each adds itself by its `add_to`.

    Attributes:
        builder: of the station's diagram.
        measured: the sensors that the `SensorSuite` measures, by the names of their ports.
        systems: those that are Drake systems of their own, by the names of their output ports.
    """

    def __init__(self, builder: DiagramBuilder):
        self.builder = builder
        self.measured: dict[str, Sensor] = {}
        self.systems: dict[str, System] = {}

    def measure(self, name: str, sensor: Sensor) -> None:
        """Let the suite measure a sensor, whose output port gets this name."""
        self.measured[name] = sensor

    def add_system(self, name: str, system: System) -> None:
        """Add a Drake system with an output port of this name.

        Of the inputs X_WB, V_WB_B, A_WB_B (the truth) and `noise` those that it has are connected.
        """
        self.systems[name] = self.builder.AddNamedSystem(name, system)

    def connect(self, source: System, output: str, target: System, name: str = "") -> None:
        """Connect ports by their names, which differ if `name` is given."""
        self.builder.Connect(source.GetOutputPort(output), target.GetInputPort(name or output))

    def add_sensors(self, sensing: Sensing, plant: System) -> dict[str, System]:
        """Add all sensors; return the systems by the names of their output ports."""
        for name, sensor in sensing.sensors.items():
            sensor.add_to(self, name)
        suite = SensorSuite(self.measured, sensing.faults)
        self.builder.AddNamedSystem("sensors", suite)
        for name, system in self.systems.items():
            check_ports("sensor", system, ({}, {name: sensing.sensors[name].port_size}))
        truth = {"X_WB": "X_WB_seen", "V_WB_B": "V_WB_B_seen", "A_WB_B": "A_WB_B"}
        for system in (suite, *self.systems.values()):
            for name, seen in truth.items():
                if system.HasInputPort(name):
                    self.connect(plant, seen, system, name)
        return dict.fromkeys(self.measured, suite) | self.systems


def _add_body(
    builder: DiagramBuilder, config: StationConfig, driven: bool
) -> tuple[System, System, System]:
    """Add allocation, plant, disturbances and battery, connected but for noise and command."""
    vehicle, (X0, V0) = config.load_vehicle(), config.initial_state()
    thrusters, disturbance = vehicle.thrusters(), config.disturbance()
    if driven:
        disturbance = Combined((*disturbance.members, Surface.of(vehicle)))
    add, connect = builder.AddNamedSystem, builder.Connect
    driver = PulseWidths(thrusters) if driven else ThrustAllocation(thrusters, config.voltage)
    allocation = add("allocation", driver)
    body = LearnedPlant(config.dynamics(), config.period, config.substeps, X0, V0, thrusters)
    plant = add("plant", body)
    water = add("disturbances", DisturbanceSource(disturbance, _WATER * config.period))
    nominal = float(thrusters.nominal_voltage)
    battery = add("battery", constant([nominal if config.voltage is None else config.voltage]))
    connect(battery.get_output_port(), plant.GetInputPort("voltage"))
    connect(allocation.GetOutputPort("pwm"), plant.GetInputPort("pwm"))
    for name in ("F_disturbance_Bo_B", "flow_W"):
        connect(water.GetOutputPort(name), plant.GetInputPort(name))
    for name in ("X_WB", "V_WB_B"):
        connect(plant.GetOutputPort(name), water.GetInputPort(name))
    return allocation, plant, water


def _export_truth(builder: DiagramBuilder, plant: System, water: System) -> None:
    truth = ((plant, "X_WB"), (plant, "V_WB_B"), (water, "F_disturbance_Bo_B"), (water, "flow_W"))
    for cheat, (system, name) in zip(CHEATS, truth, strict=True):
        builder.ExportOutput(system.GetOutputPort(name), cheat.name)


def _simulated(config: StationConfig, estimator: System | None, driven: bool = False) -> Diagram:
    builder = DiagramBuilder()
    station, add = StationBuilder(builder), builder.AddNamedSystem
    allocation, plant, water = _add_body(builder, config, driven)
    sensors = station.add_sensors(config.sensing, plant)
    ekf = add("ekf", estimator or configured_filter(config))
    check_filter(ekf, config)

    for name, source in (sensors | {"pwm": allocation}).items():
        if ekf.HasInputPort(name):
            station.connect(source, name, ekf)
    _add_noises(builder, config, sensors, (plant, water, ekf))

    command = allocation.get_input_port(0)
    builder.ExportInput(command, command.get_name())
    estimates = {port.name: ekf for port in ESTIMATES}
    for name, source in (estimates | sensors | {"pwm": allocation}).items():
        builder.ExportOutput(source.GetOutputPort(name), name)
    export_reported(builder, ekf, config)
    _export_truth(builder, plant, water)
    diagram = builder.Build()
    diagram.set_name("station")
    return diagram


def _add_noises(
    builder: DiagramBuilder,
    config: StationConfig,
    sensors: dict[str, System],
    others: tuple[System, System, System],
) -> None:
    """Feed all noise ports; a source's seed is its place in this order."""
    plant, water, ekf = others
    suite, period = sensors["imu"], 1 / config.sensing.imu.rate
    add_noise(builder, plant, "noise", config.period)
    add_noise(builder, water, "noise", _WATER * config.period)
    add_noise(builder, suite, "noise", period)
    for system in (water, suite, ekf):
        if system.HasInputPort("initial_noise"):
            add_noise(builder, system, "initial_noise", _NEVER)
    if suite.HasInputPort("fault_noise"):  # last: the other sources keep their seeds
        add_noise(builder, suite, "fault_noise", period)
    for name, system in sensors.items():
        if system is not suite and system.HasInputPort("noise"):
            add_noise(builder, system, "noise", 1 / config.sensing.sensors[name].rate)
