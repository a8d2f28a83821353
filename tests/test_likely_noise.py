"""Levels of records' and process noise, and the filter, where instruments drown the process."""

import numpy as np
import pytest
from hidden.draw import draw
from hidden.scenarios import Plan
from hidden.simulator import Noise as Hidden

from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.filter.kalman import filtered, make_filter
from spinndrift.training.diagnosis.filter.likely_noise import fit_with_slow_noise
from spinndrift.training.diagnosis.filter.noise import (
    Noise,
    estimate,
    process_covariance,
    unit_processes,
)
from spinndrift.training.diagnosis.filter.transition import Transition
from spinndrift.training.diagnosis.pipeline import Diagnoser

DT, MASS = 0.05, np.diag([20.0, 20.0, 30.0, 0.4, 0.4, 0.5])
A = np.eye(12)
A[:6, 6:] = DT * np.eye(6)
A[6:, 6:] = np.diag([0.95, 0.95, 0.9, 0.8, 0.8, 0.85])
RECORD = np.repeat([0.02, 0.007, 0.02, 0.004], 3)


def errors(rng, N, R, b, mass=MASS):
    """One-step errors of records with white noise about a linear system's states."""
    Q = process_covariance(A, np.linalg.inv(mass), b, DT)
    L = np.linalg.cholesky(Q)
    e = RECORD[:, None] * rng.standard_normal((N + 1, 12, R))
    w = np.einsum("ij,njr->nir", L, rng.standard_normal((N, 12, R)))
    return e[1:] - np.einsum("ij,njr->nir", A, e[:-1]) + w


@pytest.mark.parametrize("part", [1.0, 0.5])
def test_levels_are_found_far_below_the_records_noise(part):
    """Down to a third and a sixth of the DVL's noise in a step; slow errors don't count."""
    b = part * np.array([1.0, 1.0, 1.0, 0.03, 0.03, 0.03])
    rng = np.random.default_rng(0)
    error = errors(rng, 200, 60, b)
    error[:, 6:9] += 0.002 * np.sin(2 * np.pi * np.arange(200) / 200)[:, None, None]
    noise = estimate(error, np.ones((200, 60)), Transition.constant(A), MASS, DT)
    assert not noise.estimated
    assert np.all(np.abs(noise.diffusion - b) < 3 * noise.error)
    assert np.all(noise.error < 0.25 * b)
    np.testing.assert_allclose(noise.record[:9], RECORD[:9], rtol=0.05)
    np.testing.assert_allclose(noise.diffusion, b, rtol=0.25)


def test_errors_of_levels_are_told_of_a_heavy_vehicle_too():
    """Half a ton: variances of forces and of angles are ten orders of magnitude apart."""
    mass, b = 25 * MASS, 20 * np.array([1.0, 1.0, 1.0, 0.03, 0.03, 0.03])
    z = []
    for seed in range(4):
        error = errors(np.random.default_rng(seed), 200, 20, b, mass)
        noise = estimate(error, np.ones((200, 20)), Transition.constant(A), mass, DT)
        z.append((noise.diffusion - b) / noise.error)
    assert np.max(np.abs(z)) < 4
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.6


def test_an_axis_that_never_errs_is_left_out():
    b = np.array([1.0, 1.0, 1.0, 0.03, 0.03, 0.03])
    error = errors(np.random.default_rng(5), 200, 60, b)
    error[:, 2] = 0.0
    noise = estimate(error, np.ones((200, 60)), Transition.constant(A), MASS, DT)
    np.testing.assert_allclose(noise.diffusion[[0, 1, 3, 4, 5]], b[[0, 1, 3, 4, 5]], rtol=0.25)


def test_levels_of_estimates_may_be_held():
    rng, rho = np.random.default_rng(6), 0.9
    slow = np.zeros((400, 12, 20))
    for n in range(1, 400):
        slow[n] = rho * slow[n - 1] + rng.standard_normal((12, 20))
    given = 1e-2 * slow, np.ones((400, 20)), Transition.constant(A), MASS, DT
    free, held = estimate(*given), estimate(*given, held={0: 123.0})
    assert free.estimated
    assert held.diffusion[0] == 123.0
    np.testing.assert_array_equal(held.diffusion[1:], free.diffusion[1:])
    np.testing.assert_array_equal(held.slip, free.slip)


