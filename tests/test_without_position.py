"""A vehicle without a horizontal aid holds depth and attitude, and is asked for nothing else."""

import html
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spinndrift.models import se3
from spinndrift.models.config.errors import UserError
from spinndrift.sims.run.folder import report_page, run_metrics
from spinndrift.sims.run.log import RunLog, without_horizontal
from spinndrift.sims.run.loop import simulate
from spinndrift.sims.run.metrics import metrics
from spinndrift.sims.run.way import check_positioned, depth_only, position_note
from spinndrift.sims.scenarios.criteria import FollowPath, Outcome
from spinndrift.sims.scenarios.scenario import load_scenario, overridden
from spinndrift.systems.controllers.without_position import WithoutPosition

pytestmark = pytest.mark.whole

NO_DVL = "station: {sensing: {dvl: null}}\n"
NONE = "station: {sensing: {dvl: none}}"
LINK = 'vehicle_link: !Mavlink {connection: "tcp:127.0.0.1:1"}\n'
PYLON = "station: {obstacles: [{x: 3, y: 0, diameter: 0.3}]}"
OWN = "controller: !Own {system: mine.py:Mine}\nsuccess: !FollowPath {}"


def test_what_is_not_known_is_replaced_and_the_rest_passes():
    rng = np.random.default_rng(0)
    gate = WithoutPosition((3.0, -1.0))
    for _ in range(10):
        q = Rotation.random(rng=rng).as_quat(scalar_first=True)
        X, V = np.array([*q, *rng.normal(size=3)]), rng.normal(size=6)
        context = gate.CreateDefaultContext()
        gate.GetInputPort("X_WB").FixValue(context, X)
        gate.GetInputPort("V_WB_B").FixValue(context, V)
        seen: Any = [gate.GetOutputPort(name).Eval(context) for name in ("X_WB", "V_WB_B")]
        X1, V1 = seen
        np.testing.assert_array_equal(X1, [*X[:4], 3.0, -1.0, X[6]])
        before, after = (
            np.asarray(se3.rotate(jnp.asarray(X), jnp.asarray(v[:3]))) for v in (V, V1)
        )
        np.testing.assert_allclose(after, [0, 0, before[2]], atol=1e-12)
        np.testing.assert_array_equal(V1[3:], V[3:])


def test_a_simulated_vehicle_without_a_dvl_reaches_and_holds_depth_and_attitude():
    pose = "{position: [0, 0, -2.5], rpy_deg: [0, 0, 60]}"
    text = f"controller: !TrackReference {{path: !HoldPose {{at: {pose}}}}}\nvehicle_link: null\n"
    text += "duration: 30\nsuccess: !FollowPath {settle: 20}"
    run = simulate(load_scenario("hold_depth_vehicle", text))
    late = run.log.time > 20
    X, F = run.log["X_WB"][late], run.log["F_Bo_B"][late]
    assert (run.log["health"][late, 0] == 2).mean() > 0.5, "velocity is unknown, as was foreseen"
    # the gauge's noise and the ripple of small waves; the compass' bias of a few degrees
    assert np.abs(X[:, 6] + 2.5).max() < 0.15
    yaw = Rotation.from_quat(X[:, :4], scalar_first=True).as_euler("ZYX")[:, 0]
    assert np.abs(yaw - math.radians(60)).max() < math.radians(10)
    assert np.abs(F[:, :2]).max() < 3.0, "nothing drives it along the horizontal"
    assert run.note == position_note(run.scenario)
    assert "the depth alone is judged" in run.note
    values = run_metrics(run)
    drift = np.linalg.norm(run.log["X_WB"][:, 4:6], axis=1).max()
    assert values["tracking"]["drift_m"] == pytest.approx(drift)
    assert values["outcome"]["success"]
    assert "the vehicle did not know its place, and drifted" in values["outcome"]["words"]
    assert run.note in html.unescape(report_page(run, values).html())


@pytest.mark.parametrize(
    ("name", "more", "words"),
    [
        ("pylon_crossing_calm", "", "controller: !MppiImpedance needs to know where"),
        ("trajectory_tracking_calm", "", "controller: !TrackReference needs to know where"),
        ("station_keeping_calm", "success: !ReachGoal {goal: [1, 0, -1]}", "!ReachGoal needs"),
        ("station_keeping_calm", PYLON, "station.obstacles: to keep clear of them"),
        ("station_keeping_calm", "", ""),
        ("station_keeping_calm", OWN, ""),
        ("pylon_crossing_calm", "vehicle_link: {estimate: autopilot}", ""),
    ],
)
def test_what_needs_a_position_is_refused_without_one(name: str, more: str, words: str):
    scenario = load_scenario(name, NO_DVL + LINK)
    scenario = overridden(scenario, more) if more else scenario
    if not words:
        check_positioned(scenario)
        return
    with pytest.raises(UserError, match=words):
        check_positioned(scenario)


