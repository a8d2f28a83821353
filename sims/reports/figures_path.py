"""Figures of a run in space: its path among the obstacles, and the planner's samples."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from scipy.ndimage import gaussian_filter

from ...models import se3
from ...systems.planning.obstacles import Pylon
from ..run.log import Plans, RunLog
from .figures import ESTIMATE, FLOWN, GOAL, INK, OBSTACLE, PLANNED, QUIET, WATER, panels, styled

_FOOTPRINTS = 9
_SPACE = 0.7  # m of margin around the drawn objects
_DENSITY = LinearSegmentedColormap.from_list(
    "density", ["#ffffff", "#f6d9bd", "#d9772b", "#7d3b0c"]
)


@dataclass(frozen=True)
class Scene:
    """The surroundings of the vehicle, and its size.

    Attributes:
        size: length, width, height of the vehicle (m).
        obstacles: pylons.
        goal: position in W (m).
        goal_radius: (m).
        water_depth: the bed lies at z = −water_depth (m).
    """

    size: tuple[float, float, float]
    obstacles: tuple[Pylon, ...] = ()
    goal: tuple[float, float, float] | None = None
    goal_radius: float = 0.5
    water_depth: float | None = None


@styled
def path_figure(log: RunLog, scene: Scene) -> Figure:
    """The path from above and from the side, with obstacles, goal and the vehicle's footprint."""
    low, high = _box(log, scene)
    wide, deep = high[0] - low[0], high[1] - low[1]
    tall = high[2] - low[2]
    height = float(np.clip(9.0 * (deep + tall) / wide + 1.5, 4.5, 9.5))
    figure, axes = panels(2, 1, height, height_ratios=[deep, tall])
    above, side = axes[:, 0]
    p, t = log["X_WB"][:, 4:], log.time
    for ax, (i, j) in ((above, (0, 1)), (side, (0, 2))):
        if "X_WB_plan" in log:
            plan = np.where(log["plan_valid"][:, None] > 0.5, log["X_WB_plan"][:, 4:], np.nan)
            ax.plot(plan[:, i], plan[:, j], color=PLANNED, lw=1.2, label="planned", zorder=3)
        ax.plot(p[:, i], p[:, j], color=FLOWN, lw=2, label="flown", zorder=4)
        if "X_WB_estimate" in log:
            e = log["X_WB_estimate"][:, 4:]
            ax.plot(e[:, i], e[:, j], "--", color=ESTIMATE, lw=1.1, label="estimated", zorder=5)
        ax.plot(p[0, i], p[0, j], "o", color=FLOWN, ms=6, zorder=6)
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[j], high[j])
        ax.set_aspect("equal", adjustable="box")
    for k in _moments(t, p, _FOOTPRINTS):
        _footprint(above, log["X_WB"][k], scene.size, alpha=0.16)
    draw_above(above, scene)
    _draw_side(side, scene, low)
    above.set_title("From above")
    above.set_ylabel("y / m")
    side.set_title("From the side")
    side.set_xlabel("x / m")
    side.set_ylabel("z / m")
    above.legend(loc="upper right", ncols=3, bbox_to_anchor=(1.0, 1.11), borderaxespad=0)
    return figure


