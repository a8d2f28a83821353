"""Figures of a diagnosis: what is wrong, which name explains it, what naming it wins."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ..training.diagnosis.diagnose import Finding
from ..training.diagnosis.looking import Look
from ..training.diagnosis.result import Diagnosis
from .figures import FLOWN, INK, PLANNED, QUIET, legend, panels, styled

_TWIST = ("surge", "sway", "heave", "roll", "pitch", "yaw")
_BINS = 12


@styled
def names_figure(finding: Finding, most: int = 14) -> Figure:
    """Held-out gain of the best names tried alone, and the line that noise stays below."""
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
    ax.set_xlabel("nats won on scenarios left out (dashed: what noise alone can win)")
    ax.set_title("Every name tried alone: the best ones")
    return figure


@styled
def residual_figure(finding: Finding) -> Figure:
    """Variance and autocorrelation of the innovations by axis: belief and explained."""
    figure, axes = panels(1, 2, 2.9)
    x = np.arange(12)
    labels = ("x", "y", "z", "roll", "pitch", "yaw", "u", "v", "w", "p", "q", "r")
    w = finding.data.weight
    for k, (look, name, color) in enumerate(
        ((finding.base, "belief", PLANNED), (finding.final, "with the causes", FLOWN))
    ):
        z = look.z * w[:, None]
        variance = (z**2).sum(axis=(0, 2)) / w.sum()
        memory = (z[1:] * z[:-1]).sum(axis=(0, 2)) / np.maximum((z**2).sum(axis=(0, 2)), 1e-300)
        for ax, values in zip(axes[0], (variance, memory), strict=True):
            ax.bar(x + 0.38 * (k - 0.5), values * finding.data.told, 0.36, color=color, label=name)
    axes[0, 0].axhline(1, color=INK, lw=1, ls="--")
    axes[0, 0].set_title("Variance against the noise's (1)")
    axes[0, 1].set_title("Correlation at one step (0)")
    for ax in axes[0]:
        ax.set_xticks(x, labels, rotation=45)
    legend(axes[0, 1])
    return figure


def variables(finding: Finding) -> dict[str, Float[np.ndarray, "N R"]]:
    """What errors may depend on: states, commands, voltage, time, where each step begins."""
    d = finding.data
    qw, qx, qy, qz = (d.X[:-1, i] for i in range(4))
    found = {n: d.V[:-1, i] for i, n in enumerate(("u", "v", "w", "p", "q", "r"))}
    found["heading"] = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy**2 + qz**2))
    found |= {"east": d.X[:-1, 4], "north": d.X[:-1, 5], "height": d.X[:-1, 6]}
    found["voltage"] = d.voltage
    found["effort"] = np.abs(d.u).sum(axis=1)
    found["time"] = d.times[:-1]
    return found


def error_map(
    z: Float[np.ndarray, "n a"], variables: Mapping[str, Float[np.ndarray, " n"]], most: int = _BINS
) -> Float[np.ndarray, "a k"]:
    """Nats by axis and variable: ½ Σ n m² of means m in bins of equal counts, less the bins.

    White errors of unit variance give about zero; what depends on a variable gives much.
    """
    found = np.zeros((z.shape[1], len(variables)))
    for k, values in enumerate(variables.values()):
        edges = np.unique(np.quantile(values, np.linspace(0, 1, most + 1)))
        if len(edges) < 3:
            continue
        bins = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
        counts = np.bincount(bins, minlength=len(edges) - 1)
        for i in range(z.shape[1]):
            sums = np.bincount(bins, weights=z[:, i], minlength=len(counts))
            nats = (sums**2 / np.maximum(counts, 1)).sum() / 2 - len(counts) / 2
            found[i, k] = max(float(nats), 0.0)
    return found


def draw_map(
    maps: Sequence[Float[np.ndarray, "a k"]],
    titles: Sequence[str],
    variables: Sequence[str],
    axes_of: Sequence[str],
) -> Figure:
    """Maps of nats side by side, on one scale."""
    height = 1.2 + 0.32 * len(axes_of)
    figure, axes = panels(1, len(maps), height, sharey=True)
    top = max(10.0, float(np.max(maps)))
    images = []
    for ax, values, title in zip(axes[0], maps, titles, strict=True):
        image = ax.imshow(np.log10(1 + values), vmin=0, vmax=np.log10(1 + top), cmap="PuBu")
        images.append(image)
        ax.set_aspect("auto")
        ax.set_xticks(range(len(variables)), list(variables), rotation=60)
        ax.set_yticks(range(len(axes_of)), axes_of)
        ax.grid(visible=False)
        ax.set_title(title)
    bar = figure.colorbar(images[0], ax=axes[0].tolist(), shrink=0.9)
    ticks = [t for t in range(8) if t <= np.log10(1 + top)]
    bar.set_ticks(ticks, labels=[f"{10**t:g}" for t in ticks])
    bar.set_label("nats")
    return figure


def innovations_of(finding: Finding, look: Look) -> Float[np.ndarray, "n 6"]:
    """Whitened innovations of the twist at all steps that exist."""
    return look.z[:, 6:].swapaxes(1, 2)[finding.data.weight > 0].astype(float)


def where_they_are(finding: Finding) -> dict[str, Float[np.ndarray, " n"]]:
    """What innovations may depend on, at all steps that exist."""
    exists = finding.data.weight > 0
    return {name: values[exists] for name, values in variables(finding).items()}


@styled
def map_figure(finding: Finding) -> Figure:
    """Where the error lives: axis against state and input, belief and explained."""
    known = where_they_are(finding)
    looks = (finding.base, finding.final)
    maps = [error_map(innovations_of(finding, look), known) for look in looks]
    return draw_map(maps, ("Belief", "With the causes"), list(known), _TWIST)


@styled
def experiments_figure(diagnosis: Diagnosis) -> Figure | None:
    """What each maneuver of the set is expected to tell about each cause; None if it makes none."""
    causes = [c for c in diagnosis.causes if c.experiments]
    if not causes:
        return None
    trials = list(dict.fromkeys(name for c in causes for name in c.experiments))
    figure, axes = panels(1, len(causes), 0.9 + 0.22 * len(trials), sharey=True)
    for ax, c in zip(axes[0], causes, strict=True):
        nats = np.array([c.experiments.get(name, 0.0) for name in trials])
        colors = [FLOWN if n == nats.max() else QUIET for n in nats]
        ax.barh(range(len(trials)), np.maximum(nats, 0.01), color=colors, height=0.7)
        ax.set_xscale("log")
        ax.set_xlim(left=0.01)
        ax.set_xlabel("nats a minute")
        ax.set_title(f"{c.name.replace('_', ' ')} · {c.where}")
    axes[0, 0].set_yticks(range(len(trials)), trials)
    axes[0, 0].invert_yaxis()
    return figure


@styled
def horizon_figure(diagnosis: Diagnosis) -> Figure:
    """Errors and scores of simulations against their horizon, on data left out, with 95 %."""
    figure, axes = panels(1, 4, 2.7)
    titles = ("position / m", "rotation / rad", "velocity / (m/s)", "energy score")
    colors = {"base": PLANNED, "refitted": QUIET, "black_box": INK, "extended": FLOWN}
    for name, gain in diagnosis.gain.items():
        tables = (gain.position_rmse, gain.rotation_rmse, gain.velocity_rmse, gain.energy_score)
        style = {"base": "o-", "extended": "o-", "refitted": "s--", "black_box": "^:"}[name]
        for ax, table, title in zip(axes[0], tables, titles, strict=True):
            h = [float(k) for k in table]
            value = [v.value for v in table.values()]
            low, high = np.array([v.interval95 for v in table.values()]).T
            ax.fill_between(h, low, high, color=colors[name], alpha=0.13, lw=0)
            ax.plot(h, value, style, ms=3.5, color=colors[name], label=name.replace("_", " "))
            ax.set_title(title)
            ax.set_xlabel("horizon / s")
            ax.set_ylim(bottom=0)
    axes[0, 3].legend(loc="upper left", fontsize=7, frameon=False)
    return figure


@styled
def innovations_figure(finding: Finding) -> Figure:
    """Mean innovation over time in the scenario that the belief explains worst."""
    d = finding.data
    score = (finding.base.z**2).sum(axis=(0, 1))
    there = np.unique(d.scenario)  # faulty runs are left out, and with them whole scenarios
    worst = int(there[np.argmax([score[d.scenario == s].mean() for s in there])])
    own = d.scenario == worst
    figure, axes = panels(2, 3, 3.9, sharex=True, sharey=True)
    bins = np.maximum(np.rint(d.times[1:, own] / d.dt).astype(int) - 1, 0)
    count = np.bincount(bins.ravel(), d.weight[:, own].ravel())
    t = d.dt * np.arange(1, len(count) + 1)
    for i, ax in enumerate(axes.flat):
        ax.axhspan(-2, 2, color=QUIET, alpha=0.15, lw=0)
        for look, name, color in (
            (finding.base, "belief", PLANNED),
            (finding.final, "with the causes", FLOWN),
        ):
            total = np.bincount(bins.ravel(), look.z[:, 6 + i][:, own].ravel())
            mean = total / np.sqrt(np.maximum(count, 1))
            ax.plot(t, mean, color=color, lw=0.9, label=name)
        ax.set_title(_TWIST[i])
    for ax in axes[-1]:
        ax.set_xlabel("t / s")
    for ax in axes[:, 0]:
        ax.set_ylabel("standard errors")
    figure.suptitle(
        f"Mean innovation of {int(own.sum())} runs of '{d.names[worst]}'; grey: what noise does",
        fontsize=9.5, x=0.01, ha="left",
    )  # fmt: skip
    legend(axes[0, 2])
    return figure
