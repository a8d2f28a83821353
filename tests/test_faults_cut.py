"""Faults that every run has are cut out, so that no cause is named for them."""

from functools import cache

import numpy as np
import pytest
from hidden.draw import Case
from hidden.faults import spoil
from hidden.scenarios import Plan
from hidden.write import write_folder

from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.data.checks import problems, without_faults
from spinndrift.training.diagnosis.disturbance.found import laws_of
from spinndrift.training.diagnosis.pipeline import Diagnoser

pytestmark = pytest.mark.whole

VEHICLE = load_vehicle("bluerov2_heavy")


@cache
def logged():
    return tuple(Case(3, (), Plan(scenarios=5, runs=2, seconds=8.0)).logged())


def spoilt(tmp_path, fault):
    runs, _ = spoil(list(logged()), fault, 3, count=len(logged()))
    write_folder(tmp_path / "data", runs, rate=20.0)
    return read_csv(tmp_path / "data")


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault",
    ["lost_lock", *(pytest.param(f, marks=pytest.mark.slow) for f in ("stuck", "pose_jump"))],
)
def test_a_fault_of_every_run_leaves_noise_alone(tmp_path, fault):
    recording = spoilt(tmp_path, fault)
    told, faulty = problems(recording)
    assert told
    assert len(faulty) == len(logged())
    diagnoser = Diagnoser(recording, VEHICLE)
    assert diagnoser.faults == told
    problem = diagnoser.problem
    seen = problem.evaluate(problem.believed, [])
    weight = problem.data.weight[:, None]
    count = weight.sum()
    square = (seen.z.astype(float) ** 2 * weight).sum(axis=(0, 2)) / count
    assert np.all(np.abs(square - 1) < 6 * np.sqrt(2 / count))
    assert max(law.heldout_gain for law in laws_of(problem, seen)) < 10


def test_good_stretches_stay_as_they_are(tmp_path):
    recording = spoilt(tmp_path, "stuck")
    cut = without_faults(recording)
    assert problems(cut)[1] == []
    lost = int(recording.lengths.sum() - cut.lengths.sum())
    # three seconds of each run, and the pieces beside them that are shorter than a second
    assert 10 * 59 <= lost <= 10 * (60 + 2 * 20)
    every = {row.tobytes() for run in recording.trajectories() for row in run.V_WB_B}
    assert {row.tobytes() for run in cut.trajectories() for row in run.V_WB_B} <= every


def test_a_channel_that_never_moves_is_not_cut(tmp_path):
    write_folder(tmp_path / "data", list(logged()), rate=20.0)
    recording = read_csv(tmp_path / "data")
    recording.dataset["V_WB_B"][..., 3] = 0.0
    assert len(problems(recording)[1]) == len(logged())
    assert without_faults(recording).lengths.sum() == recording.lengths.sum()
