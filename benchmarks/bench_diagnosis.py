"""How long a diagnosis of 10 scenarios x 20 runs x 10 s takes, in one-step predictions of its data.

The data hide a lag of the thrusters (`tests/hidden`). Times are warm; the predictions of all
samples, with their Jacobians, are the yardstick of the same run.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).resolve().parent.parent / "tests"))

from hidden.draw import draw
from hidden.scenarios import Plan

from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.filter.innovations import predict
from spinndrift.training.diagnosis.pipeline import Diagnoser
from spinndrift.training.diagnosis.selection.search import Search
from spinndrift.training.diagnosis.selection.state import Selection

VEHICLE = load_vehicle("bluerov2_heavy")
DIFFUSION = np.array([1.0, 1.0, 1.0, 0.03, 0.03, 0.03])


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Recording:
    folder = tmp_path_factory.mktemp("full") / "data"
    draw(1, "single", names=("thruster_lag",), plan=Plan()).write(folder)
    return read_csv(folder)


def diagnoser(recording: Recording) -> Diagnoser:
    return Diagnoser(recording, VEHICLE, VEHICLE.dynamics(DIFFUSION))


def test_predictions_of_all_samples(benchmark, recording):
    problem = diagnoser(recording).problem

    def look():
        predict(
            problem.model, problem.library, problem.believed, problem.data
        ).error.block_until_ready()

    benchmark.pedantic(look, rounds=5, warmup_rounds=1)


def test_all_single_causes(benchmark, recording):
    """One look at the data and the fit of every cause alone, single thrusters too."""
    problem = diagnoser(recording).problem
    choices = []

    def single():
        first = problem.evaluate(problem.believed)
        choices.append(Search().propose(Selection.start(problem, first)).proposed[0])

    benchmark.pedantic(single, rounds=3, warmup_rounds=1)
    assert choices[-1].hypothesis == ("thruster_lag", "all")


def test_the_whole_diagnosis(benchmark, recording):
    """Composition, joint fit, gain and all, without the pages."""
    found = []
    benchmark.pedantic(lambda: found.append(diagnoser(recording).run()), rounds=1, warmup_rounds=1)
    assert [c.name for c in found[-1].diagnosis.causes] == ["thruster_lag"]
