"""Depth by pressure, and whether the pressure is that of the water.

A vehicle has a barometer in its hull too, whose pressure hardly changes with depth. That of the
water follows the autopilot's height, or else is too high or changes too fast for a sealed hull.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...models.recordings.checks.finding import Finding
from ...models.recordings.conventions import LENGTHS
from ..mavlink import codec
from .signals import Parameter, Series, series, values_at

_LAGS_S = (2.0, 8.0, 32.0, 128.0)
_MOVED_M, _LEAST, _SHARE = 0.3, 20, 0.1
"""Change of height (m) that is more than its usual noise; how many must be seen, and which share of
all changes: of a vehicle at rest a few are as large, as with the noise of a GPS (0.1 m)."""
_RATIO = 2.0
"""Factor by which the changes of a depth and of the height may differ: salt and a wrong
specific gravity make a few percent, a hull's barometer nearly all of it."""
_NEAR, _FITS = 1.1, 0.9
"""Factor within which a ratio tells of a unit, and the share of the changes that it then explains:
of a barometer in a hull heat and leaks make as much as the depth does."""
_LOWEST_HPA, _ABOVE_M = 500.0, 1.0
"""hPa that no surface of water has less of (5500 m high); m above the surface in the median."""
_UNITS = ((0.5, 8.0, "bar"), (8.0, 60.0, "psi"), (60.0, _LOWEST_HPA, "kPa"))
_HULL = 0.1
"""Share of the water's pressure that a hull which gives way may show."""
_DEEP_M, _FAST_M, _FAST_S = 6.0, 0.2, 2.0
"""Depth that a sealed hull never shows (1.6 atmospheres), and a change that heat does not make."""


@dataclass(frozen=True)
class Followed:
    """A depth by pressure that was compared with the height.

    Attributes:
        depth: None if it does not follow the height.
        told: a sentence on a depth that was dropped.
        sure: whether the height moved enough to tell.
        findings: a contradiction between the signs or units of depth and height.
        opposite: whether their signs differ.
    """

    depth: Series | None
    told: tuple[str, ...] = ()
    sure: bool = False
    findings: tuple[Finding, ...] = ()
    opposite: bool = False


def depth_series(
    t: Float[np.ndarray, " n"],
    hPa: Float[np.ndarray, " n"],
    source: str,
    parameters: Sequence[Parameter],
    barometer: int,
    density: float | None,
) -> tuple[Series | None, list[Finding]]:
    """Depth by one barometer (from 1) with the parameters of each time; None in another unit."""
    known = np.isfinite(hPa)
    if not known.any():
        return None, []
    median = float(np.median(hPa[known]))
    surface = values_at(parameters, f"BARO{barometer}_GND_PRESS", t, 0.0) / 100
    told = (surface > 800) & (surface < 1200)
    surface = np.where(told, surface, codec.SURFACE_PRESSURE_HPA)
    if median < _LOWEST_HPA:
        if median <= _UNITS[0][0]:
            return None, []  # a barometer that is not there
        unit = next(unit for low, high, unit in _UNITS if low < median <= high)
        return None, [_left_out(source, f"it is {median:.4g}, which looks like {unit}, not hPa")]
    gradient = codec.pascal_per_metre(1.0, density)
    if density is None:
        gradient = gradient * values_at(parameters, "BARO_SPEC_GRAV", t, 1.0)
    depth = (hPa - surface) * (100.0 / gradient)
    if told.all() and float(np.nanmedian(depth)) < -_ABOVE_M:
        low = f"it is {median:.4g} hPa, less than the surface's {float(np.median(surface)):.4g}"
        return None, [_left_out(source, f"{low}: no absolute pressure, or a wrong GND_PRESS")]
    return series(t, depth, source, "depth"), []


def _left_out(source: str, text: str) -> Finding:
    remedy = "give absolute pressures in hPa, as ArduPilot sends them"
    return Finding("sensor-left-out", source, f"{text}; the pressure is left out", remedy)


