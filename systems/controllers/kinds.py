"""Controllers by kind: each is a dataclass for YAML that adds itself to a diagram.

A controller is any system with the input ports `X_WB` (7) and `V_WB_B` (6), the estimated state,
and the output port `F_Bo_B` (6), the commanded wrench. An input port `health` receives the health
of the estimate (`systems.estimation.state.health_names`); the controllers here command a zero
wrench while it is lost (`systems.controllers.health_gate`).
"""

import abc
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from pydrake.systems.framework import Diagram, DiagramBuilder, System

from ...models.config.checks import Vector6, check_numbers, require
from ...models.dynamics import Dynamics
from ...models.files.checkpoint import load_model
from ...models.lasting import whitened
from ...models.vehicles.vehicle import load_vehicle
from ..estimation.disturbance_observer import DisturbanceObserver, MomentumObserver
from ..own import OwnSystem, check_ports, port_sizes
from ..planning.beside import MppiBeside, with_free_core
from ..planning.mppi import Mppi
from ..planning.mppi_config import MppiConfig
from ..planning.mppi_core import MppiPlanner
from ..planning.paths import FigureEight, HoldPose, PoseConfig, Waypoints
from ..planning.plan import PlanLayout
from ..planning.reference import Reference
from ..planning.tasks import PylonCrossing, TaskKind
from ..plant.wrench_limits import ThrusterLimits
from ..station.config import StationConfig
from ..station.parts import add_noise
from ..station.ports import station_ports
from .health_gate import HealthGate
from .impedance import Impedance, ImpedanceGains, ImpedanceLaw
from .without_position import WithoutPosition

INPUTS = {"X_WB": 7, "V_WB_B": 6}
"""Input ports of every controller and their sizes."""

TOLD = ("health",)
"""Optional input ports of a controller, connected if the station has them."""

OUTPUTS = {"F_Bo_B": 6}
"""Output ports of every controller and their sizes; it may have more."""


Goal = Float[np.ndarray, "3"] | None
"""Goal position of a run (m, W), if it has one."""


class Controller(abc.ABC):
    """A kind of controller."""

    @abc.abstractmethod
    def build(self, station: StationConfig, goal: Goal = None) -> System:
        """The system for a station, whose vehicle, obstacles and rates it may read.

        `goal` is that of the run, for a controller without a goal of its own.
        """

    def beside_the_loop(self) -> "Controller":
        """The same controller for a loop in real time, which may not wait for its planner."""
        return self

    def without_position(self, station: StationConfig) -> "Controller | None":
        """The same controller for a vehicle that knows attitude and depth alone; None without one.

        A user's own decides by itself what to do with an estimate whose health is lost.
        """
        del station
        return None

    def add_to(self, builder: DiagramBuilder, station: StationConfig, goal: Goal = None) -> System:
        """Add the system to a diagram under the name `controller`.

        Raises:
            UserError: it lacks a port, or a port has another size.
        """
        system = self.build(station, goal)
        sizes = station_ports(station)[1]
        told = {name: sizes[name] for name in TOLD}
        check_ports("controller", system, (INPUTS, OUTPUTS), (told, {}))
        return builder.AddNamedSystem("controller", system)


def _given(controller: Any) -> dict[str, Any]:
    """The values of its fields by their names."""
    return {field.name: getattr(controller, field.name) for field in fields(controller)}


@dataclass(frozen=True)
class ObserverConfig:
    """Settings of the disturbance observer (`systems.estimation.disturbance_observer`).

    Attributes:
        time_constant: of its low-pass (s).
        largest_force: bound of the observed force (N).
        largest_moment: bound of the observed moment (N·m).
        period: between calls (s), that of the state estimates.
    """

    time_constant: float = 1.5
    largest_force: float = 60.0
    largest_moment: float = 5.0
    period: float = 0.05

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        for name in ("time_constant", "largest_force", "largest_moment", "period"):
            require(getattr(self, name) > 0, self, name, "give a number above zero")

    def build(self, dynamics: Dynamics) -> DisturbanceObserver:
        """The observer for a model."""
        limit = (self.largest_force, self.largest_moment)
        observer = MomentumObserver(dynamics, self.time_constant, limit)
        return DisturbanceObserver(observer, self.period)