def test_numbers_of_a_flight_without_a_place_are_those_of_its_depth():
    n, dt = 200, 0.1
    X = np.tile([1.0, 0, 0, 0, 900.0, -70.0, -2.2], (n, 1))
    V = np.tile([9.0, -3.0, 0, 0, 0, 0], (n, 1))
    plan = np.tile([1.0, 0, 0, 0, 0, 0, -2.0], (n, 1))
    X, V, _ = without_horizontal(X, V)
    variables = {"X_WB": X, "V_WB_B": V, "F_Bo_B": np.zeros((n, 6)), "X_WB_plan": plan}
    variables |= {"V_WB_B_plan": np.zeros((n, 6)), "plan_valid": np.ones(n)}
    log = RunLog.create("hold", dt, variables)
    vehicle = load_scenario("station_keeping_calm").station.load_vehicle()
    for allowed, good in ((0.3, True), (0.1, False)):
        success = FollowPath(position_rms=allowed, settle=0.0)
        found = metrics(log, Outcome("duration", 20.0, ""), success, vehicle)
        assert found["outcome"]["success"] is good
        words = {
            True: "The depth was held within 0.20 m RMS; the place is not known.",
            False: "The depth error was 0.20 m RMS; 0.1 m are allowed; the place is not known.",
        }
        assert found["outcome"]["words"] == words[good]
        assert found["tracking"]["position_rms_m"] == pytest.approx(0.2)
        assert found["path"]["length_m"] is None


def test_a_simulation_is_judged_as_the_flight_would_be():
    """The truth's drift is told, and is no error: numbers are those of the log without a place."""
    n, dt = 200, 0.1
    t = dt * np.arange(n)
    q = Rotation.from_euler("ZYX", [0.4, 0.1, -0.2]).as_quat(scalar_first=True)
    X = np.column_stack([np.tile(q, (n, 1)), 0.05 * t, -0.02 * t, np.full(n, -2.2)])
    V = np.tile([0.3, -0.1, 0.05, 0.0, 0.0, 0.1], (n, 1))
    plan = np.tile([*q, 0, 0, -2.0], (n, 1))
    more = {"F_Bo_B": np.zeros((n, 6)), "X_WB_plan": plan}
    more |= {"V_WB_B_plan": np.zeros((n, 6)), "plan_valid": np.ones(n)}
    X1, V1, _ = without_horizontal(X, V)
    states = {"X_WB": X, "V_WB_B": V}
    flown = RunLog.create("hold", dt, {"X_WB": X1, "V_WB_B": V1, **more})
    simulated = RunLog.create("hold", dt, states | more, depth_only=True)
    seen = RunLog.create("hold", dt, states | more)
    vehicle = load_scenario("station_keeping_calm").station.load_vehicle()
    success = FollowPath(position_rms=0.25, settle=0.0)
    a, b, c = (
        metrics(log, Outcome("duration", 20.0, ""), success, vehicle)
        for log in (flown, simulated, seen)
    )
    drift = a["tracking"].pop("drift_m"), b["tracking"].pop("drift_m")
    assert drift == (None, pytest.approx(np.hypot(0.05, 0.02) * t[-1]))
    assert b["tracking"] == pytest.approx(a["tracking"])
    assert b["tracking"]["position_rms_m"] == pytest.approx(0.2)
    assert b["outcome"]["success"]
    assert "drifted by up to 1.07 m" in b["outcome"]["words"]
    assert not c["outcome"]["success"], "a vehicle that knows its place is to keep it"
    assert b["path"]["length_m"] == c["path"]["length_m"], "the true path is told"


def test_a_scenario_that_a_vehicle_would_refuse_is_told_of_it():
    scenario = load_scenario("trajectory_tracking_calm", NO_DVL)
    with pytest.raises(UserError) as refused:
        check_positioned(scenario)
    assert position_note(scenario).endswith(f"a vehicle would refuse the scenario: {refused.value}")
    assert not depth_only(scenario), "its path is judged in all axes"
    with_dvl = load_scenario("trajectory_tracking_calm")
    assert (position_note(with_dvl), depth_only(with_dvl)) == ("", False)


def test_a_sensor_that_is_left_out_by_the_wrong_word_is_told_the_right_one():
    with pytest.raises(UserError, match=r"found `none` .*, or null for none"):
        load_scenario("station_keeping_calm", NONE)


def test_an_autopilots_position_is_not_simulated():
    linked = load_scenario("pylon_crossing_calm", NO_DVL + LINK)
    linked = overridden(linked, "vehicle_link: {estimate: autopilot}")
    check_positioned(linked)
    assert "!MppiImpedance needs to know where" in position_note(linked)
