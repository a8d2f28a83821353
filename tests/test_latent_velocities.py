"""Diagnosis of recordings without u and v: attitude, rates, climb, perhaps an accelerometer."""

import numpy as np
import pytest
import scipy.linalg
import scipy.stats
from hidden.draw import draw
from hidden.instruments import specific_force
from hidden.scenarios import Plan
from hidden.write import write_folder

from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.data.checks import limits
from spinndrift.training.diagnosis.filter.kalman import filtered, log_density, make_filter
from spinndrift.training.diagnosis.filter.noise import Noise, process_covariance
from spinndrift.training.diagnosis.filter.problem import DiagnosisProblem
from spinndrift.training.diagnosis.filter.transition import Latent, Transition
from spinndrift.training.diagnosis.findings.reported import residual
from spinndrift.training.diagnosis.pipeline import DiagnoseConfig, Diagnoser
from spinndrift.training.diagnosis.selection.model_selection import acts_unseen
from spinndrift.training.diagnosis.selection.refit_all import one_step, with_coefficients
from spinndrift.training.diagnosis.selection.state import Selection

pytestmark = pytest.mark.whole

VEHICLE = load_vehicle("bluerov2_heavy")
PLAN = Plan(scenarios=6, runs=2, seconds=8.0)
FELT = 0.03  # m/s², noise of the accelerometer


def hidden(folder, names=(), seed=7, plan=PLAN):
    """A case without u, v, x, y; its specific force (J, K, N, 3) and its whole recording."""
    case = draw(seed, "single" if names else "null", names=names or None, plan=plan)
    truth = case.simulate()
    write_folder(folder / "data", case.logged(truth=truth), rate=plan.rate)
    whole = read_csv(folder / "data", resample=False)
    force = specific_force(truth.states, case.scenarios().setup.samples, plan.h)
    force = force + FELT * np.random.default_rng(seed).standard_normal(force.shape)
    return case, without(whole), np.moveaxis(force, 2, 0).reshape(plan.scenarios, plan.runs, -1, 3)


def without(recording, channels=("u", "v"), coordinates=("x", "y")):
    found = recording.dataset.copy(deep=True)
    for name in channels:
        found["V_WB_B"].loc[{"twist_component": name}] = np.nan
    for name in coordinates:
        found["X_WB"].loc[{"pose_component": name}] = np.nan
    return Recording(found)


def felt(recording, force):
    leading = ("scenario", "trajectory", "time", "axis")
    return Recording(recording.dataset.assign(imu_specific_force=(leading, force)))


def proposed(recording):
    """The best cause, and the evaluation of the belief."""
    diagnoser = Diagnoser(recording, VEHICLE, config=DiagnoseConfig(refit="none"))
    problem = diagnoser.problem
    base = problem.evaluate(problem.believed)
    state = diagnoser._selector(problem, []).propose(Selection.start(problem, base))
    return state.proposed[0], base, problem


def test_innovations_of_latent_velocities_have_the_density_of_all_data_at_once():
    """Against the joint normal density of all records, with an accelerometer for two velocities."""
    rng, N, dt = np.random.default_rng(2), 6, 0.1
    A = np.eye(12)
    A[:6, 6:] = dt * np.eye(6)
    A[3:, 3:] += 0.05 * rng.standard_normal((9, 9))
    A[:3] = np.eye(12)[:3]  # biases
    A[3:, :3] = 0.0
    B = np.zeros((12, 12))
    B[6:8, 6:] = np.eye(6)[:2] + 0.1 * rng.standard_normal((2, 6))
    B[6:8, 3:6] = 0.3 * rng.standard_normal((2, 3))
    B[6, 0], B[7, 1] = -dt, -dt
    record = rng.uniform(0.02, 0.1, 12)
    first = record.copy()
    first[[0, 1, 6, 7]] = 0.1, 0.2, 0.4, 0.3
    silent = np.zeros(12, bool)
    silent[:3] = True
    noise = Noise(record, np.full(6, 0.2), silent=silent, first=first)
    latent = Latent({0: 1.0, 1: 1.0}, (0, 1), np.broadcast_to(B[..., None], (N, 12, 12, 1)))
    step, weight = np.full((N, 1), dt), np.ones((N, 1))
    steps = Transition(A, np.zeros([12] * 4), latent=latent.mean(weight))
    kalman = make_filter(noise, steps, np.eye(6), dt, step, None, latent)
    Q = process_covariance(A, np.eye(6), noise.diffusion, dt)

    known = [i for i in range(3, 12) if i not in (6, 7)]
    seen, root = [*known, 6, 7], np.linalg.cholesky(Q + 1e-14 * np.eye(12))
    x = np.zeros((N + 1, 12))
    x[0] = first * rng.standard_normal(12)
    for n in range(N):
        x[n + 1] = A @ x[n] + root @ rng.standard_normal(12)
    z = x + record * rng.standard_normal(x.shape)
    z[0] = 0.0  # the first record is where the filter starts
    y = x[1:] - x[:-1] @ B.T + record * rng.standard_normal((N, 12))
    error, reference = np.zeros((N, 12, 1)), np.zeros((N + 1, 12))
    for n in range(N):
        reference[n + 1] = A @ reference[n]
        error[n, known, 0] = (z[n + 1] - reference[n + 1])[known]
        error[n, 6:8, 0] = (y[n] - reference[n + 1] + B @ reference[n])[6:8]
        reference[n + 1, known] = z[n + 1, known]
    jacobian = np.broadcast_to(A[..., None], (N, 12, 12, 1))
    white = filtered(error, jacobian, kalman, latent)
    white[:, :3] = 0.0
    unused = 3 * N * (np.log(10.0) + np.log(2 * np.pi) / 2)  # places without any instrument
    found = log_density(white, kalman, weight)[0] + unused

    # all data as a linear function of the first state and the process noise
    before, rows = np.zeros((12, 12 * (N + 1))), []
    before[:, :12] = np.eye(12)
    for n in range(N):
        after = A @ before
        after[:, 12 * (n + 1) : 12 * (n + 2)] = np.eye(12)
        rows += [after[known], (after - B @ before)[6:8]]
        before = after
    prior = scipy.linalg.block_diag(np.diag(first**2), *[Q] * N)
    whole = np.concatenate(rows)
    S = whole @ prior @ whole.T + np.diag(np.tile(record[seen] ** 2, N))
    data = np.concatenate([z[1:, known], y[:, 6:8]], axis=1).ravel()
    wanted = scipy.stats.multivariate_normal(np.zeros(len(data)), S).logpdf(data)
    assert found == pytest.approx(wanted, abs=0.05)