@dataclass(frozen=True)
class Tracking:
    """Settings of the tracking of a plan.

    Attributes:
        gains: of the impedance law.
        error_limit: distance (m) and angle (rad) at which the tracking error is saturated.
        period: between calls (s).
        observer: of steady wrenches, which planner and reference compensate; none if null.
    """

    gains: ImpedanceGains = field(default_factory=ImpedanceGains)
    error_limit: tuple[float, float] = (1.0, 1.0)
    period: float = 0.02
    observer: ObserverConfig | None = field(default_factory=ObserverConfig)

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        require(min(self.error_limit) > 0, self, "error_limit", "give numbers above zero")
        require(self.period > 0, self, "period", "give a time above zero")

    def build(
        self,
        station: StationConfig,
        source: System,
        layout: PlanLayout,
        observed: Dynamics,
        noise_period: float | None = None,
        place: tuple[float, float] | None = None,
    ) -> Diagram:
        """A controller around the source of a plan; the source's output ports are exported too.

        `observed` is the model that the disturbance observer uses; `noise_period` (s) is the period
        at which the source's `noise` is drawn. A `place` (x and y, m) is that of the plan, for a
        vehicle that does not know where it is.
        """
        vehicle = station.load_vehicle()
        limits = ThrusterLimits.create(vehicle.thrusters(), station.voltage)
        K_p, K_d = self.gains.matrices(vehicle.dynamics())
        law = ImpedanceLaw(K_p, K_d, limits, self.error_limit)
        builder = DiagramBuilder()
        builder.AddNamedSystem("source", source)
        impedance = builder.AddNamedSystem("impedance", Impedance(law, layout, self.period))
        builder.Connect(source.GetOutputPort("plan"), impedance.GetInputPort("plan"))
        systems = [impedance]
        if self.observer is not None:
            observer = builder.AddNamedSystem("observer", self.observer.build(observed))
            builder.Connect(impedance.GetOutputPort("F_Bo_B"), observer.GetInputPort("F_Bo_B"))
            bias = observer.GetOutputPort("F_bias_Bo_W")
            builder.Connect(bias, source.GetInputPort("F_bias_Bo_W"))
            builder.ExportOutput(bias, "F_bias_Bo_W")
            systems.append(observer)
        if source.HasInputPort("X_WB"):
            systems.append(source)
        size = station_ports(station)[1]["health"]
        known = HealthGate(size) if place is None else WithoutPosition(place)
        gate = builder.AddNamedSystem("gate", known)
        for name in (*INPUTS, *(TOLD if place is None else ())):
            builder.ExportInput(gate.GetInputPort(name), name)
        for name in INPUTS:
            for system in systems:
                builder.Connect(gate.GetOutputPort(name), system.GetInputPort(name))
        if noise_period is not None:
            add_noise(builder, source, "noise", noise_period)
        builder.ExportOutput(impedance.GetOutputPort("F_Bo_B"), "F_Bo_B")
        for name in port_sizes(source)[1]:
            builder.ExportOutput(source.GetOutputPort(name), name)
        return builder.Build()


