"""The autopilot's low-pass on inertial samples."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.signal import bilinear, butter, lfilter, lfilter_zi


class LowPass:
    """A Butterworth filter of second order, at a rate of its own.

    It is discretised so that slow motion is delayed as by the continuous one, √2/ω_c
    (`systems.mavlink.codec.filter_delay`).
    """

    def __init__(self, cutoff: float, rate: float):
        """With a cutoff frequency, of 0 for no filter, for samples at a rate (Hz)."""
        self.cutoff = cutoff
        self._coefficients = None
        if cutoff > 0:
            analog: Any = butter(2, 2 * math.pi * cutoff, analog=True, output="ba")
            b, a = bilinear(*analog, fs=rate)
            self._coefficients = np.asarray(b), np.asarray(a)
        self._state: np.ndarray | None = None

    def __call__(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Filter the next sample. The filter starts in the steady state of its first sample.

        A sample that is not finite is returned as it is and resets the filter, as in ArduPilot.
        """
        if self._coefficients is None:
            return x
        if not np.isfinite(x).all():
            self._state = None
            return x
        b, a = self._coefficients
        if self._state is None:
            self._state = np.asarray(lfilter_zi(b, a))[:, None] * x
        y, self._state = lfilter(b, a, x[None], axis=0, zi=self._state)
        return y[0]
