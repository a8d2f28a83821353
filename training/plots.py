"""Figures of training and evaluation; matplotlib is imported when one is drawn."""

from typing import Any

import numpy as np

from .evaluate import Evaluation
from .metrics import AXES, BANDS

_NORMS = {
    "position": "m",
    "rotation": "rad",
    "linear_velocity": "m/s",
    "angular_velocity": "rad/s",
}


def errors(evaluation: Evaluation) -> Any:
    """Root mean square errors of the noise-free motion against the horizon, a line a model."""
    figure, axes = _subplots(2, 2)
    for ax, (norm, unit) in zip(axes.flat, _NORMS.items(), strict=True):
        for model in evaluation.dataset["model"].to_numpy():
            line = evaluation.dataset["rmse"].sel(model=model, norm=norm)
            ax.plot(line["horizon"], line, label=str(model))
        ax.set_xlabel("horizon, s")
        ax.set_ylabel(f"{norm.replace('_', ' ')}, {unit}")
        ax.set_ylim(bottom=0)
    axes[0, 0].legend()
    return figure


def bands(evaluation: Evaluation) -> Any:
    """Share of windows inside the 50 and 90 % bands, by axis, against the horizon."""
    names = evaluation.dataset["model"].to_numpy()
    figure, axes = _subplots(len(names), len(BANDS))
    for row, model in zip(axes, names, strict=True):
        for ax, band in zip(row, BANDS, strict=True):
            covered = evaluation.dataset["coverage"].sel(model=model, band=band)
            for axis in AXES:
                line = covered.sel(axis=axis)
                ax.plot(line["horizon"], line, color="0.75", linewidth=0.8)
            ax.plot(covered["horizon"], covered.mean("axis"), label="mean of the axes")
            ax.axhline(band, color="black", linestyle=":", label="what it should be")
            ax.set_title(f"{model}: {band:.0%} band")
            ax.set_xlabel("horizon, s")
            ax.set_ylim(0, 1)
    axes[0, 0].legend()
    return figure


def learning_curve(metrics: dict[str, np.ndarray]) -> Any:
    """Loss and its parts against steps, with the validation loss."""
    figure, axes = _subplots(1, 1)
    ax = axes[0, 0]
    told = {"step", "gradient_norm", "rate", "ok", "validation", "seconds"}
    for name in (name for name in metrics if name not in told):
        ax.plot(metrics["step"], _smooth(metrics[name]), label=name.replace("_", " "))
    seen = np.isfinite(metrics["validation"])
    if seen.any():
        ax.plot(metrics["step"][seen], metrics["validation"][seen], "k.-", label="validation")
    ax.set_xlabel("step")
    ax.legend()
    return figure


def _smooth(values: np.ndarray, width: int = 25) -> np.ndarray:
    """Running mean of what is finite."""
    kernel = np.ones(min(width, values.size))
    good = np.isfinite(values)
    total = np.convolve(np.where(good, values, 0), kernel, "same")
    return total / np.maximum(np.convolve(good, kernel, "same"), 1)


def _subplots(rows: int, columns: int) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * columns, 2.8 * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)
