"""Height and climb between pressure and accelerometer, smoothed with what came later as well.

An autopilot's climb is the estimate of a causal filter, wrong by 2 to 3 cm/s for a second or more,
and where it controls the depth its errors are in the commands too: thrust then looks 10 % too weak.
With z measured by pressure, w = z', and a the vertical acceleration that the accelerometer gives,

    z' = w,    w' = a - b + n,    b' = m,

n and m white. The smoothed z, w, b minimise the sum of all squared residuals (Rauch, Tung and
Striebel 1965; as one banded system of equations). The levels of the noise of pressure and
accelerometer are those under which the pressures are most likely.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Float

from ...models.recordings.resample import linear, mean
from .between import acceleration_of, near
from .signals import Series, Signals

_GRID, _SLOWEST = 0.02, 0.1
"""Shortest and longest step between accelerations (s)."""
_PAUSE = 0.5
"""Longest pause (s) of either sensor: over it the climb drifts by centimetres a second."""
_LEAST = 50
"""Readings of pressure that tell the levels of noise."""
_BIAS, _DRIFT = 0.2, 0.01
"""Standard deviations (m/s²) of an accelerometer's bias at first, and of its change in a second."""
_START = np.log([0.02, 0.05])
_RANGE = np.log([[1e-4, 1.0], [1e-3, 3.0]])
"""Of the standard deviations of a pressure (m) and of the acceleration's mean over a second
(m/s²)."""
_DIFFUSE = 1e-6
"""Information on height and climb before the first reading."""


class Vertical(NamedTuple):
    """Height and climb at some times, and the noise found.

    Attributes:
        z: m, up; minus the depth by pressure but for noise.
        w: m/s.
        pressure: standard deviation of a depth (m).
        acceleration: standard deviation of the acceleration's mean over a second (m/s²).
    """

    z: Float[np.ndarray, " n"]
    w: Float[np.ndarray, " n"]
    pressure: float
    acceleration: float


def vertical(signals: Signals, t: Float[np.ndarray, " n"]) -> Vertical | None:
    """Height and climb at the times t (s), which increase; None if sensors lack, or pause."""
    sensors = read_throughout(signals, t)
    if sensors is None:
        return None
    depth, force = sensors
    h = float(np.clip(1.0 / force.rate, _GRID, _SLOWEST))
    first, last = max(depth.t[0], force.t[0]), min(depth.t[-1], force.t[-1])
    grid = np.arange(first, last, h)
    a = mean(grid[:-1] + h / 2, force.t, acceleration_of(signals, force).x[2], h)
    inside = (depth.t >= grid[0]) & (depth.t < grid[-1])
    level = float(np.mean(depth.x[inside]))
    problem = _Problem(h, a, depth.t[inside] - grid[0], level - depth.x[inside])
    found = scipy.optimize.minimize(
        lambda levels: problem.solve(*np.exp(levels))[1], _START, method="Nelder-Mead",
        bounds=_RANGE, options={"xatol": 0.02, "fatol": 0.1},
    )  # fmt: skip
    levels = np.exp(found.x)
    states = problem.solve(*levels)[0]
    z, w = (linear(t, grid, x) for x in (states[:, 0] - level, states[:, 1]))
    return Vertical(z, w, float(levels[0]), float(levels[1]))


def read_throughout(signals: Signals, t: Float[np.ndarray, " n"]) -> tuple[Series, Series] | None:
    """Depth and specific force about the times t; None if one lacks, or pauses."""
    depth, force = signals.pressure_depth, signals.specific_force
    if depth is None or force is None:
        return None
    depth, force = near(depth, t), near(force, t)
    if depth.t.size < _LEAST or not all(_throughout(each, t) for each in (depth, force)):
        return None
    return depth, force


class _Problem(NamedTuple):
    """Accelerations (N,) over steps h (s), and heights z at the times τ from the first step on."""

    h: float
    a: Float[np.ndarray, " N"]
    tau: Float[np.ndarray, " M"]
    z: Float[np.ndarray, " M"]

    def solve(
        self, pressure: float, acceleration: float
    ) -> tuple[Float[np.ndarray, "N1 3"], float]:
        """States z, w, b and minus the log likelihood of the heights, but for a constant."""
        h, N = self.h, len(self.a)
        A = np.array([[1.0, h, -h * h / 2], [0.0, 1.0, -h], [0.0, 0.0, 1.0]])
        G = np.stack([self.a * h * h / 2, self.a * h, np.zeros(N)], axis=1)
        Q = np.zeros((3, 3))
        Q[:2, :2] = acceleration**2 * np.array([[h**3 / 3, h * h / 2], [h * h / 2, h]])
        Q[2, 2] = _DRIFT**2 * h
        W = np.linalg.inv(Q)
        diagonal, below = np.zeros((N + 1, 3, 3)), np.broadcast_to(-W @ A, (N, 3, 3))
        diagonal[:-1] += A.T @ W @ A
        diagonal[1:] += W
        diagonal[0] += np.diag([_DIFFUSE, _DIFFUSE, _BIAS**-2])
        right = np.zeros((N + 1, 3))
        right[1:] += G @ W
        right[:-1] -= G @ W @ A
        k = np.minimum((self.tau / h).astype(int), N)
        H = np.stack([np.ones_like(self.tau), self.tau - k * h, np.zeros_like(self.tau)], axis=1)
        np.add.at(diagonal, k, H[:, :, None] * H[:, None] / pressure**2)
        np.add.at(right, k, H * (self.z / pressure**2)[:, None])
        factor = scipy.linalg.cholesky_banded(_banded(diagonal, below), lower=True)
        x = scipy.linalg.cho_solve_banded((factor, True), right.reshape(-1)).reshape(-1, 3)
        squares = np.sum(self.z**2) / pressure**2 + np.einsum("ni,ij,nj->", G, W, G)
        log_det = 2 * np.sum(np.log(factor[0])) + N * np.linalg.slogdet(Q)[1]
        loss = squares - np.sum(right * x) + log_det + 2 * len(self.z) * np.log(pressure)
        return x, float(loss) / 2


def _banded(
    diagonal: Float[np.ndarray, "n 3 3"], below: Float[np.ndarray, "m 3 3"]
) -> Float[np.ndarray, "6 n3"]:
    """A block-tridiagonal symmetric matrix as SciPy's lower band."""
    n = len(diagonal)
    band = np.zeros((6, n, 3))
    for j in range(3):
        for i in range(j, 3):
            band[i - j, :, j] = diagonal[:, i, j]
        for i in range(3):
            band[3 + i - j, :-1, j] = below[:, i, j]
    return band.reshape(6, -1)


def _throughout(series: Series, t: Float[np.ndarray, " n"]) -> bool:
    """Whether a sensor was read before, after and without a long pause in the wanted time."""
    whole = series.t[0] <= t[0] + _PAUSE and series.t[-1] >= t[-1] - _PAUSE
    return bool(whole and np.diff(series.t).max() <= _PAUSE and series.rate >= 1 / _PAUSE)
