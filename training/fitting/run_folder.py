"""A training run on disk: checkpoint, metrics, settings, all safe if the process is killed."""

import csv
import dataclasses
import io
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...models.config import typed_yaml as yaml
from ...models.config.errors import UserError
from ...models.files.archive import read_archive
from ...models.files.atomic import atomic_path, disk_errors_told
from ...models.files.owned import FolderKind, claim
from ..config import TrainingConfig

TRAINING = FolderKind(
    "training",
    (
        "checkpoint.npz",
        "metrics.csv",
        "config.yaml",
        "run.json",
        "model.spinn",
        "start.spinn",
        "preset.spinn",
        "evaluation.csv",
        "evaluation.json",
        "report.html",
    ),
)
"""Files that `spinndrift train` writes, including those of `fit`."""
_MAY_DIFFER = ("steps", "patience", "max_recoveries", "checkpoint_every")


class CheckpointError(UserError):
    """A checkpoint that can't be resumed: damaged, or of other settings or data."""


@dataclass(frozen=True)
class _Event:
    """A recovery at a step, for the report."""

    step: int
    text: str


@dataclass
class TrainState:
    """Mutable state of a run. Trees hold arrays only; `events` are the recoveries."""

    params: Any
    moments: Any
    objective: Any
    best: Any
    step: int = 0
    best_value: float = float("inf")
    best_step: int = 0
    stale: int = 0
    rate_scale: float = 1.0
    excluded: list[int] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0

    _TREES = ("params", "moments", "objective", "best")
    _PLAIN = (
        "step",
        "best_value",
        "best_step",
        "stale",
        "rate_scale",
        "excluded",
        "events",
        "seconds",
    )

    def arrays(self) -> list[np.ndarray]:
        """Copies of all arrays, in a fixed order."""
        trees = [eqx.filter(getattr(self, name), eqx.is_array) for name in self._TREES]
        return [np.array(leaf) for leaf in jax.tree.leaves(trees)]

    def plain(self) -> dict[str, Any]:
        """Everything else, as JSON."""
        values = {name: getattr(self, name) for name in self._PLAIN}
        return values | {"best_value": values["best_value"].hex()}

    def fill(self, arrays: list[np.ndarray], plain: dict[str, Any]) -> None:
        """Restore the results of `arrays` and `plain` of a state of equal structure.

        Raises:
            ValueError: number, shape or type of the arrays differ.
        """
        trees = [getattr(self, name) for name in self._TREES]
        dynamic, static = eqx.partition(trees, eqx.is_array)
        leaves, treedef = jax.tree.flatten(dynamic)
        if [(a.shape, a.dtype) for a in leaves] != [(a.shape, a.dtype) for a in arrays]:
            raise ValueError("the checkpoint's arrays are not those of this model and objective")
        filled = jax.tree.unflatten(treedef, [jnp.array(a) for a in arrays])
        for name, tree in zip(self._TREES, eqx.combine(filled, static), strict=True):
            setattr(self, name, tree)
        for name in self._PLAIN:
            setattr(self, name, plain[name])
        self.best_value = float.fromhex(plain["best_value"])


@dataclass(frozen=True)
class _Plain:
    """Schema of `TrainState.plain`."""

    step: int
    best_value: str
    best_step: int
    stale: int
    rate_scale: float
    excluded: list[int]
    events: list[_Event]
    seconds: float

    def __post_init__(self) -> None:
        float.fromhex(self.best_value)
        counts = (self.step, self.best_step, self.stale, *self.excluded)
        if min(counts) < 0 or not self.rate_scale > 0 or self.seconds < 0:
            raise ValueError("a count, rate or time below zero")


