"""The simulated autopilot's low-pass against the continuous filter that it stands for."""

import numpy as np
import pytest

from spinndrift.sims.vehicle.autopilot.low_pass import LowPass
from spinndrift.systems.mavlink.codec import filter_delay

RATE = 100.0


def filtered(low_pass: LowPass, x: np.ndarray) -> np.ndarray:
    return np.array([low_pass(row) for row in x])


@pytest.mark.parametrize("cutoff", [5.0, 10.0, 20.0])
def test_a_slow_motion_is_late_by_the_filters_delay(cutoff: float):
    t = np.arange(400) / RATE
    x = np.column_stack([np.sin(2.0 * t), 0.3 * t, np.ones(400)])
    y = filtered(LowPass(cutoff, RATE), x)[200:]
    late = t[200:] - filter_delay(cutoff)
    np.testing.assert_allclose(y[:, 0], np.sin(2.0 * late), atol=1e-3)
    np.testing.assert_allclose(y[:, 1], 0.3 * late, rtol=1e-6)
    np.testing.assert_allclose(y[:, 2], 1.0, rtol=1e-9)


def test_what_is_not_finite_is_not_remembered():
    low_pass = LowPass(20.0, RATE)
    low_pass(np.ones(3))
    assert np.isnan(low_pass(np.array([1.0, np.nan, 1.0]))).any()
    np.testing.assert_allclose(low_pass(np.full(3, 2.0)), 2.0)


def test_noise_is_taken_off_and_a_cutoff_of_zero_is_no_filter():
    x = np.random.default_rng(0).standard_normal((4000, 3))
    np.testing.assert_array_equal(filtered(LowPass(0.0, RATE), x), x)
    # the equivalent noise bandwidth of a Butterworth filter of second order is 1.11 cutoffs
    share = filtered(LowPass(5.0, RATE), x).var(axis=0)
    np.testing.assert_allclose(share, 1.11 * 5.0 / (RATE / 2), rtol=0.15)
