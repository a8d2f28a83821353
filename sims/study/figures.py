"""Figures of a study: the paper's two, and supporting ones."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ...models.se3 import AXES
from ..reports.figures import ESTIMATE, FLOWN, GOAL, GRID, INK, LIMIT, PLANNED, QUIET, WIDTH, styled
from .config import REGIMES
from .table import Row

_FAMILIES = (
    ("fdm", FLOWN, "FDM on the group"),
    ("moments", ESTIMATE, "moments on the group"),
    ("pinn", PLANNED, "deterministic"),
    ("euclidean", GOAL, "Euclidean"),
)
_QUANTITIES = (
    ("w2", "W₂ to the true law"),
    ("rmse_mean_geodesic", "mean path: pose"),
    ("rmse_samples_geodesic", "samples: pose"),
    ("rmse_mean_velocity", "mean path: velocity"),
)
_SNAPSHOTS = 4


def color(method: str) -> str:
    """The colour of a method's family."""
    return next((c for prefix, c, _ in _FAMILIES if method.startswith(prefix)), QUIET)


def ordered(methods: Sequence[str]) -> list[str]:
    """Methods by family, then in their given order."""
    names = list(dict.fromkeys(methods))
    prefixes = [prefix for prefix, _, _ in _FAMILIES]

    def rank(method: str) -> int:
        return next((i for i, p in enumerate(prefixes) if method.startswith(p)), len(prefixes))

    return sorted(names, key=lambda m: (rank(m), names.index(m)))


