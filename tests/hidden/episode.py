"""A cause that acts in a part of the data, or grows in the course of it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .effect import Effect, Latent, Moment, Parameters, Signals


@dataclass(frozen=True)
class Episode(Effect):
    """Another cause times a strength, 0 to 1, that depends on the run and its time.

    `strength(t)` gives that of every run, (B,), at a time t (s) of the runs; for causes whose
    wrench or thrust is proportional to their size, and for instruments with a strength of 0 or 1.
    """

    inner: Any = None
    strength: Callable[[float], np.ndarray] = lambda t: np.zeros(0)

    @property
    def cause(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.inner.cause

    @property
    def order(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.inner.order

    @property
    def where(self) -> str:
        return self.inner.where

    def parameters(self) -> Parameters:
        return self.inner.parameters()

    def neutral(self) -> bool:
        return self.inner.neutral()

    def distort_at(self, u: np.ndarray, volts: np.ndarray, t: float) -> np.ndarray:
        changed = self.inner.distort(u, volts)
        return u if changed is u else u + self.strength(t) * (changed - u)

    def wrench(self, now: Moment, latent: Latent, state: np.ndarray) -> np.ndarray | None:
        full = self.inner.wrench(now, latent, state)
        return None if full is None else self.strength(now.t) * full

    def measure(self, signals: Signals) -> Signals:
        full = self.inner.measure(signals)
        if full is signals:
            return signals
        on = np.array([[self.strength(t)[b] for b, t in enumerate(row)] for row in signals.t]) > 0.5
        parts = {name: np.where(on, getattr(full, name), getattr(signals, name)) for name in "pqvw"}
        return Signals(signals.t, **parts)


def within(runs: int, run: int, start: float, stop: float) -> Callable[[float], np.ndarray]:
    """Full strength in one run (from 0) between two times (s)."""
    return lambda t: np.where(np.arange(runs) == run, float(start <= t < stop), 0.0)


def session(
    runs: int, apart: float, course: Callable[[np.ndarray], np.ndarray]
) -> Callable[[float], np.ndarray]:
    """A strength by the time of a session in which runs start `apart` s from each other."""
    return lambda t: course(np.arange(runs) * apart + t)
