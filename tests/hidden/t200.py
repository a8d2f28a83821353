"""Steady thrust of a T200 against PWM and supply voltage, and back.

Blue Robotics, T200 public performance data, September 2019 (R1 unit, Basic ESC, bollard), rounded:
kgf at PWM, with the edges of the zero band of each voltage; linear in between.
"""

import numpy as np

from .vehicle import GRAVITY

VOLTS = np.array([10.0, 12, 14, 16, 18, 20])
_PWM = np.array([1100.0, 1200, 1300, 1400, 1600, 1700, 1800, 1900])
_ZERO_BELOW = (1460.0, 1464.0, 1468.0, 1472.0, 1472.0, 1476.0)
_ZERO_ABOVE = (1540.0, 1536.0, 1532.0, 1528.0, 1528.0, 1528.0)
_KGF = np.array(
    [
        [-2.31, -1.54, -0.80, -0.24, 0.29, 0.97, 1.91, 2.93],
        [-2.90, -1.95, -1.02, -0.32, 0.39, 1.28, 2.46, 3.71],
        [-3.52, -2.35, -1.24, -0.40, 0.50, 1.55, 2.99, 4.52],
        [-4.07, -2.71, -1.44, -0.48, 0.60, 1.82, 3.42, 5.25],
        [-4.59, -2.96, -1.56, -0.53, 0.63, 1.92, 3.72, 6.02],
        [-5.04, -3.13, -1.58, -0.53, 0.64, 1.92, 3.96, 6.72],
    ]
)


def _row(i: int, pwm: np.ndarray) -> np.ndarray:
    x = np.concatenate([_PWM[:4], [_ZERO_BELOW[i], _ZERO_ABOVE[i]], _PWM[4:]])
    y = np.concatenate([_KGF[i, :4], [0.0, 0.0], _KGF[i, 4:]])
    return GRAVITY * np.interp(pwm, x, y)


def thrust(pwm: np.ndarray, volts: float) -> np.ndarray:
    """Force in N along the axis at `pwm` µs and a supply of `volts` (10 to 20 V)."""
    v = float(np.clip(volts, VOLTS[0], VOLTS[-1]))
    i = min(int(np.searchsorted(VOLTS, v, side="right")) - 1, len(VOLTS) - 2)
    s = (v - VOLTS[i]) / (VOLTS[i + 1] - VOLTS[i])
    return (1 - s) * _row(i, pwm) + s * _row(i + 1, pwm)


def pulse(force: np.ndarray, volts: float) -> np.ndarray:
    """Whole µs whose thrust comes nearest to `force`; 1500 for none."""
    grid = np.arange(1100.0, 1901.0)
    f = thrust(grid, volts)
    forward, back = grid[f > 0], grid[f < 0]
    p = np.where(
        force > 0,
        np.interp(force, f[f > 0], forward),
        np.interp(force, f[f < 0], back),
    )
    return np.where(force == 0, 1500.0, np.round(p))