@styled
def results_figure(rows: Sequence[Row]) -> Figure:
    """Errors and W₂ of every method with the floor, and its number of successful runs.

    Small dots are seeds, large ones their mean, bars one standard deviation. Failed runs have no
    dot; the labels at the left show the share of successful runs.
    """
    regimes = [r for r in REGIMES if any(row["regime"] == r for row in rows)]
    methods = ordered([row["method"] for row in rows])
    height = 1.0 + 0.3 * len(methods)
    figure = Figure(figsize=(WIDTH, height * len(regimes) + 0.5), layout="constrained")
    axes = figure.subplots(len(regimes), len(_QUANTITIES), squeeze=False, sharey="row")
    for line, regime in zip(axes, regimes, strict=True):
        for ax, (name, title) in zip(line, _QUANTITIES, strict=True):
            _dots(ax, [r for r in rows if r["regime"] == regime], methods, name)
            ax.set_title(title)
        line[0].set_yticks(range(len(methods)), _labels(rows, regime, methods))
        line[0].set_ylim(len(methods) - 0.4, -0.6)
        line[0].set_ylabel(f"{regime} data", fontsize=10, color=INK)
    handles = [
        Line2D([], [], marker="o", ls="", color=c, label=text)
        for prefix, c, text in _FAMILIES
        if any(m.startswith(prefix) for m in methods)
    ]
    handles.append(Line2D([], [], color=LIMIT, ls="--", lw=1, label="floor"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def _labels(rows: Sequence[Row], regime: str, methods: Sequence[str]) -> list[str]:
    labels = []
    for method in methods:
        runs = [r for r in rows if (r["regime"], r["method"]) == (regime, method)]
        share = f"{sum(r['success'] for r in runs)}/{len(runs)}" if runs else "–"
        labels.append(f"{method}   {share}")
    return labels


def _dots(ax: Axes, rows: Sequence[Row], methods: Sequence[str], name: str) -> None:
    floors = np.array([float(r.get(f"{name}_floor", np.nan)) for r in rows])
    if np.isfinite(floors).any():
        ax.axvline(float(np.nanmean(floors)), color=LIMIT, ls="--", lw=1)
    for y, method in enumerate(methods):
        found = [float(r.get(name, np.nan)) for r in rows if r["method"] == method and r["success"]]
        values = np.array([v for v in found if np.isfinite(v)])
        if not values.size:
            continue
        ax.plot(values, np.full(values.size, y), "o", ms=3, color=color(method), alpha=0.45)
        ax.errorbar(
            values.mean(),
            y,
            xerr=values.std(ddof=1) if values.size > 1 else None,
            fmt="o",
            ms=6,
            color=color(method),
            elinewidth=1.4,
        )
    ax.set_xlim(left=0)
    ax.grid(axis="y", visible=False)


@styled
def distributions_figure(motions: Mapping[str, xr.Dataset], scenario: str) -> Figure:
    """Positions under the true and every learned law, seen from above, at four times."""
    methods = ordered(list(motions))
    columns = min(4, len(methods))
    lines = -(-len(methods) // columns)
    figure = Figure(figsize=(WIDTH, 2.6 * lines + 0.4), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
    for ax, method in zip(axes.ravel(), methods, strict=False):
        position = motions[method]["position"].sel(scenario=scenario)
        count = position.sizes["time"]
        times = np.unique(np.linspace(0, count, _SNAPSHOTS + 1).round().astype(int)[1:] - 1)
        for law, shade, size in (("true", QUIET, 5.0), ("learned", color(method), 2.5)):
            path = position.sel(law=law).isel(time=times).to_numpy()
            flat = path[..., :2].reshape(-1, 2)
            style = {"s": size, "color": shade, "lw": 0, "rasterized": True}
            ax.scatter(*flat.T, alpha=0.25 if law == "true" else 0.35, **style)
            mean = position.sel(law=law).mean("sample").to_numpy()
            ax.plot(mean[:, 0], mean[:, 1], color=INK if law == "true" else shade, lw=1.2)
        ax.set_title(method)
        ax.set_aspect("equal", adjustable="box")
    for ax in axes.ravel()[len(methods) :]:
        ax.set_visible(False)
    # limits from the true law alone, so that a diverging law does not shrink the others
    true = np.concatenate(
        [m["position"].sel(scenario=scenario, law="true").to_numpy() for m in motions.values()]
    ).reshape(-1, 3)
    low, high = np.nanpercentile(true[:, :2], (0.2, 99.8), axis=0)
    center, half = (low + high) / 2, 0.6 * max(*(high - low), 0.2)
    axes[0, 0].set_xlim(center[0] - half, center[0] + half)
    axes[0, 0].set_ylim(center[1] - half, center[1] + half)
    for ax in axes[-1]:
        ax.set_xlabel("x / m")
    for ax in axes[:, 0]:
        ax.set_ylabel("y / m")
    handles = [
        Line2D([], [], marker="o", ls="", color=QUIET, label="true law"),
        Line2D([], [], color=INK, label="its mean"),
        *(
            Line2D([], [], marker="o", ls="", color=c, label=text)
            for prefix, c, text in _FAMILIES
            if any(m.startswith(prefix) for m in methods)
        ),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


@styled
def horizon_figure(metrics: Mapping[str, xr.Dataset]) -> Figure:
    """W₂ over the floor's against time, one line per method; means over seeds and scenarios."""
    figure = Figure(figsize=(WIDTH, 3.2), layout="constrained")
    axes = figure.subplots(1, len(metrics), squeeze=False, sharey=True)[0]
    for ax, (regime, d) in zip(axes, metrics.items(), strict=True):
        styles: dict[str, int] = {}
        for method in ordered([str(m) for m in d["method"].to_numpy()]):
            runs = d["w2"].where(d["method"] == method, drop=True).mean(("run", "scenario"))
            ratio = (runs.sel(side="law") / runs.sel(side="floor")).to_numpy()
            shade = color(method)
            number = styles.setdefault(shade, 0)
            styles[shade] += 1
            line = ("-", "--", ":", "-.")[number % 4]
            ax.plot(d["time"], ratio, color=shade, ls=line, label=method)
        ax.axhline(1, color=LIMIT, lw=1)
        ax.set_title(f"{regime} data: W₂ / floor")
        ax.set_xlabel("t / s")
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter("{x:g}")
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


@styled
def curves_figure(curves: Mapping[tuple[str, str], list[tuple[np.ndarray, np.ndarray]]]) -> Figure:
    """Training loss against steps, a panel per method, a line per seed; scales differ by method.

    Faint lines are the losses of single batches, bold lines their mean over a tenth of the run.
    """
    methods = ordered([method for _, method in curves])
    columns = min(4, len(methods))
    lines = -(-len(methods) // columns)
    figure = Figure(figsize=(WIDTH, 1.9 * lines + 0.5), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False)
    shades = dict[str, str](zip(REGIMES, (PLANNED, FLOWN), strict=True))
    for ax, method in zip(axes.ravel(), methods, strict=False):
        for regime in REGIMES:
            for step, loss in curves.get((regime, method), []):
                ax.plot(step, loss, color=shades[regime], lw=0.6, alpha=0.2)
                ax.plot(*_smoothed(step, loss), color=shades[regime], lw=1.1)
        ax.set_title(method)
    for ax in axes.ravel()[len(methods) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("step")
    seen = [r for r in REGIMES if any(regime == r for regime, _ in curves)]
    handles = [Line2D([], [], color=shades[r], label=f"{r} data") for r in seen]
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def _smoothed(step: np.ndarray, loss: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means of step and loss over a window of a tenth of all entries."""
    width = max(1, len(loss) // 10)
    even = np.full(width, 1 / width)
    return np.convolve(step, even, "valid"), np.convolve(loss, even, "valid")


@styled
def diffusion_figure(rows: Sequence[Row]) -> Figure:
    """Learned over true diffusion by axis, one panel per regime; the band is ± 20 %."""
    regimes = [r for r in REGIMES if any(row["regime"] == r for row in rows)]
    methods = ordered([r["method"] for r in rows if r["success"]])
    figure = Figure(figsize=(WIDTH, 2.8 * len(regimes) + 0.4), layout="constrained")
    axes = figure.subplots(len(regimes), 1, squeeze=False, sharex=True)[:, 0]
    x = np.arange(len(AXES))
    for ax, regime in zip(axes, regimes, strict=True):
        ax.axhspan(0.8, 1.2, color=GRID)
        ax.axhline(1, color=LIMIT, lw=1)
        for number, method in enumerate(methods):
            runs = [
                r
                for r in rows
                if (r["regime"], r["method"], r["success"]) == (regime, method, True)
            ]
            if not runs:
                continue
            values = np.array([[r.get(f"b_{a}_ratio", np.nan) for a in AXES] for r in runs], float)
            offset = (number - (len(methods) - 1) / 2) * 0.8 / max(1, len(methods))
            marker = "osD^vP*X"[number % 8]
            ax.plot(
                x + offset, values.mean(axis=0), marker, ms=5, color=color(method), label=method
            )
        ax.set_xticks(x, AXES)
        ax.set_ylim(bottom=0)
        ax.set_ylabel("learned b / true b")
        ax.set_title(f"{regime} data")
    axes[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def thinned_curve(path: Path, points: int = 150) -> tuple[np.ndarray, np.ndarray] | None:
    """Steps and loss of a metrics.csv, medians of equal pieces; None without steps."""
    if not path.exists():
        return None
    columns: Any = ("step", "loss")  # NumPy's stubs know numbers alone
    table = np.genfromtxt(path, delimiter=",", names=True, usecols=columns, ndmin=1)
    if table.size == 0:
        return None
    table = table[np.isfinite(table["loss"])]
    pieces = np.array_split(table, max(1, min(points, table.size)))
    medians = [[np.median(p[name]) for p in pieces if p.size] for name in ("step", "loss")]
    return np.array(medians[0]), np.array(medians[1])
