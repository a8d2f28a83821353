"""Inertial samples that arrive at times of their own, as means over the periods of a filter."""

from collections import deque

import numpy as np
from jaxtyping import Float


class InertialSamples:
    """Means of specific force and angular rate over successive intervals of the local clock.

    Samples are joined by straight lines, the newest is held; their integral is kept, so that what
    intervals have held too long is corrected in the following ones, and no motion is lost or
    counted twice. A correction lasts as long as the sample was held: all at once, after a link or a
    loop that hung, it would be a jolt of many times the motion.
    """

    def __init__(self, hold: float = 0.2):
        """`hold` is the longest time (s) for which the newest sample is held."""
        self._hold = hold
        self._kept: deque[tuple[float, np.ndarray, np.ndarray]] = deque(maxlen=200)
        self._told: np.ndarray | None = None
        self._owed = 0.0
        """Time (s) over which what was held is still to be corrected."""

    def add(self, taken: float, value: Float[np.ndarray, "6"]) -> None:
        """A sample of a local time (s); one that is not later than the last is left out."""
        if not np.isfinite(value).all():
            return
        if not self._kept:
            self._kept.append((taken, value, np.zeros(6)))
            return
        before, last, integral = self._kept[-1]
        if taken > before:
            if taken - before > self._hold:  # a gap: nothing is known about it
                self._told, last = None, value
            more = integral + (taken - before) * (last + value) / 2
            self._kept.append((taken, value, more))

    def mean(self, start: float, end: float) -> Float[np.ndarray, "6"]:
        """Mean over the interval (s) that follows the last one; NaN where no sample is known."""
        if not self._kept or end - self._kept[-1][0] > self._hold or start < self._kept[0][0]:
            self._told = None
            return np.full(6, np.nan)
        span, begun = end - start, self._integral(start)
        if self._told is None:
            self._told, self._owed = begun, 0.0
        share = min(1.0, span / self._owed) if self._owed > 0 else 1.0
        moved = self._integral(end) - begun + share * (begun - self._told)
        self._told = self._told + moved
        self._owed = max(self._owed - span, end - self._kept[-1][0])
        return moved / span

    def _integral(self, t: float) -> np.ndarray:
        kept = list(self._kept)
        times = np.array([time for time, _, _ in kept])
        i = max(int(np.searchsorted(times, t, side="right")) - 1, 0)
        taken, value, integral = kept[i]
        dt = t - taken
        if i + 1 < len(kept) and dt > 0:
            following, after, _ = kept[i + 1]
            slope = (after - value) / (following - taken)
            return integral + dt * (value + slope * dt / 2)
        return integral + dt * value