@pytest.mark.slow
def test_a_weak_thruster_and_drag_are_named_without_u_and_v(tmp_path):
    """As with a DVL; from attitude, rates and w alone, and with an accelerometer."""
    for number, name in enumerate(("thruster_gain", "quadratic_drag")):
        case, recording, force = hidden(tmp_path / name, (name,))
        truth = case.answer()["causes"][0]
        choice, _, problem = proposed(felt(recording, force) if number else recording)
        assert choice is not None
        assert choice.hypothesis == (name, truth["where"])
        rows = problem.library.at(*choice.hypothesis)
        theta, _, fit = problem.polish(problem.believed, rows)
        value = next(iter(truth["parameters"].values()))["value"] - (name == "thruster_gain")
        assert abs(theta[rows[0]] - value) < 3 * fit.errors[0]
        assert fit.errors[0] < 0.05 * abs(value)


@pytest.mark.slow
def test_nothing_is_named_without_u_and_v_where_nothing_is_hidden(tmp_path):
    """Innovations are white and of the predicted size, and axes that no instrument tells of have
    no causes."""
    _, recording, force = hidden(tmp_path)
    for given in (recording, felt(recording, force)):
        choice, seen, problem = proposed(given)
        assert choice is None
        left = residual(problem, seen)
        assert all(np.isnan(left[name].variance_ratio) for name in ("x", "y", "z", "u", "v"))
        for name in ("roll", "pitch", "yaw", "w", "p", "q", "r"):
            assert 0.6 < left[name].variance_ratio < 1.2, name
        told = " ".join(limits(problem.data, [], False))
        assert "u, v were not measured" in told
        assert ("no instrument tells" in told) == (given is recording)
        causes = {e.cause for e in problem.library.entries}
        assert not causes & {"dvl_scale", "dvl_lever_arm", "current_steady", "tether"}


def test_thrust_is_known_on_axes_whose_velocity_nobody_has_measured():
    unseen = ["surge", "sway"]
    assert acts_unseen("axis_thrust", "surge", unseen)
    assert acts_unseen("quadratic_drag", "sway", unseen)
    assert acts_unseen("drag_coupling", "pitch_from_surge", unseen)
    assert not acts_unseen("drag_coupling", "pitch_from_heave", unseen)
    assert not acts_unseen("thrust_lever", "pitch_from_surge", unseen)


@pytest.mark.slow
def test_far_from_the_belief_sensitivities_are_those_of_the_simulation(tmp_path):
    """A latent velocity carries an error on through all later steps, as the model at hand lets it:
    here with another mass, without its Munk moment, and with twice the drag of the belief."""
    _, recording, force = hidden(tmp_path)
    problem = DiagnosisProblem.of(felt(recording, force), VEHICLE)
    problem = with_coefficients(problem, "all")
    library, theta = problem.library, problem.believed.copy()
    most = max(problem.believes("added_mass", axis) for axis in ("surge", "sway", "heave"))
    for axis in ("surge", "sway", "heave"):
        theta[library.at("added_mass", axis)] = most - problem.believes("added_mass", axis)
        drag = problem.believes("quadratic_drag", axis)
        theta[library.at("quadratic_drag", axis)] = drag
    problem = problem.along(theta)
    kalman = one_step(problem, theta)
    rows = [i for a in ("surge", "sway") for i in library.at("axis_thrust", a)]
    seen = problem.evaluate(theta, rows, kalman)
    for axis, row in zip((0, 1), rows, strict=True):
        probe = np.zeros((1, library.size))
        probe[0, row] = 1e-3
        shape = (len(problem.data.u), 12, -1)
        changed = problem.whitened(seen, probe)[1].reshape(shape)
        errors = problem.errors(theta + probe[0] / 2) - problem.errors(theta - probe[0] / 2)
        exact = np.einsum("nijr,njr->nir", kalman.whiten, errors)
        own = changed[:, 6 + axis] * problem.data.weight, exact[:, 6 + axis]
        sizes = [np.linalg.norm(x) for x in own]
        assert np.sum(own[0] * own[1]) > 0.97 * sizes[0] * sizes[1]
        assert sizes[0] == pytest.approx(sizes[1], rel=0.1)
        turned = [np.linalg.norm(x[:, 9:]) for x in (changed, exact)]
        assert turned[0] < 0.2 * sizes[0], "no moment turns it"
        assert turned[1] < 0.2 * sizes[1]
