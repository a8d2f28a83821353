"""The tasks of planners by kind: each is a dataclass for YAML that makes a `Task` for a station."""

import abc
from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models import se3
from ...models.config.checks import Vector6, check_numbers, require
from ..own import OwnSystem
from ..station.config import StationConfig
from .obstacles import Cylinders, SphereHull
from .paths import FigureEight, HoldPose, Path, PoseConfig, Waypoints
from .task import Task, Wanted, check_task


@dataclass(frozen=True, kw_only=True)
class StateCost:
    """The running cost ‖log(g⁻¹ g_w)‖²_L + ‖ξ_w − ξ‖²_Q + w (|v| − v_max)₊² about a wanted state.

    Palmer et al., "Field Experiments", but for the last term. Six numbers are for x, y, z, roll,
    pitch, yaw.

    Attributes:
        pose_weight: diagonal of L (1/m² and 1/rad²).
        twist_weight: diagonal of Q (s²/m² and s²/rad²).
        speed_limit: v_max, the linear speed (m/s) above which `speed_weight` counts; null for none.
        speed_weight: w (s²/m²).
    """

    pose_weight: Vector6 = (1.0, 1.0, 2.0, 20.0, 20.0, 4.0)
    twist_weight: Vector6 = (0.5, 0.5, 0.5, 1.0, 1.0, 1.0)
    speed_limit: float | None = 0.5
    speed_weight: float = 100.0

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        for name in ("pose_weight", "twist_weight"):
            require(min(getattr(self, name)) >= 0, self, name, "give six numbers of zero or more")
        require(self.speed_weight >= 0, self, "speed_weight", "give zero or more")
        positive = self.speed_limit is None or self.speed_limit > 0
        require(positive, self, "speed_limit", "give a speed above zero, or null")

    def __call__(
        self, wanted: Wanted, X_WB: Float[Array, "7 n"], V_WB_B: Float[Array, "6 n"]
    ) -> Float[Array, " n"]:
        """The cost rate (1/s)."""
        L = jnp.asarray(self.pose_weight, V_WB_B.dtype)[:, None]
        Q = jnp.asarray(self.twist_weight, V_WB_B.dtype)[:, None]
        to_wanted, twist = se3.local(X_WB, wanted.X_WB), wanted.V_WB_B[:, None] - V_WB_B
        cost = jnp.sum(L * to_wanted * to_wanted + Q * twist * twist, axis=0)
        if self.speed_limit is not None:
            speed = jnp.sqrt(jnp.sum(V_WB_B[:3] * V_WB_B[:3], axis=0))
            cost = cost + self.speed_weight * jnp.maximum(speed - self.speed_limit, 0) ** 2
        return cost


class StateTask(Task):
    """Be in a wanted state, clear of pylons."""

    cost: StateCost = eqx.field(static=True)
    cylinders: Cylinders
    hull: SphereHull

    def running_cost(
        self, t: Float[Array, ""], X_WB: Float[Array, "7 n"], V_WB_B: Float[Array, "6 n"]
    ) -> Float[Array, " n"]:
        return self.cost(self.wanted(t), X_WB, V_WB_B)

    def clearance(
        self, t: Float[Array, ""], X_WB: Float[Array, "7 n"], V_WB_B: Float[Array, "6 n"]
    ) -> Float[Array, " n"] | None:
        del t, V_WB_B
        if self.cylinders.radius.shape[0] == 0:
            return None
        return self.hull.clearance(X_WB, self.cylinders)


class PoseTask(StateTask):
    """Come to a pose and rest there."""

    X_WG: Float[Array, "7"]

    def wanted(self, t: Float[Array, ""]) -> Wanted:
        del t
        return Wanted(self.X_WG, jnp.zeros_like(self.X_WG[:6]))


class PathTask(StateTask):
    """Be on a path, at its time and with its twist."""

    path: Path = eqx.field(static=True)

    def wanted(self, t: Float[Array, ""]) -> Wanted:
        motion = self.path.motion(t[None])
        return Wanted(motion.X_WB[:, 0], motion.V_WB_B[:, 0])


class TaskConfig(abc.ABC):
    """A kind of task."""

    @abc.abstractmethod
    def build(self, station: StationConfig, goal: Float[np.ndarray, "3"] | None = None) -> Task:
        """The task at a station; `goal` (m, W) is the run's, for a task without one of its own."""


def _surroundings(station: StationConfig) -> tuple[Cylinders, SphereHull]:
    return Cylinders.create(station.obstacles), SphereHull.cover(station.load_vehicle().size)


@dataclass(frozen=True)
class PylonCrossing(StateCost, TaskConfig):
    """Reach a pose between the station's pylons, as in the paper's field experiments.

    Attributes:
        goal: the pose.
    """

    goal: PoseConfig

    def build(self, station: StationConfig, goal: Float[np.ndarray, "3"] | None = None) -> Task:
        del goal  # `self.goal` is used
        return PoseTask(self, *_surroundings(station), self.goal.pose())


@dataclass(frozen=True)
class StationKeeping(StateCost, TaskConfig):
    """Hold a pose, clear of the station's pylons.

    Attributes:
        at: the pose; that of the start if left out.
    """

    at: PoseConfig | None = None

    def build(self, station: StationConfig, goal: Float[np.ndarray, "3"] | None = None) -> Task:
        del goal
        return PoseTask(self, *_surroundings(station), (self.at or station.start).pose())


@dataclass(frozen=True)
class PathFollowing(StateCost, TaskConfig):
    """Follow a path through space and time, clear of the station's pylons.

    Attributes:
        path: the path.
    """

    path: HoldPose | Waypoints | FigureEight

    def build(self, station: StationConfig, goal: Float[np.ndarray, "3"] | None = None) -> Task:
        del goal
        return PathTask(self, *_surroundings(station), self.path)


@dataclass(frozen=True)
class OwnTask(OwnSystem, TaskConfig):
    """A user-defined task; its constructor receives what that of a user-defined controller does."""

    base: ClassVar[type] = Task

    def build(self, station: StationConfig, goal: Float[np.ndarray, "3"] | None = None) -> Task:
        return self.make(station.offered(goal), check_task)


TaskKind = PylonCrossing | StationKeeping | PathFollowing | OwnTask
"""The kinds that a scenario can name by a tag."""
