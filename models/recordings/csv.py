"""Recordings as a folder of CSV files, one per trajectory, and a `recording.yaml`.

`docs/recording.md` is the user's page. Thruster forces and PWM are scalars along each thruster's
axis, positive as ArduSub's positive PWM, and therefore the same in either choice of frames.
"""

import difflib
import os
import re
import secrets
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from ..config.errors import UserError
from ..config.typed_yaml import dump, load
from ..frames import pose_to_enu, twist_frd_to_flu
from ..se3 import TWIST, WRENCH
from .build import Trajectory
from .csv_table import Table, read_table
from .kinematics import contradictions
from .resample import continuous, geodesic, grid, hold, linear, slerp
from .schema import COMMANDS, LIMITS, MAY_LACK, QUANTITIES, UNEVEN, variable_units
from .store import Recording

METADATA = "recording.yaml"
Frames = Literal["ENU/FLU", "NED/FRD"]

_POSITION, _QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
_STATE = ("t", *_POSITION, *_QUATERNION, *TWIST)
_LACKABLE = MAY_LACK["X_WB"] + MAY_LACK["V_WB_B"]
_SHORTEST_STEP, _LONGEST_STEP = 1e-5, 1e3
_UNIFORM, _GAP_STEPS, _GAP_S = 1e-3, 10.0, 1.0
_FEW_STEPS, _USUAL = 4.5, 0.9
"""Without resampling a run is cut at steps longer than 4.5 times the 90th percentile, so that files
whose lines come in bursts are not cut at each burst."""
_NORM = 0.02
_RANGES = {"pwm": (500.0, 2500.0, "µs (1500 is stopped)"), "voltage": (1.0, 100.0, "V")}
_LATEST = 1e10
"""Latest time (s): beyond any count of seconds since 1970."""
_MOST_SAMPLES = 10_000_000
"""Largest number of samples of a run on its grid: a week at 16 Hz."""


@dataclass(frozen=True)
class CsvFolder:
    """Content of `recording.yaml`.

    Attributes:
        frames: of all files: `ENU/FLU` or `NED/FRD` (world/body).
        vehicle: name of a preset or path of a vehicle file.
        files: scenario of each CSV file; by default every `*.csv` in the folder, named as the file.
        rate: rate of the recording (Hz); by default that of the files.
        ignore: columns to leave out.
        check: compare poses with velocities, and refuse contradictions.
        source, notes: free text.
    """

    frames: Frames
    vehicle: str = ""
    files: dict[str, str] = field(default_factory=dict)
    rate: float | None = None
    ignore: list[str] = field(default_factory=list)
    check: bool = True
    source: str = ""
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.rate is not None and not 0.1 <= self.rate <= 1000:
            raise ValueError(f"rate must lie between 0.1 and 1000 Hz, not {self.rate:g}")


@dataclass(frozen=True)
class _Run:
    """One file's content in W and B, component first, at the times of its samples."""

    scenario: str
    t: np.ndarray
    X: np.ndarray
    V: np.ndarray
    commands: dict[str, np.ndarray]
    voltage: np.ndarray | None


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
    files = meta.files or {p.name: p.stem for p in sorted(folder.glob("*.csv"))}
    if not files:
        raise UserError(f"{folder}: no .csv file in it; put one a trajectory beside {METADATA}")
    notes = list(meta.notes)
    runs: list[_Run] = []
    for name, scenario in files.items():
        table = read_table(folder / name)
        runs.extend(_cut(_run(table, scenario, meta, notes), table, notes, resample))
    dt = _step(folder, [run.t for run in runs], rate or meta.rate, notes, resample)
    trajectories = [_on_grid(run, dt) if resample else _as_recorded(run, dt) for run in runs]
    try:
        recording = Recording.from_trajectories(
            trajectories, dt, vehicle=meta.vehicle, source=meta.source or folder.name, notes=notes
        )
        return recording
    except UserError:
        raise
    except ValueError as error:
        raise UserError(f"{folder}: {error}") from error


def _run(table: Table, scenario: str, meta: CsvFolder, notes: list[str]) -> _Run:
    groups = _groups(table, meta.ignore)
    _check_time(table)
    _check_finite(table, [*_STATE, *(c for columns in groups.values() for c in columns)])
    _check_limits(table, groups)
    t = table[["t"]][0]
    X = np.concatenate([_unit(table), table[_POSITION]])
    V = table[TWIST]
    commands = {name: table[columns] for name, columns in groups.items() if name in COMMANDS}
    if meta.frames == "NED/FRD":
        X, V = pose_to_enu(X), twist_frd_to_flu(V)
        if "F_Bo_B" in commands:
            commands["F_Bo_B"] = twist_frd_to_flu(commands["F_Bo_B"])
    for name, (low, high, unit) in _RANGES.items():
        if name in groups:
            _check_range(table, groups[name], low, high, unit)
    X[:4] = continuous(X[:4])
    if meta.check:
        errors, doubts = contradictions(t, X, V)
        if errors:
            raise UserError(f"{table.path}: {errors[0]} (`check: false` in {METADATA} skips this)")
        notes.extend(f"{table.path.name}: {doubt}" for doubt in doubts)
    voltage = table[["voltage"]][0] if "voltage" in groups else None
    return _Run(scenario, t, X, V, commands, voltage)


