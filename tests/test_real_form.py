"""Diagnosis of what users have: few long stretches, recorded through an estimator.

Its velocities err by 1.2 cm/s with a memory of 0.8 s, its attitude by 0.2° with one of 3 s, and
positions are dead-reckoned. Nobody states a diffusion.
"""

from dataclasses import replace

import numpy as np
import pytest
from hidden.blind import DATA, ESTIMATED, NOISE
from hidden.draw import Case, draw
from hidden.effects_actuation import ThrusterGain
from hidden.scenarios import Plan
from hidden.telemetry import Streams, write_tlog

from helpers import shared_data
from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.logs.load import LogOptions, load_data
from spinndrift.training.diagnosis.disturbance.found import all_laws
from spinndrift.training.diagnosis.filter.noise import slip_of
from spinndrift.training.diagnosis.findings.reported import residual
from spinndrift.training.diagnosis.pipeline import Diagnoser, diagnose

pytestmark = pytest.mark.whole

VEHICLE = load_vehicle("bluerov2_heavy")


def recorded(folder, plan, seed=7, kind="null", **options):
    case = draw(seed, kind, plan=plan, noise=ESTIMATED, **options)
    case.write(folder / "data")
    return case, read_csv(folder / "data", resample=False)


def test_slip_is_that_of_an_estimator_and_none_of_an_instrument():
    """Drift of a Gauss–Markov attitude, against white errors and against dead reckoning."""
    rng, N, R, dt = np.random.default_rng(0), 3000, 4, 0.02
    size, memory = 0.0035, 3.0
    kept = np.exp(-dt / memory)
    e = size * rng.standard_normal((N + 1, R))
    for n in range(N):
        e[n + 1] = kept * e[n] + np.sqrt(1 - kept**2) * e[n + 1]
    error = np.zeros((N, 12, R))
    error[:, 3] = np.diff(e, axis=0)
    white = 0.005 * rng.standard_normal((N + 1, R))
    error[:, 0] = np.diff(white, axis=0)
    push = 0.01 * rng.standard_normal((N, R))  # moves pose and twist alike: no error of either
    error[:, 1], error[:, 7] = dt / 2 * push, push
    slip = slip_of(error, np.ones((N, R)), dt)
    drift = size * np.sqrt(2 / memory)
    assert slip[3] == pytest.approx(drift, rel=6 / np.sqrt(2 * N * R))
    assert slip[0] == 0
    assert slip[1] < 1e-12


def test_errors_of_an_estimator_are_no_law_of_the_disturbance(tmp_path):
    """They are noise of the records: innovations are white, and no larger than predicted.

    Slip covers errors that last, so that innovations are smaller than predicted from step to step.
    """
    plan = Plan(scenarios=4, runs=1, seconds=24.0, rate=25.0, dead_reckoned=True)
    _, recording = recorded(tmp_path, plan)
    problem = Diagnoser(recording, VEHICLE).problem
    assert problem.data.left_out == "block"
    assert len(np.unique(problem.data.fold)) == 10
    seen = problem.evaluate(problem.believed, [])
    assert not seen.noise.estimated
    assert np.all(seen.noise.slip[3:] == pytest.approx(0.0035 * np.sqrt(2 / 3.0), rel=0.1))
    left = residual(problem, seen)
    n = problem.data.weight.sum()
    for name in ("roll", "pitch", "yaw", "u", "v", "w", "p", "q", "r"):
        assert 0.7 < left[name].variance_ratio < 1.15, name
        assert abs(left[name].autocorrelation) < 6 / np.sqrt(n), name
    assert [w for w in all_laws(problem, seen, 10.0) if w.heldout_gain > 10] == []


@pytest.mark.slow
@pytest.mark.parametrize("data", ["stretches", "flights"])
def test_nulls_of_real_form_are_adequate(tmp_path, data):
    _, recording = recorded(tmp_path, DATA[data](Plan()), 51_000)
    found = diagnose(recording, VEHICLE).diagnosis
    assert found.verdict == "adequate", found.sentence
    for share in found.gain["base"].coverage["90 %"].values():
        assert share.value == pytest.approx(0.9, abs=0.06)


