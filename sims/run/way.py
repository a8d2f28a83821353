"""Checks before a scenario runs: free start and goal, and a safe path between them."""

from dataclasses import replace

import numpy as np

from ...models.config.errors import UserError
from ...systems.controllers.kinds import Controller, MppiImpedance
from ...systems.planning.obstacles import Pylon
from ...systems.planning.passage import Passage, upright_gap, widest_way
from ...systems.planning.paths import PoseConfig
from ...systems.planning.tasks import StationKeeping
from ..scenarios.criteria import ReachGoal, clearance, named
from ..scenarios.scenario import Scenario


def check_free(scenario: Scenario) -> None:
    """Check that start and goal are free of obstacles.

    Raises:
        UserError: the hull touches a pylon there.
    """
    station = scenario.station
    _check("station.start", station.start, scenario)
    if isinstance(scenario.controller, MppiImpedance) and scenario.controller.goal is not None:
        _check("controller.task.goal", scenario.controller.goal, scenario)
    if isinstance(scenario.success, ReachGoal) and scenario.success.goal is not None:
        size = station.load_vehicle().size
        for pylon in station.obstacles:
            gap = upright_gap(np.array(scenario.success.goal), pylon, size)
            if gap <= 0:
                raise UserError(_taken("success.goal", pylon, gap))


def check_positioned(scenario: Scenario) -> None:
    """Check that a vehicle without a position is asked for nothing that needs one.

    Raises:
        UserError: its controller, its goal or its obstacles need one.
    """
    if scenario.positioned:
        return
    lacking = (
        "needs to know where the vehicle is, and station.sensing has no sensor of horizontal motion"
    )
    remedy = "add its DVL, or take `estimate: autopilot` if the autopilot has a position, or"
    kind = type(scenario.controller).__name__
    if scenario.controller.without_position(scenario.station) is None:
        raise UserError(
            f"controller: !{kind} {lacking}; {remedy} hold depth and attitude: "
            "controller: !TrackReference {path: !HoldPose {at: {position: [0, 0, -1.5]}}}"
        )
    if isinstance(scenario.success, ReachGoal):
        raise UserError(f"success: !ReachGoal {lacking}; {remedy} give !FollowPath {{}}")
    if scenario.station.obstacles:
        raise UserError(
            f"station.obstacles: to keep clear of them {lacking}; {remedy} fly in free water: "
            "station: {obstacles: []}"
        )


def position_note(scenario: Scenario) -> str:
    """What a simulation without a sensor of horizontal motion says of it; empty with one.

    Simulated, such a scenario runs in any case; on a vehicle `check_positioned` refuses some.
    """
    scenario = replace(scenario, vehicle_link=None)  # whose autopilot is not simulated
    if scenario.positioned:
        return ""
    try:
        check_positioned(scenario)
    except UserError as error:
        return f"This simulation goes on, but a vehicle would refuse the scenario: {error}"
    return (
        "There is no sensor of horizontal motion: the vehicle does not know where it is, and "
        "drifts. Of its position the depth alone is judged."
    )


def depth_only(scenario: Scenario) -> bool:
    """Whether a simulated vehicle holds its depth without a position, and is judged by it."""
    held = scenario.controller.without_position(scenario.station) is not None
    return held and not scenario.station.sensing.horizontal


def find_passage(scenario: Scenario) -> Passage | None:
    """The widest path to the goal, with the planner's measure of risk; None without a goal.

    Without a planner that has a measure of risk, a path is safe if the vehicle fits through.
    """
    if not isinstance(scenario.success, ReachGoal) or scenario.goal is None:
        return None
    controller, station = scenario.controller, scenario.station
    std, allowed = 0.0, None
    if isinstance(controller, MppiImpedance):
        std, allowed = controller.planner.clearance_std, controller.planner.collision_risk
    widest = widest_way(
        np.array(station.start.position),
        scenario.goal,
        scenario.success.radius,
        station.obstacles,
        station.load_vehicle().size,
        -station.sensing.water_depth,
        4 * std,
    )
    return Passage(float(widest), std, allowed)


def holding(scenario: Scenario) -> Controller:
    """The scenario's controller; a planner gets the task to hold the start pose."""
    controller = scenario.controller
    if not isinstance(controller, MppiImpedance):
        return controller
    return replace(controller, task=StationKeeping())


def no_safe_plan(scenario: Scenario, passage: Passage) -> str:
    """The sentences on the outcome `no safe plan`."""
    held = " The vehicle kept its pose." if isinstance(scenario.controller, MppiImpedance) else ""
    risk = f"has a collision risk of {_percent(passage.risk)} or more"
    if passage.allowed is None:
        return f"No safe plan: no passage to the goal is wide enough; each {risk}.{held}"
    allowed = _percent(passage.allowed)
    return f"No safe plan: every passage to the goal {risk}; {allowed} is allowed.{held}"


def _check(field: str, pose: PoseConfig, scenario: Scenario) -> None:
    vehicle, X_WB = scenario.station.load_vehicle(), np.asarray(pose.pose())
    for pylon in scenario.station.obstacles:
        gap = clearance(vehicle, X_WB, pylon)
        if gap <= 0:
            raise UserError(_taken(field, pylon, gap))


def _taken(field: str, pylon: Pylon, gap: float) -> str:
    return (
        f"{field}: the hull would be {-gap:.2f} m inside {named(pylon)}, a certain collision; "
        "move it or the pylon"
    )


def _percent(risk: float) -> str:
    return f"{100 * risk:.3g} %" if risk < 0.9995 else "nearly 100 %"
