"""Velocity between the samples of a slow stream, as the accelerometer measured it.

A line between two velocities smooths what lies between them: at 10 Hz it leaves 94 % of a motion
of 1.2 Hz and 64 % of one of 4 Hz (the climb of an ArduSub against its simulator), which then looks
like that of a heavier vehicle. With f the specific force and I the integral of R f - g e_z,

    v(t) = I(t) + line through (t_i, v_i - I(t_i)),

which keeps every sample; a bias of the accelerometer has no effect. Whether the accelerometer tells
is asked of the samples: every second one must be nearer to this curve through the others than to
their lines. A value that stands still is kept: its stream was lost, and the checks of the data are
to see that.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from ...models.recordings.resample import integral, linear, rotations, slerp
from ..mavlink import codec
from .signals import Series, Signals

_PERIODS = 3.0
"""Periods of a stream beyond the wanted times that are looked at."""


def velocity_at(signals: Signals, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "3 n"]:
    """Velocity in W (m/s) at the times t (s), which increase.

    Components for which no accelerometer helps are interpolated linearly.
    """
    assert signals.velocity is not None
    v = near(signals.velocity, t)
    line = linear(t, v.t, v.x)
    force = None if signals.specific_force is None else near(signals.specific_force, t)
    if force is None or force.t.size < 2 or v.t.size < 5:
        return line
    acceleration = acceleration_of(signals, force)
    bent = _along(t, v, acceleration)
    others, left = replace(v, t=v.t[::2], x=v.x[:, ::2]), slice(1, (v.t.size - 1) // 2 * 2, 2)
    off = [
        v.x[:, left] - found
        for found in (
            _along(v.t[left], others, acceleration),
            linear(v.t[left], others.t, others.x),
        )
    ]
    nearer = np.sum(off[0] ** 2, axis=1) < np.sum(off[1] ** 2, axis=1)  # not if any is unknown
    return np.where(nearer[:, None], bent, line)


def acceleration_of(signals: Signals, force: Series) -> Series:
    """Acceleration in W (m/s²) by a specific force."""
    R = rotations(slerp(force.t, signals.attitude.t, signals.attitude.x))
    return replace(force, x=R.apply(force.x.T).T - np.array([[0.0], [0.0], [codec.G]]))


def _along(
    t: Float[np.ndarray, " n"], slow: Series, derivative: Series
) -> Float[np.ndarray, "c n"]:
    """Samples connected along a derivative; by lines where it pauses longer than they do."""
    path = integral(derivative.t, derivative.x)
    bent = path(t) + linear(t, slow.t, slow.x - path(slow.t))
    i = np.clip(np.searchsorted(slow.t, t, side="right") - 1, 0, slow.t.size - 2)
    begin, end = slow.t[i], slow.t[i + 1]
    before = np.searchsorted(derivative.t, begin, side="right") - 1
    after = np.searchsorted(derivative.t, end)
    inside = (before >= 0) & (after < derivative.t.size)
    long = np.concatenate([[0], np.cumsum(np.diff(derivative.t) > np.median(np.diff(slow.t)))])
    last = derivative.t.size - 1
    pauses = long[np.clip(after, 0, last)] - long[np.clip(before, 0, last)]
    follows = inside & (pauses == 0) & ~_held(slow.x)[:, i]
    return np.where(follows, bent, linear(t, slow.t, slow.x))


def _held(x: Float[np.ndarray, "c n"]) -> Bool[np.ndarray, "c m"]:
    """Whether each of the m = n - 1 steps lies between two of three equal samples or more.

    Two are equal by rounding too.
    """
    same = np.diff(x, axis=1) == 0
    around = np.pad(same, ((0, 0), (1, 1)))
    return same & (around[:, :-2] | around[:, 2:])


def near(series: Series, t: Float[np.ndarray, " n"]) -> Series:
    """Samples in the wanted times t and a few periods around them."""
    apart = _PERIODS / max(series.rate, 1e-3)
    first = max(int(np.searchsorted(series.t, t[0] - apart)) - 1, 0)
    last = min(int(np.searchsorted(series.t, t[-1] + apart)) + 1, series.t.size)
    first = min(first, max(last - 2, 0))
    return replace(series, t=series.t[first:last], x=series.x[..., first:last])