# checks


def _groups(table: Table, ignore: Sequence[str]) -> dict[str, list[str]]:
    """Columns by variable: commands and voltage."""
    names = [name for name in table.names if name not in ignore]
    missing = [name for name in _STATE if name not in names]
    if missing:
        raise UserError(
            f"{table.path}: column `{missing[0]}` is missing; needed are {','.join(_STATE)} "
            "and a command"
        )
    groups: dict[str, list[str]] = {}
    rest = [name for name in names if name not in _STATE]
    if any(name in rest for name in WRENCH):
        groups["F_Bo_B"] = list(WRENCH)
    for variable, stem in (("thruster_force", "f"), ("pwm", "pwm")):
        count = sum(1 for name in rest if re.fullmatch(rf"{stem}[0-9]+", name))
        if count:
            groups[variable] = [f"{stem}{i}" for i in range(1, count + 1)]
    if not groups:
        raise UserError(
            f"{table.path}: no command; add X,Y,Z,K,M,N or f1..f8 or pwm1..pwm8 after the state"
        )
    if "voltage" in rest:
        groups["voltage"] = ["voltage"]
    wanted = [column for columns in groups.values() for column in columns]
    for column in wanted:
        if column not in rest:
            raise UserError(f"{table.path}: column `{column}` is missing beside {wanted[0]}")
    for name in rest:
        if name not in wanted:
            close = difflib.get_close_matches(name, [*_STATE, *wanted, "voltage"], 1)
            hint = f"did you mean `{close[0]}`?" if close else "remove it"
            raise UserError(
                f"{table.path}: column `{name or '(without a name)'}` is not known; {hint} "
                f"(or list it under `ignore` in {METADATA})"
            )
    return groups


def _check_time(table: Table) -> None:
    t = table[["t"]][0]
    if not np.isfinite(t).all():
        row = int(np.argmin(np.isfinite(t)))
        raise UserError(f"{table.at(row)}: column `t` is no finite number; give seconds")
    _check_range(table, ["t"], -_LATEST, _LATEST, "s")
    if t.size < 2:
        raise UserError(f"{table.path}: a single sample is no trajectory; give at least two")
    for row in (np.flatnonzero(np.diff(t) <= 0)[:1] + 1).tolist():
        kind = "repeats" if t[row] == t[row - 1] else "goes back from"
        raise UserError(
            f"{table.at(row)}: time {t[row]:g} s {kind} {t[row - 1]:g} s; "
            "sort the lines by time and remove doubles"
        )


def _check_finite(table: Table, columns: Sequence[str]) -> None:
    for column in columns:
        values = table[[column]][0]
        bad = ~np.isfinite(values)
        if bad.all() and column in _LACKABLE:
            continue
        if bad.any():
            whole = f"; only {','.join(_LACKABLE)} may lack, and then in the whole file"
            raise UserError(
                f"{table.at(int(np.argmax(bad)))}: column `{column}` has no finite number{whole}"
            )


def _check_limits(table: Table, groups: dict[str, list[str]]) -> None:
    """Refuse values beyond what any vehicle does, with the units of the files."""
    columns = {"X_WB": ["", "", "", "", *_POSITION], "V_WB_B": list(TWIST)} | groups
    for variable, names in columns.items():
        if variable in _RANGES:
            continue
        quantities = QUANTITIES[variable]
        for i, name in enumerate(names):
            quantity = quantities[i if len(quantities) > 1 else 0]
            if name:
                _check_range(table, [name], *LIMITS[quantity], variable_units(variable))


def _check_range(table: Table, columns: list[str], low: float, high: float, unit: str) -> None:
    values = table[columns]
    bad = (values < low) | (values > high)
    if bad.any():
        i, row = np.argwhere(bad)[0]
        raise UserError(
            f"{table.at(int(row))}: column `{columns[i]}` is {values[i, row]:g}; "
            f"give {low:g} to {high:g} {unit}"
        )


def _unit(table: Table) -> np.ndarray:
    q = table[_QUATERNION]
    with np.errstate(over="ignore"):  # an infinite norm is refused like any other wrong one
        norm = np.linalg.norm(q, axis=0)
    bad = np.abs(norm - 1) > _NORM
    if bad.any():
        row = int(np.argmax(bad))
        raise UserError(
            f"{table.at(row)}: qw,qx,qy,qz have length {norm[row]:.4g}; give a unit quaternion "
            "(not angles), w first"
        )
    return q / norm


# time


