"""Fits to forecasts and commands of unknown scale, on runs whose truth is known."""

import jax.numpy as jnp
import numpy as np
import pytest
from multi_step_fit import (
    fit_forecasts,
    forecast_errors,
    rmse,
    windows,
)

from spinndrift.models.effects import KINDS, Extended
from spinndrift.models.effects.thrust import AxisThrust
from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.filter.along_records import substeps
from spinndrift.training.diagnosis.filter.problem import DiagnosisProblem
from spinndrift.training.diagnosis.pipeline import DiagnoseConfig, Diagnoser
from spinndrift.training.diagnosis.selection.search import refitted

VEHICLE = load_vehicle("bluerov2_heavy")
DT, STEPS, RUNS = 0.1, 160, 4
SIZES = np.array([30, 30, 30, 3, 3, 3.0])


def recording(effects, seed=0):
    """Noise-free runs under random steps of the wrench."""
    rng = np.random.default_rng(seed)
    model = Extended.create(VEHICLE.dynamics(), effects, VEHICLE.thrusters())
    F = np.repeat(rng.uniform(-1, 1, (STEPS // 8, 6, RUNS)), 8, axis=0) * SIZES[:, None]
    X0 = jnp.zeros((7, RUNS)).at[0].set(1).at[6].set(-5)
    u = jnp.einsum("ni,tir->tnr", model.inverse, jnp.asarray(F))
    parts = substeps(DT)  # of each command: the fit's own step
    X, V = model.rollout(X0, jnp.zeros((6, RUNS)), jnp.repeat(u, parts, axis=0), DT / parts)
    X, V = (np.asarray(a)[parts - 1 :: parts] for a in (X, V))
    made = [
        Trajectory(f"run_{r // 2}", X[:-1, :, r], V[:-1, :, r], {"F_Bo_B": F[1:, :, r]}, {})
        for r in range(RUNS)
    ]
    return Recording.from_trajectories(made, DT, vehicle="bluerov2_heavy")


def problem_of(made):
    return DiagnosisProblem.of(made, VEHICLE).with_effect(AxisThrust.neutral())


def rows_of(problem, *names):
    """As many rows of the same effects in every test: one compiled program."""
    return [i for name in names for i in problem.library.at(*name)]


@pytest.mark.slow
def test_gains_and_drag_come_back_from_forecasts():
    """Noise-free data, the integrator's step that of the truth: to the end of Gauss–Newton."""
    truth = (
        AxisThrust.of("surge", scale=-0.5),
        KINDS["quadratic_drag"].of("surge", change=-25.0),
        KINDS["linear_drag"].of("yaw", change=0.8),
    )
    problem = problem_of(recording(truth))
    w = windows(problem.data, 1.0, 2.0)
    surge, heave = ("axis_thrust", "surge"), ("axis_thrust", "heave")
    drag, yaw = ("quadratic_drag", "surge"), ("linear_drag", "yaw")
    rows = rows_of(problem, surge, heave, drag, yaw)
    fit = fit_forecasts(problem, w, rows)
    found = {problem.library.entries[i][:2]: fit.theta[i] for i in rows}
    assert found[surge] == pytest.approx(-0.5, abs=0.01)
    assert found[drag] == pytest.approx(-25.0, rel=0.05)
    assert found[yaw] == pytest.approx(0.8, rel=0.1)
    assert found[heave] == pytest.approx(0.0, abs=0.01)
    before = forecast_errors(problem, problem.believed, w)
    after = forecast_errors(problem, fit.theta, w)
    ratio = rmse(after, w.block, np.random.default_rng(0), before)
    assert max(high for _, _, high in ratio.values()) < 0.1


@pytest.mark.slow
def test_drag_stays_passive_and_left_out_windows_are_not_used():
    truth = (
        KINDS["quadratic_drag"].of("surge", change=-62.0),
        KINDS["linear_drag"].of("surge", change=12.0),
    )
    problem = problem_of(recording(truth))
    w = windows(problem.data, 1.0, 2.0)
    drag = ("quadratic_drag", "surge")
    rows = rows_of(
        problem, drag, ("linear_drag", "surge"), ("axis_thrust", "heave"), ("linear_drag", "yaw")
    )
    kept = w.scenario == 0
    fit = fit_forecasts(problem, w, rows, kept=kept)
    assert fit.theta[rows[0]] == pytest.approx(-58.42, abs=1e-6)  # all of the preset's
    w.X[:, :, ~kept] = np.nan  # what must not matter
    again = fit_forecasts(problem, w, rows, kept=kept)
    np.testing.assert_array_equal(again.theta, fit.theta)


@pytest.mark.slow
def test_what_thrusters_did_before_a_run_shows_in_no_piece():
    """A run that begins as commands step: thrusters follow what was commanded before it."""
    problem = DiagnosisProblem.of(
        recording((KINDS["thruster_lag"].of(time_constant=0.15),)).cut(4.0), VEHICLE
    )
    theta = problem.believed.copy()
    theta[problem.library.index("thruster_lag", "all", "time_constant")] = 0.15
    wrong, right = (np.abs(problem.errors(a)).max() for a in (problem.believed, theta))
    assert len(problem.data.past) == 5
    assert right < 1.1 * np.exp(-0.5 / 0.15) * wrong


def test_windows_are_records_and_their_commands():
    problem = problem_of(recording(()))
    data, w = problem.data, windows(problem.data, 1.0, 0.5)
    M, length = 10, int(data.weight[:, 0].sum())
    assert w.X.shape[:2] == (M + 1, 7)
    assert (w.scenario == 0).sum() == 2 * ((length - M) // 5 + 1)
    np.testing.assert_array_equal(w.X[..., 1], data.X[5 : 5 + M + 1, :, 0])
    np.testing.assert_array_equal(w.past[-1, :, 1], data.u[4, :, 0])
    np.testing.assert_array_equal(w.past[:-5, :, 1], data.past[5:, :, 0])
    errors = forecast_errors(problem, problem.believed, w)
    assert np.abs(errors).max() < 1e-9  # the truth forecasts itself


def test_intervals_cover_and_ratios_of_the_same_are_one():
    rng = np.random.default_rng(3)
    e = rng.normal(size=(1, 12, 300))
    found = rmse(e, np.arange(300) // 3, rng)
    for value, low, high in found.values():
        assert low < value < high
        assert low < np.sqrt(3) < high
    for value in rmse(e, np.arange(300) // 3, rng, e).values():
        assert value == pytest.approx((1, 1, 1))


def test_long_steps_are_cut():
    assert [substeps(dt) for dt in (0.01, 0.02, 0.05, 0.1, 0.2)] == [2, 2, 4, 8, 16]


def test_the_gain_of_a_command_is_there_only_if_asked_for():
    made = recording(())
    assert not Diagnoser(made, VEHICLE).problem.library.has("axis_thrust")
    asked = Diagnoser(made, VEHICLE, None, DiagnoseConfig(refit="command"))
    assert asked.problem.library.has("axis_thrust")
    free = {asked.problem.library.entries[i].cause for i in refitted(asked.problem, "command")}
    assert "axis_thrust" in free
    assert "added_mass" not in free
