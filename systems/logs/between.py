"""Attitude and velocity between the samples of slow streams, as faster sensors measured them.

A line between two velocities smooths what lies between them: at 10 Hz it leaves 94 % of a motion
of 1.2 Hz and 64 % of one of 4 Hz (the climb of an ArduSub against its simulator), which then looks
like that of a heavier vehicle. With f the specific force and I the integral of R f - g e_z,

    v(t) = I(t) + line through (t_i, v_i - I(t_i)),

which keeps every sample; a bias of the accelerometer has no effect. Attitudes are connected along
the gyro in the same way: by its rotation vector since the sample before, to second order in the
angle (Bortz 1971), closed by a constant rate. Whether a sensor
tells is asked of the samples: every second one must be nearer to this curve through the others than
to their lines. A value that stands still is kept: its stream was lost, and the checks of the data
are to see that.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from ...models.recordings.resample import continuous, integral, linear, rotations, slerp
from ..mavlink import codec
from .signals import Series, Signals

_PERIODS = 3.0
"""Periods of a stream beyond the wanted times that are looked at."""
_FASTER = 1.5
"""Times the rate of attitudes that a gyro has, to tell of what is between them."""


def attitude_at(signals: Signals, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "4 n"]:
    """Attitude q_WB at the times t (s), which increase; along the geodesic where no gyro helps."""
    q = near(signals.attitude, t)
    rates = near(signals.rates, q.t)
    if not gyro_tells(q, rates):
        return slerp(t, q.t, q.x)
    return _turned(t, q, rates)


def gyro_tells(slow: Series, rates: Series) -> bool:
    """Whether body rates tell of the attitude between its samples: they are faster, and agree."""
    if rates.rate < _FASTER * slow.rate or slow.t.size < 5:
        return False
    others = replace(slow, t=slow.t[::2], x=slow.x[:, ::2])
    left = slice(1, (slow.t.size - 1) // 2 * 2, 2)
    t, R = slow.t[left], rotations(slow.x[:, left])
    bent, line = (
        (R.inv() * rotations(found)).magnitude()
        for found in (_turned(t, others, rates), slerp(t, others.t, others.x))
    )
    return bool(np.sum(bent**2) < np.sum(line**2))


def _turned(t: Float[np.ndarray, " n"], slow: Series, rates: Series) -> Float[np.ndarray, "4 n"]:
    """Attitudes connected along body rates; by geodesics where these pause longer than they do."""
    angle = integral(rates.t, rates.x)
    swept = integral(rates.t, np.cross(angle(rates.t), rates.x, axis=0))

    def turn(begin: np.ndarray, end: np.ndarray) -> Rotation:
        whole = angle(end) - angle(begin)
        cone = (swept(end) - swept(begin) - np.cross(angle(begin), whole, axis=0)) / 2
        return Rotation.from_rotvec((whole + cone).T)

    i = _interval(t, slow)
    begin, end = slow.t[i], slow.t[i + 1]
    R = rotations(slow.x[:, i])
    left = turn(begin, end).inv() * R.inv() * rotations(slow.x[:, i + 1])
    share = np.clip((t - begin) / (end - begin), 0.0, 1.0)
    inside = np.clip(t, begin, end)
    bent = R * turn(begin, inside) * Rotation.from_rotvec(share[:, None] * left.as_rotvec())
    follows = _covered(i, slow, rates)
    q = np.where(follows, bent.as_quat(scalar_first=True).T, slerp(t, slow.t, slow.x))
    return continuous(q)


def velocity_at(signals: Signals, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "3 n"]:
    """Velocity in W (m/s) at the times t (s), which increase.

    Components for which no accelerometer helps are interpolated linearly.
    """
    assert signals.velocity is not None
    v = near(signals.velocity, t)
    line = linear(t, v.t, v.x)
    force = None if signals.specific_force is None else near(signals.specific_force, v.t)
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
    R = rotations(attitude_at(signals, force.t))
    return replace(force, x=R.apply(force.x.T).T - np.array([[0.0], [0.0], [codec.G]]))


def _along(
    t: Float[np.ndarray, " n"], slow: Series, derivative: Series
) -> Float[np.ndarray, "c n"]:
    """Samples connected along a derivative; by lines where it pauses longer than they do."""
    path = integral(derivative.t, derivative.x)
    bent = path(t) + linear(t, slow.t, slow.x - path(slow.t))
    i = _interval(t, slow)
    follows = _covered(i, slow, derivative) & ~_held(slow.x)[:, i]
    return np.where(follows, bent, linear(t, slow.t, slow.x))


def _interval(t: Float[np.ndarray, " n"], slow: Series) -> Int[np.ndarray, " n"]:
    """Index of the sample before each time, at most the last but one."""
    return np.clip(np.searchsorted(slow.t, t, side="right") - 1, 0, slow.t.size - 2)


def _covered(i: Int[np.ndarray, " n"], slow: Series, fast: Series) -> Bool[np.ndarray, " n"]:
    """Whether a fast stream goes on from sample i of a slow one to the next, without a pause."""
    before = np.searchsorted(fast.t, slow.t[i], side="right") - 1
    after = np.searchsorted(fast.t, slow.t[i + 1])
    inside = (before >= 0) & (after < fast.t.size)
    long = np.concatenate([[0], np.cumsum(np.diff(fast.t) > np.median(np.diff(slow.t)))])
    last = fast.t.size - 1
    return inside & (long[np.clip(after, 0, last)] == long[np.clip(before, 0, last)])


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