@styled
def samples_figure(log: RunLog, scene: Scene, moments: int = 6) -> Figure | None:
    """The density of the planner's samples and its plan, at several times.

    After the contour maps of the paper's field experiments. None without samples.
    """
    plans = log.plans
    if plans is None or plans.p_WB is None or plans.time.size < 2:
        return None
    p = log["X_WB"][:, 4:]
    low, high = _box(log, scene)
    start = np.searchsorted(log.time, plans.time[0])
    at = [float(log.time[k]) for k in _moments(log.time[start:], p[start:], moments) + start]
    rows = -(-moments // 3)
    ratio = (high[1] - low[1]) / (high[0] - low[0])
    figure, axes = panels(rows, 3, float(np.clip(rows * (3.1 * ratio + 0.45), 2.5, 11)))
    for ax in axes.flat[len(at) :]:
        ax.set_axis_off()
    for ax, t in zip(axes.flat, at, strict=False):
        k = plans.at(t)
        assert k is not None
        _density(ax, plans, k, low, high)
        ax.plot(p[:, 0], p[:, 1], color=QUIET, lw=0.7, alpha=0.7, zorder=2)
        plan = plans.X_WB[k][:, 4:]
        ax.plot(plan[:, 0], plan[:, 1], color=INK, lw=1.3, zorder=4)
        now = int(np.searchsorted(log.time, plans.time[k]))
        _footprint(ax, log["X_WB"][min(now, len(p) - 1)], scene.size, alpha=0.9)
        draw_above(ax, scene, names=False)
        ax.set_title(f"{plans.time[k]:.1f} s")
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        ax.set_aspect("equal", adjustable="box")
        ax.grid(visible=False)
    for ax in axes[:, 0]:
        ax.set_ylabel("y / m")
    for ax in axes[-1]:
        ax.set_xlabel("x / m")
    return figure


def draw_above(ax: Axes, scene: Scene, names: bool = True) -> None:
    """Draw pylons and goal as seen from above."""
    for pylon in scene.obstacles:
        centre = (pylon.x, pylon.y)
        ax.add_patch(Circle(centre, pylon.diameter / 2, fc=OBSTACLE, ec="white", lw=0.8, zorder=5))
        if names and pylon.name:
            ax.annotate(
                pylon.name,
                (pylon.x + pylon.diameter / 2, pylon.y),
                xytext=(4, 0),
                textcoords="offset points",
                color=QUIET,
                fontsize=8,
                va="center",
                zorder=6,
            )
    if scene.goal is not None:
        x, y, _ = scene.goal
        circle = Circle((x, y), scene.goal_radius, fill=False, ec=GOAL, lw=1.4, ls="--", zorder=5)
        ax.add_patch(circle)
        ax.plot(x, y, "+", color=GOAL, ms=7, mew=1.6, zorder=6)


def _draw_side(ax: Axes, scene: Scene, low: np.ndarray) -> None:
    for pylon in scene.obstacles:
        corner = (pylon.x - pylon.diameter / 2, pylon.bottom)
        ax.add_patch(
            Rectangle(
                corner,
                pylon.diameter,
                pylon.top - pylon.bottom,
                fc=OBSTACLE,
                ec="white",
                alpha=0.55,
            )
        )
    ax.axhline(0, color=WATER, lw=1.4)
    ax.annotate(
        "surface",
        (low[0], 0),
        xytext=(4, -10),
        textcoords="offset points",
        color=WATER,
        fontsize=8,
    )
    if scene.goal is not None:
        x, _, z = scene.goal
        circle = Circle((x, z), scene.goal_radius, fill=False, ec=GOAL, lw=1.4, ls="--", zorder=5)
        ax.add_patch(circle)


def _footprint(
    ax: Axes, X_WB: Float[np.ndarray, "7"], size: tuple[float, float, float], alpha: float
) -> None:
    half = np.array(size) / 2
    # the bow is tapered to show the heading
    x = np.array([1.0, 0.55, -1.0, -1.0, 0.55, 1.0]) * half[0]
    y = np.array([0.45, 1.0, 1.0, -1.0, -1.0, -0.45]) * half[1]
    corners = jnp.asarray(np.stack([x, y, np.zeros(6)]))
    X = jnp.broadcast_to(jnp.asarray(X_WB)[:, None], (7, 6))
    p = np.asarray(se3.act(X, corners))
    ax.add_patch(Polygon(p[:2].T, closed=True, fc=FLOWN, ec="none", alpha=alpha, zorder=3.5))


def _density(ax: Axes, plans: Plans, k: int, low: np.ndarray, high: np.ndarray) -> None:
    assert plans.p_WB is not None
    p = plans.p_WB[k]
    bins = [np.arange(low[i], high[i] + 0.06, 0.06) for i in (0, 1)]
    count, xs, ys = np.histogram2d(p[:, 0].ravel(), p[:, 1].ravel(), bins=bins)
    count = gaussian_filter(count, 1.6)
    if count.max() <= 0:
        return
    levels = np.array([0.01, 0.04, 0.1, 0.2, 0.4, 0.7, 1.0]) * count.max()
    middle = [(edges[1:] + edges[:-1]) / 2 for edges in (xs, ys)]
    ax.contourf(*middle, count.T, levels=levels, cmap=_DENSITY, zorder=1, alpha=0.95)


def _moments(t: np.ndarray, p: np.ndarray, count: int) -> np.ndarray:
    """Indices spread evenly in the mean of time and distance travelled, both normalised."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    measure = (t - t[0]) / max(t[-1] - t[0], 1e-9) + way / max(way[-1], 1e-9)
    return np.unique(np.searchsorted(measure, np.linspace(0, measure[-1], count) - 1e-9))


def _box(log: RunLog, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the region in the figures (m)."""
    points = [log["X_WB"][:, 4:]]
    if scene.goal is not None:
        goal = np.array(scene.goal)
        points.append(np.stack([goal - scene.goal_radius, goal + scene.goal_radius]))
    near = np.concatenate(points)
    for pylon in scene.obstacles:
        middle = [pylon.x, pylon.y, near[0, 2]]
        points.append(np.array([middle]) + pylon.diameter / 2 * np.array([[-1, -1, 0], [1, 1, 0]]))
    every = np.concatenate(points)
    every = every[np.all(np.isfinite(every), axis=1)]
    low, high = every.min(axis=0) - _SPACE, every.max(axis=0) + _SPACE
    middle, least = (low[:2] + high[:2]) / 2, np.array([3.0, 1.6])
    half = np.maximum(high[:2] - low[:2], least) / 2
    half[1] = max(half[1], 0.22 * half[0])
    low[:2], high[:2] = middle - half, middle + half
    high[2] = max(high[2], 0.25)
    return low, high
