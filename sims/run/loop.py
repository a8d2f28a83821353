"""Runs a scenario: builds the closed-loop diagram, simulates, monitors, logs."""

import gc
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram

from ...models.config.errors import UserError
from ...models.files.interrupts import interrupt_noted
from ...systems.closed_loop import build_diagram, logged, seeded
from ...systems.compiled.network import NotPureError, compile_functions
from ...systems.compiled.simulator import CompiledSimulator
from ...systems.drake import value
from ...systems.planning.mppi import Mppi
from ...systems.planning.passage import Passage
from ..scenarios.criteria import FollowPath, Monitor, Outcome
from ..scenarios.scenario import Scenario
from .live import LivePage, simulation_view
from .log import RunLog
from .signals import PlanTap, collect, log_commands, log_periods, plan_source
from .trajectories import Keep, ManeuverTap
from .way import check_free, depth_only, find_passage, holding, no_safe_plan, position_note

Progress = Callable[[float, str], None]
Engine = Literal["auto", "drake", "compiled"]
_WARM_UP = 0.45  # s: beyond the filter's delay, so that every event has occurred
_WORTH_A_LOOP = 10.0  # s: shortest run that repays the compilation of a loop
_AT_ONCE = 0.2  # s that a compiled loop advances between checks of the monitor


@dataclass
class Timing:
    """Wall-clock times; not part of the log, which is the same for the same seed."""

    engine: str = "drake"
    compilation: float = 0.0
    chunks: list[float] = field(default_factory=list)
    planning: list[bool] = field(default_factory=list)
    dt: float = 0.0

    def add(self, spent: float, planning: bool, steps: int = 1) -> None:
        """Add the wall time of some steps of the log, and whether they called the planner."""
        self.chunks += [spent / steps] * steps
        self.planning += [planning] * steps

    def speed(self, last: int = 0) -> float:
        """Simulated time per wall time, of the whole run or its last steps."""
        chunks = self.chunks[-last:]
        return len(chunks) * self.dt / max(sum(chunks), 1e-9)

    def summary(self) -> dict[str, float | str | None]:
        """Engine, compilation time (s), real-time factor, planner's time per call (ms)."""
        spent, planning = 1e3 * np.array(self.chunks), np.array(self.planning, bool)
        rest = spent[~planning]
        calls = spent[planning] - (np.median(rest) if rest.size else 0.0)
        return {
            "engine": self.engine,
            "compilation_s": self.compilation,
            "wall_s": sum(self.chunks),
            "real_time_factor": self.speed() if self.chunks else None,
            "planner_median_ms": float(np.median(calls)) if calls.size else None,
            "planner_p95_ms": float(np.percentile(calls, 95)) if calls.size else None,
        }


class Run(NamedTuple):
    """The result of a scenario."""

    scenario: Scenario
    log: RunLog
    outcome: Outcome
    timing: Timing
    numbers: Mapping[str, Mapping[str, Any]] = {}
    """Further metrics by group, of a flight on a vehicle."""
    checks: tuple[tuple[str, bool, str], ...] = ()
    """Name, result and words of each check of its pre-flight."""
    note: str = ""
    """What a reader of its report should know (`way.position_note`)."""


def simulate(
    scenario: Scenario,
    progress: Progress | None = None,
    engine: Engine = "auto",
    keep: Keep | None = None,
    live: LivePage | None = None,
) -> Run:
    """Simulate a scenario to its end. The same scenario gives the same log, bit for bit.

    Drake steps the diagram, or one compiled loop does (`systems.compiled.simulator`), which is
    several times as fast and differs by rounding only. By default the loop is used if the diagram
    can be compiled and the run may last long enough to repay the compilation.

    Ctrl-C ends the run after the current sample with the outcome `interrupted`; the run up to then
    is returned. A second Ctrl-C, or one before the first step, interrupts at once.

    If no path to the goal satisfies the allowed risk, a planner holds the vehicle's start pose, and
    the outcome is `no safe plan`. `keep` takes in each trajectory that the controller `!Maneuvers`
    finishes. `live` shows the run, which then goes on in real time at most.

    Raises:
        UserError: start or goal are in an obstacle, the scenario names what can't be read, its
            controller lacks a port, has no plan though `FollowPath` needs one or has no finite
            wrench at t = 0, or the engine `compiled` is given and the diagram can't be compiled.

    Example:
        >>> scenario = load_scenario("trajectory_tracking_calm", text="duration: 0.5")
        >>> simulate(scenario).outcome.reason
        'duration'
    """
    return next(simulate_seeds(scenario, [scenario.seed], progress, engine, keep, live))


