"""Recordings as a folder of CSV files, one per trajectory, and a `recording.yaml`.

`docs/recording.md` is the user's page. Thruster forces and PWM are scalars along each thruster's
axis, positive as ArduSub's positive PWM, and therefore the same in either choice of frames.
"""

import csv
import os
import re
import secrets
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from ..config.errors import UserError
from ..config.typed_yaml import dump, load
from ..frames import pose_to_enu, twist_frd_to_flu
from ..se3 import TWIST, WRENCH, XYZ
from ..vehicles.places import named_in
from .build import Trajectory
from .checks.finding import Finding, with_findings
from .checks.flickers import flicker_finding, mended
from .csv_columns import METADATA, STATE, STEMS, checked_groups, unit_quaternions
from .csv_runs import Run, as_recorded, common_step, cut, on_grid
from .csv_table import Table, read_table
from .kinematics import contradictions
from .outputs import outputs_of, with_outputs
from .resample import continuous
from .schema import COMMANDS, UNEVEN
from .steady_times import Steady, steady_times
from .store import Recording

Frames = Literal["ENU/FLU", "NED/FRD"]


@dataclass(frozen=True)
class CsvFolder:
    """Content of `recording.yaml`.

    Attributes:
        frames: of all files: `ENU/FLU` or `NED/FRD` (world/body).
        vehicle: name of a preset, or path of a vehicle file from this folder.
        files: scenario of each CSV file; by default every `*.csv` in the folder, named as the file.
        rate: rate of the recording (Hz); by default that of the files.
        ignore: columns to leave out.
        check: compare poses with velocities, and refuse contradictions.
        outputs: output of the autopilot (n of SERVOn) that drives each thruster, 0 for none;
            findings name it.
        source, notes: free text.
    """

    frames: Frames
    vehicle: str = ""
    files: dict[str, str] = field(default_factory=dict)
    rate: float | None = None
    ignore: list[str] = field(default_factory=list)
    check: bool = True
    outputs: list[int] = field(default_factory=list)
    source: str = ""
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.rate is not None and not 0.1 <= self.rate <= 1000:
            raise ValueError(f"rate must lie between 0.1 and 1000 Hz, not {self.rate:g}")


def read_csv(
    path: str | os.PathLike[str], *, rate: float | None = None, resample: bool = True
) -> Recording:
    """Read a folder of CSV files with its `recording.yaml` (or the path of that file).

    Uneven time steps are resampled to `rate` (Hz; by default that of the YAML, else of the files):
    commands held, poses along the geodesic, twists linearly. At long gaps a run is cut in two.
    Without `resample` samples keep their times (`Recording.elapsed`), and a run is cut wherever a
    step is longer than 4.5 times the 90th percentile, as commands are not known there.

    Raises:
        UserError: one sentence naming file, line, column and remedy.
    """
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    metadata = folder / METADATA if path.is_dir() else path
    if not metadata.is_file():
        raise UserError(
            f"{folder}: no {METADATA} in it; write one with `frames: ENU/FLU` (or NED/FRD), "
            "`vehicle: bluerov2_heavy` and `files: {run_1.csv: surge}` (see docs/recording.md)"
        )
    meta = load(CsvFolder, metadata)
    there = {p.name: p.stem for p in sorted(folder.glob("*.csv"))}
    files = meta.files or there
    findings = [_unlisted(name) for name in there if name not in files]
    if not files:
        raise UserError(f"{folder}: no .csv file in it; put one a trajectory beside {METADATA}")
    notes = list(meta.notes)
    runs: list[Run] = []
    for name, scenario in files.items():
        table = read_table(folder / name)
        run = _run(table, scenario, meta, notes, findings)
        runs.extend(cut(run, Path(name).name, notes, resample))
    dt = common_step(folder, [run.t for run in runs], rate or meta.rate, notes, resample)
    trajectories = [on_grid(run, dt) if resample else as_recorded(run, dt) for run in runs]
    try:
        recording = Recording.from_trajectories(
            trajectories,
            dt,
            vehicle=named_in(meta.vehicle, folder),
            source=meta.source or folder.name,
            notes=notes,
        )
        dataset = with_outputs(recording.dataset, meta.outputs)
        return Recording(with_findings(dataset, findings))
    except UserError:
        raise
    except ValueError as error:
        raise UserError(f"{folder}: {error}") from error


def _unlisted(name: str) -> Finding:
    return Finding(
        "unlisted-file",
        name,
        f"{name} is not under `files` in {METADATA} and is not read",
        "list it, or move it out of the folder",
    )


