"""A station and a controller in one diagram, with a log of every signal."""

from collections.abc import Callable, Container, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from pydrake.common import RandomGenerator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, System
from pydrake.systems.primitives import VectorLogSink

from .compiled.network import Port, flatten, holders
from .compiled.signal_log import SignalLog, add_log
from .controllers.kinds import INPUTS, TOLD, Controller, Goal
from .mavlink.config import Mavlink
from .station.config import StationConfig
from .station.ports import CHEATS, default_log_periods
from .station.simulated import check_stand_in, make_station

CONTROLLER_PERIODS: Mapping[str, float] = {
    "F_Bo_B": 0.05,
    "F_bias_Bo_W": 0.2,
    "plan": 0.2,
    "samples": 0.2,
    "figures": 0.2,
}
"""How often each output port of a controller is logged (s); others are not."""
_SAME = 1e-6  # s


class Signal(NamedTuple):
    """The logged samples of a port."""

    time: Float[np.ndarray, " n"]
    value: Float[np.ndarray, "n size"]


def build_diagram(
    station: StationConfig,
    controller: Controller,
    *,
    hardware: bool = False,
    log_periods: Mapping[str, float] | None = None,
    extend: Callable[[DiagramBuilder, System, System], Any] | None = None,
    goal: Goal = None,
    stand_in: System | None = None,
    link: Mavlink | None = None,
) -> Diagram:
    """Close the loop: subsystems `station`, `controller`, and a log `log_<port>` of each port.

    A row of the logs is one instant for all ports (`systems.compiled.signal_log`): the results of
    the updates at t, together with the truth at t. The truth is the output of systems that hold the
    state behind one of the station's ports `CHEATS`. `log_periods` are those of the logged
    ports (s); if left out, the table's (`station.ports`) and `CONTROLLER_PERIODS`.

    `extend(builder, station, controller)` may add more, a visualiser say, before the diagram is
    built. The diagram has no input ports; its randomness comes from sources inside (`seeded`).

    `goal` (m, W) is passed to a user-defined controller (`Own`). `stand_in`, if given, replaces the
    station: the playback of a recording, another simulator. Its input is `F_Bo_B`, its outputs are
    `X_WB` and `V_WB_B`; its further outputs of `station_ports` are logged as well.

    With `hardware` the station is a vehicle's, used as `link` says, and a planner runs beside the
    loop (`sims.run.flight`). Without a horizontal sensor a controller may hold attitude and depth.

    Raises:
        UserError: a configuration names what can't be read, or controller or stand-in lack a port.

    Example:
        >>> scenario = load_scenario("trajectory_tracking_calm")
        >>> diagram = build_diagram(scenario.station, scenario.controller)
    """
    builder = DiagramBuilder()
    if stand_in is None:
        plant = builder.AddNamedSystem("station", make_station(station, hardware, link=link))
    else:
        check_stand_in(stand_in, station)
        plant = builder.AddNamedSystem("station", stand_in)
    told = hardware and link is not None and link.estimate == "autopilot"
    if hardware:
        controller = controller.beside_the_loop()
    if not (station.sensing.horizontal or told or stand_in):
        controller = controller.without_position(station) or controller
    control = controller.add_to(builder, station, goal)
    for name in (*INPUTS, *TOLD):
        if name in INPUTS or (plant.HasOutputPort(name) and control.HasInputPort(name)):
            builder.Connect(plant.GetOutputPort(name), control.GetInputPort(name))
    builder.Connect(control.GetOutputPort("F_Bo_B"), plant.GetInputPort("F_Bo_B"))
    periods = log_periods
    if periods is None:
        periods = {**default_log_periods(station), **CONTROLLER_PERIODS}
    _add_logs(builder, plant, control, periods)
    if extend is not None:
        extend(builder, plant, control)
    diagram = builder.Build()
    diagram.set_name("closed_loop")
    return diagram


def _add_logs(
    builder: DiagramBuilder, plant: System, control: System, periods: Mapping[str, float]
) -> None:
    truth = _truth(plant, control)
    for system in (plant, control):
        for i in range(system.num_output_ports()):
            port = system.get_output_port(i)
            name = port.get_name()
            if name in periods:
                add_log(builder, port, name, periods[name], (system, i) in truth)


def seeded(diagram: Diagram, context: Context, seed: int) -> None:
    """Draw all random state of a diagram's context from one seed; equal seeds give equal runs.

    Example:
        >>> scenario = load_scenario("trajectory_tracking_calm")
        >>> diagram = build_diagram(scenario.station, scenario.controller)
        >>> seeded(diagram, diagram.CreateDefaultContext(), seed=3)
    """
    diagram.SetRandomContext(context, RandomGenerator(seed))


def logged(
    diagram: Diagram,
    context: Context,
    names: Container[str] | None = None,
    since: float = 0.0,
) -> dict[str, Signal]:
    """All logs of a closed loop by the port's name, up to the last row that all of them have.

    After `AdvanceTo(t)` the updates of t are still pending, and so is its row. A Drake log that
    `extend` has added under a name `log_…` is returned unchanged. `names` are those to return, if
    not all; rows before `since` (s) are left out.

    Example:
        >>> scenario = load_scenario("trajectory_tracking_calm")
        >>> simulator = Simulator(build_diagram(scenario.station, scenario.controller))
        >>> simulator.AdvanceTo(0.5).reason().name
        'kReachedBoundaryTime'
        >>> logged(simulator.get_system(), simulator.get_context())["X_WB"].value.shape
        (10, 7)
    """
    found: dict[str, Any] = {
        system.get_name().removeprefix("log_"): system
        for system in diagram.GetSystems()
        if isinstance(system, SignalLog | VectorLogSink) and system.get_name().startswith("log_")
    }
    periods = {name: log.period for name, log in found.items() if isinstance(log, SignalLog)}
    rows = {name: log.FindLog(context) for name, log in found.items()}
    times = {name: log.sample_times() for name, log in rows.items()}
    ends = [times[n][-1] + period if times[n].size else 0.0 for n, period in periods.items()]
    end = min(ends, default=0.0) - min(periods.values(), default=0.0) / 2
    signals = {}
    for name, t in times.items():
        if names is not None and name not in names:
            continue
        first = int(np.searchsorted(t, since - _SAME))
        last = int(np.searchsorted(t, end)) if name in periods else t.size
        own = isinstance(found[name], SignalLog)
        values = rows[name].data(first) if own else rows[name].data()[:, first:]
        signals[name] = Signal(t[first:last].copy(), values[:, : last - first].T.copy())
    return signals


def _truth(station: System, controller: System) -> set[Port]:
    """The output ports of both that depend on the state of a system behind one of `CHEATS`."""
    wires: dict[Port, Port] = {}
    flat = {system: flatten(system, wires) for system in (station, controller)}
    for source, reader in ((station, controller), (controller, station)):
        for i in range(source.num_output_ports()):
            name = source.get_output_port(i).get_name()
            if reader.HasInputPort(name):
                for port in flat[reader].feeds[int(reader.GetInputPort(name).get_index())]:
                    wires[port] = flat[source].shown[i]
    behind = {
        (system, i): holders(port, wires)
        for system in (station, controller)
        for i, port in enumerate(flat[system].shown)
    }
    true = set()
    for cheat in CHEATS:
        if station.HasOutputPort(cheat.name):
            true |= behind[station, int(station.GetOutputPort(cheat.name).get_index())]
    return {port for port, found in behind.items() if found & true}
