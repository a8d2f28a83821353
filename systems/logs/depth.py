"""Correction of height and climb of an autopilot that assumed fresh water.

Its filter fuses depth, computed from pressure with too small a gradient, with the accelerometer.
With σ the ratio of its computed depth to the true depth,

    z_est = z + (σ - 1) G z,        v_est = v + (σ - 1) L v,
    L = ω² / (s² + √2 ω s + ω²),    G = (√2 ω s + ω²) / (s² + √2 ω s + ω²):

a scale error in slow motion and none in fast motion. It is removed to first order in σ - 1, with L
and G of the estimate. This is the stationary Kalman filter of a height with white acceleration
noise (Kalman and Bucy 1961), for which ω⁴ is the ratio of the intensities of acceleration noise and
measurement noise.
"""

import itertools
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import scipy.signal
from jaxtyping import Float

from ..mavlink import codec
from .signals import Series

CROSSOVER = 0.3
"""Hz, with the noise below: 0.31 from the simulator's truth, 0.27 from pressure, on a dive with
ArduSub 4.5.6's own parameters."""
_NOISE = {"EK3_ACC_P_NSE": 0.35, "EK3_ALT_M_NSE": 0.1}
"""m/s² and m, as in that dive."""
_BAROMETER = 1  # EK3_SRC1_POSZ
_PAUSE, _GRID = 2.0, 0.01
"""s without a sample after which the filter restarts, and its longest step."""


def crossover(known: Mapping[str, float]) -> float:
    """Frequency (Hz) above which climb is from the accelerometer; `known` are parameters."""
    given = {name: value for name, value in known.items() if value > 0}
    own = {**_NOISE, **given}
    ratio = own["EK3_ACC_P_NSE"] / own["EK3_ALT_M_NSE"]
    return CROSSOVER * float(np.sqrt(ratio * _NOISE["EK3_ALT_M_NSE"] / _NOISE["EK3_ACC_P_NSE"]))


def in_water(
    position: Series | None,
    velocity: Series | None,
    known: Mapping[str, float],
    density: float | None,
) -> tuple[Series | None, Series | None]:
    """Position and velocity with z (m, m/s, up) corrected for water of `density` (kg/m³).

    Without a density, or if the height is not from the barometer, they are unchanged.
    """
    source = known.get("EK3_SRC1_POSZ", _BAROMETER)
    if density is None or source != _BAROMETER:
        return position, velocity
    scale = codec.pascal_per_metre(known.get("BARO_SPEC_GRAV", 1.0))
    excess = 1.0 - scale / codec.pascal_per_metre(density=density)
    omega = 2 * np.pi * crossover(known)
    bottom = np.array([1.0, np.sqrt(2.0) * omega, omega**2])
    tops = np.array([0.0, *bottom[1:]]), np.array([0.0, 0.0, bottom[2]])
    found = []
    for signal, top in zip((position, velocity), tops, strict=True):
        if signal is not None:
            x = signal.x.copy()
            x[2] -= excess * _filtered(signal.t, x[2], top, bottom)
            signal = replace(signal, x=x)
        found.append(signal)
    return found[0], found[1]


def _filtered(
    t: Float[np.ndarray, " n"],
    x: Float[np.ndarray, " n"],
    top: Float[np.ndarray, "3"],
    bottom: Float[np.ndarray, "3"],
) -> Float[np.ndarray, " n"]:
    """Output of a transfer function, in steady state at the first value after every pause.

    Samples may be unevenly spaced: between pauses the filter runs on a uniform grid of its own.
    """
    edges = [0, *(np.flatnonzero(np.diff(t) > _PAUSE) + 1).tolist(), t.size]
    found = np.empty_like(x)
    for start, stop in itertools.pairwise(edges):
        own, piece = t[start:stop], x[start:stop]
        count = max(int(np.ceil((own[-1] - own[0]) / _GRID)), 1)
        grid, step = np.linspace(own[0], max(own[-1], own[0] + _GRID), count + 1, retstep=True)
        b, a = scipy.signal.bilinear(top, bottom, 1.0 / step)
        even = np.interp(grid, own, piece)
        rest = scipy.signal.lfilter_zi(b, a) * even[0]
        found[start:stop] = np.interp(own, grid, scipy.signal.lfilter(b, a, even, zi=rest)[0])
    return found
