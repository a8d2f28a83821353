"""A scenario on a vehicle: pre-flight, the closed loop in real time, an orderly end."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram

from ...models.config.errors import UserError
from ...models.files.interrupts import end_noted
from ...models.sensors import Dvl
from ...systems.closed_loop import build_diagram, logged, seeded
from ...systems.compiled.network import compile_functions
from ...systems.drake import value
from ...systems.estimation.ekf import Ekf
from ...systems.mavlink import telemetry
from ...systems.mavlink.config import Mavlink
from ...systems.mavlink.driver import Driver
from ...systems.mavlink.interface import Anchor, VehicleInterface
from ...systems.mavlink.link import Statistics
from ...systems.mavlink.preflight import Finding
from ...systems.planning.beside import MppiBeside
from ...systems.station.config import StationConfig
from ..scenarios.criteria import Monitor, Outcome
from ..scenarios.scenario import Scenario
from .before_flight import Tell, as_granted, checked_link, preflight
from .dead_man import dead_man_key
from .flight_log import Journal, collect_flight
from .live import LivePage, flight_view
from .loop import Progress, Run, Timing, few_collections
from .real_time import Clockwork, percentiles, short_turns, tick_of
from .signals import PlanTap, log_periods, plan_source
from .trajectories import Keep, ManeuverTap

_SHADOW = 3.0  # s in which the loop runs without commanding
_ATTEMPTS = 3  # to get an estimate
_WARM_UP = 1.0  # s, so that every event has occurred and every sensor was fused
_START = 3.0  # s to wait for the readings that define the start
_LOST = 2


def fly(
    scenario: Scenario,
    *,
    arm: bool = False,
    dry_run: bool = False,
    record: Path | None = None,
    say: Tell = lambda text: None,
    progress: Progress = lambda fraction, remark: None,
    keep: Keep | None = None,
    live: LivePage | None = None,
) -> Run:
    """Fly a scenario on the vehicle of its `vehicle_link`; stops and disarms it at the end.

    The order is: connect, pre-flight, compile, run the loop without commanding (shadow), pre-flight
    again, arm, fly. With `dry_run` nothing is armed, changed or commanded; all is computed and
    logged. The run's scenario has the rates that the vehicle granted; its log has the estimate in
    place of the truth. `record` is a telemetry log (.tlog) to write. `say` gets sentences on what
    is done. `keep` takes in each trajectory that the controller `!Maneuvers` finishes (of
    `spinndrift collect`, which has no --dry-run), `live` what is seen.

    Raises:
        UserError: the scenario has no `vehicle_link` or no safe plan, a check of the pre-flight
            fails, neither `arm` nor `dry_run` is given, or the vehicle refuses a step. The vehicle
            is disarmed then, with its parameters restored.
    """
    link = checked_link(scenario)
    thrusters = scenario.station.load_vehicle().thrusters()
    say(f"connecting to {link.connection}")
    with Driver(link, thrusters, dry_run=dry_run, record=record) as driver:
        checks = preflight(driver, scenario, say)
        scenario = as_granted(scenario, driver, say)
        driver.use(scenario.vehicle_link or link)
        if live is not None:
            live.begin(scenario)
        cockpit = Cockpit(driver, scenario)
        progress(0.0, "compiling")
        cockpit.warm_up()
        say("running the loop without commands")
        cockpit.shadow()
        if not (arm or dry_run):
            dry = ", or --dry-run to compute and log without commands" if keep is None else ""
            raise UserError(f"all checks are passed, and nothing was armed: add --arm to fly{dry}")
        say("dry run: nothing is armed" if dry_run else "arming")
        cockpit.compile_monitor()
        checks = preflight(driver, scenario)
        with ExitStack() as held:
            if scenario.vehicle_link is not None and scenario.vehicle_link.safety.dead_man > 0:
                cockpit.dead_man = held.enter_context(dead_man_key())
            driver.prepare()
            held.enter_context(short_turns())
            outcome = cockpit.fly(progress, keep, live)
        statistics = driver.link.statistics()
        try:
            driver.stop()
        except UserError as error:  # what was flown is kept all the same
            say(str(error))
            outcome = outcome._replace(sentence=f"{outcome.sentence} Then {error}.")
    return cockpit.flight(outcome, checks, statistics)


class Cockpit:
    """The closed loop of a connected vehicle."""

    def __init__(self, driver: Driver, scenario: Scenario):
        """Build the diagram for the vehicle's present place.

        Raises:
            UserError: the scenario names what can't be read, or no reading of attitude or depth
                comes.
        """
        assert scenario.vehicle_link is not None
        self.driver, self.scenario = driver, scenario
        self.anchor = _anchor(driver, scenario.station, scenario.vehicle_link)
        self.diagram = build_diagram(
            scenario.station,
            scenario.controller,
            hardware=True,
            log_periods=log_periods(scenario),
            goal=scenario.goal,
            link=scenario.vehicle_link,
        )
        station: Any = self.diagram.GetSubsystemByName("station")
        self.station: Diagram = station
        self.interface: VehicleInterface = station.GetSubsystemByName("vehicle")
        self.source = plan_source(self.diagram)
        self.journal = Journal(driver)
        self.dead_man: Callable[[], float] | None = None
        period = getattr(getattr(scenario.controller, "tracking", None), "period", 0.02)
        self.tick = tick_of(self.interface.period, period, 1 / scenario.log.rate)

    # ---------------------------------------------------------------------------- before arming

    def warm_up(self) -> None:
        """Compile every event's function, on the vehicle's readings: the loop falls behind."""
        compile_functions(self.diagram)
        self.interface.commanding = False
        self._begin().run(_WARM_UP)
        self._end_planner()
        self.interface.end()

    def shadow(self) -> None:
        """Run the loop without commanding, anew a few times until its estimate is good.

        Raises:
            UserError: the estimate is lost or not finite at the end.
        """
        self.interface.commanding = False
        lost = ""
        for _ in range(_ATTEMPTS):
            lost = self._shadowed()
            if not lost:
                return
        raise UserError(lost)

    def _shadowed(self) -> str:
        """What is wrong with the estimate after a run without commands; empty if it is good."""
        clockwork = self._begin()
        clockwork.run(_SHADOW)
        context = clockwork.simulator.get_context()
        own = self.station.GetMyContextFromRoot(context)
        X = value(self.station.GetOutputPort("X_WB"), own)
        health = value(self.station.GetOutputPort("health"), own)
        self._end_planner()
        self.interface.end()
        if np.isfinite(X).all() and health[0] < _LOST:
            return ""
        names = ("imu", *self.scenario.station.sensing.fused)
        doubted = [n for n, trusted in zip(names, health[1:], strict=True) if not trusted]
        late = percentiles(clockwork.late)["max"]
        return (
            f"the estimate is lost after {_SHADOW:g} s without commands, nothing was armed: not "
            f"trusted are {', '.join(doubted) or 'none of the sensors'}; check their rates and "
            f"mounts (station.sensing). The loop was {late:.0f} ms late at most"
        )

    # -------------------------------------------------------------------------------- the flight

    def fly(
        self, progress: Progress, keep: Keep | None = None, live: LivePage | None = None
    ) -> Outcome:
        """Run from the present place on until monitor, guard, clock or user end the flight."""
        assert self.scenario.vehicle_link is not None
        # it may have turned since the loop was built
        self.anchor = _anchor(self.driver, self.scenario.station, self.scenario.vehicle_link)
        self.interface.commanding = True
        self.interface.on_act = self.journal.act
        try:
            return self._fly(self._begin(), progress, keep, live)
        finally:
            self._end_planner(wait=False)  # the vehicle is still armed
            self.interface.end()

    def _monitor(self) -> Monitor:
        s = self.scenario
        vehicle = s.station.load_vehicle()
        return Monitor(vehicle, s.station.obstacles, s.success, s.goal, s.safety)

    def compile_monitor(self) -> None:
        """Compile what the monitor computes."""
        self._monitor().check(0.0, *self.scenario.station.initial_state())

    def _fly(
        self, clockwork: Clockwork, progress: Progress, keep: Keep | None, live: LivePage | None
    ) -> Outcome:
        s, monitor = self.scenario, self._monitor()
        context = clockwork.simulator.get_mutable_context()
        own = self.station.GetMyContextFromRoot(context)
        ports = [self.station.GetOutputPort(name) for name in ("X_WB", "V_WB_B", "health")]
        self.tap = PlanTap(self.diagram, context, s.log.samples)
        maneuvers = ManeuverTap(s, self.diagram, context, keep, self.journal)
        self.context, self.clockwork = context, clockwork
        stride = max(1, round(1 / (s.log.rate * clockwork.tick)))
        ended: list[Outcome] = []

        def view(t: float) -> dict[str, Any]:
            seen = [value(port, own) for port in ports]
            return flight_view(s, self.journal, self.tap, t, seen, maneuvers.words())

        def each(t: float) -> bool:
            if live is not None:
                live.show(t, lambda: view(t))
            if stopped.is_set():
                words = f"The run was interrupted after {t:.1f} s."
                ended[:] = ended or [Outcome("interrupted", t, words)]
                return False
            if reason := self.journal.reason:
                if not ended:
                    ended.append(Outcome("guard", t, f"Stopped at {t:.1f} s: {reason}."))
                return not self.journal.finished
            if round(t / clockwork.tick) % stride == 0:
                self.tap.read(t)
                found = monitor.check(t, *(value(port, own) for port in ports[:2]))
                found = found or maneuvers.read(t)
                if found is not None:
                    ended.append(found)
                    return False
                if round(t * s.log.rate) % round(s.log.rate) == 0:
                    done = maneuvers.done if maneuvers.names else t / s.duration
                    told = f"{t:.0f} s, {self.journal.words()} {maneuvers.words()}"
                    progress(max(monitor.progress, done), told)
            return True

        limit = s.duration + s.vehicle_link.safety.hold if s.vehicle_link else s.duration
        with end_noted() as stopped, few_collections():
            clockwork.run(s.duration, each)
            if ended and ended[0].reason == "guard" and not self.journal.finished:
                clockwork.run(limit, each)
        if ended:
            return ended[0]
        words = f"The time limit of {s.duration:.1f} s was reached."
        return Outcome("duration", clockwork.time, words)

    def flight(self, outcome: Outcome, checks: list[Finding], statistics: Statistics) -> Run:
        """The flight's log and numbers."""
        signals = logged(self.diagram, self.context)
        log = collect_flight(self.scenario, signals, self.tap, outcome.time, self.journal)
        numbers = {
            "loop": {
                "period_ms": 1e3 * self.clockwork.tick,
                "real_time_priority": self.clockwork.urgent,
                **{f"lateness_{k}_ms": v for k, v in percentiles(self.clockwork.late).items()},
                **{f"duration_{k}_ms": v for k, v in percentiles(self.clockwork.busy).items()},
                **{f"command_{k}_ms": v for k, v in percentiles(self.journal.late).items()},
            },
            "link": {
                "received": statistics.received,
                "lost": statistics.lost,
                "damaged": statistics.damaged,
                "reconnections": statistics.reconnections,
                "reboots": statistics.reboots,
                "round_trip_ms": statistics.round_trip and 1e3 * statistics.round_trip,
                "imu_rate_Hz": max(statistics.rates.get(n, 0.0) for n in telemetry.IMUS),
            },
            "guards": self.journal.summary(),
        }
        if isinstance(self.source, MppiBeside):
            latency = percentiles([call[1] for call in self.source.calls])
            numbers["plans"] = {
                "made": len(self.source.calls),
                **{f"latency_{name}_ms": v for name, v in latency.items()},
            }
        timing = Timing("vehicle")
        return Run(self.scenario, log, outcome, timing, numbers, tuple(checks))

    # ------------------------------------------------------------------------------------ inside

    def _begin(self) -> Clockwork:
        """A simulator at time 0 with the vehicle's present state, connected to it."""
        simulator = Simulator(self.diagram)
        context = simulator.get_mutable_context()
        self._seed(context)
        self._await_readings()
        X_WB = start_pose(self.driver, self.anchor, self.scenario.station)
        if self.station.HasSubsystemNamed("ekf"):
            ekf: Any = self.station.GetSubsystemByName("ekf")
            if isinstance(ekf, Ekf):
                ekf.set_start(ekf.GetMyMutableContextFromRoot(context), X_WB, np.zeros(6))
        simulator.Initialize()
        epoch = time.monotonic() + 0.02
        self.interface.ages = self._ages(context)
        self.interface.begin(self.driver, epoch, self.anchor)
        offset = self.driver.link.clock.offset
        self.journal.epoch, self.journal.boot = (
            epoch,
            epoch - (np.nan if offset is None else offset),
        )
        return Clockwork(simulator, self.tick, epoch)

    def _await_readings(self) -> None:
        """Wait until the readings are new: those of before are old after a compilation.

        An armed vehicle gets neutral commands meanwhile.
        """
        since, driver = time.monotonic(), self.driver
        wants_dvl = isinstance(self.scenario.station.sensing.dvl, Dvl)
        while time.monotonic() < since + _START:
            attitude = telemetry.attitude(driver.link)
            fresh = attitude is not None and attitude.arrival > since
            if fresh and (not wants_dvl or driver.dvl_state()[0] < time.monotonic() - since):
                return
            driver.idle()
            time.sleep(0.02)

    def _ages(self, context: Context) -> dict[str, Callable[[], float]]:
        """Ages (s) of the plan that a planner made, and of the dead-man key."""
        ages: dict[str, Callable[[], float]] = {}
        if isinstance(self.source, MppiBeside):
            port, own = self.source.GetOutputPort("plan"), self.source.GetMyContextFromRoot(context)

            made = 0.0  # time of the newest plan that there was

            def age() -> float:
                nonlocal made
                plan = value(port, own)
                if plan[1:5] @ plan[1:5] > 0.25:
                    made = float(plan[0])
                return context.get_time() - made

            ages["plan"] = age
        if self.dead_man is not None:
            ages["dead_man"] = self.dead_man
        return ages

    def _seed(self, context: Context) -> None:
        seeded(self.diagram, context, self.scenario.seed)

    def _end_planner(self, wait: bool = True) -> None:
        if isinstance(self.source, MppiBeside):
            self.source.end(wait)


