"""A run's log is a recording with more in it, and comes back from disk as it was."""

import numpy as np
import pytest
from run_example import example_log

from spinndrift.models.recordings.store import Recording
from spinndrift.sims.run.log import RunLog


def test_log_survives_its_file(tmp_path):
    log = example_log(4.0)
    log.save(tmp_path / "log.nc")
    again = RunLog.load(tmp_path / "log.nc")
    for name in ("X_WB", "F_Bo_B", "pwm", "X_WB_estimate", "error_std", "flow_W", "plan_valid"):
        np.testing.assert_array_equal(again[name], log[name])
    before, after = log.plans, again.plans
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(after.p_WB, before.p_WB)
    np.testing.assert_array_equal(after.time, before.time)
    assert after.dt == before.dt
    assert again.dt == pytest.approx(0.05)


def test_log_is_a_recording_that_training_can_cut(tmp_path):
    example_log(4.0).save(tmp_path / "log.nc")
    recording = Recording.load(tmp_path / "log.nc")
    assert recording.vehicle == "bluerov2_heavy"
    learn, test = recording.split_by_time(0.25, gap=0.5)
    assert learn.duration > test.duration > 0
    assert "X_WB_estimate" in learn.dataset


def test_which_plan_was_the_newest():
    log = example_log(2.0)
    plans = log.plans
    assert plans is not None
    assert plans.at(0.1) is None
    assert plans.at(0.2) == 0
    assert plans.at(0.59) == 1
    assert plans.at(9.0) == plans.time.size - 1
    assert example_log(2.0, planned=False).plans is None
    assert "plan_X_WB" not in example_log(2.0, planned=False)
