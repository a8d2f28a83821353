"""Height and climb of a filter that takes the water for fresh, against such a filter."""

import numpy as np
import pytest
import scipy.linalg

from spinndrift.systems.logs.depth import CROSSOVER, crossover, in_water
from spinndrift.systems.logs.signals import Series
from spinndrift.systems.mavlink import codec

DENSITY = 1024.0
EXCESS = codec.pascal_per_metre(density=DENSITY) / codec.pascal_per_metre()
DT = 0.02


def dive(seed: int, seconds: float = 120.0) -> tuple[np.ndarray, ...]:
    """Time, height, climb and acceleration of a sum of sines from 0.02 to 2 Hz, 8 m deep."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, DT)
    f = np.geomspace(0.02, 2.0, 12)
    w, phase = 2 * np.pi * f, rng.uniform(0, 2 * np.pi, f.size)
    size = 0.1 / w  # of equal climb
    angle = w[:, None] * t + phase[:, None]
    z = -8.0 + size @ np.sin(angle)
    return t, z, (size * w) @ np.cos(angle), -(size * w**2) @ np.sin(angle)


def estimate(
    t: np.ndarray, z: np.ndarray, a: np.ndarray, acceleration: float, depth: float, scale: float
) -> np.ndarray:
    """Height and climb by a stationary Kalman filter of such noise; it hears heights × scale.

    The unit of noise is such that 0.35 m/s² and 0.1 m give the documented crossover.
    """
    A, B = np.array([[1.0, DT], [0.0, 1.0]]), np.array([DT**2 / 2, DT])
    unit = (2 * np.pi * CROSSOVER) ** 4 * (0.1 / 0.35) ** 2
    Q = unit * acceleration**2 * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]])
    C, R = np.array([[1.0, 0.0]]), np.array([[depth**2 / DT]])
    P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
    K = (P @ C.T / (C @ P @ C.T + R))[:, 0]
    x = np.array([scale * z[0], 0.0])
    found = np.empty((2, t.size))
    for n in range(t.size):
        if n:
            x = A @ x + B * (a[n] + a[n - 1]) / 2
        x = x + K * (scale * z[n] - x[0])
        found[:, n] = x
    return found


@pytest.mark.parametrize(("acceleration", "depth"), [(0.35, 0.1), (0.35, 0.6), (0.7, 0.05)])
def test_a_filters_height_and_climb_come_back(acceleration, depth):
    t, z, _, a = dive(0)
    known = {"EK3_ACC_P_NSE": acceleration, "EK3_ALT_M_NSE": depth}
    true = estimate(t, z, a, acceleration, depth, 1.0)
    height, climb = estimate(t, z, a, acceleration, depth, EXCESS)
    rest = np.zeros((2, t.size))
    given = [Series(t, np.stack([*rest, x]), "LOCAL_POSITION_NED") for x in (height, climb)]
    found = in_water(given[0], given[1], known, DENSITY)
    settled = t > 6 / (2 * np.pi * crossover(known))
    for before, after, x in zip(given, found, true, strict=True):
        assert after is not None
        np.testing.assert_array_equal(after.x[:2], 0.0)
        wrong, left = (np.std((one.x[2] - x)[settled]) for one in (before, after))
        assert left < 0.05 * wrong
    # all of it corrected alike is wrong where the motion is fast
    alike = np.std((climb / EXCESS - true[1])[settled])
    assert found[1] is not None
    assert np.std((found[1].x[2] - true[1])[settled]) < 0.05 * alike


@pytest.mark.parametrize("stream", ["lost", "faster", "slow"])
def test_streams_may_be_uneven(stream):
    """A third of the messages lost, and rates that a ground station changes."""
    t, z, _, a = dive(0)
    true, wrong = (estimate(t, z, a, 0.35, 0.1, scale) for scale in (1.0, EXCESS))
    kept = np.random.default_rng(0).uniform(size=t.size) > 0.3
    if stream != "lost":
        every = {"faster": 4, "slow": 12}[stream]
        kept = (np.arange(t.size) % every == 0) | (t > 60)
    zero = np.zeros((2, kept.sum()))
    given = [Series(t[kept], np.vstack([zero, x[kept]]), "LOCAL_POSITION_NED") for x in wrong]
    found = in_water(given[0], given[1], {}, DENSITY)
    settled = t[kept] > 4
    for before, after, x in zip(given, found, true, strict=True):
        assert after is not None
        off, left = (np.std((one.x[2] - x[kept])[settled]) for one in (before, after))
        assert left < 0.06 * off


def test_noise_that_is_none_is_as_usual():
    for wrong in (0.0, -1.0, np.nan):
        assert crossover({"EK3_ALT_M_NSE": wrong, "EK3_ACC_P_NSE": 0.35}) == pytest.approx(
            CROSSOVER
        )


def test_a_pause_starts_the_filter_anew():
    t, z, *_ = dive(1)
    gap = (t < 40) | (t > 80)
    whole = Series(t, np.stack([0 * t, 0 * t, EXCESS * z]), "XKF1")
    later = Series(t[t > 80], whole.x[:, t > 80], "XKF1")
    parted = in_water(Series(t[gap], whole.x[:, gap], "XKF1"), None, {}, DENSITY)[0]
    alone = in_water(later, None, {}, DENSITY)[0]
    assert parted is not None
    assert alone is not None
    np.testing.assert_allclose(parted.x[2, parted.t > 80], alone.x[2], rtol=1e-12)


def test_heights_of_other_sources_stay():
    t, z, v, _ = dive(2)
    given = [Series(t, np.stack([t, t, x]), "XKF1") for x in (z, v)]
    for known, density in (({"EK3_SRC1_POSZ": 6.0}, DENSITY), ({}, None)):
        assert in_water(given[0], given[1], known, density) == (given[0], given[1])
    same = in_water(given[0], None, {"BARO_SPEC_GRAV": DENSITY * codec.G / 9800.0}, DENSITY)[0]
    assert same is not None
    np.testing.assert_allclose(same.x, given[0].x, rtol=1e-12)
