"""Inertial samples that arrive late, early and never, at the times of a filter."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spinndrift.systems.mavlink.inertial_samples import InertialSamples

PERIOD = 0.01
OMEGA = np.array([3.0, 11.0, 7.0, 2.0, 23.0, 5.0])


def motion(t: float) -> np.ndarray:
    """A force and a rate that change within few samples."""
    return np.sin(OMEGA * t)


@given(st.lists(st.floats(0.0, 0.03), min_size=100, max_size=100), st.floats(0.004, 0.02))
def test_after_the_longest_delay_values_are_those_of_their_time(delays: list[float], step: float):
    """But for the curvature between samples of which some came after later ones and were lost."""
    arrivals = sorted((k * step + delay, k * step) for k, delay in enumerate(delays))
    samples, waiting, late = InertialSamples(hold=0.1), list(arrivals), 0.03 + step
    for k in range(1, int(0.7 * 100 * step / PERIOD)):
        now = k * PERIOD
        while waiting and waiting[0][0] <= now:
            samples.add(waiting[0][1], motion(waiting.pop(0)[1]))
        if now > late + 0.03 + step:  # the first may be among those
            apart = 0.03 + step  # of samples that are kept, at most
            off = np.abs(samples.at(now - late) - motion(now - late))
            assert np.all(off <= (OMEGA * apart) ** 2 / 8 + 1e-12)


def test_values_of_a_straight_line_are_exact_and_delays_of_low_passes_are_taken_off():
    samples = InertialSamples(delays=(0.02, 0.01))
    for k in range(50):
        samples.add(0.007 * k, np.full(6, 0.007 * k))
    np.testing.assert_allclose(samples.at(0.1), [0.12] * 3 + [0.11] * 3, rtol=1e-12)


def test_silence_is_no_sample_and_a_gap_is_not_made_up():
    samples = InertialSamples(hold=0.015)
    assert np.isnan(samples.at(0.0)).all()
    for k in range(10):
        samples.add(0.01 * k, np.full(6, 0.01 * k))
    assert np.isnan(samples.at(-0.001)).all()
    np.testing.assert_allclose(samples.at(0.1), 0.09)  # held
    assert np.isnan(samples.at(0.11)).all()
    samples.add(0.12, np.full(6, 0.12))
    np.testing.assert_allclose(samples.at(0.11), 0.11)  # two that are missing
    samples.add(0.5, np.full(6, 5.0))
    assert np.isnan(samples.at(0.3)).all()
    np.testing.assert_allclose(samples.at(0.5), 5.0)


def test_one_stream_may_end_before_the_other():
    samples = InertialSamples(hold=0.015, delays=(0.02, 0.0))
    for k in range(10):
        samples.add(0.01 * k, np.ones(6))
    value = samples.at(0.09)
    assert np.isnan(value[:3]).all()
    np.testing.assert_allclose(value[3:], 1.0)


@pytest.mark.parametrize("late", [0.01, 0.005])
def test_samples_that_are_repeated_late_or_not_finite_are_left_out(late: float):
    samples = InertialSamples()
    samples.add(0.0, np.ones(6))
    samples.add(0.01, np.ones(6))
    for taken, value in ((late, 9.0), (0.015, np.nan), (0.016, np.inf)):
        samples.add(taken, np.full(6, value))
    np.testing.assert_allclose(samples.at(0.008), 1.0)
    np.testing.assert_allclose(samples.at(0.016), 1.0)
