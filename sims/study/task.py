"""One task of a study and its folders: complete or absent, locked while running, resumable."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...models.config import typed_yaml as yaml
from ...models.config.errors import UserError
from ...models.files.atomic import atomic_path
from ...models.files.locks import locked
from ...models.files.owned import FolderKind, check_folder, claim, finish, sweep
from ...training.config import TrainingConfig
from ...training.methods import METHODS, method_config
from .config import REGIMES, Regime, StudyConfig

SEED = FolderKind("run of a study", ("settings.yaml", "result.json", "metrics.nc", "motions.nc"))


@dataclass(frozen=True)
class Task:
    """The runs of one method on one regime for some seeds, processed together by one worker."""

    regime: Regime
    method: str
    seeds: tuple[int, ...]

    def __str__(self) -> str:
        seeds = ", ".join(map(str, self.seeds))
        return f"{self.regime} {self.method} seed{'s' * (len(self.seeds) > 1)} {seeds}"

    def runs(self, study: StudyConfig, out: str | os.PathLike[str]) -> "list[RunPath]":
        """The paths of its runs.

        Raises:
            UserError: there is no such method.
        """
        settings = (RunSettings.of(study, self.regime, self.method, s) for s in self.seeds)
        return [RunPath(out, one) for one in settings]


@dataclass(frozen=True)
class RunSettings:
    """All settings that determine the results of one run; stored with them as settings.yaml."""

    regime: Regime
    method: str
    seed: int
    study: StudyConfig
    training: TrainingConfig

    @classmethod
    def of(cls, study: StudyConfig, regime: Regime, method: str, seed: int) -> "RunSettings":
        """The settings of a run.

        Raises:
            UserError: there is no such method.
        """
        return cls(regime, method, seed, study, study.size.apply(method_config(method), seed))


def make_tasks(
    regimes: tuple[Regime, ...], methods: tuple[str, ...], seeds: int, together: int = 1
) -> list[Task]:
    """All tasks of a study, `together` seeds each; one seed of every method comes first.

    Raises:
        UserError: a method or regime is unknown, or a number is below 1.
    """
    for name in methods:
        if name not in METHODS:
            raise UserError(f"method '{name}' is unknown; take some of {', '.join(METHODS)}")
    for name in regimes:
        if name not in REGIMES:
            raise UserError(f"regime '{name}' is unknown; take some of {', '.join(REGIMES)}")
    for option, number in (("seeds", seeds), ("together", together)):
        if number < 1:
            raise UserError(f"--{option} {number}: give at least 1")
    starts = range(0, seeds, together)
    return [
        Task(regime, method, tuple(range(first, min(first + together, seeds))))
        for first in starts
        for regime in dict.fromkeys(regimes)
        for method in dict.fromkeys(methods)
    ]


class RunPath:
    """The folders of one run: `final` once it is done, `partial` until then.

    `final` holds settings.yaml, result.json, metrics.nc, motions.nc (first seed) and training/.
    """

    def __init__(self, out: str | os.PathLike[str], settings: RunSettings):
        self.settings = settings
        parent = Path(out) / settings.regime / settings.method
        self.final = parent / f"seed-{settings.seed}"
        self.partial = parent / f".seed-{settings.seed}.partial"
        self._lock = parent / f".seed-{settings.seed}.lock"

    @property
    def done(self) -> bool:
        """Whether the run is complete."""
        return (self.final / "result.json").exists()

    def check(self) -> None:
        """Check that the folders hold no results of other settings and no foreign files.

        Raises:
            UserError: naming the folder, and the first setting that differs.
        """
        for folder in (self.final, self.partial):
            check_folder(folder, SEED)
            path = folder / "settings.yaml"
            if not path.exists():
                continue
            there, here = path.read_text("utf-8"), yaml.dump(self.settings)
            if there != here:
                raise UserError(
                    f"{folder}: was made with other settings ({_difference(there, here)}); name "
                    "another folder with --out, or remove this one"
                )
        if not self.done and self.final.is_dir() and any(self.final.iterdir()):
            raise UserError(f"{self.final}: lacks its result.json; move the folder away")

    @contextmanager
    def held(self) -> Iterator[None]:
        """Lock this run against other processes; waits while a live process holds it."""
        self._lock.parent.mkdir(parents=True, exist_ok=True)
        with locked(self._lock, None):
            yield

    def begin(self) -> Path:
        """The working folder, with the files of an interrupted attempt.

        Raises:
            UserError: it holds files of other settings.
        """
        self.check()
        claim(self.partial, SEED)
        for folder in (self.partial, self.partial / "training"):
            sweep(folder)
        with atomic_path(self.partial / "settings.yaml") as path:
            path.write_text(yaml.dump(self.settings), encoding="utf-8")
        return self.partial

    def finish(self, result: dict[str, Any]) -> None:
        """Write result.json and give the folder its final name."""
        with atomic_path(self.partial / "result.json") as path:
            path.write_text(json.dumps(_plain(result), indent=2) + "\n", encoding="utf-8")
        finish(self.partial, SEED)
        os.replace(self.partial, self.final)


def _difference(there: str, here: str) -> str:
    for old, new in zip(there.splitlines(), here.splitlines(), strict=False):
        if old != new:
            return f"'{old.strip()}' there, '{new.strip()}' now"
    return "one has more of them"


def _plain(value: Any) -> Any:
    """JSON has no NaN: numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not abs(value) < float("inf"):
        return None
    return value
