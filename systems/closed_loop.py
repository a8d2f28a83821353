"""A station and a controller in one diagram, with a log of every signal."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from pydrake.common import RandomGenerator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import LogVectorOutput, VectorLogSink

from .controllers import Controller
from .station import make_station
from .station_config import StationConfig

LOG_PERIODS: Mapping[str, float] = {
    "X_WB": 0.05,
    "V_WB_B": 0.05,
    "covariance": 0.2,
    "imu": 0.05,
    "dvl": 0.2,
    "depth": 0.1,
    "compass": 0.1,
    "pwm": 0.05,
    "status": 0.2,
    "X_WB_cheat": 0.05,
    "V_WB_B_cheat": 0.05,
    "F_disturbance_cheat": 0.05,
    "flow_cheat": 0.05,
    "F_Bo_B": 0.05,
    "F_bias_Bo_W": 0.2,
    "plan": 0.2,
    "samples": 0.2,
    "figures": 0.2,
}
"""How often each output port of station and controller is logged (s); others are not."""


class Signal(NamedTuple):
    """What was logged of a port."""

    time: Float[np.ndarray, " n"]
    value: Float[np.ndarray, "n size"]


def build_diagram(
    station: StationConfig,
    controller: Controller,
    *,
    hardware: bool = False,
    log_periods: Mapping[str, float] = LOG_PERIODS,
    extend: Callable[[DiagramBuilder, System, System], Any] | None = None,
) -> Diagram:
    """Close the loop: subsystems `station`, `controller`, and a log `log_<port>` of each port.

    `extend(builder, station, controller)` may add more, a visualiser say, before the diagram is
    built. The diagram has no input ports; its randomness comes from sources inside (`seeded`).

    Raises:
        UserError: a configuration names what can't be read, or the controller lacks a port.
        NotImplementedError: hardware is asked for.
    """
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("station", make_station(station, hardware))
    control = controller.add_to(builder, station)
    for name in ("X_WB", "V_WB_B"):
        builder.Connect(plant.GetOutputPort(name), control.GetInputPort(name))
    builder.Connect(control.GetOutputPort("F_Bo_B"), plant.GetInputPort("F_Bo_B"))
    for name, port in _ports(plant, control).items():
        if name in log_periods:
            LogVectorOutput(port, builder, log_periods[name]).set_name(f"log_{name}")
    if extend is not None:
        extend(builder, plant, control)
    diagram = builder.Build()
    diagram.set_name("closed_loop")
    return diagram


def seeded(diagram: Diagram, context: Context, seed: int) -> None:
    """Draw all random state of a diagram's context from one seed; equal seeds give equal runs."""
    diagram.SetRandomContext(context, RandomGenerator(seed))


def logged(diagram: Diagram, context: Context) -> dict[str, Signal]:
    """All logs of a closed loop by the port's name."""
    signals = {}
    for system in diagram.GetSystems():
        if isinstance(system, VectorLogSink) and system.get_name().startswith("log_"):
            log = system.FindLog(context)
            signals[system.get_name().removeprefix("log_")] = Signal(
                log.sample_times().copy(), log.data().T.copy()
            )
    return signals


def _ports(*systems: System) -> dict[str, OutputPort]:
    ports = [s.get_output_port(i) for s in systems for i in range(s.num_output_ports())]
    return {port.get_name(): port for port in ports}
