"""From a recording to a learned vehicle, judged on data it has not seen."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import xarray as xr

from ..models.checkpoint import load_model, save_model
from ..models.dynamics import Dynamics
from ..models.errors import UserError
from ..models.recording import Recording
from ..models.rigid_body import FossenDynamics
from ..models.vehicle import Vehicle
from ..training.config import TrainingConfig, WindowConfig
from ..training.evaluate import Evaluation, evaluate
from ..training.fit import TrainingResult, fit
from ..training.start import estimate_diffusion, starting_model
from ..training.windows import Windows, make_windows

FINE_SUBSTEPS = 5
"""Steps a sample for models that were not trained at a step of their own, such as presets."""
_VALIDATION = 0.15
_DRIFT = 0.2  # of the time, about, for the start that fits the drift alone


@dataclass(frozen=True)
class Parts:
    """Windows to train on, to choose the best step by, and held out for the verdict."""

    learn: Windows
    validation: Windows | None
    held_out: Windows


@dataclass(frozen=True)
class Learned:
    """What training a recording's vehicle ends with."""

    model: Dynamics
    preset: FossenDynamics
    parts: Parts
    result: TrainingResult
    evaluation: Evaluation
    substeps: int
    """Integration steps a sample that the model was trained with."""


def split_parts(recording: Recording, vehicle: Vehicle, config: WindowConfig) -> Parts:
    """Cut a recording into parts that share no moment of any run (`Recording.split`).

    Raises:
        UserError: it is too short for windows to learn from and others to hold out.
    """

    def cut(part: Recording, stride: float, name: str) -> Windows:
        try:
            return make_windows(
                part,
                vehicle,
                length_s=config.length_s,
                stride_s=stride,
                normalise=config.normalise,
            )
        except UserError as error:
            raise UserError(f"{name} part of the data: {error}") from error

    rest, last = recording.split(config.held_out, config.by, config.gap_s)
    held_out = cut(last, config.length_s, "held-out")
    try:
        first, middle = rest.split(_VALIDATION, config.by, config.gap_s)
        validation = cut(middle, config.length_s, "validation")
    except UserError:  # too little data to spare: the last step is taken instead of the best
        first, validation = rest, None
    return Parts(cut(first, config.stride_s, "training"), validation, held_out)


def compare(
    learned: Dynamics,
    preset: FossenDynamics,
    windows: Windows,
    substeps: int = 1,
    label: str = "learned",
) -> Evaluation:
    """Held-out errors of a preset and of a learned model, each at the step size that suits it."""
    parts = [
        evaluate({"preset": preset}, windows, substeps=FINE_SUBSTEPS),
        evaluate({label: learned}, windows, substeps=substeps),
    ]
    return Evaluation(
        xr.concat([part.dataset for part in parts], dim="model", combine_attrs="drop_conflicts")
    )


def learn(
    recording: Recording,
    vehicle: Vehicle,
    config: TrainingConfig,
    out: Path,
    *,
    resume: bool = False,
    progress: Callable[[float, str], None] = lambda fraction, remark: None,
) -> Learned:
    """Train a SPINN from a preset and judge both on the held-out part.

    Writes into `out` what `training.fit` writes, `evaluation.csv`, `evaluation.json`, the model
    that training starts from as `start.spinn`, and the preset with its estimated diffusion as
    `preset.spinn`. With `resume` a run that has a checkpoint goes on from both.

    Raises:
        UserError: the data don't suffice; the sentence says what is missing.
    """
    parts = split_parts(recording, vehicle, config.windows)
    kept = out / "start.spinn"
    if resume and kept.exists() and (out / "checkpoint.npz").exists():
        model, _ = load_model(kept)
    else:
        model = starting_model(
            config,
            vehicle,
            parts.learn,
            lambda step, total, loss: progress(_DRIFT * step / total, "drift first"),
        )
        save_model(kept, model)
    dtype = jnp.dtype(parts.learn.X.dtype)
    preset = vehicle.dynamics(estimate_diffusion(vehicle.dynamics(dtype=dtype), parts.learn), dtype)
    substeps = config.objective.substeps
    metadata: dict[str, Any] = {
        "vehicle": vehicle.name,
        "source": recording.dataset.attrs.get("source", ""),
        "dt": recording.dt,
        "substeps": substeps,
        "objective": type(config.objective).__name__,
    }
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
    evaluation = compare(result.model, preset, parts.held_out, substeps)
    evaluation.save(out / "evaluation.csv")
    evaluation.save(out / "evaluation.json")
    save_model(out / "preset.spinn", preset, metadata | {"substeps": FINE_SUBSTEPS})
    return Learned(result.model, preset, parts, result, evaluation, substeps)
