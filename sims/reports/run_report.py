"""The report of a run: one HTML page."""

import platform
from collections.abc import Sequence
from importlib import metadata
from typing import Any

import numpy as np
from jaxtyping import Float

from ...training.data.provenance import revision
from ..run.estimate import nees_words
from ..run.log import RunLog
from .figures_path import Scene, path_figure, samples_figure
from .figures_time import (
    disturbance_figure,
    estimate_figure,
    planner_figure,
    progress_figure,
    pwm_figure,
    tracking_figure,
    wrench_figure,
)
from .pages import Page

PACKAGES = ("spinndrift", "drake", "jax", "equinox", "numpy")
_NAMES = {
    "time_to_goal_s": "time to the goal (s)",
    "time_near_goal_s": "time near the goal (s)",
    "min_clearance_m": "minimum clearance (m)",
    "length_m": "length (m)",
    "max_speed_m_s": "highest speed (m/s)",
    "max_turn_rate_rad_s": "highest turn rate (rad/s)",
    "position_within_3_sigma": "position within 3σ",
    "attitude_within_3_sigma": "attitude within 3σ",
    "velocity_within_3_sigma": "velocity within 3σ",
    "position_nees": "NEES of the position, mean over the run",
    "attitude_nees": "NEES of the attitude, mean over the run",
    "velocity_nees": "NEES of the velocity, mean over the run",
    "nees_low": "NEES: lower 95 % bound of a single value",
    "nees_high": "NEES: upper 95 % bound of a single value",
    "health_good": "estimator good",
    "health_degraded": "estimator degraded",
    "health_lost": "estimator lost",
    "allowed_collision_probability": "allowed collision probability",
    "plans_beyond_allowed": "plans above the allowed probability",
    "least_risk_to_goal": "collision risk on the widest passage to the goal",
    "planner_median_ms": "planner call, median (ms)",
    "planner_p95_ms": "planner call, 95th percentile (ms)",
}


def run_page(
    log: RunLog,
    values: dict[str, Any],
    scene: Scene,
    *,
    title: str,
    description: str = "",
    scenario_text: str = "",
    limits: Float[np.ndarray, "6"] | None = None,
    limitation: str = "",
    clearance: Float[np.ndarray, " n"] | None = None,
    replay: str = "",
    checks: Sequence[tuple[str, bool, str]] = (),
) -> Page:
    """The page of a run.

    Args:
        log: of the run.
        values: its metrics (`sims.run.metrics.metrics`), with or without a `timing` block.
        scene: obstacles, goal, size of the vehicle.
        title: of the page.
        description: a sentence below it.
        scenario_text: the resolved scenario.
        limits: largest wrench along each axis alone.
        limitation: axes that the thrusters can't actuate, in a sentence.
        clearance: of the hull to the nearest obstacle over the log's time (m).
        replay: address of the 3-D replay.
        checks: name, result and words of each check of a vehicle's pre-flight.
    """
    outcome = values["outcome"]
    page = Page(title, description).verdict(outcome["words"], outcome["success"])
    page.tiles(_tiles(values))
    _path_section(page, log, scene, clearance, replay, values)
    _errors_section(page, log, values)
    page.section("Commands", "Commanded wrench and pulse widths of the thrusters.")
    page.figure(
        wrench_figure(log, limits),
        "Commanded wrench in B. Dashed, where it is near: the largest wrench that the thrusters "
        f"can give along that axis alone. {limitation}".rstrip(),
    )
    pwm = pwm_figure(log)
    if pwm is not None:
        page.figure(pwm, "Pulse widths. Grey: dead band. Dashed: ends of the range.")
    water = disturbance_figure(log)
    if water is not None:
        page.section("Disturbances", "Filter, planner and controller do not know these signals.")
        page.figure(water, "Velocity of the water at the vehicle, and disturbance wrench in B.")
    if checks:
        page.section("Pre-flight", "The checks before arming.")
        page.table([(name, words) for name, _, words in checks])
    page.section("Numbers")
    for group, block in values.items():
        if isinstance(block, dict) and block:
            told = {k: v for k, v in block.items() if k not in ("words", "health")}
            rows = [(_NAMES.get(k, _words(k)), v) for k, v in told.items()]
            page.table(rows, caption=group.capitalize(), width="half")
    if scenario_text:
        page.section("Scenario").details("Scenario with all defaults", scenario_text)
    return page.footer(_versions_line())