def _cut(run: _Run, table: Table, notes: list[str], resample: bool) -> list[_Run]:
    """Cut a run at long gaps between samples."""
    step = np.diff(run.t)
    limit = max(_GAP_STEPS * np.median(step), _GAP_S)
    if not resample:
        limit = min(limit, _FEW_STEPS * float(np.quantile(step, _USUAL)))
    edges = np.flatnonzero(step > limit) + 1
    if not edges.size:
        return [run]
    notes.append(
        f"{table.path.name}: cut at {edges.size} gap{'s' * (edges.size > 1)} of up to "
        f"{step[edges - 1].max():.1f} s."
    )
    bounds = [0, *edges.tolist(), run.t.size]
    pieces = [slice(a, b) for a, b in pairwise(bounds) if b - a > 1]
    return [
        _Run(
            run.scenario,
            run.t[part],
            run.X[:, part],
            run.V[:, part],
            {name: values[:, part] for name, values in run.commands.items()},
            None if run.voltage is None else run.voltage[part],
        )
        for part in pieces
    ]


def _step(
    folder: Path,
    times: Sequence[np.ndarray],
    rate: float | None,
    notes: list[str],
    resample: bool,
) -> float:
    """Step of the recording (s), which all runs share."""
    dt = float(np.median(np.concatenate([np.diff(t) for t in times])))
    if rate is not None:
        dt = 1.0 / rate
    elif not _SHORTEST_STEP <= dt <= _LONGEST_STEP:
        raise UserError(
            f"{folder}: steps of {dt:g} s; `t` is in seconds, and steps last {_SHORTEST_STEP:g} to "
            f"{_LONGEST_STEP:g} s"
        )
    elif abs(1.0 / dt - round(1.0 / dt)) < 1e-2:
        dt = 1.0 / round(1.0 / dt)
    longest = max(float(t[-1] - t[0]) for t in times)
    if longest > _MOST_SAMPLES * dt:
        raise UserError(
            f"{folder}: a run of {longest:g} s has more than {_MOST_SAMPLES} samples at "
            f"{1 / dt:.4g} Hz; give a lower `rate` in {METADATA}, or cut the run"
        )
    if rate is not None:
        return dt
    if resample and not all(_even(t, dt) for t in times):
        notes.append(f"Uneven time steps were resampled to {1 / dt:.4g} Hz.")
    return dt


def _even(t: np.ndarray, dt: float) -> bool:
    return bool(np.abs(t - t[0] - dt * np.arange(t.size)).max() < _UNIFORM * dt)


def _on_grid(run: _Run, dt: float) -> Trajectory:
    if _even(run.t, dt):
        X, V, commands, voltage = run.X, run.V, run.commands, run.voltage
    else:
        t = grid(run.t[0], run.t[-1], dt)
        if np.isfinite(run.X).all():
            X = geodesic(t, run.t, run.X)
        else:  # position incomplete: geodesic of the rotation, linear interpolation of the rest
            turned = slerp(t, run.t, run.X[:4])
            X = np.concatenate([turned, linear(t, run.t, run.X[4:])])
        V = linear(t, run.t, run.V)
        commands = {name: hold(t, run.t, values, dt) for name, values in run.commands.items()}
        voltage = None if run.voltage is None else linear(t, run.t, run.voltage)
    return _trajectory(_Run(run.scenario, run.t, X, V, commands, voltage), {})


def _as_recorded(run: _Run, dt: float) -> Trajectory:
    """The samples without resampling, with their times if these are not on a grid."""
    return _trajectory(run, {} if _even(run.t, dt) else {UNEVEN: run.t - run.t[0]})


def _trajectory(run: _Run, sensors: dict[str, np.ndarray]) -> Trajectory:
    if run.voltage is not None:
        sensors = {"voltage": run.voltage, **sensors}
    return Trajectory(
        run.scenario,
        run.X.T,
        run.V.T,
        {name: values.T for name, values in run.commands.items()},
        sensors,
        float(run.t[0]),
    )


# writing


def write_csv(
    recording: Recording, folder: str | os.PathLike[str], *, frames: Frames = "ENU/FLU"
) -> None:
    """Write one CSV file per trajectory and `recording.yaml`; of raw sensors only the voltage.

    Raises:
        UserError: if the folder exists and is not empty.
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
    names, rows = list(_STATE), [start + elapsed, *X[4:], *X[:4], *V]
    for name, values in commands.items():
        stem = {"thruster_force": "f", "pwm": "pwm"}.get(name)
        names += [f"{stem}{i + 1}" for i in range(len(values))] if stem else list(WRENCH)
        rows += list(values)
    voltage = trajectory.sensors.get("voltage")
    if voltage is not None and np.isfinite(voltage).all():
        names.append("voltage")
        rows.append(voltage)
    with path.open("w", encoding="utf-8", newline="\n") as out:
        out.write(",".join(names) + "\n")
        for row in zip(*rows, strict=True):
            out.write(",".join(f"{v:.12g}" if np.isfinite(v) else "" for v in row) + "\n")
