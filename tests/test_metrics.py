"""Metrics of a made-up run whose numbers are known."""

import json
import math

import numpy as np
import pytest
from run_example import ESTIMATE_ERROR, GOAL, example_log

from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.run.estimate import average_bound, estimate_error, mahalanobis, nees_words
from spinndrift.sims.run.log import RunLog
from spinndrift.sims.run.metrics import clearance, metrics, tracking_error
from spinndrift.sims.scenarios.criteria import FollowPath, Outcome, ReachGoal
from spinndrift.systems.planning.obstacles import Pylon

VEHICLE = load_vehicle("bluerov2_heavy")
REACHED = Outcome("goal", 20.0, "There.")


def _changed(log: RunLog, **variables: np.ndarray) -> RunLog:
    data = log.recording.dataset.copy(deep=True)
    for name, values in variables.items():
        data[name].to_numpy()[0, 0] = values
    return RunLog(type(log.recording)(data))


def test_known_numbers():
    log = example_log()
    found = metrics(log, REACHED, ReachGoal(), VEHICLE, (), np.array(GOAL))
    assert found["outcome"] == {
        "success": True,
        "reason": "goal",
        "time_s": 20.0,
        "words": "There.",
    }
    assert found["path"]["time_to_goal_s"] == 20.0
    assert found["path"]["min_clearance_m"] is None
    assert found["path"]["final_distance_m"] == pytest.approx(0, abs=1e-9)
    assert found["estimate"]["position_rms_m"] == pytest.approx(np.linalg.norm(ESTIMATE_ERROR))
    assert found["estimate"]["position_final_m"] == pytest.approx(np.linalg.norm(ESTIMATE_ERROR))
    assert found["tracking"]["position_rms_m"] == pytest.approx(0, abs=1e-12)
    assert found["tracking"]["without_plan_s"] == pytest.approx(0.05)
    speed = np.linalg.norm(log["V_WB_B"][:, :3], axis=1)
    assert found["path"]["length_m"] == pytest.approx(np.trapezoid(speed, log.time), rel=1e-3)


def test_tracking_error_points_from_the_vehicle_to_the_plan():
    log = example_log()
    plan = log["X_WB"].copy()
    plan[:, 4:] += [0.3, 0.0, 0.4]
    found = metrics(_changed(log, X_WB_plan=plan), REACHED, ReachGoal(), VEHICLE)
    assert found["tracking"]["position_rms_m"] == pytest.approx(0.5)
    error = tracking_error(_changed(log, X_WB_plan=plan))
    assert error is not None
    assert np.isnan(error[0][0]).all()  # no plan yet
    yaw = 2 * np.arctan2(log["X_WB"][1:, 3], log["X_WB"][1:, 0])
    np.testing.assert_allclose(error[0][1:, 0], 0.3 * np.cos(yaw), atol=1e-12)


def test_share_within_three_sigma_of_gaussian_errors():
    log = example_log(200.0)
    n = log.time.size
    rng = np.random.default_rng(0)
    std = np.full((n, 18), 0.05)
    estimate = log["X_WB"].copy()
    estimate[:, 4:] += 0.05 * rng.normal(size=(n, 3))
    covariance = np.tile(0.05**2 * np.eye(3).ravel(), (n, 3))
    log = _changed(log, X_WB_estimate=estimate, error_std=std, error_covariance=covariance)
    found = metrics(log, REACHED, ReachGoal(), VEHICLE)["estimate"]
    # 12003 Gaussians: 99.73 % ± 0.05 %, mean of 4001 sums of three squares 3 ± 0.04
    assert found["position_within_3_sigma"] == pytest.approx(0.9973, abs=0.002)
    assert found["position_nees"] == pytest.approx(3.0, abs=0.16)


def test_what_is_said_of_nees_follows_from_its_bounds():
    low, high = average_bound(3)
    own = {"position_nees": 3.0, "attitude_nees": low, "velocity_nees": high}
    bounds = {"nees_low": low, "nees_high": high}
    said = "position 3, attitude 0.22, velocity 9.3, all inside the bounds 0.22 to 9.3"
    assert nees_words(own | bounds) == said
    said = "position 3, attitude 0.21 (outside), velocity 9.4 (outside), bounds 0.22 to 9.3"
    off = {"attitude_nees": 0.21, "velocity_nees": 9.4}
    assert nees_words(own | bounds | off) == said
    assert nees_words(own | bounds | {"attitude_nees": None}) is None
    assert nees_words(own | bounds | {"attitude_nees": math.nan}) is None
    assert nees_words({}) is None


