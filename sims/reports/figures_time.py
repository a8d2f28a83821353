"""Figures of a run over time: errors, estimates, commands, disturbances, the planner."""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...models.se3 import AXES, XYZ
from ...systems.planning.mppi import FIGURES
from ..run.estimate import HEALTH, estimate_error
from ..run.log import RunLog
from ..run.metrics import tracking_error
from .figures import (
    ESTIMATE,
    FLOWN,
    GOAL,
    INK,
    LIMIT,
    OBSTACLE,
    PLANNED,
    WATER,
    at_least,
    common_legend,
    legend,
    lines,
    panels,
    styled,
)

_ANGLES = AXES[3:]
_TIME = "time / s"
PWM_RANGE = (1100.0, 1900.0)  # µs


@styled
def tracking_figure(log: RunLog) -> Figure | None:
    """Plan minus truth: position and attitude, in B. None if there never was a plan."""
    error = tracking_error(log)
    if error is None:
        return None
    figure, axes = panels(2, 1, 4.0, sharex=True)
    lines(axes[0, 0], log.time, 100 * error[0][:, :3], XYZ)
    lines(axes[1, 0], log.time, np.rad2deg(error[0][:, 3:]), _ANGLES)
    at_least(axes[0, 0], 2.0)
    at_least(axes[1, 0], 2.0)
    axes[0, 0].set_title("Position")
    axes[0, 0].set_ylabel("cm")
    axes[1, 0].set_title("Attitude")
    axes[1, 0].set_ylabel("degrees")
    axes[1, 0].set_xlabel(_TIME)
    for ax in axes[:, 0]:
        legend(ax)
    return figure


@styled
def estimate_figure(log: RunLog) -> Figure | None:
    """The filter's error with its estimated ± 3σ; None without estimates.

    A strip at the bottom of each panel is coloured by the filter's health, if that was logged.
    """
    known = estimate_error(log)
    if known is None:
        return None
    error, std = known
    scale = np.repeat([100.0, 180 / np.pi, 100.0], 3)
    figure, axes = panels(3, 3, 5.6, sharex=True)
    units = ("cm", "degrees", "cm/s")
    for i, (name, labels) in enumerate(
        (("Position", XYZ), ("Attitude", _ANGLES), ("Velocity", XYZ))
    ):
        for j, label in enumerate(labels):
            ax, c = axes[i, j], 3 * i + j
            band = 3 * scale[c] * std[:, c]
            ax.fill_between(log.time, -band, band, color=ESTIMATE, alpha=0.16, lw=0, label="± 3σ")
            ax.plot(log.time, scale[c] * error[:, c], color=ESTIMATE, lw=1, label="error")
            ax.set_title(f"{name}, {label}")
            if "health" in log:
                _health_strip(ax, log)
        axes[i, 0].set_ylabel(units[i])
    for ax in axes[-1]:
        ax.set_xlabel(_TIME)
    common_legend(figure, axes[0, 2])
    return figure


_HEALTH = (GOAL, PLANNED, LIMIT)  # good, degraded, lost


def _health_strip(ax: Axes, log: RunLog) -> None:
    """A strip along the time axis, coloured by the filter's health."""
    state = np.clip(np.nan_to_num(log["health"][:, 0], nan=2.0), 0, 2)
    begins = np.flatnonzero(np.diff(state, prepend=-1))
    ends = np.append(begins[1:], state.size)
    for number, (name, color) in enumerate(zip(HEALTH, _HEALTH, strict=True)):
        spans = [
            (log.time[a], (b - a) * log.dt)
            for a, b in zip(begins, ends, strict=True)
            if state[a] == number
        ]
        if spans:
            ax.broken_barh(
                spans, (0, 0.04), color=color, lw=0, label=name,
                transform=ax.get_xaxis_transform(),
            )  # fmt: skip


@styled
def wrench_figure(log: RunLog, limits: Float[np.ndarray, "6"] | None = None) -> Figure:
    """The commanded wrench; dashed: the limit of each axis alone."""
    figure, axes = panels(2, 3, 3.7, sharex=True)
    names = ("X, forward", "Y, left", "Z, up", "K, roll", "M, pitch", "N, yaw")
    for c, (ax, name) in enumerate(zip(axes.flat, names, strict=True)):
        ax.plot(log.time, log["F_Bo_B"][:, c], color=FLOWN, lw=1)
        if limits is not None:
            largest = np.abs(log["F_Bo_B"][:, c]).max()
            if largest > 0.6 * limits[c]:
                for sign in (-1, 1):
                    ax.axhline(sign * limits[c], color=LIMIT, lw=1, ls="--")
                ax.set_title(name)
            else:
                ax.set_title(f"{name} (limit ± {limits[c]:.0f})")
        else:
            ax.set_title(name)
    axes[0, 0].set_ylabel("N")
    axes[1, 0].set_ylabel("N m")
    for ax in axes[-1]:
        ax.set_xlabel(_TIME)
    return figure


