"""The training stage of a task: data, initial model and fit of every seed, and their success."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...models.config.errors import UserError
from ...models.dynamics import Dynamics
from ...models.files.checkpoint import load_model, save_model
from ...models.files.owned import claim
from ...models.vehicles.vehicle import load_vehicle
from ...training.config import TrainingConfig
from ...training.data.generate import generate
from ...training.data.windows import Windows, make_windows
from ...training.fitting.ensemble import fit_ensemble
from ...training.fitting.fit import Progress, TrainingResult, fit
from ...training.fitting.guard import TrainingError, not_finite
from ...training.fitting.run_folder import TRAINING
from ...training.fitting.start import starting_model
from ..progress import Update
from .task import RunSettings

_DRIFT = 0.2  # approximate share of the time for the initial fit of the drift alone


@dataclass(frozen=True)
class Data:
    """Training windows, and validation windows of other trajectories to select the best step."""

    learn: Windows
    validation: Windows


@dataclass(frozen=True)
class Trained:
    """The result of training.

    Attributes:
        model: the best one on the validation windows; None if training failed.
        result: the result of `fit`.
        failure: why training failed, or empty.
        finite: whether training completed with finite parameters.
        converged: whether it is `finite` and the loss `descended`.
        seconds: wall time of the stage (of a resumed run, of the last attempt); runs of one batch
            share it equally.
    """

    model: Dynamics | None
    result: TrainingResult | None
    failure: str
    finite: bool
    converged: bool
    seconds: float


def descended(loss: np.ndarray, refit_at: tuple[float, ...] = ()) -> bool:
    """Whether the loss at the end is no higher than at the start, within its scatter.

    It compares the medians of the last and of the first tenth of the steps since the last fraction
    of `refit_at` (where bandwidths, and so the loss' scale, changed); the end may be higher by the
    scatter (median absolute deviation) of that first tenth. Steps with a loss that is not finite
    are left out; if they are more than half, the result is False.
    """
    first = round(max(refit_at, default=0.0) * len(loss))
    kept = loss[first:]
    good = kept[np.isfinite(kept)]
    if good.size < max(2, len(kept) / 2):
        return False
    tenth = max(1, good.size // 10)
    start, end = good[:tenth], good[-tenth:]
    scatter = np.median(np.abs(start - np.median(start)))
    return bool(np.median(end) <= np.median(start) + scatter)


def make_data(settings: RunSettings) -> Data:
    """One seed's simulated trajectories, as windows.

    Raises:
        UserError: they are too short or too few.
    """
    study, windows = settings.study, settings.training.windows
    vehicle = load_vehicle(study.truth.vehicle)
    config = study.regime(settings.regime).generate_config(study.truth, settings.seed)
    learn, validation = generate(config, vehicle).split(study.validation, "run", windows.gap_s)

    def cut(part, stride: float) -> Windows:
        return make_windows(
            part,
            vehicle,
            length_s=windows.length_s,
            stride_s=stride,
            normalise=windows.normalise,
        )

    return Data(cut(learn, windows.stride_s), cut(validation, windows.length_s))


def train_seeds(
    settings: Sequence[RunSettings],
    data: Sequence[Data],
    folders: Sequence[Path],
    progress: Update,
) -> list[Trained]:
    """Train the runs of one task, several seeds in one batched program
    (`training.fitting.ensemble`).

    Each resumes from the initial model and checkpoint in its folder; those are made sequentially.
    """
    belief = load_vehicle(settings[0].study.belief)
    began, count = time.monotonic(), len(settings)
    starts: list[Dynamics | str] = []
    for number, (one, windows) in enumerate(zip(settings, data, strict=True)):

        def started(step: int, total: int, loss: float, done: int = number) -> None:
            progress(_DRIFT * (done + step / total) / count, "drift first")

        claim(folders[number], TRAINING)
        kept = folders[number] / "start.spinn"
        if kept.exists():
            starts.append(load_model(kept)[0])
            continue
        try:
            start = starting_model(one.training, belief, windows.learn, started)
        except UserError as error:
            starts.append(str(error))
            continue
        save_model(kept, start)
        starts.append(start)

    def stepped(step: int, total: int, loss: float) -> None:
        progress(_DRIFT + (1 - _DRIFT) * step / total, f"loss {loss:.3g}")

    good = [i for i, start in enumerate(starts) if not isinstance(start, str)]
    fitted = _fit(
        [(settings[i].training, starts[i], data[i], folders[i]) for i in good],
        {"vehicle": belief.name, "substeps": settings[0].training.objective.substeps},
        stepped,
    )
    ends: list[TrainingResult | str] = [start if isinstance(start, str) else "" for start in starts]
    for i, end in zip(good, fitted, strict=True):
        ends[i] = end
    seconds = (time.monotonic() - began) / count
    return [_trained(end, one.training, seconds) for end, one in zip(ends, settings, strict=True)]


def _fit(
    runs: Sequence[tuple[TrainingConfig, Any, Data, Path]],
    metadata: dict[str, Any],
    progress: Progress,
) -> list[TrainingResult | str]:
    """Results, or why training failed: that a method can't be trained is a result too."""
    if len(runs) > 1:
        configs, models, data, folders = zip(*runs, strict=True)
        try:
            found = fit_ensemble(
                configs[0],
                [config.seed for config in configs],
                models,
                [d.learn for d in data],
                folders,
                validation=[d.validation for d in data],
                progress=progress,
                resume=True,
                metadata=metadata,
            )
            return [str(end) if isinstance(end, TrainingError) else end for end in found]
        except UserError:
            pass  # one of them is at fault: run them one by one to find it
    ends: list[TrainingResult | str] = []
    for config, model, windows, folder in runs:
        try:
            ends.append(
                fit(
                    config,
                    model,
                    windows.learn,
                    folder,
                    validation=windows.validation,
                    progress=progress,
                    resume=True,
                    metadata=metadata,
                )
            )
        except (TrainingError, UserError) as error:
            if str(error).startswith(str(folder)):  # files at fault, not the method
                raise
            ends.append(str(error))
    return ends


def _trained(end: TrainingResult | str, config: TrainingConfig, seconds: float) -> Trained:
    if isinstance(end, str):
        return Trained(None, None, end, False, False, seconds)
    finite = not not_finite(end.last)
    converged = finite and descended(end.metrics["loss"], config.refit_at)
    return Trained(end.model, end, "", finite, converged, seconds)
