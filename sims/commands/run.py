"""`spinndrift run`: the closed-loop simulation of a scenario."""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from ...models.config.checks import SECONDS, SEED
from ...models.config.errors import UserError
from ...models.files.interrupts import interrupts_held
from ..progress import console, progress_bar, tell_code


@dataclass(frozen=True)
class Run:
    """Simulate a scenario: plant, water, sensors, filter, planner and controller in closed loop.

    SCENARIO is the path of a YAML file, or the name of a shipped scenario: station_keeping,
    trajectory_tracking or pylon_crossing, each with the ending _calm or _harbour, or for a vehicle
    pylon_crossing_vehicle and hold_depth_vehicle, which needs no DVL.

    Writes a folder: report.html (read this first), meshcat.html (3-D replay), log.nc (a Recording
    of the run), metrics.json, and scenario.yaml with every default written out, which can be
    changed and run again. The same scenario and seed give the same run. After Ctrl-C the folder
    holds the run up to then.

    With --arm the scenario is flown on the vehicle of its vehicle_link over MAVLink, after a
    pre-flight check and in real time; --dry-run computes and logs everything and commands nothing.
    docs/field.md is the checklist. Ctrl-C stops and disarms the vehicle. The folder then holds
    telemetry.tlog as well, all that the vehicle said.

    A scenario with !Own, !OwnTask, !OwnFilter or !OwnSensor runs the Python code that it names,
    which is printed before: review that code first if the file is not your own.
    """

    EXAMPLES: ClassVar = (
        "spinndrift run station_keeping_calm --duration 10",
        "spinndrift run pylon_crossing_harbour --model runs/mine/model.spinn --seed 3",
    )

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    """Name of a shipped scenario, or a YAML file."""
    seed: Annotated[int | None, SEED] = None
    """Seed of everything random; by default that of the scenario."""
    out: Path | None = None
    """Folder to write, which must be new, empty or that of a run that was interrupted; by default
    runs/<name>-<seed>."""
    scenario_text: str = ""
    """YAML that overrides the scenario, such as 'station: {disturbance_set: calm}'."""
    model: Path | None = None
    """Learned model (.spinn) for the planner; by default that of the scenario."""
    engine: Literal["auto", "drake", "compiled"] = "auto"
    """Engine that steps the diagram: Drake, or one compiled loop, which is faster but needs systems
    with pure functions (no user-defined system without `pure`). `auto` takes the loop for runs of
    10 s and more without a sampling planner, if every system has `pure`; in it the planner's
    rollouts run in one thread."""
    arm: Annotated[bool, FlagCreatePairsOff] = False
    """Arm the vehicle of the scenario's vehicle_link and fly."""
    dry_run: Annotated[bool, FlagCreatePairsOff] = False
    """Run the loop on the vehicle's telemetry without arming or commanding it."""
    duration: Annotated[float | None, SECONDS] = None
    """Longest simulated time (s); by default that of the scenario."""
    live: str | None = None
    """Serve a page that shows the run while it goes on, a simulation in real time: a port of this
    computer (7890 if none is given, 0 for a free one), or HOST:PORT to show it to others."""
    report: bool = True
    """Write report.html and meshcat.html."""
    quiet: Annotated[bool, FlagCreatePairsOff, arg(help="Show no progress and no summary.")] = False

    def run(self) -> None:
        """Simulate, write, summarise."""
        with interrupts_held():
            from ..run.folder import new_folder, write_files
            from ..run.live import live_page
            from ..run.loop import simulate
            from ..run.way import position_note
            from ..scenarios.scenario import load_scenario

        if self.arm and self.dry_run:
            raise UserError(
                "--arm and --dry-run exclude each other: --arm flies, --dry-run computes and logs "
                "without commands; leave one out"
            )
        scenario = load_scenario(self.scenario, self.scenario_text)
        tell_code(self.scenario, scenario.code)
        scenario = scenario.with_changes(self.seed, self.duration, self.model)
        if self.arm or self.dry_run:
            scenario.link("--arm" if self.arm else "--dry-run")
        vehicle = scenario.station.load_vehicle()
        if told := vehicle.limitation():
            console().print(f"{told} What the controller asks for there has no effect.")
        if told := vehicle.instability():
            console().print(told)
        if scenario.vehicle_link is None and (note := position_note(scenario)):
            self._say(note)
        with (
            new_folder(self.out, scenario) as out,
            live_page(self.live, scenario, self._say) as live,
        ):
            if scenario.vehicle_link is not None:
                flown = self._fly(scenario, out, live)
            elif self.quiet:
                flown = simulate(scenario, engine=self.engine, live=live)
            else:
                with progress_bar(f"flying {scenario.name}") as update:
                    flown = simulate(scenario, update, self.engine, live=live)
            if live is not None:
                live.end(flown.outcome)
            values = write_files(flown, out, self.report)
        if not self.quiet:
            self._summary(values, out)
        if flown.outcome.reason == "interrupted":
            raise KeyboardInterrupt

    def _fly(self, scenario: Any, out: Path, live: Any) -> Any:
        """Fly on the vehicle."""
        with interrupts_held():
            from ..run.flight import fly
            from ..run.folder import telemetry_log

        def say(text: str) -> None:
            self._say(text)
            if live is not None:
                live.say(text)

        settings: dict[str, Any] = {
            "arm": self.arm, "dry_run": self.dry_run, "say": say, "live": live,
        }  # fmt: skip
        with ExitStack() as held:
            settings["record"] = held.enter_context(telemetry_log(out))
            if not self.quiet:
                settings["progress"] = held.enter_context(progress_bar(f"flying {scenario.name}"))
            return fly(scenario, **settings)

    def _say(self, text: str) -> None:
        if not self.quiet:
            console().print(text, markup=False, soft_wrap=True)

    def _summary(self, values: dict, out: Path) -> None:
        shown, path, timing = console(), values["path"], values["timing"]
        shown.print(values["outcome"]["words"])
        tracked = "depth error" if values["tracking"].get("depth_only") else "tracking error"
        told = [] if path["length_m"] is None else [f"path {path['length_m']:.1f} m"]
        for name, block, key in (
            ("minimum clearance", path, "min_clearance_m"),
            (tracked, values["tracking"], "position_rms_m"),
            ("estimation error", values["estimate"], "position_rms_m"),
        ):
            if block.get(key) is not None:
                told.append(f"{name} {block[key]:.2f} m")
        if timing["real_time_factor"] is not None:
            told.append(f"{timing['real_time_factor']:.1f} × real time")
        beyond = values["planner"].get("plans_beyond_allowed")
        if beyond:
            allowed = values["planner"]["allowed_collision_probability"]
            told.append(f"collision risk above the allowed {100 * allowed:g} % in {beyond} plans")
        if told:
            shown.print(", ".join(told))
        shown.print(f"wrote {out}" + (f"; open {out / 'report.html'}" if self.report else ""))
