"""Advances a diagram in real time, and measures how late its events are."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator

from ...systems.mavlink.urgent import urgent

_PASS = 1e-3  # s beyond a tick, so that all updates of its time are done
_TURN = 2e-4  # s


@contextmanager
def short_turns() -> Iterator[None]:
    """Let Python's threads take turns of 0.2 ms in place of 5 ms.

    The loop needs Python's lock again after every compiled call, and would wait a turn of the
    link's thread each time.
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(_TURN)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


@dataclass
class Clockwork:
    """A simulator and the local time of its context's time 0.

    Drake's own pacing (`set_target_realtime_rate`) sleeps without releasing Python's lock, so that
    the threads of link and planner would stand still; here the wait is between steps.

    Attributes:
        simulator: initialised, at time 0.
        tick: time between wake-ups (s); all events' periods are multiples of it.
        epoch: local monotonic time of time 0 (s).
        late: how late each tick began (s).
        busy: how long its events took (s).
        urgent: whether the system has given the loop a real-time priority.
    """

    simulator: Simulator
    tick: float
    epoch: float
    late: list[float] = field(default_factory=list)
    busy: list[float] = field(default_factory=list)
    urgent: bool = False

    @property
    def time(self) -> float:
        """Time of the next tick (s)."""
        return round(len(self.late) * self.tick, 9)

    def run(self, until: float, each: Callable[[float], bool] = lambda t: True) -> None:
        """Advance tick by tick up to `until` (s), as long as `each` of the tick's time is true."""
        with urgent() as self.urgent:
            self._run(until, each)

    def _run(self, until: float, each: Callable[[float], bool]) -> None:
        while (t := self.time) <= until + 1e-9:
            wait = self.epoch + t - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            started = time.monotonic()
            self.simulator.AdvanceTo(t + _PASS)
            self.late.append(started - self.epoch - t)
            self.busy.append(time.monotonic() - started)
            if not each(t):
                return


def tick_of(*periods: float) -> float:
    """The longest tick (s) of which all periods are multiples, of 10, 5, 2 and 1 ms."""
    for tick in (0.01, 0.005, 0.002):
        if all(abs(p / tick - round(p / tick)) < 1e-6 and p >= tick - 1e-9 for p in periods):
            return tick
    return 0.001


def percentiles(values: list[float], scale: float = 1e3) -> dict[str, float]:
    """Median, 99th percentile and maximum, by default of seconds in milliseconds."""
    found: Any = scale * np.asarray(values, float)
    if not found.size:
        return {}
    return {
        "median": float(np.median(found)),
        "p99": float(np.percentile(found, 99)),
        "max": float(found.max()),
    }
