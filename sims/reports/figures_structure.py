"""Figures of a diagnosis: the innovations' correlation, repeatability and place in state space."""

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ...models.se3 import AXES
from ...training.diagnosis.data.arrays import Data
from ...training.diagnosis.data.repeats import shares
from ...training.diagnosis.pipeline import Finding
from .figures import INK, QUIET, common_legend, panels, plain_logs, scaled, styled
from .figures_maps import error_map, innovations_of, labelled, where_they_are
from .figures_simulated import MODELS

_LONGEST = 2.0
"""Longest lag (s) of the autocorrelation."""
_CELLS, _PANELS = 14, 3


@styled
def memory_figure(finding: Finding) -> Figure:
    """Autocorrelation and spectrum of the innovations of each axis: white is flat."""
    d = finding.data
    figure, axes = panels(2, 6, 3.9, sharey="row")
    longest = max(2, min(round(_LONGEST / d.dt), len(d.u) // 2))
    lags = np.arange(1, longest + 1)
    spread = 2 / np.sqrt(max(d.steps, 1))
    for evaluation, (name, color) in zip(
        (finding.base, finding.final), MODELS.values(), strict=True
    ):
        for i in range(6):
            z = evaluation.z[:, 6 + i].astype(float) * d.weight
            square = max(float((z**2).sum()), 1e-300)
            memory = [(z[k:] * z[:-k]).sum() / square for k in lags]
            axes[0, i].plot(d.dt * lags, memory, color=color, label=name)
            f, power = _spectrum(z, d)
            axes[1, i].plot(f, power, color=color)
    for i, axis in enumerate(AXES):
        axes[0, i].axhspan(-spread, spread, color=QUIET, alpha=0.2, lw=0)
        axes[0, i].set_title(axis)
        axes[0, i].set_xlabel("lag / s")
        axes[1, i].axhline(1, color=INK, lw=1, ls="--")
        axes[1, i].set_yscale("log")
        plain_logs(axes[1, i])
        axes[1, i].set_xlabel("frequency / Hz")
    axes[0, 0].set_ylabel("autocorrelation")
    axes[1, 0].set_ylabel("power, 1 is noise")
    common_legend(figure, axes[0, 5])
    return figure


def _spectrum(
    z: Float[np.ndarray, "N R"], d: Data
) -> tuple[Float[np.ndarray, " f"], Float[np.ndarray, " f"]]:
    """Mean periodogram, 1 for unit white noise, averaged over neighbouring frequencies."""
    power = (np.abs(np.fft.rfft(z, axis=0)) ** 2).sum(axis=1) / max(d.weight.sum(), 1)
    f = np.fft.rfftfreq(len(z), d.dt)
    each = max(1, len(f) // 60)
    n = len(f) // each * each
    return f[:n].reshape(-1, each).mean(1), power[:n].reshape(-1, each).mean(1)


@styled
def repeats_figure(finding: Finding) -> Figure:
    """Repeatable part of the innovations (model error) and the rest (noise)."""
    d = finding.data
    by_model = [
        shares(evaluation.z[:, 6:].astype(float), d) for evaluation in (finding.base, finding.final)
    ]
    figure, axes = panels(1, 3, 2.7, sharey=True)
    titles = ("Means of runs", "Means of repeated runs, step by step", "Spread of repeated runs")
    x = np.arange(6)
    for number, (ax, title) in enumerate(zip(axes[0], titles, strict=True)):
        for k, (found, (name, color)) in enumerate(zip(by_model, MODELS.values(), strict=True)):
            ax.bar(x + 0.38 * (k - 0.5), found[number], 0.36, color=color, label=name)
        ax.axhline(1, color=INK, lw=1, ls="--")
        ax.set_title(title)
        ax.set_xticks(x, AXES, rotation=30)
        if np.isnan(by_model[0][number]).all():
            ax.text(0.5, 0.5, "no runs repeat", ha="center", color=QUIET, transform=ax.transAxes)
    scaled(axes[0, 0], np.array([found[:3] for found in by_model]), bars=True)
    axes[0, 0].set_ylabel("variance, 1 is noise")
    common_legend(figure, axes[0, 2])
    return figure


def most_structured(finding: Finding) -> list[tuple[int, str, str]]:
    """Axes with most structure in the belief's innovations, each with its two main variables."""
    known = where_they_are(finding)
    known.pop("run")  # not a coordinate of state space
    nats = np.nan_to_num(error_map(innovations_of(finding, finding.base), known))
    names = list(known)
    order = np.argsort(-nats.max(axis=1))[:_PANELS]
    found = []
    for i in order:
        a, b = np.argsort(-nats[i])[:2]
        found.append((int(i), names[int(a)], names[int(b)]))
    return found


@styled
def state_space_figure(finding: Finding) -> Figure:
    """Mean innovations of the worst axes over their two most informative variables."""
    known = where_they_are(finding)
    chosen = most_structured(finding)
    figure, axes = panels(2, len(chosen), 5.2, sharex="col", sharey="col")
    image = None
    for column, (i, a, b) in enumerate(chosen):
        edges = [_edges(known[name]) for name in (a, b)]
        for ax, evaluation, title in zip(
            axes[:, column], (finding.base, finding.final), ("belief", "with the causes"),
            strict=True,
        ):  # fmt: skip
            z = innovations_of(finding, evaluation)[:, i]
            count = np.histogram2d(known[a], known[b], edges)[0]
            total = np.histogram2d(known[a], known[b], edges, weights=z)[0]
            mean = np.where(count > 0, total / np.sqrt(np.maximum(count, 1)), np.nan)
            image = ax.pcolormesh(*edges, mean.T, cmap="RdBu_r", vmin=-6, vmax=6, rasterized=True)
            ax.set_title(f"{AXES[i]}, {title}")
            ax.set_ylabel(labelled(b))
            ax.grid(visible=False)
        axes[-1, column].set_xlabel(labelled(a))
    assert image is not None
    bar = figure.colorbar(image, ax=axes.ravel().tolist(), shrink=0.8)
    bar.set_label("mean innovation / standard errors")
    return figure


def _edges(values: np.ndarray) -> Float[np.ndarray, " e"]:
    """Edges of cells between the 1st and the 99th percentile."""
    low, high = np.quantile(values, (0.01, 0.99))
    return np.linspace(low, max(high, low + 1e-9), _CELLS + 1)
