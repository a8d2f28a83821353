"""Outputs between the samples of a slow stream, as they were demanded.

A ground station gets the outputs at 2 to 10 Hz unless it asks for more, and logs its own sticks at
20 Hz and more; an autopilot's log has them at 10 Hz, and what its controllers demand often faster
(RATE). In each mode the outputs are, beside what else acts on them, a linear map of such demands,
so with C fitted to all samples of a mode and s the demands at a time

    u(t) = C s(t - lag) + line through (t_k, u_k - C s(t_k - lag)),

for each thruster whose every second sample lies nearer to this curve through the others than to
their lines, beyond doubt; elsewhere the outputs are those lines. A map has the demands whose
coefficients are beyond doubt. Sticks have one lag in a log: that at which the maps leave least.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..mavlink import codec
from .segments import Segment, intersect
from .signals import Series, Spans, silences
from .table import Table
from .tlog import RENAMED

NAMES = ("MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE")
"""What a ground station sends."""
_CONTROLLERS = ("ROut", "POut", "YOut", "AOut")
_AXES = (*"xyzrs", RENAMED["t"])
_GAIN = b"PilotGain"
_LAGS_S = np.arange(-0.1, 0.3001, 0.01)
_RANGE_US = (1100.0, 1900.0)
"""Range of the outputs, or that of the samples where it is wider."""
_STEP_S = 0.01
"""Step of the outputs along demands, which change within it."""
_DOUBT = 3.0
"""Standard errors from which on a coefficient or a difference is beyond doubt."""
_FASTER = 1.5
"""Times the rate of the outputs that a controller's demands have, to tell of what is between."""
_LOST_PERIODS = 3.0
"""Periods of the outputs beyond which a step between samples is a gap."""
_AS_GOOD, _ROUNDING = 1.01, 1e-9
_SAMPLES = 3
"""Samples of a mode at least for each coefficient of its map."""


class _Demands(NamedTuple):
    """Demands s (m, n) in [-1, 1] at times t (n,), of the message `name`.

    Those of a pilot are held until the next; those of a controller are samples of faster ones.
    """

    t: Float[np.ndarray, " n"]
    s: Float[np.ndarray, "m n"]
    name: str
    held: bool = True

    def at(self, t: Float[np.ndarray, " k"]) -> Float[np.ndarray, "m k"]:
        """The demands at some times."""
        if not self.held:
            return np.stack([np.interp(t, self.t, x) for x in self.s])
        return self.s[:, np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, None)]


