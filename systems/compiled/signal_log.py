"""Logs whose rows are instants: what is true at t stands beside what is estimated of t.

Drake publishes before it updates: a log at t sees the truth of t and the estimate that the updates
of t are about to replace. Besides, the floats of 3 × 0.05 and 15 × 0.01 differ, so that a log and
an update of one time come in either order. Both kinds of port are therefore read beside t, where
nothing happens.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    OutputPort,
    ValueProducer,
)

_ASIDE = 1e-6
"""How far beside an instant ports are read (s): more than rounding puts between the times of
simultaneous events (1e-11 s after a day), far less than any period."""


class Rows:
    """Values of a port at multiples of a period, in the manner of Drake's `VectorLog`."""

    def __init__(self, size: int, period: float):
        self._period = period
        self._times, self._values = np.zeros(64), np.zeros((64, size))
        self._count = 0

    def AddData(self, time: float, value: Float[np.ndarray, " size"]) -> None:
        """Append a row that was read beside its instant."""
        if self._count == len(self._times):
            self._times = np.concatenate([self._times, np.zeros_like(self._times)])
            self._values = np.concatenate([self._values, np.zeros_like(self._values)])
        self._times[self._count] = round(time / self._period) * self._period
        self._values[self._count] = value
        self._count += 1

    def sample_times(self) -> Float[np.ndarray, " n"]:
        """The instants (s)."""
        return self._times[: self._count]

    def data(self) -> Float[np.ndarray, "size n"]:
        """The values, one column an instant."""
        return self._values[: self._count].T


class SignalLog(LeafSystem):
    """Logs a port at every multiple of `period`: its value after the updates of that time.

    With `early` it is the value before them, which is what a plant's state has at that time: the
    update of t moves a plant on from t, but makes the estimate, the reading, the command of t.

    .. pydrake_system::

        name: SignalLog
        input_ports:
        - value

    """

    def __init__(self, size: int, period: float, early: bool = False):
        """`size` is that of the port, `period` in s.

        Raises:
            ValueError: the period is not well above 2 µs.
        """
        super().__init__()
        if not period > 10 * _ASIDE:
            raise ValueError(f"period is {period} s: give one above {10 * _ASIDE:g} s")
        self.period, self.early = period, early
        self.offset = period - _ASIDE if early else _ASIDE
        self._value = self.DeclareVectorInputPort("value", size)
        rows = self.DeclareCacheEntry(
            "rows",
            ValueProducer(lambda: AbstractValue.Make(Rows(size, period)), ValueProducer.NoopCalc),
            {self.nothing_ticket()},
        )
        self._rows = rows.cache_index()
        if early:  # the first row has no time before it
            self.DeclareInitializationPublishEvent(self._first)
        self.DeclarePeriodicPublishEvent(period, self.offset, self._add)

    def FindMutableLog(self, context: Context) -> Rows:
        """The rows in a context of the diagram that this log is part of."""
        return self._own(self.GetMyContextFromRoot(context))

    FindLog = FindMutableLog

    def _own(self, context: Context) -> Rows:
        entry: Any = self.get_cache_entry(self._rows).get_mutable_cache_entry_value(context)
        return entry.GetMutableValueOrThrow()

    def _first(self, context: Context) -> EventStatus:
        t = context.get_time()
        if abs(t - round(t / self.period) * self.period) < _ASIDE:
            return self._add(context)
        return EventStatus.DidNothing()

    def _add(self, context: Context) -> EventStatus:
        self._own(context).AddData(context.get_time(), self._value.Eval(context))
        return EventStatus.Succeeded()


def add_log(
    builder: DiagramBuilder, port: OutputPort, name: str, period: float, early: bool = False
) -> SignalLog:
    """Log a port under `log_<name>`, for `systems.closed_loop.logged`."""
    log = SignalLog(port.size(), period, early)
    builder.AddNamedSystem(f"log_{name}", log)
    builder.Connect(port, log.GetInputPort("value"))
    return log
