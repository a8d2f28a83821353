"""Closes the loop of a scenario: builds the diagram, simulates, watches, logs."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, System

from ..systems.closed_loop import Signal, build_diagram, logged, seeded
from ..systems.filtering.error_state import ERRORS
from .criteria import Monitor, Outcome
from .run_log import Plans, RunLog
from .scenario import Scenario

Progress = Callable[[float, str], None]
_PLAN_STEP = 0.2  # s between the states of a plan that are kept
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

    Ctrl-C ends the run after the sample at hand with the outcome `interrupted`; what was flown
    until then is returned. A second one interrupts at once.

    Raises:
        UserError: the scenario names what can't be read, or its controller lacks a port.
    """
    tell = progress or (lambda fraction, remark: None)
    tell(0.0, "building")
    diagram = build_diagram(scenario.station, scenario.controller, log_periods=_periods(scenario))
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    seeded(diagram, context, scenario.seed)
    vehicle = scenario.station.load_vehicle()
    obstacles = scenario.station.obstacles
    monitor = Monitor(vehicle, obstacles, scenario.success, scenario.goal, scenario.safety)
    with _stop_on_interrupt() as stopped:
        outcome, timing = _fly(scenario, diagram, simulator, monitor, tell, stopped)
    log = _collect(scenario, diagram, context, outcome)
    return Run(scenario, log, outcome, timing)


def _fly(
    scenario: Scenario,
    diagram: Diagram,
    simulator: Simulator,
    monitor: Monitor,
    tell: Progress,
    stopped: threading.Event,
) -> tuple[Outcome, Timing]:
    """Advance sample by sample until the monitor, the clock or the user ends the run."""
    context = simulator.get_mutable_context()
    station = diagram.GetSubsystemByName("station")
    own = station.GetMyContextFromRoot(context)
    ports = [station.GetOutputPort(name) for name in ("X_WB_cheat", "V_WB_B_cheat")]
    planned_every = _planner_period(scenario, diagram)
    dt = 1 / scenario.log.rate
    timing = Timing(dt=dt)
    steps = max(1, round(scenario.duration / dt))
    tell(0.0, "compiling")
    started = time.perf_counter()
    _warm_up(diagram, min(scenario.duration, _WARM_UP))
    timing.compilation = time.perf_counter() - started
    k = 0
    try:
        simulator.Initialize()
        outcome = monitor.check(0.0, *(port.Eval(own) for port in ports))
        while outcome is None:
            started = time.perf_counter()
            simulator.AdvanceTo((k + 1) * dt)
            spent = time.perf_counter() - started
            k += 1
            t = k * dt
            phase = ((k - 1) * dt + 1e-9) % (planned_every or 1.0)
            timing.add(spent, planned_every is not None and phase < dt - 1e-9)
            outcome = monitor.check(t, *(port.Eval(own) for port in ports))
            if outcome is None and k >= steps:
                outcome = Outcome("duration", t, f"The time was over after {t:.1f} s.")
            if outcome is None and stopped.is_set():
                outcome = Outcome("interrupted", t, f"Stopped by hand after {t:.1f} s.")
            if k % 5 == 0:
                tell(k / steps, f"{t:.0f} s, {timing.speed(200):.1f} × real time")
    except FloatingPointError as error:  # the plant names what was not finite
        outcome = Outcome("not finite", k * dt, str(error))
    return outcome, timing


def _warm_up(diagram: Diagram, duration: float) -> None:
    """Compile every event's function by a short flight in a context of its own."""
    simulator = Simulator(diagram)
    seeded(diagram, simulator.get_mutable_context(), 0)
    with suppress(FloatingPointError):  # the flight that counts will tell
        simulator.AdvanceTo(duration)


def _planner_period(scenario: Scenario, diagram: Diagram) -> float | None:
    """How often the controller plans (s), None if it doesn't."""
    source = _plan_source(diagram)
    planner = getattr(source, "planner", None)
    return None if planner is None else float(planner.config.period)


def _plan_source(diagram: Diagram) -> System | None:
    """The controller's subsystem that makes plans, if there is one."""
    controller = diagram.GetSubsystemByName("controller")
    if isinstance(controller, Diagram) and controller.HasSubsystemNamed("source"):
        return controller.GetSubsystemByName("source")
    return None


def _periods(scenario: Scenario) -> dict[str, float]:
    """How often each port is logged (s)."""
    dt = 1 / scenario.log.rate
    names = ("pwm", "X_WB_cheat", "V_WB_B_cheat", "F_disturbance_cheat", "flow_cheat", "plan")
    periods = dict.fromkeys(names, dt)
    fine = ("X_WB", "V_WB_B", "covariance", "F_Bo_B")
    periods |= dict.fromkeys(fine, scenario.station.period)
    planner = getattr(scenario.controller, "planner", None)
    if planner is not None:
        periods["figures"] = planner.period
        if scenario.log.samples:
            periods["samples"] = planner.period
    return periods


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


# ------------------------------------------------------------------------ from signals to the log


