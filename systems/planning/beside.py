"""The path integral planner beside a loop that runs in real time."""

import os
import queue
import threading
import time
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from ..drake import set_groups, value, value_or_zeros
from .mppi import FIGURES, Mppi
from .mppi_config import MppiConfig
from .mppi_core import MppiPlanner

_NICE = 10  # of the planning thread: the loop's thread goes first


class Call(NamedTuple):
    """A finished call of the planner."""

    t: float
    """Time of the state that it started from (s)."""
    latency: float
    """Wall time from then until its end (s)."""
    values: list[Float[np.ndarray, "_"]]
    """Of the ports plan, samples, figures."""


class PlanningThread:
    """Calls the planner in a thread of its own, one call at a time; close it at the end."""

    def __init__(self, mppi: Mppi, nominal: Float[np.ndarray, " n"]):
        """Start with the first `nominal` wrenches (`Mppi.plan`)."""
        self._mppi, self._nominal = mppi, nominal
        self._waiting: queue.Queue[tuple | None] = queue.Queue(maxsize=1)
        self._done: queue.SimpleQueue[Call] = queue.SimpleQueue()
        self.error: BaseException | None = None
        self.skipped = 0
        """States for which the planner was still busy."""
        self._thread = threading.Thread(target=self._run, name="planner", daemon=True)
        self._thread.start()

    def submit(self, t: float, *state: Float[np.ndarray, "_"]) -> None:
        """Plan from the state (X_WB, V_WB_B, F_bias_Bo_W, noise) of time t (s) unless busy."""
        try:
            self._waiting.put_nowait((t, time.perf_counter(), *(part.copy() for part in state)))
        except queue.Full:
            self.skipped += 1

    def newest(self) -> Call | None:
        """The call that ended last since the previous question.

        Raises:
            RuntimeError: the planner raised, which is the cause.
        """
        if self.error is not None:
            raise RuntimeError(f"the planner failed: {self.error}") from self.error
        found = None
        with suppress(queue.Empty):
            while True:
                found = self._done.get_nowait()
        return found

    def close(self, wait: bool = True) -> None:
        """End after the present call, and wait for it or not."""
        with suppress(queue.Empty):
            self._waiting.get_nowait()
        self._waiting.put(None)
        if wait:
            self._thread.join()

    def _run(self) -> None:
        with suppress(OSError, AttributeError):  # a priority of threads is Linux' alone
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        try:
            while (given := self._waiting.get()) is not None:
                t, started, *state = given
                self._nominal, *values = self._mppi.plan(t, self._nominal, *state)
                self._done.put(Call(t, time.perf_counter() - started, values))
        except BaseException as error:  # noqa: BLE001  told by `newest`, in the loop's thread
            self.error = error


def with_free_core(config: MppiConfig) -> MppiConfig:
    """The settings with at most as many threads as leave a core to the loop."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return replace(config, threads=min(config.threads, max((cores or 1) - 1, 1)))


class MppiBeside(LeafSystem):
    """`systems.planning.mppi.Mppi` whose calls run in a thread: an event never waits for a plan.

    Every `planner.config.period` a state is given to the thread, and every `period` the newest
    plan, if there is one, becomes the output. It holds the time of the state that it started from,
    at which the tracking controller reads it: the age of a plan is compensated by its own
    prediction. For a loop in real time only, as what comes when depends on the machine.

    .. pydrake_system::

        name: MppiBeside
        input_ports:
        - X_WB
        - V_WB_B
        - F_bias_Bo_W
        - noise
        output_ports:
        - plan
        - samples
        - figures

    """

    def __init__(self, planner: MppiPlanner, period: float = 0.02):
        """Look for a new plan every `period` (s)."""
        super().__init__()
        self._mppi = mppi = Mppi(planner)
        self.planner, self.layout, self.samples = planner, mppi.layout, mppi.samples
        self._ports = [self.DeclareVectorInputPort(n, k) for n, k in (("X_WB", 7), ("V_WB_B", 6))]
        self._bias = self.DeclareVectorInputPort("F_bias_Bo_W", 6)
        self._noise = self.DeclareVectorInputPort("noise", 4, RandomDistribution.kGaussian)
        sizes = {
            "plan": self.layout.size,
            "samples": self.samples.size,
            "figures": len(FIGURES),
        }
        self._shown = [self.DeclareDiscreteState(size) for size in sizes.values()]
        for name, group in zip(sizes, self._shown, strict=True):
            self.DeclareStateOutputPort(name, group)
        self.DeclareInitializationDiscreteUpdateEvent(self._begin)
        self.DeclarePeriodicDiscreteUpdateEvent(planner.config.period, 0.0, self._submit)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._look)
        self.thread: PlanningThread | None = None
        self.calls: list[tuple[float, float]] = []
        """Time of the state and latency (s) of each plan that came in."""

    def end(self, wait: bool = True) -> None:
        """End the thread; a context that is initialised starts another."""
        if self.thread is not None:
            self.thread.close(wait)
            self.thread = None

    def _begin(self, context: Context, state: DiscreteValues) -> None:
        del context, state
        self.end()
        self.calls = []
        self.thread = PlanningThread(self._mppi, self._mppi.first_nominal())

    def _submit(self, context: Context, state: DiscreteValues) -> None:
        del state
        assert self.thread is not None
        given = [value(port, context) for port in self._ports]
        given.append(value_or_zeros(self._bias, context))
        self.thread.submit(context.get_time(), *given, value(self._noise, context))

    def _look(self, context: Context, state: DiscreteValues) -> None:
        del context
        assert self.thread is not None
        found = self.thread.newest()
        if found is not None:
            self.calls.append((found.t, found.latency))
            set_groups(state, self._shown, found.values)
