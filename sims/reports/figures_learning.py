"""Figures of data, training and held-out errors."""

import itertools

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array
from matplotlib.figure import Figure

from ...models.dynamics import Dynamics
from ...models.recordings.store import Recording
from ...models.se3 import CHANNELS
from ...training.data.windows import Windows
from ...training.evaluation.evaluate import Evaluation
from ...training.evaluation.metrics import displacement
from ...training.losses.base import Batch
from ...training.predict import predict
from .figures import ESTIMATE, FLOWN, INK, PLANNED, QUIET, legend, panels, styled

_NORMS = (
    ("position", "position / m"),
    ("rotation", "rotation / rad"),
    ("linear_velocity", "velocity / (m/s)"),
    ("angular_velocity", "rate / (rad/s)"),
)
_COLORS = {"preset": PLANNED, "learned": FLOWN, "start": ESTIMATE, "extended": ESTIMATE}


@styled
def recording_figure(recording: Recording) -> Figure:
    """Path from above, and depth, speed and body rates over time, one line per trajectory."""
    figure, axes = panels(2, 2, 5.6)
    above, depth, speed, rate = axes.ravel()
    for number, trajectory in enumerate(recording.trajectories()):
        X, V = trajectory.X_WB, trajectory.V_WB_B
        t = trajectory.start + recording.dt * np.arange(len(X))
        color = f"C{number % 6}"
        above.plot(X[:, 4], X[:, 5], color=color, lw=1.1, label=trajectory.scenario)
        depth.plot(t, X[:, 6], color=color)
        speed.plot(t, np.linalg.norm(V[:, :3], axis=1), color=color, lw=0.8)
        rate.plot(t, np.linalg.norm(V[:, 3:], axis=1), color=color, lw=0.8)
    above.set_aspect("equal", adjustable="datalim")
    above.set_title("Path from above")
    above.set_xlabel("x (east) / m")
    above.set_ylabel("y (north) / m")
    for ax, title, unit in (
        (depth, "Height", "z / m"),
        (speed, "Speed", "|v| / (m/s)"),
        (rate, "Turning", "|ω| / (rad/s)"),
    ):
        ax.set_title(title)
        ax.set_xlabel("t / s")
        ax.set_ylabel(unit)
    return figure


@styled
def learning_figure(
    metrics: dict[str, np.ndarray], refits: tuple[int, ...] = (), taken: int | None = None
) -> Figure:
    """Training and validation loss and their parts over the steps.

    Curves are split at `refits`, after which losses have another scale; a ring marks the validation
    loss of the selected step `taken`.
    """
    figure, axes = panels(1, 2, 3.0)
    done = metrics["step"] + 1
    left, right = axes[0]
    known = {"step", "loss", "gradient_norm", "rate", "ok", "validation", "seconds"}
    parts = {name: f"C{i}" for i, name in enumerate(sorted(set(metrics) - known))}
    for number, part in enumerate(stretches(metrics["step"], refits)):
        first = "" if number == 0 else "_"  # an underscore hides a label from the legend
        left.plot(done[part], _smooth(metrics["loss"][part]), color=FLOWN, label=f"{first}training")
        values = metrics["validation"][part]
        known_at = np.isfinite(values)
        if known_at.any():
            left.plot(
                done[part][known_at], values[known_at], "o-", ms=3, color=PLANNED,
                label=f"{first}validation",
            )  # fmt: skip
        for name, color in parts.items():
            smooth = _smooth(metrics[name][part])
            right.plot(done[part], smooth, color=color, label=f"{first}{name}")
    at = np.flatnonzero((done == taken) & np.isfinite(metrics["validation"]))
    if at.size:
        left.plot(
            done[at], metrics["validation"][at], "o", ms=9, mfc="none", color=INK, label="taken"
        )
    left.set_title("Loss")
    right.set_title("Its parts")
    for ax in (left, right):
        for refit in refits:
            ax.axvline(refit, color=QUIET, lw=0.8, ls=":")
    for ax in (left, right):
        ax.set_xlabel("step")
        legend(ax)
    return figure


def stretches(step: np.ndarray, refits: tuple[int, ...]) -> list[np.ndarray]:
    """Masks of the rows of the metrics between one refit and the next."""
    edges = [-np.inf, *refits, np.inf]
    masks = [(step >= low) & (step < high) for low, high in itertools.pairwise(edges)]
    return [mask for mask in masks if mask.any()]


