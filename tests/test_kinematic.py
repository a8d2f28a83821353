"""Biases of gyros in estimated states: the attitude's drift against the rates tells them."""

from dataclasses import replace

import numpy as np
import pytest
from hidden.blind import DATA, NOISE
from hidden.draw import Case, draw
from hidden.effects_measurement import GyroBias
from hidden.scenarios import Plan
from hidden.telemetry import Streams, write_tlog

from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.sensors import Imu
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.logs.load import load_data
from spinndrift.training.diagnosis.data.reckoned import OVER
from spinndrift.training.diagnosis.pipeline import Diagnoser, diagnose
from spinndrift.training.diagnosis.selection.kinematic import borne_out, drifts
from spinndrift.training.diagnosis.selection.state import Selection

VEHICLE = load_vehicle("bluerov2_heavy")
PLAN = Plan(scenarios=4, runs=1, seconds=24.0, rate=25.0, dead_reckoned=True)


def started(folder, *effects):
    Case(7, effects, PLAN, NOISE["stretches"]).write(folder)
    problem = Diagnoser(read_csv(folder, resample=False), VEHICLE).problem
    return Selection.start(problem, problem.evaluate(problem.believed, []))


@pytest.mark.parametrize(
    "bias", [*(pytest.param(b, marks=pytest.mark.slow) for b in (0.0, -0.001)), -0.005]
)
def test_a_drift_of_the_attitude_bears_out_a_bias_of_its_size(tmp_path, bias):
    state = started(tmp_path / "data", *([GyroBias(1, bias)] if bias else []))
    problem, error = state.problem, np.asarray(state.current.predictions.error)
    found, seconds = drifts(error, problem.data)
    assert seconds == pytest.approx(OVER)
    off = found + seconds * bias * np.eye(3)[1]
    assert np.all(np.abs(off.mean(axis=0)) < 4 * off.std(axis=0) / np.sqrt(len(off)))
    rows = [problem.library.at("gyro_bias", axis)[0] for axis in "xyz"]
    evidence = problem.evaluate(problem.believed, rows).evidence
    fits = {("gyro_bias", a): evidence.fit([i]) for a, i in zip("xyz", rows, strict=True)}
    told = [("gyro_bias", "y")] if abs(bias) > Imu().gyroscope_bias else []
    assert list(borne_out(state, fits, 0.01)) == told
    much = {h: replace(fit, values=3 * fit.values) for h, fit in fits.items()}
    assert borne_out(state, much, 0.01) == {}  # of another size: no bias of the gyro


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "named"), [("single", ["gyro_bias"]), ("null", [])])
def test_a_bias_is_named_from_a_dive_as_a_vehicle_logs_it(tmp_path, kind, named):
    plan, noise = DATA["dive"](Plan()), NOISE["dive"]
    case = draw(1032, kind, names=named, plan=plan, noise=noise)
    write_tlog(tmp_path / "dive.tlog", case.simulate(), Streams.draw(1032), noise.rate_filter)
    found = diagnose(load_data(tmp_path / "dive.tlog", resample=False), VEHICLE).diagnosis
    assert [c.name for c in found.causes] == named, found.sentence
    for cause, effect in zip(found.causes, case.effects, strict=True):
        truth = effect.parameters()["bias"]["value"]
        assert cause.parameters["bias"].value == pytest.approx(truth, rel=0.1)
