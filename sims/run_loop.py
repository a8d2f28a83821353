"""Closes the loop of a scenario: builds the diagram, simulates, watches, logs."""

import gc
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram

from ..systems.closed_loop import build_diagram, logged, seeded
from .criteria import Monitor, Outcome
from .run_log import RunLog
from .run_signals import PlanTap, collect, log_periods, with_present
from .scenario import Scenario

Progress = Callable[[float, str], None]
_WARM_UP = 0.45  # s: beyond the filter's delay, so that every event has occurred


@dataclass
class Timing:
    """What the clock on the wall said; no part of the log, which is the same for the same seed."""

    compilation: float = 0.0
    chunks: list[float] = field(default_factory=list)
    planning: list[bool] = field(default_factory=list)
    dt: float = 0.0

    def add(self, spent: float, planning: bool) -> None:
        """File the time of one step of the log, and whether a call of the planner fell into it."""
        self.chunks.append(spent)
        self.planning.append(planning)

    def speed(self, last: int = 0) -> float:
        """Simulated time per time on the clock, of the whole run or its last steps."""
        chunks = self.chunks[-last:]
        return len(chunks) * self.dt / max(sum(chunks), 1e-9)

    def summary(self) -> dict[str, float | None]:
        """Seconds of compilation, real-time factor, planner's time a call (ms)."""
        spent, planning = 1e3 * np.array(self.chunks), np.array(self.planning, bool)
        rest = spent[~planning]
        calls = spent[planning] - (np.median(rest) if rest.size else 0.0)
        return {
            "compilation_s": self.compilation,
            "wall_s": sum(self.chunks),
            "real_time_factor": self.speed() if self.chunks else None,
            "planner_median_ms": float(np.median(calls)) if calls.size else None,
            "planner_p95_ms": float(np.percentile(calls, 95)) if calls.size else None,
        }


class Run(NamedTuple):
    """What came of a scenario."""

    scenario: Scenario
    log: RunLog
    outcome: Outcome
    timing: Timing


def simulate(scenario: Scenario, progress: Progress | None = None) -> Run:
    """Fly a scenario to its end. The same scenario gives the same log, bit for bit.

    Ctrl-C ends the flight after the sample at hand with the outcome `interrupted`; what was flown
    until then is returned. A second one, or one before the flight, interrupts at once.

    Raises:
        UserError: the scenario names what can't be read, or its controller lacks a port.
    """
    tell = progress or (lambda fraction, remark: None)
    tell(0.0, "building")
    diagram = build_diagram(
        scenario.station, scenario.controller, log_periods=log_periods(scenario)
    )
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    seeded(diagram, context, scenario.seed)
    vehicle = scenario.station.load_vehicle()
    obstacles = scenario.station.obstacles
    monitor = Monitor(vehicle, obstacles, scenario.success, scenario.goal, scenario.safety)
    tap = PlanTap(diagram, context, scenario.log.samples)
    timing = Timing(dt=1 / scenario.log.rate)
    started = time.perf_counter()
    with _ticking(tell, "compiling"):
        _warm_up(diagram, min(scenario.duration, _WARM_UP))
    timing.compilation = time.perf_counter() - started
    with _stop_on_interrupt() as stopped, _few_collections():
        outcome = _fly(scenario, diagram, simulator, monitor, tap, timing, tell, stopped)
    signals = with_present(logged(diagram, context), diagram, context)
    log = collect(scenario, signals, tap, outcome.time)
    return Run(scenario, log, outcome, timing)


def _fly(
    scenario: Scenario,
    diagram: Diagram,
    simulator: Simulator,
    monitor: Monitor,
    tap: PlanTap,
    timing: Timing,
    tell: Progress,
    stopped: threading.Event,
) -> Outcome:
    """Advance sample by sample until the monitor, the clock or the user ends the run."""
    context = simulator.get_mutable_context()
    station = diagram.GetSubsystemByName("station")
    own = station.GetMyContextFromRoot(context)
    ports = [station.GetOutputPort(name) for name in ("X_WB_cheat", "V_WB_B_cheat")]
    dt = timing.dt
    steps = max(1, round(scenario.duration / dt))
    k, done, outcome = 0, 0.0, None
    try:
        simulator.Initialize()
        outcome = monitor.check(0.0, *(port.Eval(own) for port in ports))
        while outcome is None:
            started = time.perf_counter()
            simulator.AdvanceTo((k + 1) * dt)
            spent = time.perf_counter() - started
            k += 1
            t = round(k * dt, 9)
            phase = ((k - 1) * dt + 1e-9) % (tap.period or 1.0)
            timing.add(spent, tap.period is not None and phase < dt - 1e-9)
            tap.read(t - dt)
            outcome = monitor.check(t, *(port.Eval(own) for port in ports))
            if outcome is None and k >= steps:
                outcome = Outcome("duration", t, f"The time was over after {t:.1f} s.")
            if outcome is None and stopped.is_set():
                outcome = Outcome("interrupted", t, f"Stopped by hand after {t:.1f} s.")
            if k % 5 == 0:
                done = max(done, k / steps, monitor.progress)
                tell(done, f"{t:.0f} s, {timing.speed(200):.1f} × real time")
        # one period more, in which the filter has its say on the last sample
        simulator.AdvanceTo(k * dt + scenario.station.period)
    except FloatingPointError as error:  # the plant names what was not finite
        outcome = outcome or Outcome("not finite", round(k * dt, 9), str(error))
    return outcome


def _warm_up(diagram: Diagram, duration: float) -> None:
    """Compile every event's function by a short flight in a context of its own."""
    simulator = Simulator(diagram)
    seeded(diagram, simulator.get_mutable_context(), 0)
    with suppress(FloatingPointError):  # the flight that counts will tell
        simulator.AdvanceTo(duration)


@contextmanager
def _ticking(tell: Progress, remark: str) -> Iterator[None]:
    """Report every second that nothing is finished yet, while the block runs."""
    over = threading.Event()

    def tick() -> None:
        while not over.wait(1.0):
            tell(0.0, remark)

    thread = threading.Thread(target=tick, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextmanager
def _few_collections() -> Iterator[None]:
    """Leave what exists out of Python's garbage collections: they took 5 % of a flight's time."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def _stop_on_interrupt() -> Iterator[threading.Event]:
    """Turn the first Ctrl-C into an event; outside the main thread signals stay as they are."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    former = signal.getsignal(signal.SIGINT)

    def stop(*_: object) -> None:
        event.set()
        signal.signal(signal.SIGINT, former)

    signal.signal(signal.SIGINT, stop)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, former)