def test_an_axis_may_be_held_while_the_rest_is_sought():
    b = np.array([1.0, 1.0, 1.0, 0.03, 0.03, 0.03])
    error, weight = errors(np.random.default_rng(3), 200, 60, b), np.ones((200, 60))
    noise = estimate(error, weight, Transition.constant(A), MASS, DT, held={1: 2.0, 5: 0.02})
    np.testing.assert_allclose(noise.diffusion[[1, 5]], [2.0, 0.02], rtol=1e-12)
    np.testing.assert_allclose(noise.diffusion[[0, 2, 3, 4]], b[[0, 2, 3, 4]], rtol=0.25)


@pytest.mark.parametrize("believed", [1.0, 2.0])
def test_a_level_is_told_from_pushes_that_last(believed):
    """Without pushes in the model b is far above the truth, beside them the truth loses nothing."""
    b = np.array([1.0, 1.0, 1.0, 0.03, 0.03, 0.03])
    N, R, tau, pushes = 200, 60, 0.7, np.array([5.0, 0.0, 5.0, 0.15, 0.0, 0.0])
    rng = np.random.default_rng(4)
    inverse, weight = np.linalg.inv(MASS), np.ones((N, R))
    once = np.concatenate([DT**2 / 2 * inverse, DT * inverse]).T
    rho, p = np.exp(-DT / tau), pushes[:, None] * rng.standard_normal((6, R))
    error = errors(rng, N, R, b)
    for n in range(N):
        error[n] += once.T @ p
        drawn = rng.standard_normal((6, R))
        p = rho * p + np.sqrt(1 - rho**2) * pushes[:, None] * drawn
    steps = Transition.constant(A)
    alone = estimate(error, weight, steps, MASS, DT)
    assert np.all(alone.diffusion[[0, 2, 3]] > 1.2 * b[[0, 2, 3]])
    units = unit_processes(steps, inverse, DT)
    start = np.concatenate([alone.record, alone.diffusion])
    left, lost = fit_with_slow_noise(
        error, weight, steps, units, once, DT, start**2, believed * b, [0, 1, 3]
    )
    assert np.all(left < 1.2 * b)
    np.testing.assert_allclose(left[[1, 4, 5]], b[[1, 4, 5]], rtol=0.3)
    assert np.all(lost[[2, 4, 5]] == 0)
    assert np.all((lost[[0, 1, 3]] > 20) if believed == 2.0 else (lost < 4))


def test_a_process_that_can_not_be_seen_counts_with_its_error():
    rng = np.random.default_rng(1)
    found = []
    for runs in (20, 80):
        error = errors(rng, 200, runs, np.full(6, 1e-9))
        found.append(estimate(error, np.ones((200, runs)), Transition.constant(A), MASS, DT))
    for few, many in zip(found[0].diffusion, found[1].diffusion, strict=True):
        assert 0 < many < few
    step = (
        found[1].diffusion * np.sqrt(DT) / np.diag(MASS)
    )  # what is left for the process of a step
    assert np.all(step < RECORD[6:] / 5)


def test_blocks_leave_gaps_out():
    rng = np.random.default_rng(2)
    b = np.array([1.0, 1.0, 1.0, 0.03, 0.03, 0.03])
    error, weight = errors(rng, 200, 60, b), np.ones((200, 60))
    hole = rng.uniform(size=weight.shape) < 0.02
    weight[hole] = 0
    error[np.broadcast_to(hole[:, None], error.shape)] = 0
    noise = estimate(error, weight, Transition.constant(A), MASS, DT)
    np.testing.assert_allclose(noise.diffusion, b, rtol=0.15)


def test_a_transition_carries_what_jacobians_that_change_make_of_errors():
    rng = np.random.default_rng(3)
    jacobian = A[None, :, :, None] + 0.1 * rng.standard_normal((50, 12, 12, 4))
    weight = np.ones((50, 4))
    weight[40:, 3] = 0
    P = np.diag(RECORD**2) + 1e-5
    exact = np.einsum("nijr,jk,nlkr,nr->il", jacobian, P, jacobian, weight) / weight.sum()
    steps = Transition.along(jacobian, weight, np.zeros(6))
    np.testing.assert_allclose(steps.of(P), exact, rtol=1e-10, atol=1e-16)
    np.testing.assert_allclose(Transition.constant(A).of(P), A @ P @ A.T, rtol=1e-12)


