"""Height and climb from pressure and accelerometer: the least squares and the likelihood of their
model, by other means, and errors as small as its noise allows."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from scipy.spatial.transform import Rotation

from spinndrift.systems.logs import vertical as module
from spinndrift.systems.logs.signals import Series, Signals
from spinndrift.systems.logs.vertical import vertical

GRAVITY = 9.80665
PRESSURE, FELT = 0.02, 0.05  # m; m/s² of each reading
WANTED = np.arange(2.0, 58.0, 0.05)


def height(t):
    return -5 + 0.4 * np.sin(0.7 * t) + 0.1 * np.sin(3.1 * t)


def climb(t):
    return 0.28 * np.cos(0.7 * t) + 0.31 * np.cos(3.1 * t)


def log(rate=25.0, bias=(0.006, -0.004, 0.05), seed=0):
    """A rolling vehicle without horizontal motion, accelerations at `rate` and depth at 10 Hz."""
    rng = np.random.default_rng(seed)
    t, slow = np.arange(0.0, 60.0, 1 / rate), np.arange(0.033, 60.0, 0.1)
    R = Rotation.from_euler("ZYX", np.stack([0.1 * t, 0.1 * np.sin(t), 0.5 * np.cos(t)], axis=1))
    a = -0.196 * np.sin(0.7 * t) - 0.961 * np.sin(3.1 * t)
    f = R.inv().apply(np.stack([0 * t, 0 * t, a + GRAVITY], axis=1)).T
    f = f + np.asarray(bias)[:, None] + FELT * rng.normal(size=f.shape)
    depth = -height(slow) + PRESSURE * rng.normal(size=slow.size)
    some = Series(t, np.zeros((3, t.size)), "some")
    return Signals(
        attitude=Series(t, R.as_quat(scalar_first=True).T, "ATTITUDE"),
        rates=some,
        outputs=some,
        specific_force=Series(t, f, "RAW_IMU"),
        pressure_depth=Series(slow, depth, "SCALED_PRESSURE2"),
    )


def rms(x):
    return float(np.sqrt(np.mean(x**2)))


@pytest.mark.parametrize("rate", [25.0, 200.0])
def test_errors_are_small_and_levels_of_noise_are_found(rate):
    found = vertical(log(rate), WANTED)
    assert found is not None
    assert rms(found.w - climb(WANTED)) < 0.01
    assert rms(found.z - height(WANTED)) < 0.3 * PRESSURE
    assert found.pressure == pytest.approx(PRESSURE, rel=0.1)
    differentiated = np.gradient(np.interp(WANTED, *_depth(log(rate))), WANTED)
    assert rms(-differentiated - climb(WANTED)) > 0.1


def _depth(signals):
    return signals.pressure_depth.t, signals.pressure_depth.x


def small(seed=1):
    rng = np.random.default_rng(seed)
    tau = np.array([0.02, 0.11, 0.13, 0.29, 0.36, 0.41])
    return module._Problem(0.05, rng.normal(size=9), tau, rng.normal(size=6))


def test_states_and_likelihood_are_those_of_the_joint_normal_distribution():
    """Heights as a linear function of the start, the process noise and the noise of pressure."""
    p, found = small(), []
    for pressure, acceleration in ((0.3, 0.2), (0.05, 1.1)):
        h, N = p.h, len(p.a)
        A = np.array([[1, h, -h * h / 2], [0, 1, -h], [0, 0, 1]])
        Q = acceleration**2 * np.array([[h**3 / 3, h * h / 2, 0], [h * h / 2, h, 0], [0, 0, 0]])
        Q[2, 2] = module._DRIFT**2 * h
        mean, cov = np.zeros((N + 1, 3)), np.zeros((N + 1, N + 1, 3, 3))
        cov[0, 0] = np.diag([1 / module._DIFFUSE, 1 / module._DIFFUSE, module._BIAS**2])
        for n in range(N):
            mean[n + 1] = A @ mean[n] + p.a[n] * np.array([h * h / 2, h, 0])
            for m in range(n + 1):
                cov[n + 1, m] = A @ cov[n, m]
                cov[m, n + 1] = cov[n + 1, m].T
            cov[n + 1, n + 1] = A @ cov[n, n] @ A.T + Q
        whole = cov.transpose(0, 2, 1, 3).reshape(3 * N + 3, -1)
        H = np.zeros((len(p.tau), N + 1, 3))
        k = (p.tau / h).astype(int)
        H[np.arange(len(k)), k] = np.stack([np.ones(len(k)), p.tau - k * h, 0 * p.tau], axis=1)
        H = H.reshape(len(k), -1)
        S = H @ whole @ H.T + pressure**2 * np.eye(len(k))
        off = p.z - H @ mean.reshape(-1)
        exact = mean.reshape(-1) + whole @ H.T @ np.linalg.solve(S, off)
        x, loss = p.solve(pressure, acceleration)
        np.testing.assert_allclose(x.reshape(-1), exact, atol=2e-4)
        density = scipy.stats.multivariate_normal(H @ mean.reshape(-1), S).logpdf(p.z)
        found.append((loss, -density))
    (a, b), (c, d) = found
    assert a - c == pytest.approx(b - d, abs=1e-3)


def test_a_sensor_that_pauses_or_lacks_tells_nothing():
    whole = log()
    depth, force = whole.pressure_depth, whole.specific_force
    assert depth is not None
    assert force is not None
    for name, series in (("pressure_depth", depth), ("specific_force", force)):
        assert vertical(replace(whole, **{name: None}), WANTED) is None
        for kept in (np.abs(series.t - 30) > 0.4, series.t < 50, series.t > 5):
            cut = replace(series, t=series.t[kept], x=series.x[..., kept])
            assert vertical(replace(whole, **{name: cut}), WANTED) is None
        lost = replace(series, t=np.delete(series.t, 40), x=np.delete(series.x, 40, axis=-1))
        assert vertical(replace(whole, **{name: lost}), WANTED) is not None
