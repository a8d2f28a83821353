"""Scenarios load, merge with what is laid over them, and fly."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers import ROOT
from spinndrift.models.config import typed_yaml
from spinndrift.models.config.errors import UserError
from spinndrift.models.effects.effect_config import EffectConfig, check_distinct
from spinndrift.sims.run.loop import simulate
from spinndrift.sims.scenarios.criteria import FollowPath, ReachGoal
from spinndrift.sims.scenarios.page import scenario_page
from spinndrift.sims.scenarios.scenario import Scenario, load_scenario, overridden, scenario_names
from spinndrift.systems.controllers.kinds import MppiImpedance, TrackReference

pytestmark = pytest.mark.whole

SMALL = """
planner: {horizon: 10, sequences: 16, realisations: 1, knots: [2], effective_samples: 4,
    shown_paths: 4}
"""
_SELDOM = ("tracking_calm", "keeping_harbour", "crossing_harbour", "hold_depth_vehicle")
BASE = """
name: base
duration: 5
station: {vehicle: bluerov2_heavy, seed: 3}
controller: !TrackReference
  path: !HoldPose {at: {position: [0, 0, -1]}}
success: !FollowPath {position_rms: 0.2}
"""


def test_what_is_shipped():
    kinds = ("pylon_crossing", "station_keeping", "trajectory_tracking")
    simulated = {f"{k}_{water}" for k in kinds for water in ("calm", "harbour")}
    assert set(scenario_names()) == simulated | {"pylon_crossing_vehicle", "hold_depth_vehicle"}


@pytest.mark.parametrize("name", scenario_names())
def test_shipped_scenarios_are_whole(name):
    scenario = load_scenario(name)
    assert scenario.name == name
    assert scenario.description
    assert typed_yaml.loads(Scenario, typed_yaml.dump(scenario)) == scenario
    assert scenario.vehicle_link or scenario.station.disturbance_set in name


def test_scenarios_of_the_pages_load():
    """Those of the README are whole; the options of the field page turn a link on and off."""
    blocks = re.findall(r"```yaml\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    names = [typed_yaml.loads(Scenario, block).name for block in blocks]
    assert names == ["my_run", "my_watch"]
    page = (ROOT / "docs" / "field.md").read_text()
    texts = set(re.findall(r"'(vehicle_link: [^']+)'", page))
    links = {text: load_scenario("pylon_crossing_vehicle", text).vehicle_link for text in texts}
    assert links.pop("vehicle_link: null") is None
    [link] = links.values()
    assert link is not None
    assert link.safety.max_wrench == (20, 20, 20, 2, 2, 4)


def test_pylon_crossing_is_the_papers_task():
    for name in ("pylon_crossing_calm", "pylon_crossing_harbour"):
        scenario = load_scenario(name)
        assert scenario.station.start.position == (0.0, 0.0, -1.5)
        np.testing.assert_array_equal(scenario.goal, [4.5, -2.0, -1.5])
        assert isinstance(scenario.success, ReachGoal)
        assert (scenario.success.radius, scenario.success.near_time) == (0.5, 15.0)
        # the straight way is closed: some pylon stands nearer to it than half the hull
        start, goal = np.zeros(2), np.array([4.5, -2.0])
        ahead = (goal - start) / np.linalg.norm(goal - start)
        gaps = [
            abs(ahead[0] * p.y - ahead[1] * p.x) - p.diameter / 2
            for p in scenario.station.obstacles
        ]
        assert min(gaps) < scenario.station.load_vehicle().size[1] / 2


@pytest.mark.parametrize(
    "name",
    [
        # test_without_position flies hold_depth_vehicle
        pytest.param(n, marks=[pytest.mark.slow] * n.endswith(_SELDOM))
        for n in scenario_names()
    ],
)
def test_every_scenario_flies(name):
    text = "{duration: 0.1}"
    if isinstance(load_scenario(name).controller, MppiImpedance):
        text = f"{{duration: 0.1, controller: {{{SMALL.strip()}}}}}"
    run = simulate(load_scenario(name, text))
    assert run.outcome.reason == "duration"
    assert run.log.time[-1] == pytest.approx(0.1)
    np.testing.assert_array_equal(run.log["X_WB"][0], run.scenario.station.initial_state()[0])
    assert run.log["plan_valid"][-1] == 1


def test_text_is_laid_over_key_by_key():
    scenario = overridden(BASE, "{duration: 2, station: {seed: 7}, success: {settle: 1}}")
    assert (scenario.duration, scenario.seed, scenario.station.vehicle) == (2, 7, "bluerov2_heavy")
    assert scenario.success == FollowPath(0.2, 1.0)
    before = overridden(BASE, "{}").controller
    assert isinstance(before, TrackReference)
    same = overridden(BASE, "controller: !TrackReference {feedforward: false}").controller
    assert same == replace(before, feedforward=False)
    other = overridden(BASE, "success: !ReachGoal {goal: [1, 0, -1]}")
    assert other.success == ReachGoal(goal=(1.0, 0.0, -1.0))
    np.testing.assert_array_equal(other.goal, [1, 0, -1])


def test_changes():
    scenario = overridden(BASE, "{}")
    changed = scenario.with_changes(seed=9, duration=1.5)
    assert (changed.seed, changed.duration) == (9, 1.5)
    assert scenario.with_changes() == scenario
    with pytest.raises(UserError, match="TrackReference, which does not plan"):
        scenario.with_changes(model=Path("a.spinn"))
    crossing = load_scenario("pylon_crossing_calm").with_changes(model=Path("a.spinn"))
    assert isinstance(crossing.controller, MppiImpedance)
    assert crossing.controller.model == Path("a.spinn")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("durations: 3", r"^--scenario-text: durations: is no key .*did you mean `duration`"),
        ("{station: {disturbance_set: storm}}", "storm.*unknown"),
        ("[1, 2]", "give a mapping"),
        ("{duration: -1}", "duration"),
        (
            "{duration: 5e9}",
            "duration is 5000000000.0: give a number of seconds above 0, at most 86400",
        ),
        ("{station: {period: 1e-12}}", "period is 1e-12: give a time from 0.0001 to 1"),
        ("{success: !ReachGoal {goal: [1e300, 0, -1]}}", "at most 1e\\+12"),
        ("{name: a b}", "one word"),
        ("{log: {rate: 30}}", "multiple of 0.01"),
        ("success: !ReachGoal {}", "needs `goal`"),
        ("{station: {seed: -1}}", "seed"),
        ("{station: {vehicle: 3}}", "text"),
        ("{station: {effects: [{name: lag}]}}", "effects.*'lag'.*thruster_lag"),
        (
            "{station: {effects: [{name: thruster_lag, parameters: {tau: 1}}]}}",
            "effects.*no 'tau': it has time_constant",
        ),
        ("{station: {effects: [{name: linear_drag}]}}", "say where: one of surge"),
        (
            "{station: {effects: [{name: thruster_lag, parameters: {time_constant: -1}}]}}",
            "is -1: give 0 to 1.5 s",
        ),
        (
            "{station: {effects: [{name: proximity, where: bottom, options: {height: 1}}]}}",
            "proximity.options has no 'height': take one of floor, walls",
        ),
        (
            "{station: {effects: [{name: proximity, where: bottom, options: {walls: [1, 2]}}]}}",
            r"proximity.options.walls is .*: give 4 finite numbers",
        ),
        (
            "{station: {effects: [{name: actuation_delay, options: {steps: 1.5}}]}}",
            r"actuation_delay.options.steps is 1.5: give 1, 2, 3",
        ),
        (
            "{station: {effects: [{name: linear_drag, where: surge, options: {a: 1}}]}}",
            "linear_drag.options has no 'a': it has none; leave it out",
        ),
        (
            "{station: {effects: [{name: thruster_lag, parameters: {dtype: 1}}]}}",
            "no 'dtype': it has time_constant",
        ),
        (
            "{station: {effects: [{name: thruster_lag}]}}",
            "thruster_lag has no parameters.*give one of time_constant",
        ),
        ("{", "--scenario-text"),
    ],
)
def test_faults_are_told(text, message):
    with pytest.raises(UserError, match=message):
        overridden(BASE, text)


def test_unknown_scenarios_are_told(tmp_path):
    with pytest.raises(UserError, match="take one of hold_depth_vehicle, pylon_crossing_calm"):
        load_scenario("storm")
    with pytest.raises(UserError, match="no such file"):
        load_scenario(tmp_path / "mine.yaml")
    (tmp_path / "mine.yaml").write_text(BASE.replace("duration", "durtion"))
    with pytest.raises(UserError, match=r"mine\.yaml:3: durtion"):
        load_scenario(tmp_path / "mine.yaml")


def test_an_effect_twice_at_one_place_is_told():
    lag = EffectConfig("thruster_lag", parameters={"time_constant": 0.1})
    one = replace(lag, where="1")
    check_distinct((lag, one, replace(lag, where="2")))
    for twice in ((lag, one, one), (lag, replace(lag, where="all"))):
        with pytest.raises(UserError, match=r"thruster_lag.*is there twice"):
            check_distinct(twice)


def test_the_page_of_keys_is_that_of_the_classes_and_each_key_has_a_meaning():
    page = (ROOT / "docs" / "scenario.md").read_text(encoding="utf-8")
    assert page == scenario_page(), "write docs/scenario.md anew from scenario_page()"
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    assert len(rows) > 200
    assert [row for row in rows if row.endswith("|  |")] == []
    linked = set(re.findall(r"\]\(#(\w+)\)", page))
    assert linked <= {line[3:].lower() for line in page.splitlines() if line.startswith("## ")}