def simulate_seeds(
    scenario: Scenario,
    seeds: Iterable[int],
    progress: Progress | None = None,
    engine: Engine = "auto",
    keep: Keep | None = None,
    live: LivePage | None = None,
) -> Iterator[Run]:
    """Simulate a scenario with one seed after the other, as `simulate`, with one diagram for all.

    Building, tracing and compiling takes longer than many a run. After Ctrl-C the current run is
    the last.

    Raises:
        UserError: as `simulate`, when the first run is requested.
    """
    tell = progress or (lambda fraction, remark: None)
    tell(0.0, "building")
    check_free(scenario)
    passage = find_passage(scenario)
    blocked = passage is not None and not passage.safe
    diagram = build_diagram(
        scenario.station,
        holding(scenario) if blocked else scenario.controller,
        log_periods=log_periods(scenario),
        extend=log_commands(scenario),
        goal=scenario.goal,
    )
    _check_plan(diagram, scenario)
    simulator = None
    for seed in seeds:
        warm = simulator is not None
        if simulator is None:
            simulator = _simulator(diagram, scenario, engine)
        else:
            simulator.reset_context(diagram.CreateDefaultContext())
        own = scenario.with_changes(seed=seed)
        run = _one(diagram, simulator, own, warm, tell, passage, keep, live)
        yield run
        if run.outcome.reason == "interrupted":
            return


def _check_plan(diagram: Diagram, scenario: Scenario) -> None:
    if isinstance(scenario.success, FollowPath) and plan_source(diagram) is None:
        controller = type(diagram.GetSubsystemByName("controller")).__name__
        raise UserError(
            f"success: !FollowPath judges how a plan is followed, and the controller {controller} "
            "tells none: give it an output port `plan` with the attribute `layout` "
            "(systems.planning.plan.PlanLayout), or the scenario "
            "success: !ReachGoal {goal: [x, y, z]}"
        )


def _check_start(
    diagram: Diagram, context: Context, period: float, error: FloatingPointError
) -> None:
    """Raise a UserError if a signal was not finite from the start on, so that there is no run.

    A controller's output at t = 0 acts at once or one `period` of the plant (s) later.
    """
    signals = logged(diagram, context)
    acting = signals["F_acting"]
    bad = acting.time[~np.isfinite(acting.value).all(axis=1)]
    if bad.size and bad[0] < 1.5 * period:
        controller = type(diagram.GetSubsystemByName("controller")).__name__
        raise UserError(
            f"controller {controller}: its F_Bo_B is not finite at t = 0 s; put out a finite "
            "wrench from the start on"
        ) from error
    if not signals["X_WB_cheat"].time.size:
        raise UserError(f"the run ended in its first step: {error}") from error


def _one(
    diagram: Diagram,
    simulator: Simulator | CompiledSimulator,
    scenario: Scenario,
    warm: bool,
    tell: Progress,
    passage: Passage | None,
    keep: Keep | None,
    live: LivePage | None,
) -> Run:
    """Simulate a diagram once, in a new context; `warm` says that its programs are compiled."""
    context = simulator.get_mutable_context()
    seeded(diagram, context, scenario.seed)
    vehicle = scenario.station.load_vehicle()
    obstacles = scenario.station.obstacles
    monitor = Monitor(vehicle, obstacles, scenario.success, scenario.goal, scenario.safety)
    tap = PlanTap(diagram, context, scenario.log.samples)
    maneuvers = ManeuverTap(scenario, diagram, context, keep)
    watch = _watching(live, diagram, context, tap, maneuvers)
    timing = Timing(dt=1 / scenario.log.rate)
    started = time.perf_counter()
    with _ticking(tell, "compiling"):
        if isinstance(simulator, CompiledSimulator):
            timing.engine = "compiled"
            simulator.compile()
        elif not warm:
            _warm_up(diagram, min(scenario.duration, _WARM_UP))
    timing.compilation = time.perf_counter() - started
    with interrupt_noted() as stopped, few_collections():
        outcome = _fly(
            scenario, diagram, simulator, monitor, tap, maneuvers, timing, tell, stopped, watch
        )
    if passage is not None and not passage.safe and outcome.reason in ("duration", "no progress"):
        outcome = Outcome("no safe plan", outcome.time, no_safe_plan(scenario, passage))
    log = collect(
        scenario, logged(diagram, context), tap, outcome.time, passage, depth_only(scenario)
    )
    return Run(scenario, log, outcome, timing, note=position_note(scenario))


def _simulator(
    diagram: Diagram, scenario: Scenario, engine: Engine
) -> Simulator | CompiledSimulator:
    """The simulator that steps a diagram."""
    if engine == "auto":
        samples = isinstance(plan_source(diagram), Mppi)  # takes most of the time, in threads
        engine = "drake" if samples or scenario.duration < _WORTH_A_LOOP else engine
    if engine == "drake":
        return Simulator(diagram)
    try:
        return CompiledSimulator(diagram, {"log_F_acting": scenario.station.period})
    except NotPureError as error:
        if engine == "compiled":
            raise UserError(
                f"engine: this run can't be compiled: {error}; let Drake step it (drake or auto)"
            ) from error
        return Simulator(diagram)