class _Mode(NamedTuple):
    """The samples of one mode: their indices, and its spans."""

    rows: np.ndarray
    inside: Spans

    def within(self, t: Float[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
        """Whether times lie in the mode."""
        return _within(t, self.inside)


def by_sticks(
    outputs: Series, tables: Mapping[str, Table], states: Sequence[Spans]
) -> tuple[Series, list[str]]:
    """The outputs (µs) of a telemetry log along the pilot's sticks, and a sentence.

    They stay as they are if no sticks tell better than lines between samples do. A mode is a
    combination of labels of the `states`, such as the autopilot's mode and the wiring.
    """
    return _along(outputs, [_sticks(tables, name) for name in NAMES], states)


def by_controllers(
    outputs: Series, rate: Table | None, states: Sequence[Spans]
) -> tuple[Series, list[str]]:
    """The outputs (µs) of an autopilot's log along what its controllers demand, and a sentence.

    These are ROut, POut, YOut and AOut (climb) of RATE. Forward and lateral are not among them.
    """
    if rate is None or not set(_CONTROLLERS) <= set(rate):
        return outputs, []
    t, first = np.unique(rate["t"], return_index=True)
    if t.size < 4 or _rate(t) < _FASTER * outputs.rate:
        return outputs, []
    s = np.stack([rate[name][first].astype(float) for name in _CONTROLLERS])
    return _along(outputs, [_Demands(t, np.clip(s, -1, 1), "RATE", held=False)], states)


def _along(
    outputs: Series, demands: Sequence[_Demands | None], states: Sequence[Spans]
) -> tuple[Series, list[str]]:
    """The outputs along those demands that tell best, and a sentence."""
    modes, tried = _modes(states), []
    for one in demands:
        curves = None if one is None else _curves(outputs, one, modes)
        if curves is not None:
            tried.append((one, *curves))
    if not tried:
        return outputs, []
    one, series, misses = min(tried, key=lambda found: found[2][0])
    return series, [
        f"Outputs between samples ({outputs.rate:.1f} Hz) follow {one.name} at "
        f"{_rate(one.t):.0f} Hz: left-out samples err by {misses[0]:.0f} µs (rms), where lines "
        f"between the others err by {misses[1]:.0f} µs."
    ]


def _curves(
    outputs: Series, demands: _Demands, modes: Sequence[Spans]
) -> tuple[Series, tuple[float, float]] | None:
    """The outputs along demands, and what every second sample misses them and lines by (µs, rms).

    None where no thruster follows these demands.
    """
    groups = _groups(outputs, demands, modes)
    if not groups:
        return None
    lag = _lag(outputs, demands, groups) if demands.held else 0.0
    late = demands._replace(t=demands.t + lag)
    t = _times(outputs, late)
    x = np.stack([np.interp(t, outputs.t, u) for u in outputs.x])
    curve, line, count, all_follow = 0.0, 0.0, 0, True
    for mode in groups:
        own = outputs.t[mode.rows]
        s, u = late.at(own), outputs.x[:, mode.rows]
        C, missed = _map(s, u), _missed(own, s, u)
        gain = missed[1] - missed[0]
        better = gain.sum(axis=1) > _DOUBT * np.sqrt((gain**2).sum(axis=1))
        curve += float(np.where(better[:, None], *missed).sum())
        line += float(missed[1].sum())
        count += u.size
        all_follow &= bool((better | (missed[1] == 0).all(axis=1)).all())
        here = mode.within(t)
        for i in np.flatnonzero(better):
            rest = np.interp(t[here], own, u[i] - C[i] @ s)
            low, high = min(_RANGE_US[0], u[i].min()), max(_RANGE_US[1], u[i].max())
            x[i, here] = np.clip(C[i] @ late.at(t[here]) + rest, low, high)
    if curve == line:
        return None
    misses = (float(np.sqrt(curve / count)), float(np.sqrt(line / count)))
    source, measured = f"{outputs.source} along {demands.name}", 0.0 if all_follow else outputs.rate
    return Series(t, x, source, outputs.left_out, measured), misses


def _missed(
    t: Float[np.ndarray, " k"], s: Float[np.ndarray, "m k"], u: Float[np.ndarray, "n k"]
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
    """Squares by which every second sample misses the curve, and the line, of the others."""
    curve, line = np.zeros_like(u), np.zeros_like(u)
    for first in (0, 1):
        out = np.arange(first, t.size, 2)
        out = out[(out > 0) & (out < t.size - 1)]
        rest = np.setdiff1d(np.arange(t.size), out)
        C = _map(s[:, rest], u[:, rest])
        left = u - C @ s
        for i in range(len(u)):
            line[i, out] = (u[i, out] - np.interp(t[out], t[rest], u[i, rest])) ** 2
            curve[i, out] = (left[i, out] - np.interp(t[out], t[rest], left[i, rest])) ** 2
    return curve, line


def _map(s: Float[np.ndarray, "m k"], u: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n m"]:
    """The map from demands to outputs by least squares; nothing of those that stand still.

    It is that of their changes between samples: what else acts on outputs changes little in one.
    Demands whose coefficients are within doubt of zero are left out.
    """
    ds, du = np.diff(s).T, np.diff(u).T
    Q, R = np.linalg.qr(ds)  # few rows in place of all samples, with the same solutions
    y = Q.T @ du
    C = np.linalg.lstsq(R, y, rcond=1e-6)[0].T
    spread = np.sqrt(np.diag(np.linalg.pinv(R.T @ R, rcond=1e-12, hermitian=True)))
    noise = np.sqrt(np.mean((du - ds @ C.T) ** 2, axis=0))
    kept = np.abs(C) > _DOUBT * noise[:, None] * spread
    for i in np.flatnonzero(~kept.all(axis=1)):
        C[i] = 0.0
        C[i, kept[i]] = np.linalg.lstsq(R[:, kept[i]], y[:, i], rcond=1e-6)[0]
    return C


def _lag(outputs: Series, sticks: _Demands, groups: Sequence[_Mode]) -> float:
    """The middle of the lags (s) at which the maps leave least, or hardly more."""
    left = np.array([_left(outputs, sticks, groups, lag) for lag in _LAGS_S])
    return float(np.mean(_LAGS_S[left <= _AS_GOOD * left.min() + _ROUNDING * left.max()]))


def _left(outputs: Series, sticks: _Demands, groups: Sequence[_Mode], lag: float) -> float:
    """Sum of squares that the maps leave of the samples' changes, at a lag (s)."""
    left = 0.0
    for mode in groups:
        s, u = sticks.at(outputs.t[mode.rows] - lag), outputs.x[:, mode.rows]
        left += float(np.sum(np.diff(u - _map(s, u) @ s) ** 2))
    return left


def _groups(outputs: Series, demands: _Demands, modes: Sequence[Spans]) -> list[_Mode]:
    """The modes with enough samples for a map."""
    covered = (outputs.t > demands.t[0]) & (outputs.t < demands.t[-1])
    groups = []
    for inside in modes:
        rows = np.flatnonzero(_within(outputs.t, inside) & covered)
        if rows.size >= _SAMPLES * len(demands.s):
            groups.append(_Mode(rows, inside))
    return groups


def _modes(states: Sequence[Spans]) -> list[Spans]:
    """The spans of each combination of labels."""
    parts = [Segment(-np.inf, np.inf, ())]
    for state in states:
        parts = intersect(parts, state)
    return [
        _spans([(part.start, part.stop) for part in parts if part.labels == labels])
        for labels in dict.fromkeys(part.labels for part in parts)
    ]


def _times(outputs: Series, demands: _Demands) -> Float[np.ndarray, " k"]:
    """A fine grid where neither demands are silent nor samples are lost, and samples elsewhere."""
    t = np.arange(outputs.t[0], outputs.t[-1], _STEP_S)
    step = np.diff(outputs.t)
    lost = np.flatnonzero(step > _LOST_PERIODS * np.median(step))
    gaps = [(outputs.t[i], outputs.t[i + 1]) for i in lost]
    gaps += [(-np.inf, demands.t[0]), *silences(demands.t), (demands.t[-1], np.inf)]
    spans = _spans(gaps)
    own = outputs.t[_within(outputs.t, spans)]
    return np.unique(np.concatenate([t[~_within(t, spans)], own]))


def _spans(ends: Sequence[tuple[float, float]]) -> Spans:
    start, stop = np.array(ends).T
    return Spans(start, stop, ("",) * len(ends))


def _within(t: np.ndarray, spans: Spans) -> np.ndarray:
    return np.any((t >= spans.start[:, None]) & (t <= spans.stop[:, None]), axis=0)


def _rate(t: np.ndarray) -> float:
    return 1.0 / float(np.median(np.diff(t)))


def _sticks(tables: Mapping[str, Table], name: str) -> _Demands | None:
    """The sticks of one message; MANUAL_CONTROL acts by the pilot's gain, where that was logged."""
    table = tables.get(name)
    if table is None:
        return None
    t, first = np.unique(table["t"], return_index=True)
    if t.size < 4:
        return None
    if name == "MANUAL_CONTROL":
        gain = _gain(tables.get("NAMED_VALUE_FLOAT"), table["t"])
        s = codec.manual_control_demand(*(table[n] for n in _AXES), gain=gain)
    else:
        pulses = np.stack([table[f"chan{n}_raw"] for n in range(1, 9)]).astype(float)
        left_alone = (pulses == 0) | (pulses == codec.UINT16_MAX)
        s = np.asarray(codec.stick(np.where(left_alone, codec.NEUTRAL_US, pulses)))
    return _Demands(t, np.clip(s[:, first], -1, 1), name)


def _gain(table: Table | None, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The pilot's gain at some times, 1 if it was not logged: the maps then contain it."""
    if table is None:
        return np.ones(t.size)
    own = np.array([bytes(name).rstrip(b"\0") == _GAIN for name in table["name"]], bool)
    own &= np.isfinite(table["value"]) & (table["value"] > 0)
    if not own.any():
        return np.ones(t.size)
    rows = table.rows(own)
    return rows["value"][np.clip(np.searchsorted(rows["t"], t, side="right") - 1, 0, None)]
