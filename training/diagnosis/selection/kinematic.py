"""Causes by kinematics alone, for states that were estimated.

One-step errors of an estimator's states are partly its own, and depend on the motion. Those of the
attitude against the rates are not: no force is in them, and they stay bounded over seconds, while
the turn of a biased gyro adds up. A bias counts if it turns the attitude over seconds by more than
these errors, and clearly so, and if it is larger than what calibration leaves of it in any case.
"""

import numpy as np
import scipy.stats
from jaxtyping import Float

from ....models.effects.attitude import GyroBias
from ....models.sensors import Imu
from ..data.arrays import Data
from ..data.reckoned import OVER
from .state import Fits, Selection

_ACCOUNTED = 0.5
"""Share of the drift that a fit must account for."""


def borne_out(state: Selection, fits: Fits, alpha: float) -> Fits:
    """The fits of gyros' biases that the drift of the attitude against the rates bears out."""
    sums, seconds = drifts(np.asarray(state.current.predictions.error), state.problem.data)
    if len(sums) < 2:
        return {}
    mean, spread = sums.mean(axis=0), sums.std(axis=0, ddof=1)
    found = {}
    for h, fit in fits.items():
        if h[0] != GyroBias.name:
            continue
        i = GyroBias.places.index(h[1])
        t = mean[i] / max(float(spread[i]), 1e-300) * np.sqrt(len(sums))
        chance = 2 * float(scipy.stats.t.sf(abs(t), len(sums) - 1)) * len(fits)
        left = abs(mean[i] + seconds * float(fit.values[0]))
        clear = abs(mean[i]) > max(spread[i], seconds * Imu().gyroscope_bias)
        if clear and chance < alpha and left < _ACCOUNTED * abs(mean[i]):
            found[h] = fit
    return found


def drifts(
    error: Float[np.ndarray, "N 12 R"], data: Data
) -> tuple[Float[np.ndarray, "B 3"], float]:
    """Turn of the attitude beyond that of the rates over stretches (rad), and their length (s).

    They last `OVER` s, or as long as the pieces of the data.
    """
    k = error[:, 3:6] - data.dt / 2 * error[:, 9:]
    length = max(1, min(round(OVER / data.dt), len(k)))
    count = len(k) // length
    sums = k[: count * length].reshape(count, length, 3, -1).sum(axis=1)
    whole = data.weight[: count * length].reshape(count, length, -1).min(axis=1) > 0
    return sums.swapaxes(1, 2)[whole], length * data.dt