def followed(depth: Series | None, position: Series | None, pressed: bool = True) -> Followed:
    """Drop a depth by pressure that does not follow the estimated height, if there is one.

    `pressed` tells whether it is by pressure, else a number in any unit.
    """
    found = None if depth is None or position is None else _ratio(depth, position)
    if depth is None or position is None or found is None:
        return Followed(depth)
    ratio, explained = found
    if 1 / _RATIO < ratio < _RATIO:
        return Followed(depth, sure=True)
    for unit, size in LENGTHS.items() if explained > _FITS else ():
        if 1 / _NEAR < ratio / size < _NEAR and _not_a_hulls(depth, size, pressed):
            return Followed(depth, sure=True, findings=(_height_in(unit, depth, position, ratio),))
        if not pressed and 1 / _NEAR < ratio * size < _NEAR:
            return Followed(None, sure=True, findings=(_depth_in(unit, size, depth, position),))
    if 1 / _RATIO < -ratio < _RATIO:
        sign = Finding(
            "motion-contradiction",
            f"{position.source}, {depth.source}",
            "the pressure falls where the height does: one of them has the other sign",
            "pressure rises with depth, so correct the sign of the height; give the log with the "
            "streams as the autopilot sends them",
        )
        return Followed(depth, sure=True, findings=(sign,), opposite=True)
    changes = f"{depth.source} changes by {100 * ratio:.0f} % of the estimated height's change"
    if ratio > _RATIO:
        said = f"{changes}: it is no pressure of water in hPa, and was left out."
    else:
        said = f"{changes}, as a barometer in the hull does: it was left out."
    return Followed(None, (said,), sure=True)


def _not_a_hulls(depth: Series, size: float, pressed: bool) -> bool:
    """Whether changes of a few percent of the height's can't be those in a hull that gives way."""
    return not pressed or size > _HULL or in_water_for_sure(depth)


def _height_in(unit: str, depth: Series, position: Series, ratio: float) -> Finding:
    return Finding(
        "motion-contradiction",
        f"{position.source}, {depth.source}",
        f"the height of {position.source} looks like {unit}: {depth.source} changes by "
        f"{100 * ratio:.3g} % of it",
        "give heights and positions in m",
    )


def _depth_in(unit: str, size: float, depth: Series, position: Series) -> Finding:
    return Finding(
        "sensor-left-out",
        depth.source,
        f"its depths look like {unit} against the height of {position.source}: they are left out",
        f"give them in m, in a topic map by `scale: {size:g}`",
    )


def in_water_for_sure(depth: Series) -> bool:
    """Whether a pressure is too high, or changes too fast, to be that of a sealed hull."""
    own = depth.t[depth.t + _FAST_S <= depth.t[-1]]
    later = np.interp(own + _FAST_S, depth.t, depth.x)
    fast = np.abs(later - np.interp(own, depth.t, depth.x)) > _FAST_M
    moved = np.count_nonzero(fast) >= max(_LEAST, _SHARE * fast.size)
    return bool(moved or float(np.median(depth.x)) > _DEEP_M)


def outside(found: Followed, better: str) -> Followed:
    """Drop a first barometer that no height was compared with, unless it is in the water for sure.

    `better` are the messages that have the other barometer.
    """
    if found.depth is None or found.sure or in_water_for_sure(found.depth):
        return found
    left = Finding(
        "sensor-left-out",
        found.depth.source,
        "it is the first barometer, which is in the hull of a BlueROV2, and no height that moves "
        "tells whether its pressure is the water's; it is no depth and is left out",
        f"log {better}, or a height (GLOBAL_POSITION_INT, VFR_HUD) while the vehicle dives",
    )
    return Followed(None, findings=(left,))


def _ratio(depth: Series, position: Series) -> tuple[float, float] | None:
    """Median ratio of changes of depth and of the estimate; None if the height hardly moves.

    The second result is the share of the squared changes of depth that the ratio explains. The
    changes are those over the shortest lag at which the height moves. In the median resets of the
    estimate, and drift of a barometer, do not count.
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
            ratio = float(np.median(deeper[clear] / moved[clear]))
            left = float(np.sum((deeper - ratio * moved) ** 2))
            return ratio, 1 - left / max(float(np.sum(deeper**2)), 1e-12)
    return None
