from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hidden.draw import draw
from hidden.scenarios import Plan
from scipy.spatial.transform import Rotation

from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.reports.figures_maps import (
    binned,
    draw_map,
    error_map,
    in_one_noise,
    labelled,
    run_times,
    variables,
)
from spinndrift.training.diagnosis.data.arrays import make_data
from spinndrift.training.diagnosis.filter.problem import DiagnosisProblem
from spinndrift.training.diagnosis.findings.result import DataSummary, Diagnosis
from spinndrift.training.diagnosis.pipeline import Finding

VEHICLE = load_vehicle("bluerov2_heavy")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("null") / "data"
    draw(3, "null", plan=Plan(scenarios=3, runs=2, seconds=5.0)).write(folder)
    return read_csv(folder)


@pytest.fixture(scope="module")
def problem(recording):
    return DiagnosisProblem.of(recording, VEHICLE)


def finding(problem, base, final):
    data = DataSummary([], 0, 0.0, 0.05, "thruster_force", [], [], {})
    told = Diagnosis(
        4, "adequate", "", [], [], [], {}, {}, "scenario", data, 0, 0.0, 0.01
    )  # fmt: skip
    return Finding(
        told, problem.model, problem.library, final.theta, problem.data, base, final, {}, [], {}
    )


@pytest.mark.slow
def test_one_noise_is_a_models_own_where_both_have_the_same(problem):
    evaluation = problem.evaluate(problem.believed, [])
    z = in_one_noise(finding(problem, evaluation, evaluation)).base.z
    np.testing.assert_allclose(z, evaluation.z, atol=2e-3)  # the look's are of single precision


@pytest.mark.slow
def test_a_wrong_belief_is_larger_than_noise_in_the_noise_of_a_right_one(problem):
    theta = problem.believed.copy()
    theta[problem.library.at("thrust_scale", "all")] = 0.4
    wrong, right = problem.evaluate(theta, []), problem.evaluate(problem.believed, [])
    shared = in_one_noise(finding(problem, wrong, right))
    assert shared.final is right
    n = problem.data.steps
    own, one, noise = (
        (z.astype(float) ** 2).sum(axis=(0, 2))[6:].mean() / n
        for z in (wrong.z, shared.base.z, right.z)
    )
    assert one > own
    assert one > 1.5 * noise


def test_times_go_on_from_piece_to_piece_of_a_run(recording):
    data = make_data(recording, VEHICLE, segment=40)
    assert len(data.run) > len(np.unique(data.run))
    times = run_times(data)
    for run in np.unique(data.run):
        own = np.flatnonzero(data.run == run)
        assert times[0, own[0]] == 0
        last = data.weight[:, own].sum(axis=0).astype(int)
        np.testing.assert_allclose(times[0, own[1:]], times[last[:-1], own[:-1]], rtol=1e-12)


def test_variables_are_attitude_and_every_command_with_units(problem):
    evaluation = problem.evaluate(problem.believed, [])
    found = variables(finding(problem, evaluation, evaluation))
    q = problem.data.X[:-1, [1, 2, 3, 0]]
    euler = Rotation.from_quat(np.moveaxis(q, 1, -1).reshape(-1, 4)).as_euler("ZYX", degrees=True)
    for name, angle in zip(("heading", "pitch", "roll"), euler.T, strict=True):
        np.testing.assert_allclose(found[name].ravel(), angle, atol=1e-9)
    assert [n for n in found if n[0] == "f"] == [f"f{k}" for k in range(1, 9)]
    np.testing.assert_array_equal(found["f3"], problem.data.u[:, 2])
    assert labelled("f3") == "f3 / N"
    assert labelled("u") == "u / (m/s)"
    assert all("/" in labelled(n) for n in found if n != "run")
    # a wrench comes back from the thrusters that it was split over
    wrench = np.random.default_rng(0).standard_normal((6, *problem.data.voltage.shape))
    u = np.asarray(VEHICLE.thrusters().allocate(jnp.asarray(wrench))).swapaxes(0, 1)
    by_wrench = replace(problem, data=replace(problem.data, u=u, command="F_Bo_B"))
    found = variables(finding(by_wrench, evaluation, evaluation))
    np.testing.assert_allclose([found[n] for n in "XYZKMN"], wrench, atol=1e-9)
    assert labelled("K") == "K / N·m"


def test_maps_tell_dependence_from_noise_and_what_did_not_vary():
    rng = np.random.default_rng(0)
    n = 4000
    x = rng.standard_normal(n)
    known = {
        "x": x, "two": np.repeat([4.0, 8.0], n // 2), "rare": (np.arange(n) % 50 == 0) * x,
        "same": np.full(n, 3.0),
    }  # fmt: skip
    z = rng.standard_normal((n, 3))
    z[:, 1] += np.sign(known["two"] - 6)
    z[:, 2] += known["x"]
    nats = error_map(z, known)
    assert np.isnan(nats[:, 3]).all()
    # ½ χ² of 12 or fewer bins less half their number: five standard deviations
    assert np.nanmax(nats[0]) < 5 * np.sqrt(12 / 2)
    assert nats[1, 1] == pytest.approx(n / 2, rel=0.1)
    # means over bins keep most of the variance of a slope
    assert 0.8 * n / 2 < nats[2, 0] < 1.2 * n / 2
    assert binned(known["same"]) is None
    rare = binned(known["rare"])
    assert rare is not None
    assert rare.max() == 2, "less, zero, more"
    figure = draw_map([nats, nats * 0], ("a", "b"), list(known), ("u", "v", "w"))
    assert len(figure.axes) == 3
