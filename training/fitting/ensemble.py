"""Several runs of one method, such as its seeds, whose steps are taken in one batched program.

One small model leaves most of a processor idle. Each run keeps its own data, minibatches, noise,
validation, recoveries and folder, which are the same as those of `fit`, so that `fit` may resume
any of them alone.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...models.dynamics import Dynamics
from ...models.files.interrupts import interrupt_noted
from ..config import TrainingConfig
from ..data.windows import Windows
from .fit import Progress, Run, TrainingResult
from .guard import TrainingError
from .step import EnsembleStep


def fit_ensemble(
    config: TrainingConfig,
    seeds: Sequence[int],
    models: Sequence[Dynamics],
    windows: Sequence[Windows],
    out_dirs: Sequence[str | Path] | None = None,
    *,
    validation: Sequence[Windows] | None = None,
    progress: Progress | None = None,
    resume: bool = False,
    metadata: dict[str, Any] | None = None,
) -> list[TrainingResult | TrainingError]:
    """Train `models[i]` on `windows[i]` with seed `seeds[i]`, all runs' steps in one program.

    A run that fails is dropped and its error takes its place in the result; `progress` receives
    the slowest run's steps and the mean loss. All else is as in `fit`.

    Raises:
        UserError: as in `fit`.
        ValueError: the models' structures differ.
    """
    if not len(seeds) == len(models) == len(windows) > 0:
        raise ValueError(f"{len(seeds)} seeds, {len(models)} models, {len(windows)} windows given")
    runs = [
        Run(
            replace(config, seed=seed),
            models[i],
            windows[i],
            None if out_dirs is None else out_dirs[i],
            None if validation is None else validation[i],
            metadata,
        )
        for i, seed in enumerate(seeds)
    ]
    step = EnsembleStep(config, runs[0].state.params, [run.static for run in runs])
    results: dict[int, TrainingResult | TrainingError] = {}
    for i, run in enumerate(runs):
        run.begin(resume)
        if run.state.step >= config.steps:
            results[i] = run.finish(stopped=False)
    with interrupt_noted() as interrupted:
        try:
            while len(results) < len(runs):
                _advance(step, runs, results)
                steps = [run.state.step for i, run in enumerate(runs) if i not in results]
                if progress is not None:
                    progress(min(steps, default=config.steps), config.steps, _mean_loss(runs))
                if interrupted.is_set():
                    raise KeyboardInterrupt
        except KeyboardInterrupt:
            for i, run in enumerate(runs):
                if i not in results:
                    run.checkpoint()
            raise
    return [results[i] for i in range(len(runs))]


def _advance(
    step: EnsembleStep, runs: list[Run], results: dict[int, TrainingResult | TrainingError]
) -> None:
    """One step of every active run; the result of a run that ends or fails goes to `results`."""
    plans = {i: run.plan() for i, run in enumerate(runs) if i not in results}
    filler = next(iter(plans.values()))  # takes an ended run's place, so that shapes stay the same
    done = step([plans.get(i, filler) for i in range(len(runs))])
    for i, plan in plans.items():
        run = runs[i]
        try:
            stopped = run.take(plan, *done[i])
        except TrainingError as error:
            results[i] = error
            continue
        if stopped or run.state.step >= run.config.steps:
            results[i] = run.finish(stopped)


def _mean_loss(runs: list[Run]) -> float:
    return sum(run.loss for run in runs) / len(runs)
