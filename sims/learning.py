"""From a recording to a learned model, evaluated on held-out data."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeGuard

import jax.numpy as jnp
import numpy as np
import xarray as xr

from ..models.config.errors import UserError
from ..models.dynamics import Dynamics
from ..models.effects.extended import Extended, core
from ..models.files.checkpoint import load_model, save_model
from ..models.files.owned import claim
from ..models.integrate import cast
from ..models.recordings.store import Recording
from ..models.rigid_body import FossenDynamics
from ..models.spinn import Spinn
from ..models.vehicles.places import named_in
from ..models.vehicles.vehicle import Vehicle
from ..training.config import TrainingConfig, WindowConfig
from ..training.data.windows import Windows, make_windows, windowing
from ..training.evaluation.evaluate import Evaluation, evaluate
from ..training.fitting.calibrate import calibrated
from ..training.fitting.fit import TrainingResult, fit
from ..training.fitting.hidden_start import HiddenStart
from ..training.fitting.run_folder import TRAINING
from ..training.fitting.start import begun_with, estimate_diffusion, starting_model, with_diffusion
from ..training.smoothing.complete import Completed, not_completed_by
from ..training.smoothing.fitted import Told, completed_as_it_is
from ..training.smoothing.levels import Levels

FINE_SUBSTEPS = 5
"""Steps per sample for models without a trained step of their own, such as presets."""
_VALIDATION = 0.15
Progress = Callable[[float, str], None]
_DRIFT = 0.2  # approximate share of the time for the initial fit of the drift alone


@dataclass(frozen=True)
class Parts:
    """Windows for training, for selecting the best step, and held out for the evaluation."""

    learn: Windows
    validation: Windows | None
    held_out: Windows


@dataclass(frozen=True)
class Learned:
    """The result of training on a recording."""

    model: Dynamics
    preset: Dynamics
    parts: Parts
    result: TrainingResult
    evaluation: Evaluation
    substeps: int
    """Integration steps per sample in training."""
    told: tuple[Told, ...] = ()
    """What data without some channels tell of each coefficient of a constant model."""


@dataclass(frozen=True)
class Start:
    """A model that training starts from instead of the preset.

    Attributes:
        model: a Fossen model, a SPINN, or either with effects.
        substeps: integration steps per sample for it.
        name: of it in the evaluation.
    """

    model: Dynamics
    substeps: int = FINE_SUBSTEPS
    name: str = "start"

    @classmethod
    def read(cls, path: Path) -> tuple["Start", dict[str, Any]]:
        """From a model file, with its metadata.

        Raises:
            UserError: the file is not a model.
        """
        model, metadata = load_model(path, dtype=jnp.float32)
        if named := metadata.get("vehicle"):
            metadata = {**metadata, "vehicle": named_in(named, path.parent)}
        return cls(model, int(metadata.get("substeps", FINE_SUBSTEPS))), metadata


def split_parts(
    recording: Recording,
    vehicle: Vehicle,
    config: WindowConfig,
    model: Dynamics | None = None,
    completed: Callable[[Recording], Completed] | None = None,
) -> Parts:
    """Split a recording into parts that do not overlap in time in any run (`Recording.split`).

    `model` is to be trained or evaluated on them. Each part is `completed` by itself, if it lacks
    channels.

    Raises:
        UserError: it is too short for training windows and held-out windows.
    """

    def cut(part: Recording, stride: float, name: str) -> Windows:
        longest = (part.lengths.max() - 1) * part.dt
        if longest < config.length_s - part.dt / 2:
            raise UserError(
                f"{name} part of the data: its longest piece lasts {longest:.3g} s, and a window "
                f"is {config.length_s:g} s long; record longer runs, or give a shorter "
                "`windows: {length_s: …}` in the settings (`spinndrift train --config`)"
            )
        try:
            return make_windows(
                part,
                vehicle,
                length_s=config.length_s,
                stride_s=stride,
                completed=None if completed is None else completed(part),
                **windowing(model, config.normalise),
            )
        except UserError as error:
            raise UserError(f"{name} part of the data: {error}") from error

    first, middle, last = split_recording(recording, config)
    held_out = cut(last, config.length_s, "held-out")
    validation = None if middle is None else cut(middle, config.stride_s, "validation")
    return Parts(cut(first, config.stride_s, "training"), validation, held_out)


def split_recording(
    recording: Recording, config: WindowConfig
) -> tuple[Recording, Recording | None, Recording]:
    """The parts for training, for selecting the best step and calibrating bands, and held out.

    With too little data for validation windows there is no second part: the first one has all.
    """
    rest, last = recording.split(config.held_out, config.by, config.gap_s)
    try:
        first, middle = rest.split(_VALIDATION, config.by, config.gap_s)
    except UserError:
        return rest, None, last
    if (middle.lengths.max() - 1) * middle.dt < config.length_s - middle.dt / 2:
        return rest, None, last
    return first, middle, last


def compare(
    models: Mapping[str, tuple[Dynamics, int]], windows: Windows | Mapping[str, Windows]
) -> Evaluation:
    """Errors of models on the same windows, each with its own substeps per sample.

    Windows of a recording that lacks channels start from each model's own estimate of them.
    """
    parts = [
        evaluate(
            {name: model},
            windows if isinstance(windows, Windows) else windows[name],
            substeps=substeps,
        )
        for name, (model, substeps) in models.items()
    ]
    return Evaluation(
        xr.concat([part.dataset for part in parts], dim="model", combine_attrs="drop_conflicts")
    )


def prepared(
    recording: Recording, vehicle: Vehicle, start: Start, length_s: float
) -> tuple[dict[str, tuple[Dynamics, int]], dict[str, Windows]]:
    """Preset and learned model with their substeps, and the windows on which each is judged.

    Raises:
        UserError: no run is as long as a window, or the model can't complete the recording.
    """
    models: dict[str, tuple[Dynamics, int]] = {
        "preset": (vehicle.dynamics(), FINE_SUBSTEPS),
        "learned": (start.model, start.substeps),
    }
    if recording.missing and (why := not_completed_by(start.model)):
        raise UserError(f"model: {why}")
    shared, windows = None, {}
    for name, (model, substeps) in models.items():
        completed = None
        if recording.missing:
            completed = completed_as_it_is(recording, vehicle, model)
            model = _with_levels(model, completed.levels)
        if shared is None or completed is not None:
            shared = make_windows(
                recording,
                vehicle,
                length_s=length_s,
                stride_s=length_s,
                completed=completed,
                **windowing(start.model, "heading"),
            )
        windows[name] = shared
        models[name] = judged(model, shared), substeps
    return models, windows


def _with_levels(model: Dynamics, levels: Levels) -> Dynamics:
    """The model with these levels of noise as its b, if it is a Fossen model without one."""
    return with_diffusion(model, levels.diffusion) if _without_noise(model) else model


def _without_noise(model: Dynamics) -> bool:
    own = core(model)
    return isinstance(own, FossenDynamics) and not bool(jnp.any(own.diffusion > 0))


def judged(model: Dynamics, windows: Windows) -> Dynamics:
    """The model prepared for evaluation on windows: in their precision, at their step, with a b.

    A Fossen model without a diffusion gets the one estimated from its own errors on them.
    """
    dtype = windows.X.dtype
    model = cast(model, dtype)
    if isinstance(model, Extended):
        model = model.for_steps_of(windows.dt)
    if not _without_noise(model):
        return model
    return with_diffusion(model, estimate_diffusion(model, windows))


def learn(
    recording: Recording,
    vehicle: Vehicle,
    config: TrainingConfig,
    out: Path,
    *,
    start: Start | None = None,
    resume: bool = False,
    progress: Progress = lambda fraction, remark: None,
) -> Learned:
    """Train a SPINN from a preset, or another `start`, and evaluate them on the held-out part.

    Bands are calibrated (`training.fitting.calibrate`), those of the models compared with too. If a
    `start` scores better on the validation windows than every step, it is the learned model itself.

    Writes into `out` the files of `training.fitting.fit`, `evaluation.csv`, `evaluation.json`, the
    model that training starts from as `start.spinn`, and the preset with its estimated diffusion as
    `preset.spinn`. With `resume` a run with a checkpoint resumes from `start.spinn` and checkpoint.

    Raises:
        UserError: the data don't suffice, or `out` holds files that this package did not write.
    """
    given = None if start is None else start.model
    config = begun_with(config, given)
    hidden = None
    if recording.missing:
        hidden = _inferred(recording, vehicle, config, given, progress)
        given = hidden.model
        start = Start(given, name="fitted") if hidden.told else start
    parts = split_parts(recording, vehicle, config.windows, given, hidden and hidden.completed)
    claim(out, TRAINING)
    kept = out / "start.spinn"
    if resume and kept.exists() and (out / "checkpoint.npz").exists():
        model, _ = load_model(kept)
    else:
        rest = _drift_first(progress), given, parts.validation, hidden is not None
        model = starting_model(config, vehicle, parts.learn, *rest)
        save_model(kept, model)
    preset = judged(vehicle.dynamics() if hidden is None else hidden.preset, parts.learn)
    metadata = _metadata(recording, vehicle, config)
    result = fit(
        config,
        model,
        parts.learn,
        out,
        validation=parts.validation,
        progress=lambda step, total, loss: progress(
            _DRIFT + (1 - _DRIFT) * step / total, f"loss {loss:.3f}"
        ),
        resume=resume,
        metadata=metadata,
    )
    models = {
        "preset": (preset, FINE_SUBSTEPS),
        "learned": (result.model, config.objective.substeps),
    }
    learned = _learned(models, start, parts, result, hidden)
    _save(learned, out, metadata)
    return learned


def _inferred(
    recording: Recording,
    vehicle: Vehicle,
    config: TrainingConfig,
    given: Dynamics | None,
    progress: Progress,
) -> HiddenStart:
    """The start of a recording that lacks channels; progress is counted anew after it."""
    what = "estimating what was not recorded"
    progress(0.0, what)
    found = HiddenStart.of(recording, vehicle, config, given, lambda f: progress(f, what))
    progress(0.0, "learning")
    return found


def _learned(
    models: dict[str, tuple[Dynamics, int]],
    start: Start | None,
    parts: Parts,
    result: TrainingResult,
    hidden: HiddenStart | None,
) -> Learned:
    """The models, calibrated, and evaluated on the held-out windows."""
    if start is not None:  # between the preset and what was learned
        model = start.model if hidden is None else _with_levels(start.model, hidden.levels)
        own = {start.name: (judged(model, parts.learn), start.substeps)}
        models = {"preset": models["preset"], **own, "learned": models["learned"]}
    models = _calibrated(models, parts, hidden)
    if _is_better(start, models, parts.validation):
        models["learned"] = models[start.name]
        result = replace(result, best_step=0)
    model, substeps = models["learned"]
    evaluation, parts = _held_out(models, parts, hidden)
    told = () if hidden is None else hidden.told
    result = replace(result, model=model)
    return Learned(model, models["preset"][0], parts, result, evaluation, substeps, told)


def _save(learned: Learned, out: Path, metadata: dict[str, Any]) -> None:
    """Write the evaluation, and the models as they were evaluated."""
    for kind in ("csv", "json"):
        learned.evaluation.save(out / f"evaluation.{kind}")
    save_model(out / "model.spinn", learned.model, metadata | {"substeps": learned.substeps})
    save_model(out / "preset.spinn", learned.preset, metadata | {"substeps": FINE_SUBSTEPS})


def _calibrated(
    models: dict[str, tuple[Dynamics, int]], parts: Parts, hidden: HiddenStart | None
) -> dict[str, tuple[Dynamics, int]]:
    """The models with bands that hold on the training and validation windows.

    Without some channels, windows start from what the model knew that training began with, so that
    only the bands of it and of the learned model are calibrated.
    """
    if parts.validation is None:
        return models
    sets = parts.learn, parts.validation
    own = models if hidden is None else set(models) - {"preset"}
    return {
        name: (calibrated(model, sets, substeps) if name in own else model, substeps)
        for name, (model, substeps) in models.items()
    }


def _is_better(
    start: Start | None, models: Mapping[str, tuple[Dynamics, int]], validation: Windows | None
) -> TypeGuard[Start]:
    """Whether the model that training began with scores better on the validation windows.

    A SPINN is the first candidate of its own training. Other models are not: a SPINN approximates
    them, and is integrated in fewer steps.
    """
    if start is None or validation is None or isinstance(core(start.model), Spinn):
        return False
    names = "learned", start.name
    found = compare({name: models[name] for name in names}, validation).overall()
    learned, own = (found[n]["energy_pose"] + found[n]["energy_velocity"] for n in names)
    return bool(np.isfinite(own)) and not learned <= own


def _drift_first(progress: Progress) -> Callable[[int, int, float], None]:
    """Progress of the initial fit of the drift."""
    return lambda step, total, loss: progress(_DRIFT * step / total, "drift first")


def _held_out(
    models: Mapping[str, tuple[Dynamics, int]], parts: Parts, hidden: HiddenStart | None
) -> tuple[Evaluation, Parts]:
    """Errors on the held-out windows, for hidden states completed with each model itself."""
    if hidden is None:
        return compare(models, parts.held_out), parts
    windows = {name: hidden.held_out(model) for name, (model, _) in models.items()}
    return compare(models, windows), replace(parts, held_out=windows["learned"])


def _metadata(recording: Recording, vehicle: Vehicle, config: TrainingConfig) -> dict[str, Any]:
    return {
        "vehicle": recording.vehicle or vehicle.name,  # a file's path; a name finds presets only
        "source": recording.dataset.attrs.get("source", ""),
        "dt": recording.dt,
        "substeps": config.objective.substeps,
        "objective": type(config.objective).__name__,
    }
