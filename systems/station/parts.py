"""What the simulated station and that of a vehicle share: noise, the filter, exported ports."""

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import RandomSource

from ..drake import constant
from ..estimation.ekf import Ekf
from ..own import check_ports
from .config import StationConfig
from .ports import ESTIMATES, REPORTED, station_ports


def add_noise(builder: DiagramBuilder, system: System, name: str, period: float) -> None:
    """Feed a system's noise port, unless it is empty, with unit Gaussians every `period` (s)."""
    port = system.GetInputPort(name)
    if port.size() == 0:
        return
    source = RandomSource(RandomDistribution.kGaussian, port.size(), period)
    builder.AddNamedSystem(f"{system.get_name()}_{name}", source)
    builder.Connect(source.get_output_port(), port)


def configured_filter(config: StationConfig) -> System:
    """The configured filter."""
    s, (X0, V0) = config.sensing, config.initial_state()
    if s.filter is None:
        return Ekf(s.sensors, s.ekf, X0, V0)
    return s.filter.make(
        {
            **{name: lambda sensor=sensor: sensor for name, sensor in s.sensors.items()},
            "vehicle": config.load_vehicle,
            "X0_WB": lambda: X0,
            "V0_WB_B": lambda: V0,
            "station": lambda: config,
        }
    )


def check_filter(ekf: System, config: StationConfig) -> None:
    """Check that a filter has the ports of a station's.

    Raises:
        UserError: it lacks a port, or a port has another size.
    """
    sizes = station_ports(config)[1]
    needed, reported = ({port.name: sizes[port.name] for port in x} for x in (ESTIMATES, REPORTED))
    offered = {name: sizes[name] for name in (*config.sensing.sensors, "pwm")}
    check_ports("filter", ekf, ({}, needed), (offered, reported))


def export_reported(
    builder: DiagramBuilder, ekf: System, config: StationConfig, suffix: str = ""
) -> None:
    """Export what a filter may leave out: NaN then, and good health.

    `suffix` is that of the names of its ports.
    """
    sizes = station_ports(config)[1]
    for port in REPORTED:
        if ekf.HasOutputPort(port.name + suffix):
            builder.ExportOutput(ekf.GetOutputPort(port.name + suffix), port.name)
        else:
            size = sizes[port.name]
            value = [0.0, *[1.0] * (size - 1)] if port.name == "health" else [np.nan] * size
            unknown = builder.AddNamedSystem(f"no_{port.name}", constant(value))
            builder.ExportOutput(unknown.get_output_port(), port.name)
