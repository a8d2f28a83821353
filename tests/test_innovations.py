"""Innovations: white and of unit size for the true law, and telling where states are not exact."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.data.generate import GenerateConfig, generate
from spinndrift.training.data.windows import make_windows
from spinndrift.training.fitting.one_step_errors import (
    Steps,
    correlation,
    likely_diffusion,
    whitened,
    whitening,
)

B = (1.0, 1.5, 0.7, 0.05, 0.08, 0.04)
SUBSTEPS = 2
DATA = GenerateConfig(trajectories=8, duration=4.0, substeps=SUBSTEPS, diffusion=B)
VEHICLE = load_vehicle("bluerov2_heavy")


@pytest.fixture(scope="module")
def truth():
    return VEHICLE.dynamics(np.asarray(B), jnp.float32)


@pytest.fixture(scope="module")
def windows():
    return make_windows(generate(DATA, VEHICLE), VEHICLE, length_s=2.0, stride_s=0.5)


@pytest.fixture(scope="module")
def steps(windows):
    return Steps.of(windows, 10**6)


def errors_of(truth, steps, b=B):
    whiten, _ = whitening(truth, steps, jnp.asarray(b, jnp.float32), SUBSTEPS)
    return np.asarray(whitened(truth, steps, whiten, SUBSTEPS), float)


def test_each_step_is_there_once(windows, steps):
    assert len(steps) == 80 * 80  # ten maneuvers, eight runs, four seconds at 20 Hz
    np.testing.assert_array_equal(np.asarray(steps.follows).sum(), 80 * 79)
    pairs = np.flatnonzero(np.asarray(steps.follows))
    np.testing.assert_array_equal(steps.V_next[:, pairs], steps.V[:, pairs + 1])
    few = Steps.of(windows, 1000)
    assert 900 <= len(few) <= 1000
    assert np.asarray(few.follows).mean() > 0.9


def test_what_is_not_finite_is_left_out(windows):
    V = windows.V.copy()
    V[1, 0, 0] = np.nan  # the first window's second state: the end of one step, the start of one
    assert len(Steps.of(replace(windows, V=V), 10**6)) == 80 * 80 - 2


def test_innovations_of_the_true_law_are_white(truth, steps):
    errors = errors_of(truth, steps)
    N = errors.shape[1]
    np.testing.assert_allclose(np.cov(errors), np.eye(6), atol=5 * (2 / N) ** 0.5)
    assert (np.abs(errors.mean(axis=1)) < 5 / N**0.5).all()
    assert (np.abs(correlation(steps, errors)) < 5 / N**0.5).all()


def test_noise_of_measurement_makes_neighbours_correlated(truth, windows):
    """White noise of variance R on states whose innovations have Q gives -R / (2 R + Q)."""
    apart = windows.take(np.flatnonzero(windows.start % 2 == 0))  # no state in two of them
    size = np.asarray(B) / np.diag(truth.mass.matrix()) * apart.dt**0.5
    noise = size[:, None] * np.random.default_rng(0).standard_normal(apart.V.shape)
    noisy = Steps.of(replace(apart, V=apart.V + noise.astype(np.float32)), 10**6)
    found = correlation(noisy, errors_of(truth, noisy))
    # drag lets a share of Q and of the noise at the start fade within a step: not quite -1/3
    np.testing.assert_allclose(found, -1 / 3, atol=0.1)


def test_the_most_likely_diffusion_is_the_true_one(truth, steps):
    found = likely_diffusion(truth, steps, SUBSTEPS)
    np.testing.assert_allclose(found, B, rtol=5 / (2 * len(steps)) ** 0.5)
