"""Figures of a diagnosis: simulations compared with records."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from ...models import se3
from ...models.se3 import CHANNELS
from ...training.diagnosis.pipeline import Finding
from ...training.diagnosis.validation.simulation import Simulated
from .figures import FLOWN, GRID, INK, PLANNED, common_legend, legend, panels, scaled, styled
from .figures_maps import draw_map, error_map, variables

_UNITS = ("m", "m", "m", "°", "°", "°", "m/s", "m/s", "m/s", "°/s", "°/s", "°/s")
_BAND, _LOST = 0.9, 1e6
"""Share of simulations in a band; size of an error beyond which a simulation has diverged."""
_SCALE = np.array([1, 1, 1, *3 * (180 / np.pi,)] * 2)
"""From SI to the units in figures."""
MODELS = {"base": ("belief", PLANNED), "extended": ("with the causes", FLOWN)}


def contenders(finding: Finding) -> list[tuple[Simulated, str, str]]:
    """Simulations with name and colour: of the belief, and with the causes if there are any."""
    kept = [(finding.simulated.get(key), *style) for key, style in MODELS.items()]
    return [(s, name, color) for s, name, color in kept if s is not None]


def shown(
    X: Float[np.ndarray, "N 7 *s"], V: Float[np.ndarray, "N 6 *s"]
) -> Float[np.ndarray, "N 12 *s"]:
    """Position (m), roll, pitch and yaw (°), velocity (m/s) and turning rate (°/s).

    Attitudes of a diverged simulation are NaN.
    """
    q = np.moveaxis(X[:, [1, 2, 3, 0]], 1, -1)
    lost = np.asarray(~np.isfinite(q).all(axis=-1))
    q = np.where(lost[..., None], [0.0, 0.0, 0.0, 1.0], q)
    angles = Rotation.from_quat(q.reshape(-1, 4)).as_euler("ZYX").reshape(*q.shape[:-1], 3)
    angles[lost] = np.nan
    turned = np.moveaxis(angles[..., ::-1], -1, 1)
    return np.concatenate([X[:, 4:], turned, V], axis=1) * _SCALE.reshape(12, *(1,) * (X.ndim - 2))


def _compared(finding: Finding) -> list[int]:
    """Channels whose simulations are compared with records."""
    return np.flatnonzero(finding.data.compared).tolist()


def _title(finding: Finding, i: int) -> str:
    """A channel with its unit, or that it was not measured."""
    if i not in _compared(finding):
        return f"{CHANNELS[i]}: not measured"
    return f"{CHANNELS[i]} / {_UNITS[i]}"


def _bounded(values: np.ndarray) -> np.ndarray:
    """The values, with diverged ones replaced by ±`_LOST`."""
    return np.clip(np.nan_to_num(values, nan=_LOST, posinf=_LOST, neginf=-_LOST), -_LOST, _LOST)


def _typical(finding: Finding, simulated: Simulated) -> int:
    """The run with the median error in the scenario that the belief forecasts worst."""
    e = simulated.errors[:, _compared(finding), 0].astype(float)
    error = _bounded((e**2).sum(axis=(0, 1)))
    scenario = finding.data.scenario[simulated.pieces]
    there = np.unique(scenario)
    worst = there[np.argmax([np.median(error[scenario == s]) for s in there])]
    own = np.flatnonzero(scenario == worst)
    return int(own[np.argsort(error[own])[len(own) // 2]])


@styled
def bands_figure(finding: Finding) -> Figure:
    """A recorded run in the 90 % bands of simulations, which restart from records."""
    data, first = finding.data, contenders(finding)[0][0]
    k = _typical(finding, first)
    piece = int(first.pieces[k])
    n = int(data.weight[:, piece].sum())
    t = data.times[1 : n + 1, piece]
    X, V = data.X[1 : n + 1, :, piece], data.V[1 : n + 1, :, piece]
    record = shown(X, V)
    figure, axes = panels(4, 3, 6.6, sharex=True)
    for simulated, name, color in contenders(finding):
        e = simulated.errors[:n, :, 1:, k].astype(float)
        e[~(np.abs(e) < _LOST)] = np.nan
        away = jnp.asarray(np.moveaxis(-e[:, :6], 1, 0))
        X_s = se3.retract(jnp.asarray(X.T)[:, :, None], away)
        found = shown(np.moveaxis(np.asarray(X_s), 0, 1), V[:, :, None] - e[:, 6:])
        turn = found[:, 3:6] - record[:, 3:6, None]
        found[:, 3:6] = record[:, 3:6, None] + (turn + 180) % 360 - 180
        low, high = np.quantile(found, ((1 - _BAND) / 2, (1 + _BAND) / 2), axis=2)
        for i, ax in zip(_compared(finding), axes.flat[_compared(finding)], strict=True):
            for a in range(0, n, simulated.every):  # no line from window to window
                b = slice(a, a + simulated.every)
                named = name if a == 0 else None
                ax.fill_between(t[b], low[b, i], high[b, i], color=color, alpha=0.3, lw=0,
                                label=named)  # fmt: skip
    for i, ax in enumerate(axes.flat):
        if i in _compared(finding):
            ax.plot(t, record[:, i], color=INK, lw=1.0, label="recorded")
        ax.set_title(_title(finding, i))
        for a in range(first.every, n, first.every):
            ax.axvline(t[a], color=GRID, lw=1.2, zorder=0)
    for ax in axes[-1]:
        ax.set_xlabel("t / s")
    figure.suptitle(
        f"A run of '{data.names[int(data.scenario[piece])]}', simulated anew from each grey line: "
        "90 % bands",
        fontsize=9.5, x=0.01, ha="left",
    )  # fmt: skip
    common_legend(figure, axes.flat[_compared(finding)[0]])
    return figure


@styled
def axes_figure(finding: Finding) -> Figure:
    """Root mean square error of each axis against the horizon, without noise."""
    figure, axes = panels(2, 6, 3.9, sharex=True)
    dt = finding.data.dt
    for simulated, name, color in contenders(finding):
        exists = finding.data.weight[:, simulated.pieces] > 0
        e = simulated.errors[:, :, 0].astype(float) * _SCALE[:, None]
        square = np.zeros((simulated.every, 12))
        for h in range(simulated.every):
            square[h] = (
                (e[h :: simulated.every] ** 2)
                .swapaxes(1, 2)[exists[h :: simulated.every]]
                .mean(axis=0)
            )
        t = dt * np.arange(1, simulated.every + 1)
        for i, ax in zip(_compared(finding), axes.flat[_compared(finding)], strict=True):
            ax.plot(t, np.sqrt(square[:, i]), color=color, label=name)
    for i, ax in enumerate(axes.flat):
        ax.set_title(_title(finding, i))
        ax.set_ylim(bottom=0)
    for ax in axes[-1]:
        ax.set_xlabel("horizon / s")
    common_legend(figure, axes.flat[5])
    return figure


def at_ends(
    finding: Finding, simulated: Simulated, noise: Simulated | None = None
) -> tuple[Float[np.ndarray, "k 12"], dict[str, Float[np.ndarray, " k"]], np.ndarray]:
    """Errors at the ends of windows in units of the simulated spread (that of `noise`, other
    simulations of the same windows, if given), the means over each window of the `variables`, and
    the piece of each.
    """
    every, data = simulated.every, finding.data
    e = simulated.errors.astype(float)
    ends = np.arange(every - 1, len(e), every)
    exists = data.weight[ends][:, simulated.pieces] > 0
    own = _bounded(e[ends].transpose(0, 3, 1, 2)[exists])
    other = simulated if noise is None else noise
    drawn = _bounded(other.errors[ends].astype(float).transpose(0, 3, 1, 2)[exists])
    spread = drawn[:, :, 1:].std(axis=2)
    means = {}
    for name, values in variables(finding).items():
        windows = np.stack([values[n + 1 - every : n + 1, simulated.pieces].mean(0) for n in ends])
        means[name] = windows[exists]
    piece = np.broadcast_to(simulated.pieces, exists.shape)[exists]
    z = own[:, :, 0] / np.maximum(spread, 1e-12) * data.compared
    return _bounded(z), means, piece


@styled
def simulated_map_figure(finding: Finding) -> Figure:
    """Dependence of the errors at the ends of simulations on the `variables`, axis by axis."""
    maps, names, last = [], [], contenders(finding)[-1][0]
    for simulated, name, _ in contenders(finding):
        z, means, _ = at_ends(finding, simulated, last)
        bins = max(2, min(8, len(z) // 12))
        maps.append(error_map(z, means, bins))
        names.append(name[0].upper() + name[1:])
    return draw_map(maps, names, list(variables(finding)), CHANNELS)


@styled
def runs_figure(finding: Finding) -> Figure:
    """Errors run by run, of one step and of whole simulations, in units of the expected noise."""
    data = finding.data
    figure, axes = panels(2, 1, 4.0, sharex=True)
    order = np.lexsort((data.run, data.scenario))
    place = {int(piece): i for i, piece in enumerate(order)}
    for evaluation, (name, color) in zip(
        (finding.base, finding.final), MODELS.values(), strict=True
    ):
        count = np.maximum(data.weight.sum(axis=0) * data.measured.sum(), 1)
        z = evaluation.z[:, data.measured > 0].astype(float) if data.latent else evaluation.z
        one = np.sqrt((z.astype(float) ** 2).sum(axis=(0, 1)) / count)
        _dots(axes[0, 0], np.arange(len(order)), one[order], name, color)
    last = contenders(finding)[-1][0]
    for simulated, name, color in contenders(finding):
        z, _, piece = at_ends(finding, simulated, last)
        square = (z[:, data.measured > 0] ** 2).mean(axis=1)
        own = np.unique(piece)
        many = np.sqrt([square[piece == p].mean() for p in own])
        _dots(axes[1, 0], np.array([place[int(p)] for p in own]), many, name, color)
    scenario = data.scenario[order]
    edges = np.flatnonzero(np.diff(scenario)) + 0.5
    for ax, title in zip(axes[:, 0], ("One-step errors", "Errors of simulations"), strict=True):
        ax.axhline(1, color=INK, lw=1, ls="--")
        scaled(ax, np.concatenate([line.get_ydata() for line in ax.lines]))
        ax.set_title(f"{title} by run; dashed: what noise does")
        for edge in edges:
            ax.axvline(edge, color=GRID, lw=1.0, zorder=0)
    middle = [np.flatnonzero(scenario == s).mean() for s in np.unique(scenario)]
    labels = [data.names[s] for s in np.unique(scenario)]
    axes[-1, 0].set_xticks(middle, labels, rotation=25 if len(labels) > 6 else 0)
    axes[-1, 0].grid(visible=False, axis="x")
    legend(axes[0, 0])
    return figure


def _dots(ax: Axes, x: np.ndarray, y: np.ndarray, name: str, color: str) -> None:
    shown = np.isfinite(y)
    ax.plot(x[shown], y[shown], "o", ms=3.2, color=color, alpha=0.8, label=name)