def _fly(
    scenario: Scenario,
    diagram: Diagram,
    simulator: Simulator | CompiledSimulator,
    monitor: Monitor,
    tap: PlanTap,
    maneuvers: ManeuverTap,
    timing: Timing,
    tell: Progress,
    stopped: threading.Event,
    watch: Callable[[float], None],
) -> Outcome:
    """Advance sample by sample until the monitor, the clock or the user ends the run."""
    context = simulator.get_mutable_context()
    station = diagram.GetSubsystemByName("station")
    own = station.GetMyContextFromRoot(context)
    ports = [station.GetOutputPort(name) for name in ("X_WB_cheat", "V_WB_B_cheat")]
    sinks: list[Any] = [diagram.GetSubsystemByName(f"log_{port.get_name()}") for port in ports]
    dt = timing.dt
    steps, stride = max(1, round(scenario.duration / dt)), _samples_at_once(simulator, tap, dt)
    k, done, outcome = 0, 0.0, None

    def called(k: int) -> bool:
        """Whether a step that Drake makes alone calls the planner; the loop's steps are mixed."""
        if tap.period is None or not isinstance(simulator, Simulator):
            return False
        return (k * dt + 1e-9) % tap.period < dt - 1e-9

    try:
        simulator.Initialize()
        outcome = monitor.check(0.0, *(value(port, own) for port in ports))
        while outcome is None:
            stride = min(stride, steps - k)
            started = time.perf_counter()
            simulator.AdvanceTo((k + stride) * dt)
            spent = time.perf_counter() - started
            timing.add(spent, called(k), stride)
            tap.read(round(k * dt, 9))
            seen = [sink.FindLog(context).data(k + 1) for sink in sinks]
            for n, step in enumerate(range(k + 1, k + stride + 1)):
                outcome = outcome or monitor.check(round(step * dt, 9), *(v[:, n] for v in seen))
            k, t = k + stride, round((k + stride) * dt, 9)
            outcome = outcome or maneuvers.read(t)
            watch(t)
            if outcome is None and k >= steps:
                outcome = Outcome("duration", t, f"The time limit of {t:.1f} s was reached.")
            elif outcome is None and k // 5 > (k - stride) // 5:
                done = max(done, maneuvers.done if maneuvers.names else k / steps, monitor.progress)
                words = f"{t:.0f} s, {timing.speed(200):.1f} × real time {maneuvers.words()}"
                tell(done, words.rstrip())
            if outcome is None and stopped.is_set():
                outcome = Outcome("interrupted", t, f"The run was interrupted after {t:.1f} s.")
        # complete the row of the last sample with the updates at its time
        simulator.AdvanceTo(k * dt + scenario.station.period)
    except FloatingPointError as error:  # its message names the signal that was not finite
        log = sinks[0].FindLog(context)
        last = log.sample_times()[np.isfinite(log.data()).all(axis=0)][-1]
        _check_start(diagram, context, scenario.station.period, error)
        outcome = outcome or Outcome("not finite", round(float(last), 9), str(error))
    return outcome


def _watching(
    live: LivePage | None, diagram: Diagram, context: Context, tap: PlanTap, maneuvers: ManeuverTap
) -> Callable[[float], None]:
    """A function that shows the run at its time (s) and lets the clock catch up; or nothing."""
    if live is None:
        return lambda t: None
    begun: list[float] = []

    def watch(t: float) -> None:
        live.show(t, lambda: simulation_view(diagram, context, tap, maneuvers.words()))
        begun[:] = begun or [time.monotonic() - t]
        time.sleep(max(0.0, begun[0] + t - time.monotonic()))

    return watch


def _samples_at_once(simulator: Simulator | CompiledSimulator, tap: PlanTap, dt: float) -> int:
    """Number of log samples per advance, few enough to read every plan."""
    if isinstance(simulator, Simulator):
        return 1
    plans = getattr(tap.source, "period", _AT_ONCE)
    return max(1, int(min(plans, _AT_ONCE) / dt + 1e-9))


def _warm_up(diagram: Diagram, duration: float) -> None:
    """Compile every event's function by a short run in a context of its own."""
    compile_functions(diagram)
    simulator = Simulator(diagram)
    seeded(diagram, simulator.get_mutable_context(), 0)
    with suppress(FloatingPointError):  # the actual run reports it
        simulator.AdvanceTo(duration)


@contextmanager
def _ticking(tell: Progress, remark: str) -> Iterator[None]:
    """Report progress 0 every second while the block runs."""
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
def few_collections() -> Iterator[None]:
    """Exclude existing objects from garbage collection, which would take 5 % of a run's time."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
