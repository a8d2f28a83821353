"""A study from its settings to its pages."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...models.config import typed_yaml as yaml
from ...models.config.errors import UserError
from ...models.files.atomic import atomic_path
from ...models.files.owned import FolderKind, claim
from ...training.data.maneuvers import MANEUVERS
from ..fanout import Failed, check_workers, run_here, run_on_cluster
from ..progress import Update
from .config import REGIMES, StudyConfig
from .judge import check_vehicles
from .task import Task
from .work import run_task

STUDY = FolderKind(
    "study",
    (
        "study.yaml",
        "table.csv",
        "summary.csv",
        *(f"{regime}.nc" for regime in REGIMES),
        *(f"{name}.png" for name in ("results", "diffusion", "training")),
        *(f"distributions-{name}.png" for name in MANEUVERS),
        "report.html",
        "ablation.md",
    ),
)
"""Files that a study writes in addition to the folders of its runs."""


@dataclass(frozen=True)
class StudyWork:
    """The function sent to workers: the study's settings and folder; a call runs a task."""

    study: StudyConfig
    out: str

    def __call__(
        self, task: Task, progress: Update = lambda fraction, remark="", /: None, /
    ) -> None:
        run_task(self.study, task, self.out, progress)


def run_study(
    study: StudyConfig,
    tasks: Sequence[Task],
    out: str | os.PathLike[str],
    progress: Update,
    *,
    cluster: str | None = None,
    workers: int = 0,
) -> list[Failed]:
    """Run all tasks that are not done yet, and return those that raised.

    In this process one by one; with `workers` in as many processes of this machine; with `cluster`
    on the workers of the scheduler at this address. The settings are written to `study.yaml`.

    Raises:
        UserError: settings are wrong, or `out` holds runs of other settings.
    """
    check_vehicles(study)
    check_workers(cluster, workers)
    folder = Path(out).absolute()
    left = []
    for task in tasks:
        runs = task.runs(study, folder)
        for run in runs:
            run.check()
        if not all(run.done for run in runs):
            left.append(task)
    claim(folder, STUDY)
    with atomic_path(folder / "study.yaml") as partial:
        partial.write_text(yaml.dump(study), encoding="utf-8")
    if not left:
        return []
    work = StudyWork(study, str(folder))
    if cluster is None and workers == 0:
        return run_here(work, left, progress)
    failed = run_on_cluster(work, left, progress, address=cluster, workers=workers)
    lost = {id(f.task) for f in failed}
    for task in left:
        if id(task) not in lost and not all(run.done for run in task.runs(study, folder)):
            raise UserError(
                f"{folder}: workers finished {task}, but it is not there; give --out a folder "
                "that this machine and all workers share"
            )
    return failed
