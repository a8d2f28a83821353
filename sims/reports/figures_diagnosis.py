"""Figures of a diagnosis: model errors, the causes that explain them, and their gain."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...models.se3 import AXES, CHANNELS
from ...training.diagnosis.findings.result import Diagnosis
from ...training.diagnosis.pipeline import Finding
from .diagnosis_answer import MODELS
from .figures import FLOWN, INK, PLANNED, QUIET, common_legend, legend, panels, scaled, styled
from .figures_maps import run_times

_FAR, _APART, _ROOM = 2.5, 10.0, 1.15
"""Limits of a panel: for other models relative to the larger error of belief and causes, for the
larger relative to the smaller of these two, and margin above."""


@styled
def names_figure(finding: Finding, most: int = 14) -> Figure:
    """Held-out gain of the best single causes, and the threshold for noise."""
    order = sorted(finding.fits.items(), key=lambda item: -item[1].heldout_gain)[:most][::-1]
    named = {(c.name, c.where) for c in finding.diagnosis.causes}
    figure, axes = panels(1, 1, 0.6 + 0.26 * len(order))
    ax = axes[0, 0]
    gains = [max(fit.heldout_gain, 0.1) for _, fit in order]
    colors = [FLOWN if h in named else QUIET for h, _ in order]
    ax.barh(range(len(order)), gains, color=colors, height=0.7)
    ax.set_yticks(range(len(order)), [f"{n.replace('_', ' ')} · {w}" for (n, w), _ in order])
    ax.axvline(finding.diagnosis.threshold, color=PLANNED, lw=1.2, ls="--")
    ax.set_xscale("log")
    ax.set_xlim(left=0.1)
    ax.set_xlabel("nats won on left-out data (dashed: what noise alone can win)")
    ax.set_title("Every name tried alone: the best ones")
    return figure


@styled
def residual_figure(finding: Finding) -> Figure:
    """Variance and autocorrelation of the innovations by axis: belief and explained."""
    figure, axes = panels(1, 2, 2.9)
    x = np.arange(12)
    w, variances = finding.data.weight, []
    for k, (evaluation, name, color) in enumerate(
        ((finding.base, "belief", PLANNED), (finding.final, "with the causes", FLOWN))
    ):
        z = evaluation.z * w[:, None]
        variance = (z**2).sum(axis=(0, 2)) / w.sum()
        memory = (z[1:] * z[:-1]).sum(axis=(0, 2)) / np.maximum((z**2).sum(axis=(0, 2)), 1e-300)
        for ax, values in zip(axes[0], (variance, memory), strict=True):
            ax.bar(
                x + 0.38 * (k - 0.5), values * finding.data.measured, 0.36, color=color, label=name
            )
        variances.append(variance * finding.data.measured)
    scaled(axes[0, 0], np.array(variances), bars=True)
    axes[0, 0].axhline(1, color=INK, lw=1, ls="--")
    axes[0, 0].set_title("Variance against the noise's (1)")
    axes[0, 1].set_title("Correlation at one step (0)")
    for ax in axes[0]:
        ax.set_xticks(x, CHANNELS, rotation=45)
    legend(axes[0, 1])
    return figure


@styled
def experiments_figure(diagnosis: Diagnosis) -> Figure | None:
    """Expected information of each maneuver on each cause; None without experiments."""
    causes = [c for c in diagnosis.causes if c.experiments]
    if not causes:
        return None
    maneuvers = list(dict.fromkeys(name for c in causes for name in c.experiments))
    figure, axes = panels(1, len(causes), 0.9 + 0.22 * len(maneuvers), sharey=True)
    for ax, c in zip(axes[0], causes, strict=True):
        nats = np.array([c.experiments.get(name, 0.0) for name in maneuvers])
        colors = [FLOWN if n == nats.max() else QUIET for n in nats]
        ax.barh(range(len(maneuvers)), np.maximum(nats, 0.01), color=colors, height=0.7)
        ax.set_xscale("log")
        ax.set_xlim(left=0.01)
        ax.set_xlabel("nats a minute")
        ax.set_title(f"{c.name.replace('_', ' ')} · {c.where}")
    axes[0, 0].set_yticks(range(len(maneuvers)), maneuvers)
    axes[0, 0].invert_yaxis()
    return figure


@styled
def horizon_figure(diagnosis: Diagnosis) -> Figure:
    """Errors and scores of simulations against their horizon, held out, with 95 % intervals.

    The largest error of a model far beyond the others is written as a number at the top.
    """
    figure, axes = panels(1, 4, 2.9)
    titles = ("position / m", "rotation / rad", "velocity / (m/s)", "energy score")
    colors = {"base": PLANNED, "refitted": QUIET, "black_box": INK, "extended": FLOWN}
    lines = {"base": "o-", "extended": "o-", "refitted": "s--", "black_box": "^:"}
    for number, (ax, title) in enumerate(zip(axes[0], titles, strict=True)):
        errors = {}
        for name, g in diagnosis.gain.items():
            tables = (g.position_rmse, g.rotation_rmse, g.velocity_rmse, g.energy_score)
            table = tables[number]
            if not table:
                continue
            h = [float(k) for k in table]
            errors[name] = np.array([v.value for v in table.values()])
            low, high = np.array([v.interval95 for v in table.values()]).T
            ax.fill_between(h, low, high, color=colors[name], alpha=0.13, lw=0)
            ax.plot(h, errors[name], lines[name], ms=3.5, color=colors[name], label=MODELS[name])
        ax.set_title(title if errors else f"{title.split(' / ')[0]}: not measured")
        if not errors:
            continue
        top = panel_top(errors)
        ax.set_ylim(0, top)
        ax.set_xlabel("horizon / s")
        beyond = [n for n, e in errors.items() if not np.all(e <= top)]
        for row, name in enumerate(beyond):
            _note_beyond(ax, errors[name], row, MODELS[name], colors[name])
    common_legend(figure, axes[0, 3])
    return figure


def panel_top(errors: dict[str, np.ndarray]) -> float:
    """Upper limit of a panel: belief and causes fit, and others unless they are far beyond."""
    largest = {n: float(np.max(np.where(np.isnan(e), np.inf, e))) for n, e in errors.items()}
    own = [e for n, e in largest.items() if n in ("base", "extended") and np.isfinite(e)]
    own = own or [e for e in largest.values() if np.isfinite(e)] or [1.0]
    bar = max(min(max(own), _APART * min(own)), 1e-12)
    return _ROOM * max(e for e in (bar, *largest.values()) if e <= _FAR * bar)


def _note_beyond(ax: Axes, errors: np.ndarray, row: int, name: str, color: str) -> None:
    """Write the size of errors beyond a panel's limit at its top."""
    finite = errors[np.isfinite(errors)]
    size = f"{finite.max():.2g}" if len(finite) == len(errors) else "diverged"
    ax.text(
        0.98, 0.98 - 0.08 * row, f"↑ {name}: {size}", ha="right", va="top", fontsize=7,
        color=color, transform=ax.transAxes,
        bbox={"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 0.5},
    )  # fmt: skip


@styled
def innovations_figure(finding: Finding) -> Figure:
    """Mean innovation over time in the scenario that the belief explains worst."""
    d = finding.data
    score = (finding.base.z**2).sum(axis=(0, 1))
    there = np.unique(d.scenario)  # faulty runs are excluded: some scenarios are empty
    worst = int(there[np.argmax([score[d.scenario == s].mean() for s in there])])
    own = d.scenario == worst
    figure, axes = panels(2, 3, 3.9, sharex=True, sharey=True)
    bins = np.maximum(np.rint(run_times(d)[1:, own] / d.dt).astype(int) - 1, 0)
    count = np.bincount(bins.ravel(), d.weight[:, own].ravel())
    t = d.dt * np.arange(1, len(count) + 1)
    for i, ax in enumerate(axes.flat):
        ax.axhspan(-2, 2, color=QUIET, alpha=0.15, lw=0)
        for evaluation, name, color in (
            (finding.base, "belief", PLANNED),
            (finding.final, "with the causes", FLOWN),
        ):
            total = np.bincount(bins.ravel(), evaluation.z[:, 6 + i][:, own].ravel())
            mean = total / np.sqrt(np.maximum(count, 1))
            ax.plot(t, mean, color=color, lw=0.9, label=name)
        ax.set_title(AXES[i])
    for ax in axes[-1]:
        ax.set_xlabel("t / s")
    for ax in axes[:, 0]:
        ax.set_ylabel("standard errors")
    number = len(np.unique(d.run[own]))
    runs = f"{number} run{'s' * (number > 1)}"
    figure.suptitle(
        f"Mean innovation of {runs} of '{d.names[worst]}'; grey: what noise does",
        fontsize=9.5, x=0.01, ha="left",
    )  # fmt: skip
    legend(axes[0, 2])
    return figure
