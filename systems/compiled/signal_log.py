"""Logs with one row per instant: the truth at t and the estimate for t are in the same row.

Drake publishes before it updates: a log at t records the truth at t, but the estimate from before
the updates of t. In addition, the floats 3 × 0.05 and 15 × 0.01 differ, so that a log and an update
of the same time occur in either order. Ports are therefore read slightly before or after t, where
no events occur.
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

from ..drake import value
from ..growing_rows import GrowingRows

_ASIDE = 1e-6
"""Offset from an instant at which ports are read (s): more than the rounding difference between
times of simultaneous events (1e-11 s after a day), far less than any period."""


class Rows:
    """Values of a port at multiples of a period, with the interface of Drake's `VectorLog`."""

    def __init__(self, size: int, period: float):
        self._period = period
        self._rows = GrowingRows(1 + size)  # the instant first

    def AddData(self, time: float, value: Float[np.ndarray, " size"]) -> None:
        """Append a row that was read slightly before or after its instant."""
        row = self._rows.new()
        row[0] = round(time / self._period) * self._period
        row[1:] = value

    def sample_times(self, first: int = 0) -> Float[np.ndarray, " n"]:
        """The instants (s) of the rows from `first` on."""
        return self._rows.since(first)[:, 0]

    def data(self, first: int = 0) -> Float[np.ndarray, "size n"]:
        """The values of the rows from `first` on, one column per instant."""
        return self._rows.since(first)[:, 1:].T

    def newest(self) -> tuple[float, Float[np.ndarray, " size"]]:
        """The last row: its instant (s) and its values."""
        row = self._rows[-1].copy()
        return float(row[0]), row[1:]


class SignalLog(LeafSystem):
    """Logs a port at every multiple of `period`: its value after the updates of that time.

    With `early` it is the value before them. That is the plant's state at t: the update at t
    advances the plant from t to t + period, but computes the estimate, reading or command for t.

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
        nothing: Any = ValueProducer.NoopCalc
        rows = self.DeclareCacheEntry(
            "rows",
            ValueProducer(lambda: AbstractValue.Make(Rows(size, period)), nothing),
            {self.nothing_ticket()},
        )
        self._rows = rows.cache_index()
        if early:  # the first row can't be read before its instant
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
        self._own(context).AddData(context.get_time(), value(self._value, context))
        return EventStatus.Succeeded()


def add_log(
    builder: DiagramBuilder, port: OutputPort, name: str, period: float, early: bool = False
) -> SignalLog:
    """Log a port under `log_<name>`, for `systems.closed_loop.logged`."""
    log = SignalLog(port.size(), period, early)
    builder.AddNamedSystem(f"log_{name}", log)
    builder.Connect(port, log.GetInputPort("value"))
    return log