def _path_section(
    page: Page,
    log: RunLog,
    scene: Scene,
    clearance: np.ndarray | None,
    replay: str,
    values: dict[str, Any],
) -> None:
    text = f"The [3-D replay]({replay}) shows the whole run." if replay else ""
    if not log.placed:
        unknown = "The vehicle did not know its place, but its depth and attitude."
        page.section("Path", f"{unknown} {text}".strip())
        return
    page.section("Path", text)
    page.figure(
        path_figure(log, scene),
        "Planned, flown and estimated path. Shaded: the hull at several times. "
        + ("Grey: pylons. " if scene.obstacles else "")
        + ("Dashed circle: the goal." if scene.goal is not None else ""),
    )
    distance = progress_figure(log, clearance, scene.goal, scene.goal_radius)
    if distance is not None:
        page.figure(distance)
    samples = samples_figure(log, scene)
    if samples is not None:
        page.section("Planning", "Sampled paths and the chosen plan.")
        page.figure(
            samples,
            "Sampled paths at six times; darker where more of them pass. Black: the chosen plan. "
            "Grey: the path flown.",
        )
        planner = planner_figure(log)
        if planner is not None:
            page.figure(
                planner, f"Cost, risk and clearance of every plan.{_risk(values['planner'])}"
            )


def _risk(planner: dict[str, Any]) -> str:
    """Sentences on whether the chance constraint was satisfied."""
    allowed = planner.get("allowed_collision_probability")
    beyond = planner.get("plans_beyond_allowed")
    if allowed is None:
        return " The planner has no chance constraint."
    text = f" Dashed: the collision risk that the chance constraint allows, {100 * allowed:g} %."
    if not beyond:
        return f"{text} Every plan satisfies it."
    return (
        f"{text} In {beyond} of {planner['plans']} plans no sampled sequence satisfied it; the "
        f"risk was up to {100 * planner['max_collision_probability']:.2g} %."
    )


def _errors_section(page: Page, log: RunLog, values: dict[str, Any]) -> None:
    tracking = tracking_figure(log)
    if tracking is not None:
        page.section("Tracking", "Difference between the plan and the true state.")
        page.figure(tracking, "Plan minus truth, in B.")
    estimate = estimate_figure(log)
    if estimate is not None:
        within = values["estimate"].get("position_within_3_sigma")
        text = "Estimation error and its estimated standard deviation."
        if within is not None:
            text += f" {100 * within:.0f} % of the position errors lie within 3σ."
        text += consistency(values["estimate"])
        page.section("Estimate", text)
        page.figure(estimate, "Truth minus estimate in B, and three estimated standard deviations.")


def consistency(estimate: dict[str, Any]) -> str:
    """Sentences on a run's covariance and health of the filter."""
    told, text = nees_words(estimate), ""
    if told is not None:
        text = (
            " NEES, the squared error normalised by the estimated covariance, is 3 on average for "
            f"a consistent filter. Mean over this run: {told} (95 % of single values). Errors of "
            "one run are correlated in time, so its mean varies nearly as much as single values."
        )
    if "health" in estimate:
        text += f" Estimator health: {estimate['health']}."
    return text


def _tiles(values: dict[str, Any]) -> list[tuple[str, str, str]]:
    path, tracking = values["path"], values["tracking"]
    tiles: list[tuple[str, str, str]] = []

    def add(label: str, value: float | None, unit: str, digits: int, remark: str = "") -> None:
        if value is not None:
            tiles.append((label, f"{value:.{digits}f} {unit}", remark))

    if path.get("time_to_goal_s") is not None:
        near = f"{path['time_near_goal_s']:.1f} s of it within 1 m"
        add("Time to goal", path["time_to_goal_s"], "s", 1, near)
    else:
        add("Time", values["outcome"]["time_s"], "s", 1)
        add("Distance left", path.get("final_distance_m"), "m", 2)
    fastest = path["max_speed_m_s"]
    add("Path", path["length_m"], "m", 1, "" if fastest is None else f"up to {fastest:.2f} m/s")
    add("Minimum clearance", path.get("min_clearance_m"), "m", 2, "hull to pylon")
    tracked = "Depth error" if tracking.get("depth_only") else "Tracking error"
    add(tracked, tracking.get("position_rms_m"), "m", 2, "RMS")
    add("Estimation error", values["estimate"].get("position_rms_m"), "m", 2, "RMS")
    return tiles


_UNITS = {
    "_m_s": "m/s",
    "_rad_s": "rad/s",
    "_N_s": "N/s",
    "_Nm": "N m",
    "_deg": "degrees",
    "_ms": "ms",
    "_m": "m",
    "_s": "s",
    "_N": "N",
}


def _words(name: str) -> str:
    for ending, unit in _UNITS.items():
        if name.endswith(ending):
            return f"{name.removesuffix(ending).replace('_', ' ').replace('rms', 'RMS')} ({unit})"
    return name.replace("_", " ")


def _versions_line() -> str:
    found = [f"python {platform.python_version()}"]
    for name in PACKAGES:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    commit = revision()
    return ", ".join(found) + ("" if commit is None else f", revision `{commit[:12]}`")
