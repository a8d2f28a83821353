"""`spinndrift diagnose`: the causes of a simulation's errors, by name."""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import Positional, arg

from ...models.config.checks import RATE_OF_ALARMS, WATER_DENSITY, Vector6, Within
from ...models.config.errors import UserError
from ...models.files.interrupts import interrupts_held
from ..progress import console, progress_bar

if TYPE_CHECKING:
    from ...models.dynamics import Dynamics
    from ...models.recordings.store import Recording
    from ...models.vehicles.vehicle import Vehicle
    from ...training.diagnosis.config import DiagnoseConfig
    from ...training.diagnosis.findings.result import Diagnosis
    from ...training.diagnosis.pipeline import Finding

_USUAL = "bluerov2_heavy"
_STATE_VEHICLES = (".nc", ".nc4", ".h5", ".yaml", ".yml")
"""Suffixes of files that can state their vehicle; logs can't."""


@dataclass(frozen=True)
class Diagnose:
    """Compare measured data with the simulation you believe, and name the causes of differences.

    Writes into the folder `--out`: `diagnosis.json`, `report.html`, and `extended/model.spinn`, a
    model with the causes in it that other commands take as any other.
    """

    EXAMPLES: ClassVar = (
        "spinndrift diagnose dive.nc --vehicle bluerov2_heavy",
        "spinndrift diagnose tank.nc --diffusion 2 2 2 0.2 0.2 0.2 --refit none --out runs/told",
        "spinndrift diagnose harbour.nc --against tank.nc --out runs/changed",
    )

    data: Annotated[Positional[Path], arg(metavar="DATA")]
    """Recording (.nc), CSV folder, log (.tlog, .BIN) or ROS bag."""
    vehicle: str | None = None
    """Preset name or YAML file; by default what the data name, else the model's, else that of a
    log's frame, else bluerov2_heavy."""
    model: Path | None = None
    """Model file (.spinn) to believe instead of the preset."""
    diffusion: Annotated[Vector6 | None, Within(0, 1e6)] = None
    """Disturbance that is believed with a preset: b of surge, sway, heave (N√s), roll, pitch, yaw
    (N·m√s). Without it a wrong level of the disturbance can't be found."""
    against: Path | None = None
    """Healthy runs, to report what has changed in DATA since them. A folder that `diagnose` wrote
    for them (their data are read again), healthy data in any form that DATA may have (diagnosed
    first, with the options given), or a folder of several recordings."""
    alpha: Annotated[float, RATE_OF_ALARMS] = 0.01
    """Rate of false alarms over all names together; with `--against` calibrated on healthy runs,
    each left out in turn."""
    refit: Literal["auto", "none", "scales", "linear", "command", "all"] = "auto"
    """Coefficients that are fitted before any cause is named: none, one factor on all thrust
    (`scales`), added mass, drag and buoyancy (`linear`), drag, buoyancy and the scale of each axis'
    command, where commands pass through gains that are not known (`command`), or all of a grey box
    (these, the thrusters' curve, dead band and levers, restoring moment), for a belief that is
    wrong in most of them. `auto` first fits none; if left-out data reject the result, it
    repeats with `all`."""
    water_density: Annotated[float | None, WATER_DENSITY] = None
    """kg/m³, if a log's autopilot assumed fresh water in the sea (as in `spinndrift import`)."""
    accept: tuple[str, ...] = ()
    """Words of severe findings on the data that are accepted (docs/checks.md), such as no-commands.
    """
    out: Path = Path("diagnosis")
    """Folder to write."""

    def place(self) -> AbstractContextManager[Path]:
        """Check and lock the outputs."""
        with interrupts_held():
            from ...models.files.owned import run_folder
            from ..diagnosis_folder import DIAGNOSIS

        return run_folder(self.out, DIAGNOSIS)

    def run(self) -> None:
        """Load, diagnose, write."""
        with interrupts_held():
            import numpy as np

            from ...models.files.checkpoint import load_model
            from ...models.recordings.checks.finding import check_accepted
            from ...models.vehicles.places import absolute, load_named
            from ...models.vehicles.vehicle import load_vehicle
            from ...training.diagnosis.pipeline import diagnose
            from ..diagnosis_folder import write_diagnosis
            from ..healthy import OPTIONS, SOURCE
            from ..reports.findings import print_findings

        self._check()
        check_accepted(self.accept)
        base, metadata = (None, {}) if self.model is None else load_model(self.model, dtype=float)
        named = metadata.get("vehicle")
        if self.vehicle is not None:
            load_vehicle(self.vehicle)  # fails now, not after the data are read
        recording = self._read(self.data, self.vehicle or (named if self._is_log() else None))
        stated = absolute(self._vehicle(recording.vehicle, named))
        vehicle = load_named(stated, str(self.data))
        recording = self._examined(recording, vehicle, self.data)
        print_findings(console(), recording)
        if self.diffusion is not None:
            base = vehicle.dynamics(np.array(self.diffusion))
        if self.against is not None:
            finding = self._compared(recording, vehicle, base, stated)
        else:
            with progress_bar("diagnosing") as update:
                finding = diagnose(recording, vehicle, base, self._config(), update)
        about = {
            "vehicle": stated,
            SOURCE: str(self.data.absolute()),
            OPTIONS: {"water_density": self.water_density, "accept": list(self.accept)},
            "dt": recording.dt,
        }
        write_diagnosis(self.out, finding, recording, self.data.name, about)
        _print(finding.diagnosis)
        console().print(f"wrote {self.out}")

    def _read(self, path: Path, vehicle: str | None, **options: Any) -> "Recording":
        """Data of any kind; `options` replace those of the command."""
        with interrupts_held():
            from ...systems.logs.load import LogOptions, load_data

        density = options.get("water_density", self.water_density)
        with progress_bar(f"reading {path.name}") as update:
            return load_data(
                path,
                vehicle=vehicle,
                options=LogOptions(water_density=density),
                resample=False,
                accept=options.get("accept", self.accept),
                progress=update,
            )

    def _examined(
        self, recording: "Recording", vehicle: "Vehicle", path: Path, **options: Any
    ) -> "Recording":
        """The recording after all checks."""
        with interrupts_held():
            from ...models.recordings.checks.examine import examine

        return examine(recording, vehicle, str(path), options.get("accept", self.accept))

    def _config(self) -> "DiagnoseConfig":
        with interrupts_held():
            from ...training.diagnosis.config import DiagnoseConfig

        return DiagnoseConfig(alpha=self.alpha, refit=self.refit)

    def _compared(
        self, recording: "Recording", vehicle: "Vehicle", base: "Dynamics | None", stated: str
    ) -> "Finding":
        """What differs from the healthy runs; without a diagnosis of these, one is made first."""
        with interrupts_held():
            from ...training.diagnosis.against.pipeline import Healthy, diagnose_against
            from ...training.diagnosis.pipeline import diagnose
            from ..healthy import diagnosis_at, healthy_of_diagnosis, recordings_in

        def read(path: Path, options: dict[str, Any]) -> "Recording":
            data = self._read(path, stated, **options)
            return self._examined(data, vehicle, path, **options)

        assert self.against is not None
        folder = diagnosis_at(self.against)
        if folder is not None:
            healthy = healthy_of_diagnosis(folder, read)
        else:
            runs = recordings_in(self.against, lambda path: read(path, {}))
            with progress_bar("diagnosing the healthy runs") as update:
                model = diagnose(runs, vehicle, base, self._config(), update).extended
            healthy = Healthy(runs, model, str(self.against))
        with progress_bar("comparing with them") as update:
            return diagnose_against(recording, vehicle, healthy, self._config(), update)

    def _check(self) -> None:
        """Check for contradicting options, before anything is read."""
        if self.diffusion is not None and self.model is not None:
            raise UserError("--diffusion: the model of --model has its own; leave one out")
        if self.against is not None:
            with interrupts_held():
                from ..healthy import check_healthy

            given = {"--model": self.model, "--diffusion": self.diffusion}
            check_healthy(
                self.against, [name for name, value in given.items() if value is not None]
            )

    def _vehicle(self, recorded: str, named: str | None) -> str:
        """The vehicle given, or that of the data or the model; else the default, with a message."""
        stated = self.vehicle or ("" if self._is_log() else recorded) or named
        if not stated:
            stated = recorded or _USUAL  # that of a log's frame
            by = ", by its frame or number of outputs," if recorded and self._is_log() else ""
            told = f"{self.data.name} names no vehicle, so {stated}{by} is assumed; name another"
            console().print(f"{told} with --vehicle", soft_wrap=True)
        return stated

    def _is_log(self) -> bool:
        return self.data.is_file() and self.data.suffix.lower() not in _STATE_VEHICLES


def _print(diagnosis: "Diagnosis") -> None:
    """The verdict and the causes."""
    shown = console()
    shown.print(diagnosis.sentence)
    if diagnosis.against is not None:
        return
    for cause in diagnosis.causes:
        told = ", ".join(f"{k} {v.with_unit}" for k, v in cause.parameters.items())
        if cause.structure is not None:  # its coefficients are in diagnosis.json
            told = cause.structure.description
        shown.print(f"  {cause.name} ({cause.where}): {told}")
