"""`spinndrift demo`: the main job from end to end."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar

from ...models.config.checks import COUNT


@dataclass(frozen=True)
class Demo:
    """A log goes in, a learned vehicle comes out and flies a closed-loop dive.

    Imports the log, trains a SPINN from a preset, compares both on the part of the log that was
    held out, flies the pylon crossing with MPPI on the learned model, and tells it all in one
    report.html. An interrupted demo goes on where it was.
    """

    EXAMPLES: ClassVar = (
        "spinndrift demo",
        "spinndrift demo --log dive.nc --steps 100 --out runs/short",
    )

    log: Path | None = None
    """Your own log (.tlog, .BIN), recording (.nc) or CSV folder; by default the one that comes
    along."""
    out: Path | None = None
    """Folder for everything that is made; by default runs/demo, or runs/demo-2 and so on where that
    holds something else."""
    vehicle: str | None = None
    """Preset name or YAML file to start from; by default what the data name, or bluerov2_heavy."""
    scenario: str = "pylon_crossing_calm"
    """The dive to fly: a shipped scenario's name or a YAML file."""
    steps: Annotated[int | None, COUNT] = None
    """Training steps, for a shorter or a longer look."""

    def run(self) -> None:
        """Run the demo and print its summary."""
        from ...training.config import TrainingConfig
        from ..cores import share_cores
        from ..demo import EMBEDDED, demo, demo_folder
        from ..progress import console, tell_code
        from ..scenarios.scenario import load_scenario

        share_cores()
        config = TrainingConfig()
        if self.steps is not None:
            config = replace(config, steps=self.steps)
        source = EMBEDDED if self.log is None else self.log
        scenario = load_scenario(self.scenario)
        tell_code(self.scenario, scenario.code)
        with demo_folder(self.out) as out:
            told = demo(source, out, scenario, config, self.vehicle)
        console().print(told)
