"""All settings, sequentially or distributed over processes; finished ones are kept."""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ...models.config import typed_yaml
from ...models.config.errors import UserError
from ...models.files.atomic import atomic_path
from ...models.files.owned import FolderKind
from ...training.data.provenance import revision
from ..compile_cache import give_back_programs, keep_compiled
from ..fanout import Failed, run_here, run_on_cluster
from ..progress import Update
from ..run.loop import Engine, simulate_seeds
from .scores import Scores, score, stacked
from .settings import Setting, setting_files

ESTIMATOR = FolderKind(
    "check of the estimator", ("estimator.md", *setting_files()), edited=("estimator.md",)
)
"""Files that a check writes, in addition to the folder of the demo's model."""


@dataclass(frozen=True)
class Result:
    """The result of a setting: scores of all its runs, and the revision that made them."""

    setting: Setting
    scores: Scores
    revision: str


@dataclass(frozen=True)
class FlySetting:
    """Simulates a setting with its seeds, and writes its scores atomically.

    Attributes:
        out: folder; the file is `<table>/<name>.npz`.
        runs: of each setting, by its table.
        revision: of the sources.
        engine: as in `sims.run.loop.simulate`.
    """

    out: str
    runs: dict[str, int]
    revision: str = ""
    engine: Engine = "auto"

    def path(self, setting: Setting) -> Path:
        """The file of a setting."""
        return Path(self.out) / setting.table / f"{setting.name}.npz"

    def __call__(
        self, setting: Setting, progress: Update = lambda fraction, remark="", /: None
    ) -> None:
        """Simulate and score; one program for all seeds."""
        jax.config.update("jax_enable_x64", True)  # a worker does not run the CLI's start-up
        jax.config.update("jax_cpu_enable_async_dispatch", False)
        keep_compiled()
        give_back_programs()
        count, found = self.runs[setting.table], []

        def report(fraction: float, remark: str) -> None:
            # zero would mean a new start
            progress(max(1e-6, (len(found) + fraction) / count), f"{setting}: {remark}")

        seeds = setting.seeds(count)
        for run in simulate_seeds(setting.scenario, seeds, report, self.engine):
            if run.outcome.reason == "interrupted":
                raise KeyboardInterrupt
            found.append(score(run, setting.scenario.duration / 3))
        made = self._made(setting) | {"revision": self.revision}
        with atomic_path(self.path(setting)) as partial, partial.open("wb") as file:
            arrays: dict[str, Any] = {"made": np.array(json.dumps(made)), **stacked(found)}
            np.savez_compressed(file, **arrays)

    def result(self, setting: Setting) -> Result | None:
        """The stored result, None if there is none.

        Raises:
            UserError: the file is of other settings, or not a result.
        """
        at = self.path(setting)
        if not at.exists():
            return None
        try:
            with np.load(at, allow_pickle=False) as file:
                scores = {name: file[name] for name in file.files}
            made = json.loads(str(scores.pop("made")))
            flown = made.pop("revision")
        except (OSError, ValueError, KeyError, EOFError, AttributeError) as error:
            raise UserError(f"{at}: is no result of a check; remove it to fly it again") from error
        if made != self._made(setting):
            raise UserError(
                f"{at}: was flown with other settings (runs, time, model or defaults); name "
                "another --out, or remove it"
            )
        return Result(setting, scores, flown)

    def _made(self, setting: Setting) -> dict[str, Any]:
        model, seeds = setting.scenario.station.model, setting.seeds(self.runs[setting.table])
        return {
            "scenario": typed_yaml.dump(setting.scenario),
            "seeds": [seeds.start, seeds.stop],
            "model": "" if model is None else hashlib.sha256(model.read_bytes()).hexdigest(),
        }


def run_settings(
    settings: Sequence[Setting],
    out: str | os.PathLike[str],
    runs: dict[str, int],
    progress: Update,
    workers: int = 0,
    engine: Engine = "auto",
) -> tuple[list[Result], list[Failed]]:
    """Simulate the settings that have no stored result; all results, and failed settings.

    In this process one by one, or with `workers` in as many processes of this machine.

    Raises:
        UserError: a stored result is of other settings.
    """
    work = FlySetting(str(Path(out).absolute()), runs, revision() or "", engine)
    left = [setting for setting in settings if work.result(setting) is None]
    failed = []
    if left and workers == 0:
        failed = run_here(work, left, progress)
    elif left:
        failed = run_on_cluster(work, left, progress, workers=workers)
    progress(1.0, "")
    return [found for one in settings if (found := work.result(one)) is not None], failed