def _anchor(driver: Driver, station: StationConfig, link: Mavlink) -> Anchor:
    """Where W lies for a vehicle at its present place.

    Raises:
        UserError: no attitude comes.
    """
    end = time.monotonic() + _START
    while telemetry.heading(driver.link) is None and time.monotonic() < end:
        time.sleep(0.02)
    heading = telemetry.heading(driver.link)
    if heading is None:
        raise UserError("the vehicle sends no attitude; check its streams (SR0_EXTRA1)")
    position = telemetry.position(driver.link) if link.estimate == "autopilot" else None
    X0, _ = station.initial_state()
    yaw = float(heading.value[0])
    anchor = Anchor.at_start(X0, yaw, None if position is None else position.value[:3])
    return anchor if link.world == "start" else anchor._replace(yaw=0.0)


def start_pose(driver: Driver, anchor: Anchor, station: StationConfig) -> np.ndarray:
    """X_WB now: attitude and depth as the vehicle measures them, the station's place in x and y."""
    X_WB, _ = station.initial_state()
    X_WB = np.array(X_WB, float)
    attitude = telemetry.attitude(driver.link)
    if attitude is not None:
        X_WB[:4] = anchor.attitude(attitude.value)
    sensor = station.sensing.depth
    if sensor is not None:
        depth = telemetry.depth(driver.link, driver.parameters, sensor.assumed_density)
        if depth is not None:
            X_WB[6] = -float(depth.value[0])
    return X_WB
