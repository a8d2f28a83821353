"""Position and velocity of telemetry: the local estimate, and height and climb where it is silent.

Without a horizontal estimate ArduSub sends no LOCAL_POSITION_NED, but GLOBAL_POSITION_INT goes on.
"""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from ..mavlink import codec
from .signals import Series, Spans, series, silences, witnessed_spans
from .streams import UNAIDED
from .table import Table

_VELOCITY_HORIZ, _POS_HORIZ, _CONST_POS = 2, 8 | 16, 128
_SHORTEST_S = 2.0
"""Height and climb alone are taken for no less time than this."""
_BEFORE_S = 1e-6
"""A span of local positions ends before its last sample: after it x and y are unknown."""
_WINDOW_S = 0.5
_FITS = 0.5
"""Share of the change of height over windows that the integrated climb explains, if it fits."""

Motion = tuple[Series | None, Series | None]


def motion(tables: Mapping[str, Table]) -> tuple[Motion, dict[str, Spans], list[str]]:
    """Position and velocity in W, spans without a horizontal estimate, and sentences on both.

    x, y and their velocities are NaN where no LOCAL_POSITION_NED was sent.
    """
    local = _local(tables.get("LOCAL_POSITION_NED"))
    vertical, notes = _vertical(tables)
    if local[0] is None or local[1] is None:
        return vertical, {"aiding": _all(UNAIDED)}, notes
    covered = _covered(local[0])
    outside = [] if vertical[0] is None else _outside(covered, vertical[0])
    if not outside:
        return local, _by_status(tables), []
    lost = sum(b - a for a, b in outside)
    notes.append(
        f"LOCAL_POSITION_NED is silent for {lost:.1f} s: height and climb are there those of "
        "GLOBAL_POSITION_INT, and the horizontal motion is unknown."
    )
    both = _with(local[0], vertical[0], outside), _with(local[1], vertical[1], outside)
    edges = sorted(x for span in (*covered, *outside) for x in span)
    middles = [(a + b) / 2 for a, b in pairwise(edges)]
    labels = [UNAIDED if any(a < t < b for a, b in outside) else "" for t in middles]
    spans = Spans(np.array(edges[:-1]), np.array(edges[1:]) - _BEFORE_S, tuple(labels))
    return both, {"coverage": spans, **_by_status(tables)}, notes


def _local(table: Table | None) -> Motion:
    if table is None or table["t"].size < 2:
        return None, None
    t, name = table["t"], "LOCAL_POSITION_NED"
    p = codec.world_vector(table["x"], table["y"], table["z"])
    v = codec.world_vector(table["vx"], table["vy"], table["vz"])
    return series(t, p, name, "position"), series(t, v, name, "velocity")


def _vertical(tables: Mapping[str, Table]) -> tuple[Motion, list[str]]:
    """Height and climb alone."""
    table = tables.get("GLOBAL_POSITION_INT")
    if table is None:
        return (None, None), []
    t, name = table["t"], "GLOBAL_POSITION_INT"
    z = np.asarray(codec.height_from_relative_alt(table["relative_alt"]), float)
    position = series(t, _upward(z), name, "position")
    velocity = series(
        t, _upward(np.asarray(codec.climb_from_vz(table["vz"]), float)), name, "velocity"
    )
    velocity, notes = upright(position, velocity)
    return (position, _finer(tables, velocity)), notes


def _upward(z: np.ndarray) -> np.ndarray:
    lacking = np.full(z.size, np.nan)
    return np.stack([lacking, lacking, z])


def _finer(tables: Mapping[str, Table], velocity: Series | None) -> Series | None:
    """The climb of VFR_HUD where it comes more often: the same estimate, not rounded to 1 cm/s."""
    hud = tables.get("VFR_HUD")
    if hud is None:
        return velocity
    found = series(hud["t"], _upward(np.asarray(hud["climb"], float)), "VFR_HUD", "velocity")
    if found is None or (velocity is not None and found.rate <= velocity.rate):
        return velocity
    return found


def upright(position: Series | None, velocity: Series | None) -> tuple[Series | None, list[str]]:
    """The climb with the sign that its height has: up to ArduSub 3.5 vz was positive upwards."""
    if position is None or velocity is None:
        return velocity, []
    t, climb = velocity.t, velocity.x[2]
    path = np.concatenate([[0.0], np.cumsum(np.diff(t) * (climb[1:] + climb[:-1]) / 2)])
    window = max(_WINDOW_S, 2.0 / velocity.rate if velocity.rate else _WINDOW_S)
    before = t[t + window <= t[-1]]
    whole = np.interp(before + window, t, path) - np.interp(before, t, path)
    height = [np.interp(at, position.t, position.x[2]) for at in (before, before + window)]
    moved = height[1] - height[0]
    square = float(np.sum(moved**2))
    given, turned = (square - float(np.sum((moved - sign * whole) ** 2)) for sign in (1, -1))
    if turned <= _FITS * square or given > 0:
        return velocity, []
    said = (
        f"{velocity.source}: its vz is positive upwards, as the heights tell, and was turned "
        "(ArduSub up to 3.5)."
    )
    return Series(t, -velocity.x, velocity.source, velocity.left_out), [said]


def _covered(one: Series) -> list[tuple[float, float]]:
    """Spans in which a stream is not silent."""
    edges = [float(one.t[0]), *(x for span in silences(one.t) for x in span), float(one.t[-1])]
    return list(zip(edges[::2], edges[1::2], strict=True))


def _outside(covered: list[tuple[float, float]], other: Series) -> list[tuple[float, float]]:
    """Spans of another stream that are longer than a short silence, and not covered."""
    edges = [float(other.t[0]), *(x for span in covered for x in span), float(other.t[-1])]
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > _SHORTEST_S]


def _with(one: Series, other: Series | None, outside: list[tuple[float, float]]) -> Series:
    """One stream, with the samples of another in some spans."""
    if other is None:
        return one
    inside = np.zeros(other.t.size, bool)
    for a, b in outside:
        inside |= (other.t > a) & (other.t < b)
    t = np.concatenate([one.t, other.t[inside]])
    order = np.argsort(t, kind="stable")
    x = np.concatenate([one.x, other.x[:, inside]], axis=1)
    return Series(t[order], x[:, order], one.source, one.left_out)


def _by_status(tables: Mapping[str, Table]) -> dict[str, Spans]:
    """Spans with and without a horizontal estimate by the filter's own word."""
    status = tables.get("EKF_STATUS_REPORT")
    if status is None:
        return {}
    flags = status["flags"].astype(int)
    aided = (flags & _VELOCITY_HORIZ > 0) & (flags & _POS_HORIZ > 0) & (flags & _CONST_POS == 0)
    return {"aiding": witnessed_spans(status["t"], ["" if a else UNAIDED for a in aided])}


def _all(label: str) -> Spans:
    return Spans(np.array([-np.inf]), np.array([np.inf]), (label,))
