"""Steady times of streams with jittering stamps: the truth where the motion tells, else nothing."""

import numpy as np
import pytest
from motion import smooth_motion

from spinndrift.models.recordings.steady_times import steady_times

RATE, N = 20.0, 800
TRUE = np.arange(N) / RATE


def motion(t):
    return np.concatenate(smooth_motion(t)[:2])


def error(found):
    """Largest error of the times apart from a common latency (s)."""
    off = found.t - TRUE
    return float(np.abs(off - np.median(off)).max())


@pytest.mark.parametrize("size", [0.3, 1.5])
def test_steady_times_are_those_of_the_source_whatever_the_order_of_arrival(size):
    """Zero-mean jitter and one-sided latencies, also larger than a period."""
    rng = np.random.default_rng(0)
    for jitter in (rng.normal(size=N), rng.exponential(size=N)):
        stamps = TRUE + size / RATE * jitter
        found = steady_times(stamps, motion(TRUE))
        assert found is not None
        assert found.rate == pytest.approx(RATE, rel=1e-3)
        assert found.jitter == pytest.approx(np.std(stamps - TRUE), rel=0.1)
        # a line over 101 stamps: its error at the ends is twice that of their mean
        assert error(found) < 4 * 2 * np.std(stamps - TRUE) / np.sqrt(101)


def test_latencies_are_positive():
    rng = np.random.default_rng(1)
    stamps = TRUE + 0.03 * rng.exponential(size=N)
    found = steady_times(stamps, motion(TRUE), late=True)
    assert found is not None
    assert abs(np.median(found.t - TRUE)) < 0.01  # 5 % of exponential latencies are below 1.5 ms


def test_bursts_and_lost_messages_keep_their_places():
    """The receiver stalls for 0.3 s every few s, and now and then messages are lost."""
    rng = np.random.default_rng(2)
    stamps = TRUE + 0.005 * rng.exponential(size=N)
    for start in np.arange(3.0, 38.0, 5.0):
        inside = (stamps > start) & (stamps < start + 0.3)
        stamps[inside] = start + 0.3 + 1e-4 * np.arange(np.count_nonzero(inside))
    kept = np.ones(N, bool)
    kept[[101, 350, 351, 640]] = False
    found = steady_times(stamps[kept], motion(TRUE)[:, kept], late=True)
    assert found is not None
    off = found.t - TRUE[kept]
    assert np.abs(off - np.median(off)).max() < 0.02


def test_stamps_that_are_right_stay():
    """An uneven source with right stamps, a steady one, noise alone, and a vehicle at rest."""
    rng = np.random.default_rng(3)
    uneven = TRUE + 0.3 / RATE * rng.normal(size=N)
    assert steady_times(uneven, motion(uneven)) is None
    assert steady_times(TRUE, motion(TRUE)) is None
    rounded = np.round(TRUE * 30) / 30  # of a simulation with longer steps
    assert steady_times(rounded + 1e-6 * np.arange(N), motion(rounded)) is None
    assert steady_times(uneven, rng.normal(size=(3, N))) is None
    assert steady_times(uneven, np.zeros((3, N))) is None
    assert steady_times(uneven[:30], motion(TRUE)[:, :30]) is None
