"""A worker's processing of one task: data, training, evaluation, results on disk."""

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import jax

from ...models.files.netcdf import save_netcdf
from ...training.data.provenance import revision, versions
from ...training.evaluation.law_metrics import overall
from ..compile_cache import keep_compiled
from ..progress import Update
from .config import StudyConfig
from .judge import judge, shown_motions
from .task import RunPath, Task
from .train import Data, Trained, make_data, train_seeds

_DATA, _TRAINING = 0.03, 0.82  # approximate share of the time until data and training are done


def run_task(
    study: StudyConfig,
    task: Task,
    out: str,
    progress: Update = lambda fraction, remark="", /: None,
) -> None:
    """Complete a task; returns when every run of it has its folder.

    Finished runs are kept; an interrupted one resumes from its last checkpoint. A failed training
    is a result too.

    Raises:
        UserError: the folders hold files of other settings.
    """
    jax.config.update("jax_enable_x64", True)  # a cluster's worker does not run the CLI's start-up
    keep_compiled()
    runs = [run for run in task.runs(study, out) if not run.done]
    with ExitStack() as stack:
        for run in runs:
            stack.enter_context(run.held())
            run.check()
        runs = [run for run in runs if not run.done]  # another process may have done some
        if not runs:
            return
        began = time.monotonic()
        folders = [run.begin() for run in runs]
        progress(0.0, f"{task}: simulating")
        data = [make_data(run.settings) for run in runs]
        seconds = {"data": time.monotonic() - began}
        trained = train_seeds(
            [run.settings for run in runs],
            data,
            [folder / "training" for folder in folders],
            lambda fraction, remark="": progress(
                _DATA + (_TRAINING - _DATA) * fraction, f"{task}: {remark}"
            ),
        )
        for i, (run, one, windows) in enumerate(zip(runs, trained, data, strict=True)):

            def report(fraction: float, remark: str = "", done: int = i) -> None:
                done_here = (done + fraction) / len(runs)
                progress(_TRAINING + (1 - _TRAINING) * done_here, f"{task}: {remark}")

            _finish(run, one, windows, folders[i], seconds, report)


def _finish(
    run: RunPath,
    trained: Trained,
    data: Data,
    folder: Path,
    seconds: dict[str, float],
    progress: Update,
) -> None:
    """Evaluate the learned model, write the results, and give the folder its final name."""
    settings, began = run.settings, time.monotonic()
    study, substeps = settings.study, settings.training.objective.substeps
    metrics: dict[str, Any] = {}
    diffusion: dict[str, Any] = {}
    if trained.model is not None:
        compared, diffusion = judge(
            trained.model, study, settings.regime, settings.seed, substeps, progress
        )
        metrics = overall(compared)
        save_netcdf(compared.astype("float32"), folder / "metrics.nc")
        if settings.seed == 0:
            motions = shown_motions(trained.model, study, settings.regime, settings.seed, substeps)
            if motions is not None:
                save_netcdf(motions, folder / "motions.nc")
    bounded = bool(metrics) and metrics["finite"]["value"] == 1.0
    result = trained.result
    run.finish(
        {
            "regime": settings.regime,
            "method": settings.method,
            "seed": settings.seed,
            "success": trained.converged and bounded,
            "trained": trained.result is not None,
            "finite": trained.finite and bounded,
            "converged": trained.converged,
            "failure": trained.failure,
            "windows": len(data.learn),
            "steps": 0 if result is None else result.steps,
            "best_step": 0 if result is None else result.best_step,
            "bad_steps": 0 if result is None else len(result.events),
            "seconds": {
                **seconds,
                "training": trained.seconds,
                "judging": time.monotonic() - began,
            },
            "metrics": metrics,
            "diffusion": diffusion,
            "revision": revision(),
            "versions": versions(),
        }
    )