@pytest.mark.slow
def test_a_weak_thruster_is_named_through_an_estimator(tmp_path):
    case, recording = recorded(
        tmp_path, DATA["stretches"](Plan()), 3, "single", names=("thruster_gain",)
    )
    found = diagnose(recording, VEHICLE).diagnosis
    assert [c.name for c in found.causes] == ["thruster_gain"], found.sentence
    assert found.verdict == "explained"
    gain = found.causes[0].parameters["gain"]
    truth = case.effects[0].parameters()["gain"]["value"] - 1
    assert gain.interval95[0] - 0.02 < truth < gain.interval95[1] + 0.02


@pytest.mark.slow
def test_a_belief_with_half_the_drag_is_told_with_its_ratios(tmp_path):
    """No name explains all axes; refitted coefficients do, and are what the sentence leads with."""
    _, recording = recorded(tmp_path, DATA["stretches"](Plan()))
    half = replace(VEHICLE, quadratic_damping=tuple(0.45 * d for d in VEHICLE.quadratic_damping))
    found = diagnose(recording, half).diagnosis
    assert found.verdict == "explained", found.sentence
    assert "quadratic drag" in found.sentence
    assert "disturbance_colour" not in [c.name for c in found.causes]


@pytest.mark.slow
def test_a_dive_through_an_autopilot_is_adequate_with_the_truth_and_refitted_without():
    """ArduSub's dive: with the simulator's constants adequate, with another vehicle's told."""
    log = shared_data("sitl_log", "dive.tlog")
    options = LogOptions(water_density=1023.6)
    for name, verdict in (("ardusub_sitl", "adequate"), ("bluerov2_heavy", "explained")):
        recording = load_data(log, vehicle=name, options=options, resample=False)
        found = diagnose(recording, load_vehicle(name)).diagnosis
        assert found.verdict == verdict, found.sentence
    assert found.sentence.startswith("Over inertia, your coefficients are off")
    truth = {"quadratic_drag": {"surge": 48.28 / 10.5, "sway": 62.08 / 10.5, "heave": 68.98 / 10.5}}
    truth["half_thrust"] = dict.fromkeys(("surge", "sway", "heave"), 51.48 / 10.5)
    for r in found.ratios:
        if r.where in truth.get(r.name, ()):
            assert r.found.value == pytest.approx(truth[r.name][r.where], rel=0.03), r
    assert min(s.value for s in found.explained.values()) > 0.85


@pytest.mark.slow
@pytest.mark.parametrize("gain", [-1.0, 0.0])
def test_a_thruster_that_is_reversed_or_dead_is_named_alone(tmp_path, gain):
    """Its errors are large and last, so that states look estimated, and structure imitates it."""
    plan, noise = DATA["dive"](Plan()), NOISE["dive"]
    case = Case(3003, (ThrusterGain(3, gain),), plan, noise)
    write_tlog(tmp_path / "dive.tlog", case.simulate(), Streams.draw(3003), noise.rate_filter)
    found = diagnose(load_data(tmp_path / "dive.tlog", resample=False), VEHICLE).diagnosis
    assert [(c.name, c.where) for c in found.causes] == [("thruster_gain", "3")], found.sentence
    assert found.verdict == "explained", found.sentence
    assert found.causes[0].parameters["gain"].value == pytest.approx(gain - 1, abs=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("data", "seed", "name"), [("piloted", 3, "tether"), ("dive", 5, "quadratic_drag")]
)
def test_causes_are_named_from_a_dive_as_a_vehicle_logs_it(tmp_path, data, seed, name):
    """Telemetry: every state an estimate, rates filtered, outputs sent at 10 to 50 Hz."""
    plan, noise = DATA[data](Plan()), NOISE[data]
    case = draw(seed, "single", names=(name,), plan=plan, noise=noise)
    write_tlog(tmp_path / "dive.tlog", case.simulate(), Streams.draw(seed), noise.rate_filter)
    found = diagnose(load_data(tmp_path / "dive.tlog", resample=False), VEHICLE).diagnosis
    assert found.verdict == "explained", found.sentence
    assert [c.name for c in found.causes] == [name], found.sentence