@dataclass(frozen=True)
class MppiImpedance(Controller):
    """Path integral planning of a task at the station, tracked by impedance control.

    Attributes:
        task: what to plan for.
        planner: settings of the planner.
        model: a checkpoint of the dynamics to plan with; physics if left out.
        vehicle: whose physics to plan with; the station's if left out.
        diffusion: b of the physics' process noise (N√s and N·m√s): the wrenches of waves, wake and
            pushes as white noise. A wrench of standard deviation σ and time constant τ has
            b = σ √(2τ).
        tracking: settings of the tracking.

    Example:
        >>> controller = load_scenario("pylon_crossing_calm").controller
        >>> isinstance(controller, MppiImpedance)
        True
        >>> learned = dataclasses.replace(controller, model=Path("runs/mine/model.spinn"))
    """

    task: TaskKind
    planner: MppiConfig = field(default_factory=MppiConfig)
    model: Path | None = None
    vehicle: str | None = None
    diffusion: Vector6 = (3.0, 3.0, 3.0, 0.2, 0.2, 0.2)
    tracking: Tracking = field(default_factory=Tracking)

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        require(min(self.diffusion) >= 0, self, "diffusion", "give six numbers of zero or more")

    @property
    def goal(self) -> PoseConfig | None:
        """The pose to reach, if the task has one."""
        return self.task.goal if isinstance(self.task, PylonCrossing) else None

    def dynamics(self, station: StationConfig) -> Dynamics:
        """The model to plan with."""
        return self._model(station)[0]

    def _model(self, station: StationConfig) -> tuple[Dynamics, Mapping[str, Any]]:
        """The model to plan with and its checkpoint's metadata."""
        if self.model is not None:
            model, metadata = load_model(self.model, float)
            return whitened(model), metadata
        vehicle = load_vehicle(self.vehicle or station.vehicle)
        return vehicle.dynamics(np.array(self.diffusion)), {}

    def build(self, station: StationConfig, goal: Goal = None) -> Diagram:
        vehicle = station.load_vehicle()
        model, metadata = self._model(station)
        c = self.planner.with_substeps_of(metadata)
        limits = ThrusterLimits.create(vehicle.thrusters(), station.voltage, c.wrench_fraction)
        planner = MppiPlanner(
            model,
            limits,
            self.task.build(station, goal),
            config=c,
            tracking=self.tracking.gains.matrices(model),
        )
        return self.tracking.build(station, self._source(planner), c.layout, model, c.period)

    def _source(self, planner: MppiPlanner) -> System:
        return Mppi(planner)

    def beside_the_loop(self) -> "MppiImpedance":
        given = _given(self)
        given["planner"] = with_free_core(self.planner)
        return _MppiBesideImpedance(**given)


class _MppiBesideImpedance(MppiImpedance):
    """Its planner runs in a thread."""

    def _source(self, planner: MppiPlanner) -> System:
        return MppiBeside(planner, self.tracking.period)

    def beside_the_loop(self) -> "MppiImpedance":
        return self


@dataclass(frozen=True)
class TrackReference(Controller):
    """Impedance control along a given path; obstacles are ignored.

    On a vehicle without a position a path that stays at its x and y is followed in attitude and
    depth.

    Attributes:
        path: the path.
        feedforward: add the wrenches that the physics of the station's vehicle needs on the path.
        tracking: settings of the tracking.
    """

    path: HoldPose | Waypoints | FigureEight
    feedforward: bool = True
    tracking: Tracking = field(default_factory=Tracking)

    def build(self, station: StationConfig, goal: Goal = None) -> Diagram:
        del goal
        return self._build(station, None)

    def _build(self, station: StationConfig, place: tuple[float, float] | None) -> Diagram:
        model = station.load_vehicle().dynamics()
        reference = Reference(self.path, model if self.feedforward else None)
        return self.tracking.build(station, reference, reference.layout, model, place=place)

    def without_position(self, station: StationConfig) -> "Controller | None":
        del station
        return None if self.path.place() is None else _TrackAttitude(**_given(self))


class _TrackAttitude(TrackReference):
    """Holds attitude and depth of its path."""

    def build(self, station: StationConfig, goal: Goal = None) -> Diagram:
        del goal
        return self._build(station, self.path.place())


@dataclass(frozen=True)
class Own(OwnSystem, Controller):
    """A user-defined controller.

    Its constructor receives, if it has arguments of these names that `parameters` lacks: the
    station's `vehicle` (a `Vehicle`), its `obstacles` (a tuple of `Pylon`), the `goal` (position in
    W, m) if the run has one, and the whole configuration `station`. An input port `health` receives
    the health of the estimate. With an output port `plan` and an attribute `layout`, the plan's
    `PlanLayout`, its plans are logged and judged.

    Example:
        >>> controller = Own("examples/own_controller.py:PidController", {"yaw": 0.5})
        >>> controller.parameters
        {'yaw': 0.5}
    """

    def build(self, station: StationConfig, goal: Goal = None) -> System:
        return self.make(station.offered(goal))

    def without_position(self, station: StationConfig) -> "Controller | None":
        del station
        return self


ControllerKind = MppiImpedance | TrackReference | Own
"""The kinds that a scenario can name by a tag."""