@styled
def pwm_figure(log: RunLog, dead_band: tuple[float, float] = (1475.0, 1525.0)) -> Figure | None:
    """Pulse widths of the thrusters; the grey band gives no thrust. None without PWM."""
    if "pwm" not in log:
        return None
    pwm = log["pwm"]
    columns = (pwm.shape[1] + 1) // 2
    figure, axes = panels(2, columns, 3.5, sharex=True, sharey=True)
    for ax in axes.flat[pwm.shape[1] :]:
        ax.set_axis_off()
    for k, ax in enumerate(axes.flat[: pwm.shape[1]]):
        ax.axhspan(*dead_band, color=OBSTACLE, alpha=0.25, lw=0)
        for end in PWM_RANGE:
            ax.axhline(end, color=LIMIT, lw=1, ls="--")
        ax.plot(log.time, pwm[:, k], color=FLOWN, lw=0.9)
        ax.set_title(f"Thruster {k + 1}")
        ax.set_ylim(1060, 1940)
        ax.set_yticks([1100, 1300, 1500, 1700, 1900])
    for ax in axes[:, 0]:
        ax.set_ylabel("µs")
    for ax in axes[-1]:
        ax.set_xlabel(_TIME)
    return figure


@styled
def disturbance_figure(log: RunLog) -> Figure | None:
    """The flow at the vehicle, and the disturbance wrench; None if not logged."""
    if "flow_W" not in log and "F_disturbance_Bo_B" not in log:
        return None
    figure, axes = panels(3, 1, 5.2, sharex=True)
    flow = log["flow_W"][:, :3] if "flow_W" in log else np.zeros((log.time.size, 3))
    lines(axes[0, 0], log.time, 100 * flow, XYZ)
    axes[0, 0].plot(
        log.time, 100 * np.linalg.norm(flow, axis=1), color=WATER, lw=0.9, alpha=0.7, label="speed"
    )
    axes[0, 0].set_title("Water's velocity (current, waves, wake), in W")
    axes[0, 0].set_ylabel("cm/s")
    F = log["F_disturbance_Bo_B"] if "F_disturbance_Bo_B" in log else np.zeros((log.time.size, 6))
    lines(axes[1, 0], log.time, F[:, :3], XYZ, lw=0.9)
    lines(axes[2, 0], log.time, F[:, 3:], _ANGLES, lw=0.9)
    axes[1, 0].set_title("Other pushes: force, in B")
    axes[1, 0].set_ylabel("N")
    axes[2, 0].set_title("Other pushes: moment, in B")
    axes[2, 0].set_ylabel("N m")
    axes[2, 0].set_xlabel(_TIME)
    for ax in axes[:, 0]:
        legend(ax)
    return figure


@styled
def progress_figure(
    log: RunLog,
    clearance: Float[np.ndarray, " n"] | None,
    goal: tuple[float, float, float] | None,
    goal_radius: float = 0.5,
) -> Figure | None:
    """Distance to the goal and to the nearest obstacle; None if there is neither."""
    if clearance is None and goal is None:
        return None
    figure, axes = panels(1, 1, 2.3)
    ax = axes[0, 0]
    if goal is not None:
        distance = np.linalg.norm(log["X_WB"][:, 4:] - np.array(goal), axis=1)
        ax.plot(log.time, distance, color=FLOWN, label="to the goal")
        ax.axhline(
            goal_radius, color=GOAL, lw=1, ls="--", label=f"goal's radius, {goal_radius:g} m"
        )
    if clearance is not None:
        ax.plot(log.time, clearance, color=LIMIT, label="hull to the nearest obstacle")
    ax.set_ylim(bottom=0.0 if clearance is None else min(0.0, float(clearance.min())))
    ax.set_ylabel("m")
    ax.set_xlabel(_TIME)
    ax.set_title("Distance")
    legend(ax)
    return figure


@styled
def planner_figure(log: RunLog) -> Figure | None:
    """The planner's cost, collision risk with the allowed risk, and expected clearance."""
    plans = log.plans
    if plans is None or plans.figures is None or plans.time.size < 2:
        return None
    figure, axes = panels(1, 3, 2.2, sharex=True)
    shown = (
        ("cost", "Cost of the plan", 1.0, FLOWN),
        ("collision_probability", "Collision risk / %", 100.0, LIMIT),
        ("clearance", "Expected clearance / m", 1.0, OBSTACLE),
    )
    for ax, (name, title, scale, color) in zip(axes[0], shown, strict=True):
        values = scale * plans.figures[:, FIGURES.index(name)]
        finite = np.isfinite(values)
        ax.plot(plans.time[finite], values[finite], color=color, lw=1.1)
        ax.set_title(title)
        ax.set_xlabel(_TIME)
        ax.set_ylim(bottom=0 if not finite.any() or values[finite].min() >= 0 else None)
    if plans.allowed is not None:
        ax = axes[0, 1]
        ax.axhline(100 * plans.allowed, color=INK, lw=1, ls="--", label="allowed")
        ax.set_ylim(top=max(ax.get_ylim()[1], 120 * plans.allowed))
        legend(ax)
    return figure
