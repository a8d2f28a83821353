"""A made-up run for tests of metrics, reports and replays: a known path with known errors."""

import numpy as np
from scipy.spatial.transform import Rotation

from spinndrift.sims.run.log import Plans, RunLog

GOAL = (4.5, -2.0, -1.5)
ESTIMATE_ERROR = (0.03, -0.04, 0.0)  # m, in W
FORCE = (30.0, -10.0, 5.0, 1.0, -1.0, 2.0)


def pose(p: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Level poses (n, 7)."""
    q = Rotation.from_euler("z", yaw[:, None]).as_quat(scalar_first=True)
    return np.concatenate([q, p], axis=1)


def path(t: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """An S from the origin to the goal: poses and body twists."""
    s = t / duration
    x, y = GOAL[0] * s, GOAL[1] * s + 0.8 * np.sin(2 * np.pi * s)
    dx = np.full_like(s, GOAL[0] / duration)
    dy = (GOAL[1] + 1.6 * np.pi * np.cos(2 * np.pi * s)) / duration
    yaw = 0.3 * np.sin(3 * s)
    dyaw = 0.9 * np.cos(3 * s) / duration
    c, sn = np.cos(yaw), np.sin(yaw)
    zero = np.zeros_like(s)
    V = np.stack([c * dx + sn * dy, -sn * dx + c * dy, zero, zero, zero, dyaw], axis=1)
    return pose(np.stack([x, y, zero + GOAL[2]], axis=1), yaw), V


def example_log(duration: float = 20.0, dt: float = 0.05, planned: bool = True) -> RunLog:
    """Log of a run that follows `path`, with an estimate that is off by a constant."""
    t = dt * np.arange(round(duration / dt) + 1)
    X, V = path(t, duration)
    n = t.size
    estimate = X.copy()
    estimate[:, 4:] += ESTIMATE_ERROR
    rng = np.random.default_rng(3)
    std = np.full((n, 18), 0.02) * np.sqrt(1 + t)[:, None]
    pwm = np.clip(1500 + 150 * rng.normal(size=(n, 8)).cumsum(axis=0) / 8, 1100, 1900)
    variables = {
        "X_WB": X,
        "V_WB_B": V,
        "F_Bo_B": np.broadcast_to(FORCE, (n, 6)) + rng.normal(size=(n, 6)),
        "pwm": pwm,
        "X_WB_estimate": estimate,
        "V_WB_B_estimate": V + 0.01 * rng.normal(size=V.shape),
        "error_std": std,
        "error_covariance": np.tile(np.eye(3).ravel(), 3) * std[:, :1] ** 2,
        "nis": rng.chisquare([3, 1, 1], size=(n, 3)),
        "rejected": np.zeros((n, 3)),
        "health": np.where(t[:, None] > 0.75 * duration, [1.0, 1, 0, 1, 1], [0.0, 1, 1, 1, 1]),
        "X_WB_plan": X,
        "V_WB_B_plan": V,
        "plan_valid": (t > 0).astype(float),
        "F_disturbance_Bo_B": rng.normal(size=(n, 6)),
        "flow_W": np.concatenate(
            [0.2 + 0.05 * rng.normal(size=(n, 3)).cumsum(axis=0) / 9, np.zeros((n, 3))], axis=1
        ),
    }
    return RunLog.create(
        "example", dt, variables, _plans(duration) if planned else None, vehicle="bluerov2_heavy"
    )


def _plans(duration: float) -> Plans:
    rng = np.random.default_rng(4)
    made, steps, paths = np.arange(0.2, duration, 0.2), 20, 30
    ahead = 0.2 * np.arange(steps + 1)
    X = np.stack([path(np.minimum(t + ahead, duration), duration)[0] for t in made])
    walk = 0.05 * rng.normal(size=(made.size, steps, 3, paths)).cumsum(axis=1)
    p = X[:, 1:, 4:, None] + walk
    weights = rng.random((made.size, paths)) ** 4
    weights /= weights.sum(axis=1, keepdims=True)
    figures = np.stack([[100 / (1 + k), 0.01, 0.4, 12.0, 1.0, 1.0] for k in range(made.size)])
    return Plans(made, 0.2, X, p.astype(np.float32), weights, figures, allowed=0.05)