def test_a_filter_of_ones_own_is_that_of_the_mean_where_all_jacobians_are_equal():
    noise = Noise(RECORD, np.array([1.0, 1.0, 1.0, 0.03, 0.03, 0.03]))
    same = np.broadcast_to(A[None, :, :, None], (30, 12, 12, 2))
    inverse, step = np.linalg.inv(MASS), np.full((30, 2), DT)
    shared = make_filter(noise, Transition.constant(A), inverse, DT, step, same)
    assert shared.keep.shape[-1] == 1
    spread = Transition(A, np.full([12] * 4, 1.0))  # far more than a share: each has its own
    own = make_filter(noise, spread, inverse, DT, step, same)
    assert own.keep.shape[-1] == 2
    for name in ("keep", "whiten", "log_det"):
        mine, all_ = getattr(own, name), getattr(shared, name)
        np.testing.assert_allclose(mine, np.broadcast_to(all_, mine.shape), rtol=1e-6, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "hidden",
    [
        Hidden(diffusion=(0.05, 0.05, 0.05, 0.0015, 0.0015, 0.0015)),
        Hidden(velocity=0.02, rate=0.004, attitude=0.007, position=0.02),
    ],
    ids=["calm", "coarse"],
)
def test_innovations_are_white_where_instruments_drown_the_process(tmp_path, hidden):
    """Data of another maker: records to 5 %, and nothing left in the innovations."""
    plan = Plan(scenarios=10, runs=2, seconds=10.0)
    draw(5, "null", plan=plan, noise=hidden).write(tmp_path / "data")
    vehicle = load_vehicle("bluerov2_heavy")
    belief = vehicle.dynamics(np.array(hidden.diffusion))
    problem = Diagnoser(read_csv(tmp_path / "data"), vehicle, belief).problem
    p, noise, kalman = problem.predict(problem.believed)
    given = np.repeat([hidden.position, hidden.attitude, hidden.velocity], 3)
    np.testing.assert_allclose(noise.record[:9], given, rtol=0.05)
    z = filtered(np.asarray(p.error), np.asarray(p.jacobian), kalman)
    n = np.sqrt(z.shape[0] * z.shape[2])
    assert np.abs(z.mean(axis=(0, 2)) * n).max() < 4.5
    acf = (z[1:] * z[:-1]).mean(axis=(0, 2)) / (z**2).mean(axis=(0, 2))
    assert np.abs(acf).max() * n < 6


def test_pushes_reach_a_late_pose_late():
    """Twists that are mostly process: innovations are white for a filter that knows of it."""
    rng = np.random.default_rng(5)
    b, fine, late, N, R = 0.1, 25, 10, 120, 150
    ds = DT / fine
    W = np.cumsum(rng.normal(size=(N * fine + fine, 6, R)) * b * np.sqrt(ds), axis=0)
    X = np.cumsum(W, axis=0) * ds
    at = fine + fine * np.arange(N)
    error = rng.normal(size=(N, 12, R)) * np.repeat([1e-3, 5e-3], 6)[:, None]
    record = np.concatenate([X[at - late], W[at]], axis=1) + error
    A = np.eye(12) + DT * np.eye(12, k=6)
    off = record[1:] - np.einsum("ij,njr->nir", A, record[:-1])
    weight, step = np.ones((N - 1, R)), np.full((N - 1, R), DT)
    jacobian = np.broadcast_to(A[None, :, :, None], (N - 1, 12, 12, R))
    noise = Noise(np.repeat([1e-3, 5e-3], 6), np.full(6, b))
    correlation, variance = [], []
    for delay in (0.0, late * ds):
        steps = Transition.along(jacobian, weight, np.full(6, delay))
        z = filtered(off, jacobian, make_filter(noise, steps, np.eye(6), DT, step))[20:]
        correlation.append(np.abs((z[1:, :6] * z[:-1, 6:]).mean()))
        variance.append((z**2).mean(axis=(0, 2)))
    assert correlation[0] > 0.1
    assert correlation[1] < 0.2 * correlation[0]
    assert np.abs(variance[1] - 1).max() < 0.1 < np.abs(variance[0] - 1).max()
