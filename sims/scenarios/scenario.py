"""Scenarios: the complete settings of a run, in one YAML file."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ...models.config import typed_yaml
from ...models.config.checks import SECONDS, check_numbers, require
from ...models.config.errors import UserError
from ...models.config.yaml_text import parse
from ...systems.controllers.kinds import ControllerKind, MppiImpedance
from ...systems.mavlink.config import Mavlink
from ...systems.own import OwnSystem
from ...systems.station.config import StationConfig
from ..vehicle.config import VehicleServer
from .criteria import Finish, ReachGoal, Safety, Success
from .located import located
from .maneuvers import Maneuvers

_FOLDER = Path(__file__).parent
_TEXT = "--scenario-text"


@dataclass(frozen=True)
class LogSettings:
    """Settings of a run's log.

    Attributes:
        rate: samples per second; its period is a multiple of the station's.
        samples: keep the planner's samples, for figures (a few MB per minute).
        covariance: keep the filter's covariance and innovations (3 MB per minute).
    """

    rate: float = 20.0
    samples: bool = True
    covariance: bool = True

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        require(self.rate > 0, self, "rate", "give a number above zero")


@dataclass(frozen=True)
class Scenario:
    """The settings of a run: station, controller, success criterion.

    Attributes:
        name: of the run's folder.
        description: a sentence for the report.
        duration: longest simulated time (s).
        station: vehicle, water, obstacles, sensors, start, seed.
        controller: the controller.
        success: the success criterion.
        safety: limits that end any run.
        log: settings of the log.
        vehicle_link: the vehicle to fly on with `spinndrift run --arm`; simulated if left out.
        vehicle_server: settings of `spinndrift vehicle`, which serves the station over MAVLink.

    Example:
        >>> known = load_scenario("station_keeping_calm")
        >>> Scenario("later", known.controller, known.success, duration=90.0).station.vehicle
        'bluerov2_heavy'
    """

    name: str
    controller: ControllerKind | Maneuvers
    success: Success
    description: str = ""
    duration: float = 60.0
    station: StationConfig = field(default_factory=StationConfig)
    safety: Safety = field(default_factory=Safety)
    log: LogSettings = field(default_factory=LogSettings)
    vehicle_link: Mavlink | None = None
    vehicle_server: VehicleServer | None = None

    def __post_init__(self) -> None:
        """Check fields that depend on each other."""
        check_numbers(self)
        word = re.fullmatch(r"[A-Za-z0-9][\w.-]*", self.name)
        require(word is not None, self, "name", "give one word of letters, digits, _ . -")
        require(
            SECONDS.holds(self.duration), self, "duration", f"give a number of seconds {SECONDS}"
        )
        steps = 1 / (self.log.rate * self.station.period)
        require(
            abs(steps - round(steps)) < 1e-6 and round(steps) >= 1,
            self.log,
            "rate",
            f"give a rate whose period is a multiple of {self.station.period:g} s",
        )
        if isinstance(self.success, ReachGoal) and self.goal is None:
            raise UserError("Scenario.success: ReachGoal needs `goal`: [x, y, z] in m")
        ends = isinstance(self.controller, Maneuvers)
        require(
            ends == isinstance(self.success, Finish),
            self,
            "success",
            "give !Finish {} with the controller !Maneuvers, and with no other",
        )
        if isinstance(self.controller, Maneuvers):
            require(
                self.controller.rate == self.log.rate,
                self.log,
                "rate",
                f"give {self.controller.rate:g}, the rate of the controller's commands",
            )

    @property
    def seed(self) -> int:
        """The seed of everything random."""
        return self.station.seed

    @property
    def goal(self) -> Float[np.ndarray, "3"] | None:
        """The goal position (m, W), None without a goal."""
        if isinstance(self.success, ReachGoal) and self.success.goal is not None:
            return np.array(self.success.goal)
        goal = getattr(self.controller, "goal", None)
        return None if goal is None else np.array(goal.position)

    @property
    def positioned(self) -> bool:
        """Whether the vehicle knows where it is: by a sensor of its own, or by the autopilot."""
        told = self.vehicle_link is not None and self.vehicle_link.estimate == "autopilot"
        return told or self.station.sensing.horizontal

    @property
    def code(self) -> tuple[str, ...]:
        """The user code that runs with it: files or modules, with the class in them."""
        sensing, task = self.station.sensing, getattr(self.controller, "task", None)
        parts = (self.controller, task, sensing.filter, *sensing.more.values())
        return tuple(part.code for part in parts if isinstance(part, OwnSystem))

    def link(self, option: str = "") -> Mavlink:
        """The link to the vehicle that `option` of a command asks for.

        Raises:
            UserError: the scenario has none.
        """
        if self.vehicle_link is None:
            asked = f"{option}: " if option else ""
            raise UserError(
                f"{asked}scenario {self.name} has no vehicle_link: add vehicle_link: !Mavlink "
                '{connection: "udpin:0.0.0.0:14550"} to fly on a vehicle'
            )
        return self.vehicle_link

    def with_changes(
        self, seed: int | None = None, duration: float | None = None, model: Path | None = None
    ) -> "Scenario":
        """The same scenario with another seed, duration or model to plan with.

        Raises:
            UserError: a model is given, and the controller does not plan with one.
        """
        changed = self
        if seed is not None:
            changed = replace(changed, station=replace(changed.station, seed=seed))
        if duration is not None:
            changed = replace(changed, duration=duration)
        if model is not None:
            if not isinstance(changed.controller, MppiImpedance):
                raise UserError(
                    f"--model: {self.name} is steered by {type(self.controller).__name__}, which "
                    "does not plan with a model; choose a scenario with MppiImpedance"
                )
            changed = replace(changed, controller=replace(changed.controller, model=model))
        return changed


def scenario_names() -> tuple[str, ...]:
    """Names of the shipped scenarios."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.yaml")))


