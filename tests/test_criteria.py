"""Runs end for the right reason at the right time."""

import math

import numpy as np
import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.scenarios.criteria import FollowPath, Monitor, ReachGoal, Safety
from spinndrift.systems.planning.obstacles import Pylon

GOAL = np.array([4.0, 0.0, -1.5])
PYLON = Pylon(2.0, 1.0, 0.4, name="the north pylon")


def _pose(x: float, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    return np.array([math.cos(yaw / 2), 0, 0, math.sin(yaw / 2), x, y, -1.5])


def _run(monitor, poses, V=None, dt=0.5):
    V = np.zeros(6) if V is None else V
    for k, X in enumerate(poses):
        outcome = monitor.check(k * dt, X, V)
        if outcome is not None:
            return outcome
    return None


@pytest.fixture(name="monitor")
def _monitor():
    return Monitor(load_vehicle("bluerov2_heavy"), (PYLON,), ReachGoal(), GOAL)


def test_goal_is_reached_within_its_radius(monitor):
    outcome = _run(monitor, [_pose(x) for x in (0.0, 2.0, 3.49, 3.51, 4.0)])
    assert outcome is not None
    assert (outcome.reason, outcome.time) == ("goal", 1.5)


def test_hull_decides_on_collisions(monitor):
    # beside the pylon there is 1 m − 0.2 m for half of a hull of some 0.58 m × 0.46 m
    half = load_vehicle("bluerov2_heavy").size[1] / 2
    assert monitor.check(0.0, _pose(2.0, 0.8 - half - 0.01), np.zeros(6)) is None
    outcome = monitor.check(0.1, _pose(2.0, 0.8 - half + 0.01), np.zeros(6))
    assert outcome is not None
    assert outcome.reason == "collision"
    assert "the north pylon" in outcome.sentence


def test_collision_counts_before_the_goal():
    at_goal = Pylon(4.0, 0.0, 0.4)
    monitor = Monitor(load_vehicle("bluerov2_heavy"), (at_goal,), ReachGoal(), GOAL)
    outcome = monitor.check(0.0, _pose(4.0), np.zeros(6))
    assert outcome is not None
    assert outcome.reason == "collision"


def test_fifteen_seconds_near_the_goal_end_the_run(monitor):
    # away and back: all visits count
    there, away = [_pose(3.2)] * 21, [_pose(2.5)] * 10
    outcome = _run(monitor, there + away + there)
    assert outcome is not None
    assert outcome.reason == "near goal"
    assert outcome.time == pytest.approx(10 + 5 + 5.5, abs=0.51)


def test_no_progress_ends_the_run(monitor):
    poses = [_pose(0.02 * min(k, 50)) for k in range(400)]
    outcome = _run(monitor, poses)
    assert outcome is not None
    assert outcome.reason == "no progress"
    assert outcome.time == pytest.approx(25 + 30, abs=3.0)


def test_slow_progress_is_progress(monitor):
    assert _run(monitor, [_pose(0.005 * k) for k in range(400)]) is None


def test_spinning_has_to_last():
    safety = Safety(spin_rate=1.0, spin_time=2.0)
    fast, slow = np.array([0, 0, 0, 0, 0, 1.2]), np.zeros(6)
    vehicle = load_vehicle("bluerov2_heavy")
    monitor = Monitor(vehicle, (), FollowPath(), None, safety)
    assert _run(monitor, [_pose(0.0)] * 4, fast) is None
    monitor = Monitor(vehicle, (), FollowPath(), None, safety)
    for k in range(20):
        assert monitor.check(0.5 * k, _pose(0.0), slow if k % 4 == 3 else fast) is None
    monitor = Monitor(vehicle, (), FollowPath(), None, safety)
    outcome = _run(monitor, [_pose(0.0)] * 9, fast)
    assert outcome is not None
    assert (outcome.reason, outcome.time) == ("spinning", 2.0)


def test_what_is_not_finite_ends_the_run(monitor):
    outcome = monitor.check(0.1, _pose(math.nan), np.zeros(6))
    assert outcome is not None
    assert outcome.reason == "not finite"


@pytest.mark.parametrize("bad", [{"radius": 0.0}, {"near_time": -1.0}, {"progress": -0.1}])
def test_bad_rules_are_refused(bad):
    with pytest.raises(UserError, match=next(iter(bad))):
        ReachGoal(**bad)