class RunFolder:
    """The files of one run: checkpoint.npz, metrics.csv, config.yaml, run.json, model.spinn."""

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.checkpoint = self.path / "checkpoint.npz"
        self.metrics = self.path / "metrics.csv"
        self.model = self.path / "model.spinn"

    def begin(self, config: TrainingConfig, provenance: dict[str, Any]) -> None:
        """Write settings and provenance before the first step.

        Raises:
            UserError: the folder holds files that this package did not write.
        """
        claim(self.path, TRAINING)
        for name, text in (
            ("config.yaml", yaml.dump(config)),
            ("run.json", json.dumps(provenance, indent=2) + "\n"),
        ):
            with atomic_path(self.path / name) as partial:
                partial.write_text(text, encoding="utf-8")

    def save(self, state: TrainState, config: TrainingConfig, data: str) -> None:
        """Write the checkpoint atomically: the previous one stays until this one is complete."""
        header = {"state": state.plain(), "config": yaml.dump(config), "data": data}
        text = np.frombuffer(json.dumps(header).encode(), np.uint8)
        arrays: dict[str, Any] = {f"array_{i:04d}": a for i, a in enumerate(state.arrays())}
        with atomic_path(self.checkpoint) as partial, partial.open("wb") as handle:
            np.savez(handle, header=text, **arrays)

    def load(self, state: TrainState, config: TrainingConfig, data: str) -> None:
        """Fill `state` from the checkpoint of the same settings and data.

        Raises:
            CheckpointError: the checkpoint is damaged, or of other settings or data.
        """
        try:
            header, arrays = read_archive(self.checkpoint, "checkpoint")
        except UserError as error:
            raise CheckpointError(f"{error} Or start anew without resume.") from error
        try:
            made = yaml.loads(TrainingConfig, str(header.get("config")), "settings")
            _check_same(made, config)
            if header.get("data") != data:
                raise UserError("it was trained on other windows; resume with the same data")
            plain = yaml.structured(_Plain, header.get("state"), "state")
            state.fill(arrays, dataclasses.asdict(plain))
        except ValueError as error:
            raise CheckpointError(
                f"{self.checkpoint}: no checkpoint of this run ({error}); start anew without resume"
            ) from error

    def begin_metrics(self, step: int) -> None:
        """Keep the rows before `step` (a killed run may have written more, or part of a row)."""
        kept = []
        if step > 0 and self.metrics.exists():
            text = self.metrics.read_text(encoding="utf-8", errors="replace")
            whole = text[: text.rfind("\n") + 1]
            rows = list(csv.reader(io.StringIO(whole)))
            kept = rows[:1] + [
                row for row in rows[1:] if len(row) == len(rows[0]) and int(row[0]) < step
            ]
        with atomic_path(self.metrics) as partial, partial.open("w", newline="") as handle:
            csv.writer(handle, lineterminator="\n").writerows(kept)

    def append_metrics(self, rows: list[dict[str, Any]]) -> None:
        """Append rows with one write; with the first row the header is written."""
        if not rows:
            return
        new = not self.metrics.exists() or self.metrics.stat().st_size == 0
        text = io.StringIO()
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerows(rows)
        before = 0 if new else self.metrics.stat().st_size
        with disk_errors_told(self.metrics):
            try:
                with self.metrics.open("a", encoding="utf-8", newline="") as handle:
                    handle.write(text.getvalue())
            except OSError:
                if self.metrics.exists():
                    os.truncate(self.metrics, before)  # remove partly written rows
                raise

    def read_metrics(self) -> dict[str, np.ndarray]:
        """Columns by name; empty cells are NaN."""
        if not self.metrics.exists():
            return {}
        with self.metrics.open(encoding="utf-8", newline="") as handle:
            rows = list(csv.DictReader(handle))
        names = list(rows[0]) if rows else []
        return {n: np.array([float(row[n]) if row[n] else np.nan for row in rows]) for n in names}


def _check_same(old: TrainingConfig, new: TrainingConfig) -> None:
    for name in TrainingConfig.__dataclass_fields__:
        if name not in _MAY_DIFFER and getattr(old, name) != getattr(new, name):
            raise UserError(
                f"{name} is {getattr(old, name)!r} there and {getattr(new, name)!r} now; resume "
                "with equal settings or start anew"
            )
