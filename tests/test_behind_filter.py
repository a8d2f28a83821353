"""Commands behind the filter of the recorded rates: its gain, its phase without the delay."""

import numpy as np
import pytest

from spinndrift.systems.mavlink.codec import filter_delay
from spinndrift.training.data.behind_filter import behind_filter

CUTOFF = 20.0


def over_steps(signal, dt, count):
    """Means and rises, by the best line, of a signal over steps."""
    s = (np.arange(400) + 0.5) / 400 - 0.5
    x = signal(dt * (np.arange(count)[:, None] + 0.5 + s))
    return x.mean(axis=1)[:, None], (x @ s / np.sum(s**2))[:, None]


@pytest.mark.parametrize(("hertz", "dt"), [(0.5, 0.02), (5.0, 0.02), (0.5, 0.04), (2.0, 0.04)])
def test_a_wave_has_the_gain_of_the_filter_and_what_its_delay_leaves(hertz, dt):
    """H(s) = 1 / (1 + √2 s + s²) with s = i f / cutoff, of a wave that steps resolve."""
    s, w = 1j * hertz / CUTOFF, 2 * np.pi * hertz
    H = np.exp(1j * w * filter_delay(CUTOFF)) / (1 + np.sqrt(2) * s + s**2)
    u, rise = over_steps(lambda t: 10 * np.sin(w * t), dt, 200)
    right = over_steps(lambda t: 10 * np.imag(H * np.exp(1j * w * t)), dt, 200)
    inside = slice(20, 180)
    bend = 10 * (w * dt) ** 3 / 100  # what lines within the steps leave
    for found, true in zip(behind_filter(u, rise, dt, CUTOFF), right, strict=True):
        np.testing.assert_allclose(found[inside], true[inside], atol=0.02 + bend)


def test_a_ramp_passes_as_it_is_and_a_step_keeps_its_area():
    dt, n = 0.05, np.arange(100)
    ramp = 2.0 * n[:, None] * np.array([1.0, -3.0])
    u, rise = behind_filter(ramp, np.full_like(ramp, 2.0) * [1.0, -3.0], dt, CUTOFF)
    np.testing.assert_allclose(u[10:-5], ramp[10:-5], atol=1e-2)
    np.testing.assert_allclose(rise[10:-5], np.tile([2.0, -6.0], (85, 1)), atol=1e-3)
    step = np.where(n < 50, 0.0, 8.0)[:, None]
    u, rise = behind_filter(step, np.zeros_like(step), dt, CUTOFF)
    assert u.sum() == pytest.approx(step.sum(), abs=0.1)
    assert np.abs(u - step).max() > 0.3  # it begins before the step, as the delay is left out
    np.testing.assert_allclose(u[:48], 0.0, atol=1e-6)
    np.testing.assert_allclose(u[54:], 8.0, atol=0.05)
