"""`spinndrift collect`: maneuvers flown for data, on a vehicle or in simulation."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from ...models.config.checks import SEED, Within
from ...models.files.interrupts import interrupts_held
from ..progress import console, progress_bar, tell_code

if TYPE_CHECKING:
    from ..run.collection import Collected


@dataclass(frozen=True)
class Collect:
    """Fly maneuvers for training data: each from rest at its start pose, then without feedback.

    The paper's protocol: a controller brings the vehicle to its start and holds it until it is
    steady; then it gets the maneuver's constant wrench for ten seconds. Ten maneuvers, 20 of each.
    SCENARIO gives vehicle, water and sensors, and with --arm the vehicle_link to fly on; its
    controller takes no part. docs/field.md is the checklist.

    Before the dive the vehicle's model predicts every maneuver: starts are moved, and efforts
    reduced where need be, so that the predicted path stays within depths and fence.

    Writes a folder: recording.nc, which train, diagnose and evaluate take, scenario.yaml, and a
    folder dive-N of each dive with its log, its report and what the vehicle said (telemetry.tlog).
    The next call goes on with what is missing, after Ctrl-C, a guard or a change of battery;
    a trajectory that was interrupted is discarded and flown again.
    """

    EXAMPLES: ClassVar = (
        "spinndrift collect station_keeping_calm --repeats 2 --out runs/maneuvers",
        "spinndrift collect station_keeping_calm --maneuver coast --out runs/coasting",
    )

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    """Name of a shipped scenario, or a YAML file."""
    maneuver: UseAppendAction[tuple[str, ...]] = ()
    """Maneuver to fly, or the diagnosis.json whose next experiments are flown; may be given several
    times. By default the ten maneuvers of the paper."""
    repeats: Annotated[int | None, Within(1, 10_000)] = None
    """Trajectories of each maneuver; by default 20 of the ten, 8 of an experiment, which differ in
    axis, heading or place."""
    duration: Annotated[float, Within(0.5, 600.0)] = 10.0
    """Time without feedback of each trajectory (s)."""
    effort: Annotated[float | None, Within(0.0, 1.0, above=True)] = None
    """Share of the largest wrench; by default 0.3 for the ten, all of its own for an experiment."""
    out: Path | None = None
    """Folder to write or to go on with; by default runs/<name>-maneuvers."""
    seed: Annotated[int | None, SEED] = None
    """Seed of everything random in a simulation; by default that of the scenario."""
    scenario_text: str = ""
    """YAML that overrides the scenario, such as 'station: {disturbance_set: calm}'."""
    engine: Literal["auto", "drake", "compiled"] = "auto"
    """Engine that steps a simulation, as in spinndrift run."""
    arm: Annotated[bool, FlagCreatePairsOff] = False
    """Arm the vehicle of the scenario's vehicle_link and fly."""
    live: str | None = None
    """Serve a page that shows the dive while it goes on, a simulation in real time: a port of this
    computer (7890 if none is given, 0 for a free one), or HOST:PORT to show it to others."""
    report: bool = True
    """Write report.html and meshcat.html of the dive."""
    quiet: Annotated[bool, FlagCreatePairsOff, arg(help="Show no progress and no summary.")] = False

    def run(self) -> None:
        """Fly, write, summarise."""
        with interrupts_held():
            from ...models.files.owned import run_folder
            from ..run.collection import COLLECTION, maneuver_scenario
            from ..run.live import live_page
            from ..scenarios.scenario import load_scenario

        scenario = load_scenario(self.scenario, self.scenario_text)
        if self.arm:
            scenario.link("--arm")
        out = self.out or Path("runs") / f"{scenario.name}-maneuvers"
        with run_folder(out, COLLECTION) as folder:
            scenario = maneuver_scenario(scenario.with_changes(self.seed), self._settings())
            tell_code(self.scenario, scenario.code)
            with live_page(self.live, scenario, self._say) as live:
                found = self._collect(scenario, folder, live)
        self._summary(found, out)
        if found.outcome is not None and found.outcome.reason == "interrupted":
            raise KeyboardInterrupt

    def _collect(self, scenario: Any, folder: Path, live: Any) -> "Collected":
        with interrupts_held():
            from ..run.collection import collect

        def say(text: str) -> None:
            self._say(text)
            if live is not None:
                live.say(text)

        settings: dict[str, Any] = {
            "arm": self.arm, "report": self.report, "engine": self.engine, "say": say, "live": live,
        }  # fmt: skip
        if self.quiet:
            return collect(scenario, folder, **settings)
        with progress_bar(f"collecting with {scenario.name}") as update:
            return collect(scenario, folder, **settings, progress=update)

    def _settings(self) -> Any:
        """The controller that flies the maneuvers."""
        with interrupts_held():
            from ...training.data.maneuvers import MANEUVERS
            from ...training.diagnosis.findings.maneuver_library import VARIANTS
            from ..run.experiment import chosen_maneuvers
            from ..scenarios.maneuvers import TRAJECTORIES, Maneuvers

        names = chosen_maneuvers(self.maneuver, self._say) or tuple(MANEUVERS)
        usual = TRAJECTORIES if set(names) <= set(MANEUVERS) else VARIANTS
        repeats = usual if self.repeats is None else self.repeats
        return Maneuvers(names, repeats, duration=self.duration, effort=self.effort)

    def _summary(self, found: "Collected", out: Path) -> None:
        if found.outcome is None:
            self._say(f"all {found.wanted} trajectories are there; nothing was flown")
            return
        self._say(found.outcome.sentence)
        if found.there < found.wanted:
            self._say(
                f"{found.there} of {found.wanted} trajectories are there, {found.added} of this "
                "dive; the same command goes on with the rest"
            )
        else:
            self._say(f"all {found.wanted} trajectories are there, {found.added} of this dive")
        if found.there:
            self._say(f"wrote {out / 'recording.nc'}")

    def _say(self, text: str) -> None:
        if not self.quiet:
            console().print(text, markup=False, soft_wrap=True)
