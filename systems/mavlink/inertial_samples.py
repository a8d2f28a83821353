"""Inertial samples that arrive at times of their own, as values at the times of a filter."""

from collections import deque

import numpy as np
from jaxtyping import Float


class InertialSamples:
    """Specific force and angular rate at times of the local clock, from samples by straight lines.

    A sample's values belong to a time before its own: by `delays` (s), those of the autopilot's
    low-passes on force and rate. What is missing is not made up: a value held while a link hangs
    would be a motion that the filter believes.
    """

    def __init__(self, hold: float = 0.1, delays: tuple[float, float] = (0.0, 0.0)):
        """`hold` is the longest time (s) for which the newest sample is held.

        Samples are joined if they are no more than twice as far apart.
        """
        self._hold = hold
        self._delays = delays
        self._kept: deque[tuple[float, np.ndarray]] = deque(maxlen=200)

    def add(self, taken: float, value: Float[np.ndarray, "6"]) -> None:
        """A sample of a local time (s); one that is not later than the last is left out."""
        if np.isfinite(value).all() and (not self._kept or taken > self._kept[-1][0]):
            self._kept.append((taken, value))

    def at(self, time: float) -> Float[np.ndarray, "6"]:
        """Force and rate at a time (s); NaN where no sample is near."""
        kept = list(self._kept)  # a link's thread adds to it
        force, rate = (self._value(kept, time + delay) for delay in self._delays)
        return np.concatenate([force[:3], rate[3:]])

    def _value(self, kept: list[tuple[float, np.ndarray]], t: float) -> np.ndarray:
        """All values at the time t of samples."""
        i = next((i for i in range(len(kept) - 1, -1, -1) if kept[i][0] <= t), None)
        if i is None:
            return np.full(6, np.nan)
        first, value = kept[i]
        if i + 1 == len(kept):
            return value if t - first <= self._hold else np.full(6, np.nan)
        after, following = kept[i + 1]
        if after - first > 2 * self._hold:
            return np.full(6, np.nan)
        return value + (t - first) / (after - first) * (following - value)
