"""Metrics of a run, from its log alone: the same log gives the same numbers."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models.vehicles.vehicle import Vehicle
from ...systems.planning.mppi import FIGURES
from ...systems.planning.obstacles import BoxHull, Cylinders, Pylon
from ..scenarios.criteria import Finish, FollowPath, Outcome, ReachGoal, Success
from .estimate import (
    BLOCKS,
    HEALTH,
    average_bound,
    estimate_error,
    health_shares,
    health_words,
    local,
    nees,
)
from .log import RunLog, without_horizontal

SETTLED = 2.0  # s: initial transient that is not counted as tracking error
_SATURATED = 5.0  # µs from the end of the range
_PWM = (1100.0, 1900.0)


def metrics(
    log: RunLog,
    outcome: Outcome,
    success: Success,
    vehicle: Vehicle,
    obstacles: tuple[Pylon, ...] = (),
    goal: Float[np.ndarray, "3"] | None = None,
) -> dict[str, Any]:
    """All numbers of a run as plain JSON values; None where a number doesn't exist."""
    values: dict[str, Any] = {"path": _path(log, outcome, success, vehicle, obstacles, goal)}
    values["tracking"] = _tracking(log, success)
    values["estimate"] = _estimate(log)
    values["effort"] = _effort(log)
    values["disturbance"] = _disturbance(log)
    values["planner"] = _planner(log)
    succeeded, words = verdict(outcome, success, values)
    told = {"success": succeeded, "reason": outcome.reason, "time_s": outcome.time, "words": words}
    return _plain({"outcome": told, **values})


def verdict(outcome: Outcome, success: Success, values: dict[str, Any]) -> tuple[bool, str]:
    """Whether the run succeeded, and the sentence that says so."""
    if isinstance(success, ReachGoal):
        words = outcome.sentence
        if outcome.reason == "duration":
            left = values["path"]["final_distance_m"]
            words = f"The time limit was reached {left:.2f} m from the goal."
        return outcome.reason == "goal", words
    if isinstance(success, Finish):
        return outcome.reason == "finished", outcome.sentence
    if outcome.reason != "duration":
        return False, outcome.sentence
    rms = values["tracking"]["position_rms_m"]
    if rms is None or math.isnan(rms):
        return False, "The run was too short to measure the tracking error."
    if values["tracking"]["depth_only"]:
        return rms <= success.position_rms, _depth_words(rms, success, values["tracking"])
    if rms <= success.position_rms:
        return (
            True,
            f"The vehicle followed its reference within {rms:.2f} m RMS.",
        )
    return False, (
        f"The tracking error was {rms:.2f} m RMS; {success.position_rms:g} m are allowed."
    )


def _depth_words(rms: float, success: FollowPath, tracking: dict[str, Any]) -> str:
    words = f"The depth was held within {rms:.2f} m RMS"
    if rms > success.position_rms:
        words = f"The depth error was {rms:.2f} m RMS; {success.position_rms:g} m are allowed"
    drift = tracking["drift_m"]
    if math.isnan(drift):
        return f"{words}; the place is not known."
    return f"{words}; the vehicle did not know its place, and drifted by up to {drift:.2f} m."


def clearance(
    log: RunLog, vehicle: Vehicle, obstacles: tuple[Pylon, ...]
) -> Float[np.ndarray, " n"] | None:
    """Distance of the true hull to the nearest obstacle over time (m), None without obstacles."""
    if not obstacles:
        return None
    hull, cylinders = BoxHull.create(vehicle.size), Cylinders.create(obstacles)
    return np.asarray(hull.clearance(jnp.asarray(log["X_WB"].T), cylinders))


def tracking_error(log: RunLog, depth_only: bool = False) -> tuple[np.ndarray, np.ndarray] | None:
    """Plan minus truth over time: log(X_WB⁻¹ X_plan) (N, 6), twist (N, 6); NaN without a plan.

    A place that is not known (NaN) has no error, and neither has a velocity; with `depth_only` they
    are taken as unknown.
    """
    if "X_WB_plan" not in log or not np.any(log["plan_valid"] > 0.5):
        return None
    valid = (log["plan_valid"] > 0.5)[:, None]
    known = log["X_WB"], log["V_WB_B"]
    if depth_only:
        known = without_horizontal(*known)[:2]
    X, V = (
        np.where(np.isnan(state) & valid, log[f"{name}_plan"], state)
        for name, state in zip(("X_WB", "V_WB_B"), known, strict=True)
    )
    pose = local(X, np.where(valid, log["X_WB_plan"], X))
    twist = log["V_WB_B_plan"] - V
    return np.where(valid, pose, np.nan), np.where(valid, twist, np.nan)


def _rms(values: np.ndarray | Array) -> float:
    """Root mean square of the norms of rows, without those that are NaN."""
    squares = np.sum(np.atleast_2d(np.asarray(values)) ** 2, axis=1)
    squares = squares[np.isfinite(squares)]
    return float(np.sqrt(np.mean(squares))) if squares.size else math.nan


def _path(log, outcome, success, vehicle, obstacles, goal) -> dict[str, Any]:
    p, V = log["X_WB"][:, 4:], log["V_WB_B"]
    gap = clearance(log, vehicle, obstacles)
    found: dict[str, Any] = {
        "length_m": float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum()),
        "min_clearance_m": None if gap is None else float(gap.min()),
        "mean_speed_m_s": float(np.linalg.norm(V[:, :3], axis=1).mean()),
        "max_speed_m_s": float(np.linalg.norm(V[:, :3], axis=1).max()),
        "max_turn_rate_rad_s": float(np.linalg.norm(V[:, 3:], axis=1).max()),
    }
    if goal is not None:
        distance = np.linalg.norm(p - goal, axis=1)
        near = success.near_radius if isinstance(success, ReachGoal) else 1.0
        found |= {
            "time_to_goal_s": outcome.time if outcome.reason == "goal" else None,
            "time_near_goal_s": float(log.dt * np.count_nonzero(distance[:-1] <= near)),
            "final_distance_m": float(distance[-1]),
            "least_distance_m": float(distance.min()),
        }
    return found