def test_nees_of_a_block_counts_how_its_axes_correlate():
    """δ = L z has δᵀ (L Lᵀ)⁻¹ δ = zᵀz, whatever the block's units; singular blocks have none."""
    rng = np.random.default_rng(1)
    L, z = (
        rng.normal(size=(5, 3, 3, 3)) * [[[[1e-3]], [[1.0]], [[1e3]]]],
        rng.normal(size=(5, 3, 3)),
    )
    delta = np.einsum("nbij,nbj->nbi", L, z).reshape(5, 9)
    P = np.einsum("nbij,nbkj->nbik", L, L).reshape(5, 27)
    P[3, :9], delta[4, 5] = 0.0, np.nan
    expected = np.sum(z**2, axis=2)
    expected[3, 0] = expected[4, 1] = np.nan
    np.testing.assert_allclose(mahalanobis(delta, P), expected, rtol=1e-6)


def test_bounds_of_an_average_are_those_of_chi_square():
    """Tables: χ²(3) is 0.2158 and 9.3484, χ²(150) is 117.985 and 185.800 at 2.5 and 97.5 %."""
    np.testing.assert_allclose(average_bound(3), (0.2158, 9.3484), atol=5e-5)
    np.testing.assert_allclose(average_bound(3, 50), (117.985 / 50, 185.8 / 50), atol=1e-4)


def test_health_is_told_by_its_time_and_by_who_is_not_trusted():
    log = example_log()
    found = metrics(log, REACHED, ReachGoal(), VEHICLE)["estimate"]
    assert found["health"] == "good 75 %, degraded (dvl) 25 %"
    assert (found["health_lost"], found["health_good"]) == (0, pytest.approx(301 / 401))


def test_estimate_error_is_the_filters():
    log = example_log()
    known = estimate_error(log)
    assert known is not None
    # X = X̂ exp(δ): a shift by −e in W, seen in the estimate's axes
    norms = np.linalg.norm(known[0][:, :3], axis=1)
    np.testing.assert_allclose(norms, np.linalg.norm(ESTIMATE_ERROR), rtol=1e-9)


def test_least_clearance_is_that_of_the_box():
    log = example_log()
    hull = VEHICLE.size
    pylon = Pylon(-2.0, 0.0, 0.4)
    gap = clearance(log, VEHICLE, (pylon,))
    assert gap is not None
    assert gap[0] == pytest.approx(2.0 - 0.2 - hull[0] / 2)
    found = metrics(log, REACHED, ReachGoal(), VEHICLE, (pylon,))
    assert found["path"]["min_clearance_m"] == pytest.approx(gap.min())


def test_following_is_judged_at_the_end():
    log = example_log()
    over = Outcome("duration", 20.0, "The time was over.")
    assert metrics(log, over, FollowPath(), VEHICLE)["outcome"]["success"] is True
    plan = log["X_WB"] + np.array([0, 0, 0, 0, 0.4, 0, 0])
    found = metrics(_changed(log, X_WB_plan=plan), over, FollowPath(), VEHICLE)["outcome"]
    assert found["success"] is False
    assert "tracking error was 0.40 m RMS" in found["words"]
    early = Outcome("interrupted", 3.0, "Stopped.")
    assert metrics(log, early, FollowPath(), VEHICLE)["outcome"]["success"] is False


def test_metrics_are_json_without_nan():
    log = example_log(1.0)  # shorter than what settles: no tracking error
    found = metrics(log, Outcome("duration", 1.0, "Over."), FollowPath(), VEHICLE)
    assert found["tracking"]["position_rms_m"] is None
    assert found["outcome"]["success"] is False
    text = json.dumps(found, allow_nan=False)
    assert json.loads(text) == found
    assert text == json.dumps(
        metrics(log, Outcome("duration", 1.0, "Over."), FollowPath(), VEHICLE), allow_nan=False
    )
    assert not math.isnan(found["path"]["length_m"])
