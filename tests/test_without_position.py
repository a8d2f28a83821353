"""A vehicle without a horizontal aid holds depth and attitude, and is asked for nothing else."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spinndrift.models import se3
from spinndrift.models.config.errors import UserError
from spinndrift.sims.run.flight_log import without_horizontal
from spinndrift.sims.run.log import RunLog
from spinndrift.sims.run.loop import simulate
from spinndrift.sims.run.metrics import metrics
from spinndrift.sims.run.way import check_positioned
from spinndrift.sims.scenarios.criteria import FollowPath, Outcome
from spinndrift.sims.scenarios.scenario import load_scenario, overridden
from spinndrift.systems.controllers.without_position import WithoutPosition

NO_DVL = "station: {sensing: {dvl: null}}\n"
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
    text = f"{NO_DVL}controller: !TrackReference {{path: !HoldPose {{at: {pose}}}}}\nduration: 30"
    run = simulate(load_scenario("station_keeping_calm", text))
    late = run.log.time > 20
    X, F = run.log["X_WB"][late], run.log["F_Bo_B"][late]
    assert (run.log["health"][late, 0] == 2).mean() > 0.5, "velocity is unknown, as was foreseen"
    # the gauge's noise and the ripple of small waves; the compass' bias of a few degrees
    assert np.abs(X[:, 6] + 2.5).max() < 0.15
    yaw = Rotation.from_quat(X[:, :4], scalar_first=True).as_euler("ZYX")[:, 0]
    assert np.abs(yaw - math.radians(60)).max() < math.radians(10)
    assert np.abs(F[:, :2]).max() < 3.0, "nothing drives it along the horizontal"


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
        assert found["outcome"]["words"] == (
            "The depth was held within 0.20 m RMS; the place is not known."
        )
        assert found["tracking"]["position_rms_m"] == pytest.approx(0.2)
        assert found["path"]["length_m"] is None
