"""A cause that acts in a part of the data, or grows in the course of it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .effect import Effect, Latent, Moment, Parameters, Signals
from .effects_actuation import ThrusterGain, ThrustScale
from .effects_body import NetBuoyancy
from .effects_measurement import HeadingError
from .scenarios import Plan


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


APART = 60.0
"""Time between the starts of two runs of a session (s)."""


@dataclass(frozen=True)
class When:
    """The part of a session in which a cause acts.

    `window` within a run, `onwards` from a time in a run to the end of the session, or `drift` from
    none at its start to all at its end; `run` counts from 1, times are those of the run (s).
    """

    kind: str
    run: int = 1
    start: float = 0.0
    end: float = 0.0


PARTS = ("fouled", "entangled", "leak", "ballast", "battery", "compass", "steel")
"""A thruster fouled for seconds, and from a time on; a slow leak; ballast lost; less thrust, and a
turned compass, from a run on; a compass that steel beside the vehicle turns for seconds."""


def draw_episode(name: str, plan: Plan, rng: np.random.Generator) -> tuple[Episode, When]:
    """One of `PARTS` with a realistic size, and when it acts."""
    runs = plan.scenarios * plan.runs
    run = int(rng.integers(runs // 4, runs - runs // 4))
    start = round(float(rng.uniform(0.2, 0.4)) * plan.seconds, 1)
    sign = rng.choice([-1.0, 1.0])
    weak = ThrusterGain(int(rng.integers(1, 9)), float(rng.uniform(0.3, 0.6)))
    if name == "fouled":
        end = round(start + float(rng.uniform(0.3, 0.5)) * plan.seconds, 1)
        return Episode(weak, within(runs, run, start, end)), When("window", run + 1, start, end)
    if name == "steel":
        end = round(start + float(rng.uniform(0.3, 0.5)) * plan.seconds, 1)
        turned = HeadingError(constant=sign * float(rng.uniform(0.1, 0.3)))
        return Episode(turned, within(runs, run, start, end)), When("window", run + 1, start, end)
    if name == "leak":
        length = APART * (runs - 1) + plan.seconds
        leak = NetBuoyancy(force=-float(rng.uniform(3.0, 6.0)))
        return Episode(leak, session(runs, APART, lambda s: s / length)), When("drift", runs)
    if name in ("battery", "compass"):
        start = 0.0
    inner: Effect = {
        "entangled": weak,
        "ballast": NetBuoyancy(force=float(rng.uniform(4.0, 8.0))),
        "battery": ThrustScale(1 - float(rng.uniform(0.08, 0.16))),
        "compass": HeadingError(constant=sign * float(rng.uniform(0.08, 0.15))),
    }[name]
    began = APART * run + start
    course = session(runs, APART, lambda s: (s >= began) * 1.0)
    return Episode(inner, course), When("onwards", run + 1, start)
