"""`spinndrift demo`: from a log to a diagnosis, a learned model and a closed-loop dive."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from ...models.config.checks import COUNT
from ...models.files.interrupts import interrupts_held


@dataclass(frozen=True)
class Demo:
    """Diagnose a preset on a log, learn what is left, and dive with the learned model.

    Imports the log, names what the preset gets wrong on its training part, trains a SPINN on top of
    the extended model, compares preset, extended and learned model on the held-out part, simulates
    the pylon crossing with MPPI on the learned model, and writes one report.html. The same command
    resumes an interrupted demo.
    """

    EXAMPLES: ClassVar = (
        "spinndrift demo",
        "spinndrift demo --log dive.nc --steps 100 --out runs/short",
    )

    log: Path | None = None
    """Your own log (.tlog, .BIN), ROS bag, recording (.nc) or CSV folder; by default the shipped
    log."""
    out: Path | None = None
    """Folder for all results; by default runs/demo, or runs/demo-2 and so on if that holds
    something else."""
    vehicle: str | None = None
    """Preset name or YAML file to start from; by default what the data name, or bluerov2_heavy."""
    scenario: str = "pylon_crossing_calm"
    """Scenario of the dive: a shipped scenario's name or a YAML file."""
    steps: Annotated[int | None, COUNT] = None
    """Training steps, for a shorter or a longer demo."""
    accept: tuple[str, ...] = ()
    """Words of severe findings on the data that are accepted (docs/checks.md), such as no-commands.
    """

    def run(self) -> None:
        """Run the demo and print its summary."""
        with interrupts_held():
            from ...models.recordings.checks.finding import check_accepted
            from ..cores import share_cores
            from ..demo import EMBEDDED, demo, demo_folder
            from ..progress import console, tell_code
            from ..scenarios.scenario import load_scenario

        share_cores()
        check_accepted(self.accept)
        source = EMBEDDED if self.log is None else self.log
        scenario = load_scenario(self.scenario)
        tell_code(self.scenario, scenario.code)
        with demo_folder(self.out) as out:
            told = demo(source, out, scenario, None, self.vehicle, self.accept, self.steps)
        console().print(told)
