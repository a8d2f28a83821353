"""The documented CSV form: a file a run, `recording.yaml` beside; docs/recording.md is its page."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .simulator import Truth

STATE = ["x", "y", "z", "qw", "qx", "qy", "qz", "u", "v", "w", "p", "q", "r"]
WRENCH = ["X", "Y", "Z", "K", "M", "N"]


@dataclass(frozen=True)
class Run:
    """One run as an instrument would log it; columns by name, each (N,)."""

    scenario: str
    columns: dict[str, np.ndarray]


def runs(
    truth: Truth,
    names: Sequence[str],
    form: str,
    commands: np.ndarray,
    volts: np.ndarray | None = None,
) -> list[Run]:
    """Runs of a simulation in the columns of the CSV form.

    `form` tells what `commands` (N, n or 6, B) are: f, pwm or wrench; `volts` (B,) fills the column
    `voltage`.
    """
    stems = WRENCH if form == "wrench" else [f"{form}{i + 1}" for i in range(commands.shape[1])]
    out = []
    for b, name in enumerate(names):
        X, V = truth.X[:, :, b], truth.V[:, :, b]
        values = np.concatenate([X[:, 4:], X[:, :4], V], axis=1)
        columns = {"t": truth.t[:, b]}
        columns |= {key: values[:, i] for i, key in enumerate(STATE)}
        columns |= {key: commands[:, i, b] for i, key in enumerate(stems)}
        if volts is not None:
            columns["voltage"] = np.full(truth.t.shape[0], volts[b])
        out.append(Run(name, columns))
    return out


def write_folder(
    folder: Path, logged: list[Run], vehicle: str = "bluerov2_heavy", rate: float | None = None
) -> None:
    """Write a new folder; nothing in it tells what is hidden."""
    folder.mkdir(parents=True)
    lines = ["frames: ENU/FLU", f"vehicle: {vehicle}"]
    lines += [f"rate: {rate:g}"] if rate else []
    lines += ["source: simulated", "files:"]
    for i, run in enumerate(logged):
        name = f"run_{i + 1:03d}.csv"
        lines.append(f'  {name}: "{run.scenario}"')
        write_run(folder / name, run)
    (folder / "recording.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_run(path: Path, run: Run) -> None:
    columns = list(run.columns.values())
    form = ",".join("%.10g" for _ in columns)
    rows = np.stack(columns, axis=1).tolist()
    text = "\n".join([",".join(run.columns), *(form % tuple(row) for row in rows)]) + "\n"
    path.write_text(text.replace("nan", ""), encoding="utf-8")


def change(run: Run, **columns: np.ndarray) -> Run:
    return replace(run, columns=run.columns | columns)