def _collect(scenario: Scenario, diagram: Diagram, context: Context, outcome: Outcome) -> RunLog:
    """One log on the uniform time grid of the run."""
    signals = logged(diagram, context)
    dt = 1 / scenario.log.rate
    n = min(round(outcome.time / dt) + 1, len(signals["X_WB_cheat"].time))
    finite = np.all(np.isfinite(signals["X_WB_cheat"].value[:n]), axis=1)
    n = n if finite.all() else max(1, int(np.argmin(finite)))
    grid = dt * np.arange(n)
    # A log sees outputs before the updates of its time: what the filter says of t comes one period
    # later. The truth of t is there at t.
    told = np.searchsorted(signals["X_WB"].time, grid + 1.5 * scenario.station.period) - 1
    variables = {
        "X_WB": signals["X_WB_cheat"].value[:n],
        "V_WB_B": signals["V_WB_B_cheat"].value[:n],
        "F_Bo_B": _mean_over(signals["F_Bo_B"], grid, dt),
        "pwm": signals["pwm"].value[:n],
        "X_WB_estimate": signals["X_WB"].value[told],
        "V_WB_B_estimate": signals["V_WB_B"].value[told],
        "error_std": _deviations(signals["covariance"].value[told]),
        "F_disturbance_Bo_B": signals["F_disturbance_cheat"].value[:n],
        "flow_W": signals["flow_cheat"].value[:n],
    }
    source = _plan_source(diagram)
    plans = None
    if source is not None and "plan" in signals:
        vectors = signals["plan"].value[:n]
        variables |= _setpoints(source.layout, vectors, grid)
        plans = _plans(source, vectors, signals)
    return RunLog.create(
        scenario.name,
        dt,
        variables,
        plans,
        vehicle=scenario.station.vehicle,
        source=f"simulation of scenario {scenario.name}, seed {scenario.seed}",
        notes=(
            "X_WB and V_WB_B are the simulation's truth, not an estimate.",
            "F_Bo_B is the mean of the commanded wrench over each step; the thrusters' lag is not "
            "in it. pwm is the command at the sample.",
            "flow_W and F_disturbance_Bo_B are known in simulation only.",
        ),
    )


def _mean_over(
    signal: Signal, grid: Float[np.ndarray, " n"], dt: float
) -> Float[np.ndarray, "n size"]:
    """Mean of a finer signal over [t, t + dt) for every t of the grid."""
    index = np.clip(np.floor(signal.time / dt + 1e-6).astype(int), 0, None)
    inside = index < grid.size
    total = np.zeros((grid.size, signal.value.shape[1]))
    count = np.zeros(grid.size)
    np.add.at(total, index[inside], signal.value[inside])
    np.add.at(count, index[inside], 1)
    return total / np.maximum(count, 1)[:, None]


def _deviations(covariance: Float[np.ndarray, "n flat"]) -> Float[np.ndarray, "n errors"]:
    return np.sqrt(np.maximum(covariance[:, :: ERRORS + 1], 0))


def _setpoints(
    layout, vectors: Float[np.ndarray, "n size"], grid: Float[np.ndarray, " n"]
) -> dict[str, np.ndarray]:
    """The plan at every time of the grid, as the tracking controller reads it."""
    wanted = jax.jit(jax.vmap(layout.at))(jnp.asarray(vectors), jnp.asarray(grid))
    valid = np.asarray(wanted.valid)
    rest = np.array([1.0, 0, 0, 0, 0, 0, 0])
    return {
        "X_WB_plan": np.where(valid[:, None], np.asarray(wanted.X_WB), rest),
        "V_WB_B_plan": np.where(valid[:, None], np.asarray(wanted.V_WB_B), 0.0),
        "plan_valid": valid.astype(float),
    }


def _plans(source, vectors: Float[np.ndarray, "n size"], signals) -> Plans | None:
    """Every distinct plan, thinned."""
    layout = source.layout
    valid = vectors[:, 1] != 0  # the first quaternion of a plan of zeros has length zero
    times, first = np.unique(vectors[valid, 0], return_index=True)
    if times.size == 0:
        return None
    stride = max(1, round(_PLAN_STEP / layout.dt))
    states = vectors[valid][first][:, 1 : 1 + 13 * (layout.horizon + 1)]
    X = states.reshape(times.size, layout.horizon + 1, 13)[:, ::stride, :7]
    extra = {}
    if "samples" in signals:
        sampled = signals["samples"].value
        rows = _rows(sampled[:, 0], times, np.any(sampled[:, 1:] != 0, axis=1))
        paths, steps = source.samples.paths, source.samples.horizon
        split = 1 + 3 * steps * paths
        p = sampled[rows, 1:split].reshape(times.size, steps, 3, paths)
        extra["p_WB"] = p[:, stride - 1 :: stride].astype(np.float32)
        extra["weights"] = sampled[rows, split:]
        extra["figures"] = signals["figures"].value[rows]
    return Plans(times, stride * layout.dt, X, **extra)


def _rows(t0: np.ndarray, times: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """For each plan the row of the sample log that was made with it (the nearest earlier one)."""
    kept = np.flatnonzero(usable)
    index = np.searchsorted(t0[kept], times + 1e-9, side="right") - 1
    return kept[np.clip(index, 0, kept.size - 1)]
