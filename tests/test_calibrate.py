"""Bands of a b that is wrong hold their shares of other windows after it is calibrated."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from diagonal import simulated

from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.data.windows import Hidden
from spinndrift.training.fitting.calibrate import _factors, calibrated
from spinndrift.training.fitting.start import diffusion_scale, with_diffusion

B = np.array([2.0, 3.0, 2.0, 0.3, 0.2, 0.3])
TRUTH = load_vehicle("bluerov2_heavy").dynamics(B, dtype=jnp.float32)
SEEN = simulated(TRUTH, 64, steps=8)


@pytest.mark.parametrize("wrong", [0.4, 3.0])
def test_the_b_of_the_data_is_found_again(wrong):
    found = calibrated(with_diffusion(TRUTH, wrong * B), [SEEN], substeps=1)
    # 64 windows: a spread is known to 1 / sqrt(2 · 64) = 9 % for one independent time, within 3
    assert np.abs(np.log(diffusion_scale(found) / B)).max() < 0.27


def test_what_nobody_has_measured_changes_nothing():
    count = len(SEEN)
    seen = np.ones((1, 9, count), np.float32)
    seen[:, [0, 3]] = 0  # x and u
    hidden = Hidden(
        seen,
        np.zeros((6, 6, count), np.float32),
        np.zeros((9, 3, count), np.float32),
        np.zeros((1, 1, count), np.float32),
    )
    found = calibrated(with_diffusion(TRUTH, 0.5 * B), [replace(SEEN, hidden=hidden)], substeps=1)
    change = diffusion_scale(found) / B
    assert change[0] == pytest.approx(0.5)
    assert change[1] > 0.75


def test_a_model_without_diffusion_stays_as_it_is():
    still = load_vehicle("bluerov2_heavy").dynamics(dtype=jnp.float32)
    assert calibrated(still, [SEEN], substeps=1) is still


def test_factors_are_those_of_the_spreads():
    rng = np.random.default_rng(0)
    e = np.sort(rng.standard_normal((12, 4, 39, 500)), axis=2)
    size = np.array([0.5, 1, 1.5, 2, 3, 1])
    y = np.tile(size, 2)[:, None, None] * rng.standard_normal((12, 4, 500))
    # 4000 numbers an axis: coverage to 0.7 %, a spread to about 1.5 %; three of these
    assert _factors([(e, y)]) == pytest.approx(size, rel=0.045)


def test_a_small_set_counts_as_a_large_one():
    rng = np.random.default_rng(1)
    e = np.sort(rng.standard_normal((12, 4, 39, 600)), axis=2)
    y = rng.standard_normal((12, 4, 600))
    few, many = (e[..., :100], 2 * y[..., :100]), (e[..., 100:], y[..., 100:])
    both = _factors([few, many])
    again = _factors([few, (np.repeat(many[0], 2, axis=3), np.repeat(many[1], 2, axis=2))])
    assert both == pytest.approx(again)
    assert (both > 1.2).all()
    assert (both < 1.8).all()
