"""Shared style of the figures of all reports: colours, fonts, axes."""

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure

P = ParamSpec("P")
F = TypeVar("F")

FLOWN, PLANNED, ESTIMATE = "#14607a", "#d9772b", "#7b5ea7"
OBSTACLE, GOAL, LIMIT, WATER = "#8b96a1", "#2e8b57", "#b0413e", "#3d8fc4"
INK, QUIET, GRID = "#1c2733", "#5b6b7a", "#e6ebef"
XYZ_COLORS = ("#c4473a", "#3b8a4a", "#2f6fb5")  # x, y, z
WIDTH = 9.6  # in: the width of a page's text
_SPAN, _LONG = 5.0, 300.0
"""Ratio of values from which an axis is logarithmic (two of 1, 2 and 5 are then on it), and ratio
of its ends from which only powers of ten are labelled."""

_STYLE: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.edgecolor": "#c4ced6",
    "axes.grid": True,
    "axes.labelcolor": QUIET,
    "axes.labelsize": 9,
    "axes.linewidth": 0.8,
    "axes.prop_cycle": cycler(color=[FLOWN, PLANNED, ESTIMATE, GOAL, LIMIT, WATER]),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "figure.facecolor": "white",
    "font.size": 9,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "text.color": INK,
    "xtick.color": "#c4ced6",
    "xtick.labelcolor": QUIET,
    "xtick.labelsize": 8.5,
    "ytick.color": "#c4ced6",
    "ytick.labelcolor": QUIET,
    "ytick.labelsize": 8.5,
}


def styled(draw: Callable[P, F]) -> Callable[P, F]:
    """Draw a figure in the reports' style, without changing matplotlib's settings."""

    @wraps(draw)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> F:
        with matplotlib.rc_context(_STYLE):
            return draw(*args, **kwargs)

    return wrapper


def panels(rows: int, columns: int, height: float, **options: Any) -> tuple[Figure, np.ndarray]:
    """A figure of the page's width with an array (rows, columns) of axes."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    return figure, axes


def lines(
    axes: Axes, t: np.ndarray, values: np.ndarray, labels: tuple[str, ...], **options: Any
) -> None:
    """One line for each column."""
    for column, label, color in zip(values.T, labels, XYZ_COLORS, strict=False):
        axes.plot(t, column, label=label, color=color, **options)


def at_least(axes: Axes, half: float) -> None:
    """Let the vertical axis span at least ± `half`, so that noise is not magnified."""
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, -half), max(high, half))


def legend(axes: Axes, **options: Any) -> None:
    """A legend in one row above the axes, at the right, where it covers no data."""
    handles, _ = axes.get_legend_handles_labels()
    settings = {
        "loc": "lower right",
        "bbox_to_anchor": (1.0, 1.0),
        "ncols": len(handles),
        "borderaxespad": 0.2,
        "columnspacing": 1.2,
        "handlelength": 1.4,
    }
    if handles:
        axes.legend(**(settings | options))


def common_legend(figure: Figure, axes: Axes) -> None:
    """One legend row above all panels, at the right, from the axes of one of them."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper right", ncols=len(handles), frameon=False,
        handlelength=1.4, columnspacing=1.2, borderaxespad=0.0,
    )  # fmt: skip


def plain_logs(axes: Axes) -> None:
    """Plain decimal labels on a logarithmic axis: 0.5, 2, 30; powers of ten alone if it is long."""

    def between(x: float, _: object) -> str:
        low, high = axes.get_ylim()
        return f"{x:g}" if f"{x:e}"[0] in "25" and high < _LONG * low else ""

    axes.yaxis.set_major_formatter(lambda x, _: f"{x:g}")
    axes.yaxis.set_minor_formatter(between)


def scaled(ax: Axes, values: np.ndarray, bars: bool = False) -> None:
    """A vertical axis with at least two labels: logarithmic if values differ by `_SPAN` or more."""
    finite = values[np.isfinite(values) & (values > 0)]
    if len(finite) and finite.max() > _SPAN * finite.min():
        ax.set_yscale("log")
        plain_logs(ax)
    elif bars:
        ax.set_ylim(bottom=0)
