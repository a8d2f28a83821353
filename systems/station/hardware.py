"""The station of a vehicle: its driver in place of plant, thrusters, water and sensors."""

from pydrake.systems.framework import Diagram, DiagramBuilder, System

from ..mavlink.config import Mavlink
from ..mavlink.interface import VehicleInterface
from .config import StationConfig
from .parts import check_filter, configured_filter, export_reported
from .ports import ESTIMATES, station_ports


def hardware_station(
    config: StationConfig, link: Mavlink | None = None, estimator: System | None = None
) -> Diagram:
    """The station of a vehicle, with the subsystems `vehicle` and, for an own estimate, `ekf`.

    `vehicle` is a `VehicleInterface`: its `begin` takes the driver. With `estimate: autopilot` in
    `link` the autopilot's estimate is exported; it has no covariance.

    Raises:
        UserError: a part of the configuration names what can't be read, or the estimator lacks a
            port.
    """
    sensors = config.sensing.sensors
    sizes = station_ports(config)[1]
    thrusters = config.load_vehicle().thrusters().positions.shape[1]
    builder = DiagramBuilder()
    own = estimator is not None or link is None or link.estimate == "own"
    interface = VehicleInterface(
        sensors,
        thrusters,
        sizes["health"],
        autopilot=not own,
        imu_latency=config.sensing.ekf.imu_latency,
    )
    vehicle = builder.AddNamedSystem("vehicle", interface)
    suffix, ekf = "_autopilot", vehicle
    if own:
        suffix, ekf = "", builder.AddNamedSystem("ekf", estimator or configured_filter(config))
        check_filter(ekf, config)
        for name in (*sensors, "pwm"):
            if ekf.HasInputPort(name):
                builder.Connect(vehicle.GetOutputPort(name), ekf.GetInputPort(name))
    for name in ("X_WB", "health"):
        if ekf.HasOutputPort(name + suffix):
            builder.Connect(ekf.GetOutputPort(name + suffix), vehicle.GetInputPort(name))
    builder.ExportInput(vehicle.GetInputPort("F_Bo_B"), "F_Bo_B")
    for port in ESTIMATES:
        builder.ExportOutput(ekf.GetOutputPort(port.name + suffix), port.name)
    for name in (*sensors, "pwm"):
        builder.ExportOutput(vehicle.GetOutputPort(name), name)
    export_reported(builder, ekf, config, suffix)
    diagram = builder.Build()
    diagram.set_name("station")
    return diagram
