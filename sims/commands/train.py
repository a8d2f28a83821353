"""`spinndrift train`: a learned model from data."""

from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import Positional

from ...models.config.checks import COUNT, SEED
from ...models.config.errors import UserError
from ...models.files.interrupts import interrupts_held
from ..progress import console, progress_bar


@dataclass(frozen=True)
class Train:
    """Learn a stochastic model of a vehicle from data, starting at a preset or another model.

    The last part of the data (or whole runs, if a scenario has several) is held out; the summary
    and report.html compare preset and learned model on it. Ctrl-C leaves a checkpoint; the same
    command with `--resume` continues to a bit-identical result.
    """

    EXAMPLES: ClassVar = (
        "spinndrift train dive.nc --out runs/mine",
        "spinndrift train tank.nc --method fdm-geodesic --steps 200 --out runs/tank",
    )

    data: Positional[Path]
    """Recording (.nc), log (.tlog, .BIN), ROS bag or CSV folder."""
    out: Path = Path("runs/train")
    """Folder for model.spinn, metrics.csv, evaluation.csv, report.html."""
    method: str | None = None
    """Method of training by name: fdm-geodesic, fdm-chordal, moments (each also with +mse), pinn;
    baselines in position and Euler angles: euclidean-fdm, euclidean-moments,
    euclidean-distance-aware, euclidean-unconstrained. By default that of `--config`, else
    fdm-geodesic+mse."""
    config: Path | None = None
    """Training settings (YAML); the run's own config.yaml has all of them with their defaults. With
    `--method` they override the method's, but may not contradict those that define it."""
    vehicle: str | None = None
    """Preset name or YAML file to start from; by default what the data name."""
    model: Path | None = None
    """Model file (.spinn) to start from instead of the preset: extended/model.spinn of `spinndrift
    diagnose`, whose effects stay fixed while a SPINN learns the rest, or a trained model, whose
    training is continued with its architecture."""
    steps: Annotated[int | None, COUNT] = None
    """Number of training steps, instead of that of the settings."""
    seed: Annotated[int | None, SEED] = None
    """Seed of the initial networks and of all noise, instead of that of the settings."""
    resume: bool = False
    """Continue the run in `--out`."""
    accept: tuple[str, ...] = ()
    """Words of severe findings on the data that are accepted (docs/checks.md), such as no-commands.
    """

    def place(self) -> AbstractContextManager[Path]:
        """Check and lock the outputs."""
        with interrupts_held():
            from ...models.files.owned import run_folder
            from ...training.fitting.run_folder import TRAINING

        return run_folder(self.out, TRAINING)

    def run(self) -> None:
        """Train, evaluate, report."""
        with interrupts_held():
            from ...models.config.typed_yaml import load
            from ...models.recordings.checks.examine import examine
            from ...models.recordings.checks.finding import check_accepted
            from ...models.vehicles.places import load_named
            from ...models.vehicles.vehicle import load_vehicle
            from ...systems.logs.load import load_data
            from ...training.config import TrainingConfig
            from ...training.methods import method_config
            from ..cores import share_cores
            from ..learning import Start, learn
            from ..reports.findings import print_findings
            from ..reports.learning_report import add_data, add_evaluation, add_training
            from ..reports.pages import Page

        share_cores()
        check_accepted(self.accept)
        if self.method is not None:
            config = method_config(self.method, self.config)
        else:
            usual = TrainingConfig()
            config = usual if self.config is None else load(TrainingConfig, self.config, usual)
        changes = {"steps": self.steps, "seed": self.seed}
        config = replace(config, **{k: v for k, v in changes.items() if v is not None})
        self._check_resumed()
        if self.vehicle is not None:
            load_vehicle(self.vehicle)  # fails now, not after the data are read
        start, metadata = (None, {}) if self.model is None else Start.read(self.model)
        with progress_bar(f"reading {self.data.name}") as update:
            recording = load_data(
                self.data, vehicle=self.vehicle, accept=self.accept, progress=update
            )
        stated = recording.vehicle or metadata.get("vehicle") or "bluerov2_heavy"
        vehicle = load_named(stated, str(self.data if recording.vehicle else self.model))
        recording = examine(recording, vehicle, str(self.data), self.accept)
        print_findings(console(), recording)
        with progress_bar("training") as update:
            learned = learn(
                recording,
                vehicle,
                config,
                self.out,
                start=start,
                resume=self.resume,
                progress=update,
            )
        began = f"the preset `{vehicle.name}`" if self.model is None else f"`{self.model}`"
        page = Page("Training", f"{self.data.name}, from {began}")
        add_evaluation(add_training(add_data(page, recording), learned), learned)
        page.write(self.out / "report.html")
        shown = console()
        shown.print(learned.evaluation.summary())
        shown.print(f"wrote {self.out / 'model.spinn'} and {self.out / 'report.html'}")

    def _check_resumed(self) -> None:
        """Refuse to begin where a training run is, and to continue where none is."""
        there = (self.out / "checkpoint.npz").exists()
        if there and not self.resume:
            raise UserError(
                f"--out {self.out}: holds a training run; continue it with --resume or name "
                "another folder"
            )
        if self.resume and not there:
            raise UserError(
                f"--resume: {self.out} has no checkpoint; leave --resume out or name the run's "
                "folder"
            )