def load_scenario(name_or_path: str | Path, text: str = "") -> Scenario:
    """Read a shipped scenario by its name, or a YAML file by its path (anything with a suffix).

    `text` is YAML that overrides the file: mappings are merged key by key, other values replace the
    file's, and so does a value with another `!Tag`.

    Files that it names (vehicles, models, code) are found from its folder, or else from the working
    folder; those in `text` from the working folder.

    Raises:
        UserError: there is no such scenario, it is not valid, with or without `text`, or its
            vehicle can't be read.

    Example:
        >>> load_scenario("station_keeping_calm", text="station: {seed: 7}").station.seed
        7
    """
    path = Path(name_or_path)
    if not path.suffix:
        if str(name_or_path) not in scenario_names():
            raise UserError(
                f"scenario `{name_or_path}` is none of those shipped; take one of "
                f"{', '.join(scenario_names())}, or the path of a .yaml file"
            )
        path = _FOLDER / f"{name_or_path}.yaml"
    stated = located(typed_yaml.load(Scenario, path), path.parent)
    scenario = overridden(stated, text) if text.strip() else stated
    try:
        vehicle = scenario.station.load_vehicle()
    except UserError as error:
        same = scenario.station.vehicle == stated.station.vehicle
        raise UserError(f"{name_or_path if same else _TEXT}: {error}") from error
    for i, effect in enumerate(scenario.station.effects):
        try:
            effect.build().for_thrusters(len(vehicle.propulsion.mounts))
        except UserError as error:
            same = scenario.station.effects == stated.station.effects
            where = f"{name_or_path if same else _TEXT}: station.effects[{i}]"
            raise UserError(f"{where}: {error}") from error
    return scenario


def overridden(base: Scenario | str, text: str) -> Scenario:
    """A scenario (or the YAML text of one) overridden by YAML `text`.

    Raises:
        UserError: the result is not a valid scenario.
    """
    scenario = typed_yaml.loads(Scenario, base, "scenario") if isinstance(base, str) else base
    if not isinstance(parse(text, _TEXT)[0], dict):
        raise UserError(f"{_TEXT}: give a mapping, such as 'duration: 5'")
    try:
        return typed_yaml.loads(Scenario, text, _TEXT, scenario)
    except UserError as error:  # an option's text has no line numbers
        message = re.sub(rf"^{_TEXT}:\d+: ", f"{_TEXT}: ", str(error), flags=re.MULTILINE)
        raise UserError(message) from error