def _smooth(values: np.ndarray, width: int = 15) -> np.ndarray:
    """A running median, robust to single outlying batches."""
    half = width // 2
    return np.array(
        [np.nanmedian(values[max(0, i - half) : i + half + 1]) for i in range(len(values))]
    )


@styled
def error_figure(evaluation: Evaluation) -> Figure:
    """Root-mean-square error of the noise-free motion against the horizon."""
    figure, axes = panels(1, 4, 2.9)
    d = evaluation.dataset
    for ax, (norm, label) in zip(axes[0], _NORMS, strict=True):
        for model in d["model"].to_numpy():
            rmse = d["rmse"].sel(model=model, norm=norm).to_numpy()
            ax.plot(d["horizon"], rmse, color=_COLORS.get(str(model), QUIET), label=str(model))
        ax.set_title(label)
        ax.set_xlabel("horizon / s")
        ax.set_ylim(bottom=0)
        ax.set_xlim(0, float(d["horizon"][-1]))
    axes[0, 0].legend(loc="upper left")
    return figure


@styled
def coverage_figure(evaluation: Evaluation) -> Figure:
    """Coverage of held-out motion by the 50 % and 90 % bands, by axis; dashes: nominal."""
    d = evaluation.dataset
    models = [str(m) for m in d["model"].to_numpy()]
    figure, axes = panels(1, 2, 2.8, sharey=True)
    labels = [str(a) for a in d["axis"].to_numpy()]
    x, step = np.arange(len(labels)), 0.8 / len(models)
    for ax, band in zip(axes[0], d["band"].to_numpy(), strict=True):
        for number, model in enumerate(models):
            share = d["coverage"].sel(model=model, band=band).mean("horizon").to_numpy()
            offset = (number - (len(models) - 1) / 2) * step
            color = _COLORS.get(model, QUIET)
            ax.bar(x + offset, 100 * share, width=0.95 * step, color=color, label=model)
        ax.axhline(100 * band, color=INK, lw=1, ls="--")
        ax.set_xticks(x, labels, rotation=45)
        ax.set_title(f"Inside the {100 * band:.0f} % band")
        ax.set_ylabel("%")
    legend(axes[0, -1])
    return figure


@styled
def bands_figure(
    learned: Dynamics,
    preset: Dynamics,
    windows: Windows,
    index: int,
    substeps: tuple[int, int],
    samples: int = 199,
) -> Figure:
    """One held-out window: measured motion, 50 % and 90 % bands of the learned law, the preset.

    Displacements are relative to the learned model's noise-free motion, so that the width of a band
    and the error of the measurement are comparable.
    """
    one = Batch.of(windows.take(np.array([index])))

    def drawn(model: Dynamics, count: int, substeps: int) -> tuple[Array, Array]:
        return eqx.filter_jit(predict)(
            model, one.X[0], one.V[0], one.F, windows.dt, jax.random.key(0), count,
            substeps=substeps, with_path_of_drift=True, commands=one.commands,
            rise=one.rise,
        )  # fmt: skip

    X, V = drawn(learned, samples, substeps[0])
    Xp, Vp = drawn(preset, 0, substeps[1])
    reference = X[:, :, -1:], V[:, :, -1:]

    def seen(X_other: Array, V_other: Array) -> np.ndarray:
        return np.asarray(displacement(X_other, V_other, *reference))[..., 0]

    sampled = seen(X[:, :, :-1], V[:, :, :-1])
    measured = seen(one.X[1:, :, None], one.V[1:, :, None])[:, :, 0]
    believed = seen(Xp, Vp)[:, :, 0]
    t = windows.dt * np.arange(1, windows.steps + 1)
    figure, axes = panels(4, 3, 8.2, sharex=True)
    units = ("m", "rad", "m/s", "rad/s")
    for i, ax in enumerate(axes.ravel()):
        for low, high, alpha in ((5, 95, 0.18), (25, 75, 0.32)):
            a, b = np.percentile(sampled[i], (low, high), axis=1)
            ax.fill_between(t, a, b, color=FLOWN, alpha=alpha, lw=0)
        ax.plot(t, measured[i], color=INK, lw=1.3, label="measured")
        limits = ax.get_ylim()
        ax.plot(t, believed[i], color=PLANNED, lw=1.1, ls="--", label="preset")
        span = limits[1] - limits[0]
        ax.set_ylim(limits[0] - 0.6 * span, limits[1] + 0.6 * span)
        ax.set_title(f"{CHANNELS[i]} / {units[i // 3]}")
    for ax in axes[-1]:
        ax.set_xlabel("t / s")
    legend(axes[0, -1])
    return figure
