"""Whether a pressure is that of the water: it then follows the autopilot's height.

A vehicle has a barometer in its hull too, whose pressure hardly changes with depth.
"""

from dataclasses import dataclass

import numpy as np

from .signals import Series

_LAGS_S = (2.0, 8.0, 32.0, 128.0)
_MOVED_M, _LEAST, _SHARE = 0.3, 20, 0.1
"""Change of height (m) that is more than its usual noise; how many must be seen, and which share of
all changes: of a vehicle at rest a few are as large, as with the noise of a GPS (0.1 m)."""
_RATIO = 2.0
"""Factor by which the changes of a depth and of the height may differ: salt and a wrong
specific gravity make a few percent, a hull's barometer nearly all of it."""


@dataclass(frozen=True)
class Followed:
    """A depth by pressure that was compared with the height.

    Attributes:
        depth: None if it does not follow the height.
        told: a sentence on a depth that was dropped.
        sure: whether the height moved enough to tell.
    """

    depth: Series | None
    told: tuple[str, ...] = ()
    sure: bool = False


def followed(depth: Series | None, position: Series | None) -> Followed:
    """Drop a depth by pressure that does not follow the estimated height, if there is one."""
    ratio = None if depth is None or position is None else _ratio(depth, position)
    if depth is None or ratio is None:
        return Followed(depth)
    if 1 / _RATIO < ratio < _RATIO:
        return Followed(depth, sure=True)
    said = (
        f"{depth.source} changes by {100 * ratio:.0f} % of the estimated height's change, as a "
        "barometer in the hull does: it was left out."
    )
    return Followed(None, (said,), sure=True)


def _ratio(depth: Series, position: Series) -> float | None:
    """Median ratio of changes of depth and of the estimate; None if the height hardly moves.

    The changes are those over the shortest lag at which the height moves. In the median resets of
    the estimate, and drift of a barometer, do not count.
    """
    known = np.isfinite(position.x[2])
    t, z = position.t[known], position.x[2, known]
    if t.size < 2:
        return None
    own = depth.t[(depth.t >= t[0]) & (depth.t <= t[-1])]
    for lag in _LAGS_S:
        before = own[own + lag <= min(t[-1], depth.t[-1])]
        moved = np.interp(before, t, z) - np.interp(before + lag, t, z)
        deeper = np.interp(before + lag, depth.t, depth.x) - np.interp(before, depth.t, depth.x)
        clear = np.abs(moved) > _MOVED_M
        if np.count_nonzero(clear) >= max(_LEAST, _SHARE * clear.size):
            return float(np.median(deeper[clear] / moved[clear]))
    return None
