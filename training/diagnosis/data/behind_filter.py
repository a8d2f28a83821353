"""Commands behind the low-pass that the recorded body rates went through.

An autopilot logs its rates behind a filter (INS_GYRO_FILTER). Behind one filter, what commands do
is what filtered commands do (Ljung 1999, section 14.4), so the forces are filtered likewise. An
import has already moved the rates back by the filter's delay, so that of the forces is left out.
"""

import numpy as np
import scipy.signal
from jaxtyping import Float

_PARTS = 20.0
"""Samples in a period of the filter's cutoff, within which steps are resolved."""


def behind_filter(
    u: Float[np.ndarray, "N n"], rise: Float[np.ndarray, "N n"], dt: float, cutoff: float
) -> tuple[Float[np.ndarray, "N n"], Float[np.ndarray, "N n"]]:
    """Means and rises of commands over their steps, behind the filter and without its delay.

    The filter is a Butterworth of second order, as ArduPilot's (LowPassFilter2p).

    Args:
        u: mean of each step.
        rise: change over it.
        dt: length of the steps (s).
        cutoff: of the filter (Hz).
    """
    parts = max(int(np.ceil(dt * _PARTS * cutoff)), 2)
    step = dt / parts
    delay = step / (np.sqrt(2.0) * np.tan(np.pi * cutoff * step))  # of the filter in steps
    along = (np.arange(parts) + 0.5) / parts - 0.5
    fine = (u[:, None] + rise[:, None] * along[:, None]).reshape(-1, u.shape[1])
    fine = np.concatenate([fine, np.repeat(fine[-1:], int(delay / step) + 2, axis=0)])
    sections = np.asarray(scipy.signal.butter(2, cutoff, fs=1 / step, output="sos"))
    start = scipy.signal.sosfilt_zi(sections)[:, :, None] * fine[0]
    y = scipy.signal.sosfilt(sections, fine, axis=0, zi=start)[0]
    whole = int(delay / step)
    share, size = delay / step - whole, len(u) * parts
    y = (1 - share) * y[whole : whole + size] + share * y[whole + 1 : whole + 1 + size]
    y = y.reshape(len(u), parts, -1)
    return y.mean(axis=1), np.einsum("npk,p->nk", y, along) / np.sum(along**2)