def _tracking(log: RunLog, success: Success) -> dict[str, Any]:
    error = tracking_error(log)
    if error is None:
        return {"position_rms_m": None}
    found: dict[str, Any] = {"depth_only": log.depth_only}
    if log.depth_only:
        aside = np.linalg.norm((log["X_WB_plan"] - log["X_WB"])[:, 4:6], axis=1)
        aside = aside[np.isfinite(aside) & (log["plan_valid"] > 0.5)]
        found["drift_m"] = float(aside.max()) if aside.size else math.nan
        error = tracking_error(log, depth_only=log.placed) or error
    settle = success.settle if isinstance(success, FollowPath) else SETTLED
    pose, twist = (part[log.time >= settle] for part in error)
    return found | {
        "position_rms_m": _rms(pose[:, :3]),
        "position_max_m": _largest(pose[:, :3]),
        "attitude_rms_deg": math.degrees(_rms(pose[:, 3:])),
        "velocity_rms_m_s": _rms(twist[:, :3]),
        "turn_rate_rms_rad_s": _rms(twist[:, 3:]),
        "without_plan_s": float(log.dt * np.count_nonzero(log["plan_valid"] < 0.5)),
    }


def _largest(values: np.ndarray) -> float:
    norms = np.linalg.norm(values, axis=1)
    return float(np.nanmax(norms)) if np.any(np.isfinite(norms)) else math.nan


def _estimate(log: RunLog) -> dict[str, Any]:
    """RMS errors, their share within 3σ of each axis, and NEES of each block over the run.

    NEES is 3 on average for a consistent filter. The errors of one run are correlated over time:
    the bounds are those of a single instant, and the mean over the run lies within them in more
    than 95 % of runs. Many seeds give a sharper test (`spinndrift check estimator`).
    """
    known = estimate_error(log)
    if known is None:
        return {}
    error, std = known
    inside = np.abs(error) <= 3 * std
    found: dict[str, Any] = {
        "position_rms_m": _rms(error[:, :3]),
        "position_final_m": float(np.linalg.norm(error[-1, :3])),
        "attitude_rms_deg": math.degrees(_rms(error[:, 3:6])),
        "velocity_rms_m_s": _rms(error[:, 6:]),
    }
    squares = nees(log)
    for i, name in enumerate(BLOCKS):
        part, own = slice(3 * i, 3 * i + 3), squares[:, i]
        claimed = bool(np.isfinite(std[:, part]).all())  # a user's filter may have none
        found[f"{name}_within_3_sigma"] = float(inside[:, part].mean()) if claimed else math.nan
        found[f"{name}_nees"] = float(np.nanmean(own)) if np.isfinite(own).any() else math.nan
    low, high = average_bound(3)
    found |= {"nees_low": low, "nees_high": high}
    if "health" in log:
        shares = health_shares(log)
        found |= {f"health_{name}": sum(shares[name].values()) for name in HEALTH}
        found["health"] = health_words(shares)
    return found


def _effort(log: RunLog) -> dict[str, Any]:
    F = log["F_Bo_B"]
    change = np.diff(F, axis=0) / log.dt
    found = {
        "force_rms_N": _rms(F[:, :3]),
        "moment_rms_Nm": _rms(F[:, 3:]),
        "force_change_rms_N_s": _rms(change[:, :3]) if len(change) else None,
    }
    if "pwm" in log:
        pwm = log["pwm"]
        at_end = (pwm <= _PWM[0] + _SATURATED) | (pwm >= _PWM[1] - _SATURATED)
        found["saturated_share"] = float(at_end.mean())
        found["any_saturated_share"] = float(at_end.any(axis=1).mean())
    return found


def _disturbance(log: RunLog) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if "flow_W" in log:
        speed = np.linalg.norm(log["flow_W"][:, :3], axis=1)
        found |= {"flow_mean_m_s": float(speed.mean()), "flow_max_m_s": float(speed.max())}
    if "F_disturbance_Bo_B" in log:
        F = log["F_disturbance_Bo_B"]
        found |= {"force_rms_N": _rms(F[:, :3]), "moment_rms_Nm": _rms(F[:, 3:])}
    return found


def _planner(log: RunLog) -> dict[str, Any]:
    plans, found = log.plans, {}
    if plans is not None and plans.figures is not None:
        figures = {name: plans.figures[:, i] for i, name in enumerate(FIGURES)}
        risk = figures["collision_probability"]
        found = {
            "plans": int(plans.time.size),
            "mean_collision_probability": float(risk.mean()),
            "max_collision_probability": float(risk.max()),
            "mean_effective_samples": float(figures["effective_samples"].mean()),
        }
        if plans.allowed is not None:
            found["allowed_collision_probability"] = plans.allowed
            found["plans_beyond_allowed"] = int(np.count_nonzero(risk > plans.allowed))
    if log.least_risk is not None:
        found["least_risk_to_goal"] = log.least_risk
    return found


def _plain(value: Any) -> Any:
    """JSON has no NaN: numbers that are not finite become None."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.generic):
        return _plain(value.item())
    return value
