"""Times of a log whose clock steps back, by a reboot or by a fault, or runs apart from another."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...models.recordings.checks.finding import Finding

REBOOT_S = 5.0
"""A step back of more than this is a reboot."""
_STEP_S, _STAYS_S, _LATER = 0.2, 0.1, 8
"""s of a step back from the messages before to those after; one that comes late, or is stamped
late, is none."""
_BETWEEN_S = 10.0
_WRAP_MS_S = 2**32 * 1e-3
_PIECE_S, _PIECES, _RATE = 10.0, 6, 0.02
"""Pieces over which two clocks are compared, how many are needed, and what they may differ by."""

_LEAST_S, _CLEAR, _FEWEST = 0.02, 6.0, 4
"""Drift that matters (s): half a sample at 25 Hz; times its standard error that it must have; and
the pieces that are needed."""


@dataclass(frozen=True)
class Drift:
    """Least latency along time, a line.

    Attributes:
        middle: s on the clock of the latencies' times.
        value: latency there (s).
        slope: s per s.
        change: over the whole (s).
    """

    middle: float
    value: float
    slope: float
    change: float

    def at(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Least latency at some times (s)."""
        return self.value + self.slope * (t - self.middle)


def least_latencies(
    t: Float[np.ndarray, " n"], latency: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Times and values of the least latencies of pieces of 10 s."""
    piece = np.floor((t - t.min()) / _PIECE_S).astype(int)
    rows = [
        inside for n in np.unique(piece) if (inside := np.flatnonzero(piece == n)).size >= _LATER
    ]
    least = np.array([inside[latency[inside].argmin()] for inside in rows], int)
    return t[least], latency[least]


def drift(t: Float[np.ndarray, " n"], latency: Float[np.ndarray, " n"]) -> Drift | None:
    """The line through the least latencies of pieces of 10 s; None if they stay as they are.

    A latency is never negative, so the least ones change as one clock does against the other (Olson
    2010, "A passive solution to the sensor synchronization problem"). The slope is the median of
    those between all pieces (Sen 1968).
    """
    x, y = least_latencies(t, latency)
    if x.size < _FEWEST:
        return None
    a, b = np.triu_indices(x.size, 1)
    slope = float(np.median((y[b] - y[a]) / (x[b] - x[a])))
    rest = y - slope * x
    scatter = 1.4826 * float(np.median(np.abs(rest - np.median(rest))))
    error = scatter / float(np.sqrt(np.sum((x - x.mean()) ** 2)))
    change = slope * float(t.max() - t.min())
    if abs(change) < _LEAST_S or abs(slope) < _CLEAR * error:
        return None
    middle = float(np.median(x))
    return Drift(middle, float(np.median(rest)) + slope * middle, slope, change)


def epochs(
    raw: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " n"], tuple[float, ...], int]:
    """Offset of each time (s, in the order of the file) so that later parts follow earlier ones.

    Also the times at which a later part begins, and how many of the steps are no reboots. A counter
    of milliseconds that wraps (49.7 days) goes on.
    """
    found = np.flatnonzero(np.diff(raw) < -_STEP_S) + 1
    shift = np.zeros_like(raw)
    starts, steps = [], 0
    for start in found.tolist():
        before = raw[start - 1]
        if raw[start : start + _LATER].max() > before - _STAYS_S:
            continue
        earlier, later = raw[max(start - _LATER, 0) : start], raw[start : start + _LATER]
        if np.median(earlier) - np.median(later) < _STAYS_S:
            continue  # a message that is stamped too late was before it
        if before - raw[start] > _WRAP_MS_S / 2:
            shift[start:] = shift[start - 1] + _WRAP_MS_S
            continue
        last = before + shift[start - 1]
        shift[start:] = last + _BETWEEN_S - raw[start]
        starts.append(float(last + _BETWEEN_S / 2))
        steps += int(before - raw[start] <= REBOOT_S)
    return shift, tuple(starts), steps


def in_words(starts: tuple[float, ...], steps: int) -> list[str]:
    """Sentences on reboots and other steps back."""
    told, boots = [], len(starts) - steps
    if boots:
        told.append(f"The autopilot booted {boots} more time{'s' * (boots > 1)} in it.")
    if steps:
        told.append(
            f"The vehicle's clock stepped back {steps} time{'s' * (steps > 1)} without a reboot; "
            "the log is cut there."
        )
    return told


def rate_findings(
    own: Float[np.ndarray, " n"], stamps: Float[np.ndarray, " n"], other: str = "the logger's"
) -> list[Finding]:
    """A clock that runs faster or slower than another one, by default the logger's (both s)."""
    edges = np.arange(own[0], own[-1], _PIECE_S)
    at = np.searchsorted(own, edges)
    apart, real = np.diff(own[at]), np.diff(stamps[at])
    usable = (apart < 2 * _PIECE_S) & (real > 0) & (real < 2 * _PIECE_S)
    if np.count_nonzero(usable) < _PIECES:
        return []
    rate = float(np.median(apart[usable] / real[usable]))
    if abs(rate - 1) < _RATE:
        return []
    how = "faster" if rate > 1 else "slower"
    return [
        Finding(
            "clock-rate",
            "",
            f"the vehicle's clock runs {100 * abs(rate - 1):.0f} % {how} than {other}, and "
            "masses and drags depend on it: a simulator at another speed, or a faulty clock",
            "record in real time, or make sure that the vehicle's clock is the right one",
        )
    ]
