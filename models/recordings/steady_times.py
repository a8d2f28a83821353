"""Times of a stream whose source is steady, while its stamps are those of an arrival and jitter.

A source that samples at t0 + k T gives stamps t0 + k T + j with a latency j of its own each time.
The stamps alone do not tell whether the source or its stamps are uneven. The motion does: a smooth
signal at wrong times looks rough. With e the error of each value against the line through its
neighbours, steady times are right where they leave clearly less of Σ e² (a ratio of variances), and
of the median of e² too: single outliers decide nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

_FEWEST = 50
"""Messages of a piece; shorter ones keep their stamps."""
_PAUSE_S, _PAUSES = 1.0, 10.0
"""A step of so many s, and of so many usual steps, ends a piece."""
_AHEAD, _WIDE = 25, 50
"""Messages ahead of which one has hardly any latency; those on both sides that tell the phase."""
_EVIDENCE = 12.0
"""Nats by which steady times must be more likely, as for every finding on commands."""
_BETTER = 0.7
"""Share of the squared roughness that they may leave: a jitter that the motion shows."""
_EARLY = 0.05
"""Quantile of the latencies that counts as none."""
_ROUNDS = 3
_USUAL = 3.0
"""Standard deviations within which latencies tell the phase."""
_TOGETHER, _APART = 51, 5.0
"""Neighbours whose median latency differs from the usual one by so many of its standard deviations
only where the source changes its rate or stops; their stamps are kept."""
_COUNTED = 0.25
"""Median deviation of an interval, in steps, up to which lost messages are counted: that of normal
jitter of a quarter step, whose least values of 25 differ by less than half a step. Beyond it the
phase must be told by several independent lines."""


@dataclass(frozen=True)
class Steady:
    """Steady times of a stream.

    Attributes:
        t: s, in the order of the messages.
        rate: of the source (Hz).
        jitter: root mean square of the stamps about steady times (s).
    """

    t: Float[np.ndarray, " n"]
    rate: float
    jitter: float


def steady_times(
    t: Float[np.ndarray, " n"], x: Float[np.ndarray, "k n"], late: bool = False
) -> Steady | None:
    """Steady times of messages in the order in which they were sent; None if the stamps are right.

    Args:
        t: stamps (s); latencies may exchange their order.
        x: numbers of the messages, which change smoothly; those that are not finite do not count.
        late: the stamps are those of an arrival: latencies are positive, and steady times are those
            of the earliest ones, else the middle ones.
    """
    if t.size < _FEWEST or not np.isfinite(t).all():
        return None
    pieces = _pieces(t)
    fitted = [_steady(t[a:b], late) if b - a >= _FEWEST else None for a, b in pieces]
    found = t.astype(float).copy()
    steps = []
    for (a, b), one in zip(pieces, fitted, strict=True):
        if one is not None:
            found[a:b] = one[0]
            steps.append(one[1])
    if not steps:
        return None
    if not _clearly_smoother(t, found, x):
        return None
    moved = np.concatenate([(t - found)[a:b] - np.median((t - found)[a:b]) for a, b in pieces])
    return Steady(found, 1 / float(np.median(steps)), float(np.sqrt(np.mean(moved**2))))


def _pieces(t: np.ndarray) -> list[tuple[int, int]]:
    """Stretches between pauses."""
    step = np.diff(t)
    usual = max(float(np.median(step)), float(np.mean(np.minimum(np.abs(step), _PAUSE_S))))
    edges = np.flatnonzero(np.abs(step) > max(_PAUSE_S, _PAUSES * usual)) + 1
    return list(pairwise([0, *edges.tolist(), t.size]))


def _steady(t: np.ndarray, late: bool) -> tuple[np.ndarray, float] | None:
    """Times of a steady source for one stretch, and its step; None if there is no step."""
    n = np.arange(t.size)
    step = _first_step(t)
    counted = float(np.median(np.abs(np.diff(t) - step))) <= _COUNTED * step
    if step <= 0 or (not counted and t.size < 4 * _WIDE):
        return None
    index = n
    for _ in range(_ROUNDS):
        index = n + _lost(t, n, step) if counted else n
        step = float(np.polyfit(index, t, 1)[0])
        if step <= 0:
            return None
    smooth = _local_line(index.astype(float), t)
    for _ in range(_ROUNDS):  # a stall of the receiver bends no line
        reach = _USUAL * _spread(t - smooth)
        smooth = _local_line(index.astype(float), np.clip(t, smooth - reach, smooth + reach))
    latency = t - smooth
    found = smooth + float(np.quantile(latency, _EARLY if late else 0.5))
    return np.where(_uneven(latency), t, found), step


def _uneven(latency: np.ndarray) -> np.ndarray:
    """Messages near which the source is not steady: latencies are then off together."""
    off = latency - np.median(latency)
    width = min(_TOGETHER, off.size)
    together = np.median(np.lib.stride_tricks.sliding_window_view(off, width), axis=1)
    usual = _spread(latency) * 1.25 / np.sqrt(width)
    bad = np.convolve(np.abs(together) > _APART * usual, np.ones(width + 2 * _WIDE), "full")
    return bad[_WIDE : _WIDE + latency.size] > 0.5


def _spread(latency: np.ndarray) -> float:
    """Standard deviation of normal latencies by their median deviation."""
    return 1.4826 * float(np.median(np.abs(latency - np.median(latency))))


def _first_step(t: np.ndarray) -> float:
    """The median step between messages that are some apart, which hardly jitters; none is lost."""
    apart = min(_AHEAD, t.size // 4)
    return float(np.median(t[apart:] - t[:-apart])) / apart


def _lost(t: np.ndarray, n: np.ndarray, step: float) -> np.ndarray:
    """Messages that were lost before each: the earliest that follow stay behind by so many."""
    behind = t - step * n
    padded = np.concatenate([behind, np.full(_AHEAD, np.inf)])
    ahead = np.lib.stride_tricks.sliding_window_view(padded, _AHEAD + 1).min(axis=1)
    jumps = np.maximum(np.rint(np.diff(ahead) / step), 0)
    return np.concatenate([[0], np.cumsum(jumps)]).astype(int)


def _local_line(index: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Regression of t on the index over the messages on both sides of each."""
    width = min(2 * _WIDE + 1, t.size)
    first = np.clip(np.arange(t.size) - width // 2, 0, t.size - width)
    k = np.lib.stride_tricks.sliding_window_view(index - index.mean(), width)[first]
    s = np.lib.stride_tricks.sliding_window_view(t - t.mean(), width)[first]
    mean_k, mean_s = k.mean(axis=1), s.mean(axis=1)
    off = k - mean_k[:, None]
    slope = np.sum(off * s, axis=1) / np.sum(off**2, axis=1)
    return mean_s + slope * (index - index.mean() - mean_k) + t.mean()


def _clearly_smoother(t: np.ndarray, steady: np.ndarray, x: np.ndarray) -> bool:
    """Whether the numbers are clearly smoother at steady times than at their stamps."""
    order, other = np.argsort(t, kind="stable"), np.argsort(steady, kind="stable")
    ratios = []
    for row in _changing(x):
        given = _errors(t[order], row[order])
        found = _errors(steady[other], row[other])
        pairs = [(np.mean(x), np.median(x)) for x in (given, found) if x.size]
        if len(pairs) == 2 and min(*pairs[0], *pairs[1]) > 0:
            ratios.append(float(np.max(np.log(pairs[1]) - np.log(pairs[0]))))
    if not ratios:
        return False
    mean = float(np.mean(ratios))
    return bool(mean < np.log(_BETTER) and -0.25 * t.size * mean > _EVIDENCE)


def _changing(x: np.ndarray) -> Sequence[np.ndarray]:
    """Rows that are known and change in most messages."""
    return [
        row
        for row in x
        if np.isfinite(row).all() and np.count_nonzero(np.diff(row)) > 0.5 * row.size
    ]


def _errors(t: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Squared errors of the values against the line through both neighbours of each."""
    span = t[2:] - t[:-2]
    inside = (span > 0) & (span < _PAUSE_S)
    part = np.where(inside, (t[1:-1] - t[:-2]) / np.where(inside, span, 1.0), 0.0)
    off = row[1:-1] - row[:-2] - part * (row[2:] - row[:-2])
    return off[inside] ** 2