def _jitter(name: str, steady: Steady) -> Finding:
    return Finding(
        "clock-jitter",
        name,
        f"t jitters by {1e3 * steady.jitter:.2g} ms (rms) about steady {steady.rate:.3g} Hz, at "
        "which the motion is smoother: steady times were taken",
        "write the times of measurement, not those of arrival",
    )


def _run(
    table: Table, scenario: str, meta: CsvFolder, notes: list[str], findings: list[Finding]
) -> Run:
    groups = checked_groups(table, meta.ignore)
    t = table[["t"]][0]
    X = np.concatenate([unit_quaternions(table), table[XYZ]])
    V = table[TWIST]
    commands = {name: table[columns] for name, columns in groups.items() if name in COMMANDS}
    if meta.frames == "NED/FRD":
        X, V = pose_to_enu(X), twist_frd_to_flu(V)
        if "F_Bo_B" in commands:
            commands["F_Bo_B"] = twist_frd_to_flu(commands["F_Bo_B"])
    X[:4] = continuous(X[:4])
    if meta.check and (whole := mended(t, X, V)) is not None:
        X, V = whole.X, whole.V
        findings.append(flicker_finding(table.path.name, t[whole.bad]))
    steady = steady_times(t, np.concatenate([X, V])) if meta.check else None
    if steady is not None and (np.diff(steady.t) > 0).all():
        t = steady.t
        findings.append(_jitter(table.path.name, steady))
    if meta.check:
        errors, doubts = contradictions(t, X, V)
        if errors:
            raise UserError(f"{table.path}: {errors[0]} (`check: false` in {METADATA} skips this)")
        notes.extend(f"{table.path.name}: {doubt}" for doubt in doubts)
    voltage = table[["voltage"]][0] if "voltage" in groups else None
    return Run(scenario, t, X, V, commands, voltage)


def write_csv(
    recording: Recording, folder: str | os.PathLike[str], *, frames: Frames = "ENU/FLU"
) -> None:
    """Write one CSV file per trajectory and `recording.yaml`; of raw sensors only the voltage.

    Raises:
        UserError: if the folder exists and is not empty.

    Example:
        >>> vehicle = load_vehicle("bluerov2_heavy")
        >>> write_csv(generate(GenerateConfig(trajectories=1, duration=4.0), vehicle), "runs")
        >>> load_data("runs").scenarios[0]
        'surge-forward'
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"{folder}: exists and is not empty; give a new folder")
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}.partial")
    partial.mkdir()
    try:
        files: dict[str, str] = {}
        for number, trajectory in enumerate(recording.trajectories(), 1):
            stem = re.sub(r"[^A-Za-z0-9._-]+", "_", trajectory.scenario)
            name = f"{number:03d}_{stem}.csv"
            files[name] = trajectory.scenario
            _write_file(partial / name, trajectory, recording.dt, frames)
        meta = CsvFolder(
            frames,
            recording.vehicle,
            files,
            rate=1.0 / recording.dt,
            outputs=list(outputs_of(recording.dataset)),
            source=str(recording.dataset.attrs.get("source", "")),
            notes=list(recording.notes),
        )
        (partial / METADATA).write_text(dump(meta), encoding="utf-8")
        if folder.exists():
            folder.rmdir()
        os.replace(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _write_file(path: Path, trajectory: Trajectory, dt: float, frames: Frames) -> None:
    X, V = trajectory.X_WB.T, trajectory.V_WB_B.T
    commands = {name: np.asarray(values).T for name, values in trajectory.commands.items()}
    if frames == "NED/FRD":
        X, V = pose_to_enu(X), twist_frd_to_flu(V)
        if "F_Bo_B" in commands:
            commands["F_Bo_B"] = twist_frd_to_flu(commands["F_Bo_B"])
    start = trajectory.start if np.isfinite(trajectory.start) else 0.0
    elapsed = trajectory.sensors.get(UNEVEN)
    if elapsed is None or not np.isfinite(elapsed).all():
        elapsed = dt * np.arange(len(trajectory))
    elapsed = elapsed - elapsed[:1]
    names, rows = list(STATE), [start + elapsed, *X[4:], *X[:4], *V]
    for name, values in commands.items():
        stem = STEMS.get(name)
        names += [f"{stem}{i + 1}" for i in range(len(values))] if stem else list(WRENCH)
        rows += list(values)
    voltage = trajectory.sensors.get("voltage")
    if voltage is not None and np.isfinite(voltage).all():
        names.append("voltage")
        rows.append(voltage)
    with path.open("w", encoding="utf-8", newline="\n") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(names)
        for row in zip(*rows, strict=True):
            writer.writerow([f"{v:.12g}" if np.isfinite(v) else "" for v in row])
