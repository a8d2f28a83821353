"""Means of inertial samples that arrive late, early and never."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from spinndrift.systems.mavlink.inertial_samples import InertialSamples

PERIOD = 0.01


def motion(t: float) -> np.ndarray:
    """A rate that changes within few samples."""
    return np.sin(np.array([3.0, 11.0, 7.0, 2.0, 23.0, 5.0]) * t)


def integral(t: float) -> np.ndarray:
    w = np.array([3.0, 11.0, 7.0, 2.0, 23.0, 5.0])
    return (1 - np.cos(w * t)) / w


@given(st.lists(st.floats(0.0, 0.03), min_size=200, max_size=200), st.floats(0.004, 0.02))
def test_late_samples_lose_no_motion(delays: list[float], step: float):
    """The sum of all means times the period is the motion, whenever the samples come."""
    arrivals = sorted((k * step + delay, k * step) for k, delay in enumerate(delays))
    now = 0.0
    samples, total, waiting, first = InertialSamples(), np.zeros(6), list(arrivals), 0.05
    for k in range(1, int(0.7 * 200 * step / PERIOD)):
        now = k * PERIOD
        while waiting and waiting[0][0] <= now:
            taken = waiting.pop(0)[1]
            samples.add(taken, motion(taken))
        if now > first:
            total += PERIOD * samples.mean(now - PERIOD, now)
    done = integral(now) - integral(first)
    # what is not here yet is extrapolated: a step and the longest delay, at a slope of 23
    assert np.all(np.abs(total - done) < 23 * (0.03 + step) ** 2)


def test_the_mean_of_a_straight_line_is_exact():
    samples = InertialSamples()
    for k in range(50):
        samples.add(0.007 * k, np.full(6, 0.007 * k))
    np.testing.assert_allclose(samples.mean(0.1, 0.11), 0.105, rtol=1e-12)
    np.testing.assert_allclose(samples.mean(0.11, 0.13), 0.12, rtol=1e-12)


def test_silence_is_no_sample_and_a_gap_is_not_made_up():
    samples = InertialSamples(hold=0.2)
    assert np.isnan(samples.mean(0.0, 0.01)).all()
    for k in range(10):
        samples.add(0.01 * k, np.ones(6))
    assert np.isfinite(samples.mean(0.08, 0.09)).all()
    assert np.isnan(samples.mean(0.4, 0.41)).all()
    samples.add(0.5, np.full(6, 5.0))
    np.testing.assert_allclose(samples.mean(0.5, 0.51), 5.0)


def test_samples_that_are_repeated_late_or_not_finite_are_left_out():
    samples = InertialSamples()
    samples.add(0.0, np.ones(6))
    samples.add(0.01, np.ones(6))
    for taken, value in ((0.01, 9.0), (0.005, 9.0), (0.015, np.nan), (0.016, np.inf)):
        samples.add(taken, np.full(6, value))
    np.testing.assert_allclose(samples.mean(0.0, 0.02), 1.0)


def test_a_loop_that_hung_is_followed_by_no_jolt():
    """190 ms without samples, which then come at once: deviations are those of a held sample."""
    samples, told, meant = InertialSamples(), [], []
    for k in range(1, 200):
        now = k * PERIOD
        late = range(61, 80) if k == 80 else [k]
        for n in late if not 61 <= k < 80 else ():
            samples.add(n * PERIOD - 0.002, motion(n * PERIOD - 0.002))
        if k > 20:
            told.append(samples.mean(now - PERIOD, now))
            meant.append((integral(now) - integral(now - PERIOD)) / PERIOD)
    off = np.array(told) - np.array(meant)
    assert np.abs(off[:35]).max() < 0.1  # of rates of one
    assert np.abs(off).max() < 2.1, "no more than two rates of opposite signs"
    assert np.abs(off[85:]).max() < 0.1
    # no motion was lost
    assert np.abs(off.sum(axis=0) * PERIOD).max() < 23 * 0.012**2
