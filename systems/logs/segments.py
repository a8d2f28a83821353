"""Cuts a log into stretches of constant mode, arming, aiding and wiring, without gaps or jumps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ...models.recordings.resample import rotations
from .signals import LONGEST_STEP_S, Series, Signals, Spans

_GUARD_S = 0.1
_NOISE_STEPS = 10.0
"""Times the median step, above which a step is not of the noise: 6.7 σ of normal noise."""


@dataclass(frozen=True)
class Segment:
    """A stretch from start to stop (s on the log's clock), labelled by its states."""

    start: float
    stop: float
    labels: tuple[str, ...]

    @property
    def duration(self) -> float:
        """Length (s)."""
        return self.stop - self.start


def segments(signals: Signals, gap: float) -> tuple[list[Segment], list[str]]:
    """Return the stretches with constant states, without gaps or jumps, in time order.

    `gap` (s) is the longest pause allowed between samples, or five typical steps if that is longer.
    The second result lists the causes of the cuts, one sentence for each kind.
    """
    told: list[str] = []
    spans = [Segment(-np.inf, np.inf, ())]
    for state in signals.spans.values():
        spans = intersect(spans, state)
    armed = [s for s in spans if "disarmed" not in s.labels]
    series = [signals.attitude, signals.rates, signals.outputs]
    series += [s for s in (signals.position, signals.velocity) if s is not None]
    gaps: list[tuple[float, float]] = []
    for one in series:
        pieces = _without_gaps(one, gap)
        spans = intersect(spans, pieces)
        gaps += zip(pieces.stop[:-1].tolist(), pieces.start[1:].tolist(), strict=True)
    told += _short(signals, series[1:], armed, gap)
    felt = [(a, b) for a, b in gaps if any(a < s.stop and b > s.start for s in armed)]
    if felt:
        starts = np.sort([a for a, _ in felt])
        count = 1 + int(np.count_nonzero(np.diff(starts) > gap))
        longest = max(b - a for a, b in felt)
        told.append(f"{count} gap{'s' * (count > 1)} of up to {longest:.1f} s")
    cuts = [*signals.cuts, *jumps(signals)]
    spans = intersect(spans, _between([t for t, _ in cuts]))
    cuts = [(t, k) for t, k in cuts if any(s.start <= t <= s.stop for s in armed)]
    for kind in dict.fromkeys(kind for _, kind in cuts):
        times = np.sort([t for t, k in cuts if k == kind])
        count = 1 + int(np.count_nonzero(np.diff(times) > 1.0))
        told.append(f"{count} × {kind}")
    return sorted(spans, key=lambda s: s.start), told


def _short(
    signals: Signals, series: Sequence[Series], armed: Sequence[Segment], gap: float
) -> list[str]:
    """Streams that begin after the attitude or end before it, and so shorten what is kept."""
    first, last = float(signals.attitude.t[0]), float(signals.attitude.t[-1])
    told = []
    for one in {one.source: one for one in series}.values():
        ends = (first, float(one.t[0]), "late start"), (float(one.t[-1]), last, "early end")
        for a, b, what in ends:
            lost = sum(max(0.0, min(b, s.stop) - max(a, s.start)) for s in armed)
            if lost > max(gap, 1.0 / one.rate if one.rate else gap):
                told.append(f"the {what} of {one.source} ({lost:.1f} s)")
    return told


def jumps(signals: Signals) -> list[tuple[float, str]]:
    """Times at which the estimate jumps faster than a vehicle moves: filter resets, lane switches.

    A position step is compared with the velocity estimate, an attitude step with the body rates,
    and each of them with the usual ones of the signal.
    """
    found = []
    q, omega = signals.attitude, signals.rates
    step = np.diff(q.t)
    R = rotations(q.x)
    middle = 0.5 * (q.t[1:] + q.t[:-1])
    rate = np.stack([np.interp(middle, omega.t, omega.x[i]) for i in range(3)])
    turn = Rotation.from_rotvec(np.nan_to_num(rate * step).T)
    off = (turn.inv() * R[:-1].inv() * R[1:]).magnitude()
    times = middle[np.isfinite(rate).all(axis=0) & _outliers(off, 0.06 + 1.5 * step)]
    found += [(float(t), "attitude reset of the estimator") for t in times]
    if signals.position is None or signals.velocity is None:
        return found
    p, v = signals.position, signals.velocity
    step = np.diff(p.t)
    speed = np.stack([np.interp(p.t, v.t, v.x[i]) for i in range(3)])
    moved = np.diff(p.x, axis=1) - 0.5 * (speed[:, 1:] + speed[:, :-1]) * step
    off = np.linalg.norm(np.nan_to_num(moved), axis=0)
    times = p.t[1:][_outliers(off, 0.25 + 1.0 * step**2)]
    found += [(float(t), "position reset of the estimator") for t in times]
    step = np.diff(v.t)
    off = np.linalg.norm(np.nan_to_num(np.diff(v.x, axis=1)), axis=0)
    times = v.t[1:][_outliers(off, 0.5 + 5.0 * step)]
    found += [(float(t), "velocity reset of the estimator") for t in times]
    return found


def _outliers(off: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Steps that are larger than a vehicle's, and than those of the signal's own noise.

    Without a horizontal aid an autopilot reports as height the barometer's, with its noise of
    0.1 to 0.3 m: no estimator was reset there.
    """
    return off > np.maximum(least, _NOISE_STEPS * np.median(off)) if off.size else off > least


def _without_gaps(one: Series, gap: float) -> Spans:
    allowed = max(gap, min(5.0 / one.rate, LONGEST_STEP_S) if one.rate else gap)
    good = np.isfinite(one.t)
    t = one.t[good]
    breaks = np.flatnonzero(np.diff(t) > allowed)
    start = np.concatenate([[t[0]], t[breaks + 1]])
    stop = np.concatenate([t[breaks], [t[-1]]])
    return Spans(start, stop, ("",) * start.size)


def _between(times: Sequence[float]) -> Spans:
    edges = np.sort(np.asarray(times, float))
    start = np.concatenate([[-np.inf], edges + _GUARD_S])
    stop = np.concatenate([edges - _GUARD_S, [np.inf]])
    return Spans(start, stop, ("",) * start.size)


def intersect(segments: Sequence[Segment], spans: Spans) -> list[Segment]:
    """The parts of segments that lie in spans of a state, with its label in addition."""
    result = []
    for segment in segments:
        for start, stop, label in zip(spans.start, spans.stop, spans.label, strict=True):
            low, high = max(segment.start, float(start)), min(segment.stop, float(stop))
            if high > low:
                labels = (*segment.labels, label) if label else segment.labels
                result.append(Segment(low, high, labels))
    return result
