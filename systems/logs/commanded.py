"""What was commanded over the steps of a grid, by the logged outputs.

Outputs of a log are samples of a faster signal, so the command of a step is the mean over it of
their linear interpolation: a zero-order hold of these samples would delay the commands by half a
sampling period (50 ms at the 10 Hz of a DataFlash log). Kept with it are the deviation within the
step, because thrust is not linear in the pulse, and the rise over it, because a turn settles within
a step. Commands that act until the next one (`Signals.held`) are held.

Where the body rates are behind a low-pass of the autopilot, so are the commands: behind one filter,
what commands do is what filtered commands do (Ljung 1999, section 14.4).
"""

import numpy as np
import scipy.signal
from jaxtyping import Float

from ...models.recordings.resample import deviation, hold, mean, rise
from ...models.recordings.schema import PWM_RISE, PWM_STD
from ..mavlink.codec import filter_delay
from .between import near
from .signals import Series, Signals

_PARTS = 20.0
"""Samples of a filtered signal in a period of the filter's cutoff."""
_LOST_PERIODS = 3.0
"""Periods of a signal beyond which a step between its samples is a gap."""


def over_steps(
    signals: Signals, t: Float[np.ndarray, " N"], dt: float
) -> tuple[Float[np.ndarray, "N n"], dict[str, Float[np.ndarray, "N n"]]]:
    """Mean command of each step from t on, `dt` long, and what else a recording has of the PWM."""
    outputs = signals.outputs
    if signals.held:
        return hold(t, outputs.t, outputs.x, dt).T, {}
    middle = t + dt / 2
    if signals.command != "pwm":
        return mean(middle, outputs.t, outputs.x, dt).T, {}
    outputs = near(outputs, np.array([t[0] - 1.0, t[-1] + 1.0]))
    seen = filtered(outputs, signals.low_pass)
    spread = deviation(middle, outputs.t, outputs.x, dt).T
    change = rise(middle, seen.t, seen.x, dt).T
    return mean(middle, seen.t, seen.x, dt).T, {PWM_STD: spread, PWM_RISE: change}


def filtered(one: Series, cutoff: float) -> Series:
    """A signal behind the autopilot's low-pass of this cutoff (Hz; 0 for none), without its delay.

    The filter is a Butterworth of second order. It overshoots; limits of the signal are kept.
    """
    delay = filter_delay(cutoff)
    if not delay:
        return one
    step = 1 / (_PARTS * cutoff)
    edges = np.flatnonzero(np.diff(one.t) > _LOST_PERIODS / max(one.rate, 1e-3)) + 1
    sections = np.asarray(scipy.signal.butter(2, cutoff, fs=1 / step, output="sos"))
    settled = scipy.signal.sosfilt_zi(sections)
    times, values = list[np.ndarray](), list[np.ndarray]()
    for rows in np.split(np.arange(one.t.size), edges):
        first, last = float(one.t[rows[0]]), float(one.t[rows[-1]])
        t = np.arange(first, last + delay + step, step)
        x = np.stack([np.interp(t, one.t[rows], row[rows]) for row in one.x])
        low, high = x.min(axis=1, keepdims=True), x.max(axis=1, keepdims=True)
        start = settled[:, None, :] * x[:, :1]
        x = np.clip(scipy.signal.sosfilt(sections, x, zi=start)[0], low, high)
        kept = t - delay >= first
        times.append(t[kept] - delay)
        values.append(x[:, kept])
    return Series(np.concatenate(times), np.concatenate(values, axis=1), one.source, one.left_out)
