"""Criteria for the end of a run and for its success.

The rules for reaching a goal are those of Palmer et al., "Field Experiments": a trial succeeds
within 0.5 m of the goal without a collision; it ends early for unsafe behaviour (uncontrolled
spinning), for failure to make progress, or after 15 s within 1 m of the goal. The paper gives no
numbers for spinning and progress; those here are estimates.
"""

from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from ...models.config.checks import Vector3, check_numbers, require
from ...models.vehicles.vehicle import Vehicle
from ...systems.compiled.jit import VectorFunction
from ...systems.planning.obstacles import BoxHull, Cylinders, Pylon

Reason = Literal[
    "goal", "collision", "spinning", "near goal", "no progress", "not finite", "duration",
    "interrupted", "no safe plan", "guard", "finished",
]  # fmt: skip


class Outcome(NamedTuple):
    """The end of a run: reason, time (s), and sentence."""

    reason: Reason
    time: float
    sentence: str


@dataclass(frozen=True)
class ReachGoal:
    """Success is to reach a goal.

    Attributes:
        goal: position in W (m); that of the controller's own goal if left out.
        radius: of the goal, for Bo (m).
        near_radius: being nearer than this for `near_time` without reaching the goal ends the run.
        near_time: total time over all visits (s).
        progress: required decrease of the distance within `progress_time` (m).
        progress_time: (s).
    """

    goal: Vector3 | None = None
    radius: float = 0.5
    near_radius: float = 1.0
    near_time: float = 15.0
    progress: float = 0.1
    progress_time: float = 30.0

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        for name in ("radius", "near_radius", "near_time", "progress_time"):
            require(getattr(self, name) > 0, self, name, "give a number above zero")
        require(self.progress >= 0, self, "progress", "give zero or more")


@dataclass(frozen=True)
class FollowPath:
    """Success is to stay near the reference for the whole duration.

    Attributes:
        position_rms: largest allowed root mean square of the distance to the reference (m).
        settle: initial time that doesn't count (s).
    """

    position_rms: float = 0.3
    settle: float = 5.0

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        require(self.position_rms > 0, self, "position_rms", "give a distance above zero")
        require(self.settle >= 0, self, "settle", "give zero or more")


@dataclass(frozen=True)
class Finish:
    """Success is that a controller with an end, `!Maneuvers`, comes to it."""


Success = ReachGoal | FollowPath | Finish
"""The kinds that a scenario can name by a tag."""


@dataclass(frozen=True)
class Safety:
    """Limits that end any run.

    Attributes:
        spin_rate: |ω| (rad/s) above which the vehicle spins.
        spin_time: uninterrupted time of spinning (s) after which it is out of control.
    """

    spin_rate: float = 1.5
    spin_time: float = 3.0

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        for name in ("spin_rate", "spin_time"):
            require(getattr(self, name) > 0, self, name, "give a number above zero")


class Monitor:
    """Checks the true motion sample by sample, in order of time, for the end of the run."""

    def __init__(
        self,
        vehicle: Vehicle,
        obstacles: tuple[Pylon, ...],
        success: Success,
        goal: Float[np.ndarray, "3"] | None,
        safety: Safety | None = None,
    ):
        """`goal` (m, W) is needed for `ReachGoal`."""
        self.obstacles, self.success, self.goal = obstacles, success, goal
        self.safety = safety or Safety()
        self._vehicle = vehicle
        self._spinning_since: float | None = None
        self._near = 0.0
        self._best, self._best_time = np.inf, 0.0
        self._first, self._nearest = 0.0, np.inf
        self._before: float | None = None

    def check(
        self, t: float, X_WB: Float[np.ndarray, "7"], V_WB_B: Float[np.ndarray, "6"]
    ) -> Outcome | None:
        """The outcome for the state at time t; None while the run continues."""
        if not (np.all(np.isfinite(X_WB)) and np.all(np.isfinite(V_WB_B))):
            return Outcome("not finite", t, f"The state was no longer finite at {t:.1f} s.")
        step = 0.0 if self._before is None else t - self._before
        self._before = t
        for pylon in self.obstacles:
            if clearance(self._vehicle, X_WB, pylon) <= 0:
                words = f"The vehicle hit {named(pylon)} after {t:.1f} s."
                return Outcome("collision", t, words)
        rate = float(np.linalg.norm(V_WB_B[3:]))
        if rate <= self.safety.spin_rate:
            self._spinning_since = None
        elif self._spinning_since is None:
            self._spinning_since = t
        elif t - self._spinning_since >= self.safety.spin_time:
            return Outcome("spinning", t, f"The vehicle spun out of control at {t:.1f} s.")
        if isinstance(self.success, ReachGoal) and self.goal is not None:
            return self._towards(self.success, t, step, float(np.linalg.norm(X_WB[4:] - self.goal)))
        return None

    @property
    def progress(self) -> float:
        """Share of the distance to the goal that is covered, 0 to 1; 0 without a goal."""
        if not isinstance(self.success, ReachGoal) or not self._first > self.success.radius:
            return 0.0
        left = (self._nearest - self.success.radius) / (self._first - self.success.radius)
        return float(np.clip(1 - left, 0, 1))

    def _towards(self, rule: ReachGoal, t: float, step: float, distance: float) -> Outcome | None:
        if not np.isfinite(self._nearest):
            self._first = distance
        self._nearest = min(self._nearest, distance)
        if distance <= rule.radius:
            return Outcome("goal", t, f"The vehicle reached the goal after {t:.1f} s.")
        if distance <= rule.near_radius:
            self._near += step
        if self._near > rule.near_time:
            words = f"The vehicle stayed {rule.near_time:g} s near the goal without reaching it."
            return Outcome("near goal", t, words)
        if distance < self._best - rule.progress:
            self._best, self._best_time = distance, t
        elif t - self._best_time > rule.progress_time:
            words = f"The vehicle made no progress for {rule.progress_time:g} s, at {t:.1f} s."
            return Outcome("no progress", t, words)
        return None


def named(pylon: Pylon) -> str:
    """A pylon in a sentence."""
    return f"the pylon `{pylon.name}`" if pylon.name else f"the pylon at ({pylon.x:g}, {pylon.y:g})"


def clearance(vehicle: Vehicle, X_WB: Float[np.ndarray, "7"], pylon: Pylon) -> float:
    """Signed distance (m) of the vehicle's box to a pylon, negative if they intersect."""
    p = np.array([pylon.x, pylon.y, pylon.diameter / 2, pylon.bottom, pylon.top])
    return float(_to_pylon(vehicle.size)(X_WB, p)[0][0])


@cache
def _to_pylon(size: tuple[float, float, float]) -> VectorFunction:
    """The distance for one pose and one pylon, compiled once per hull size."""
    hull = BoxHull.create(size)

    def distance(X: Array, p: Array) -> Array:
        cylinder = Cylinders(p[:2, None], p[2:3], p[3:4], p[4:])
        return hull.clearance(X, cylinder).reshape(1)

    return VectorFunction(distance, [7, 5], [1])
