"""A planner's task of one's own: stay within a watch circle, and spend nothing inside it.

Run it: `python examples/own_task.py`. The vehicle drifts with a current until it comes near the
circle's edge, and holds against it there; the heading is its own. In a scenario file it is

    controller: !MppiImpedance
      task: !OwnTask {system: examples/own_task.py:WatchCircle, parameters: {radius: 0.5}}
    success: !ReachGoal {goal: [0.0, 0.0, -1.5]}
"""

import jax
import jax.numpy as jnp
import numpy as np
from pydrake.systems.analysis import Simulator

from spinndrift.models.disturbances import GaussMarkovCurrent
from spinndrift.systems.closed_loop import build_diagram, logged, seeded
from spinndrift.systems.controllers.kinds import MppiImpedance
from spinndrift.systems.planning.mppi_config import MppiConfig
from spinndrift.systems.planning.task import Task, Wanted
from spinndrift.systems.planning.tasks import OwnTask
from spinndrift.systems.station.config import StationConfig


class WatchCircle(Task):
    """No cost within a radius of a point; `t` is a time (s), states are columns."""

    centre: jax.Array
    radius: float

    def __init__(self, radius: float = 0.5, goal: np.ndarray | None = None, z: float = -1.5):
        """The run's `goal` is handed over; `vehicle`, `obstacles` and `station` would be as well.

        What is an array is held in JAX's, which the planner casts to its precision.
        """
        self.centre = jnp.array([0.0, 0.0, z] if goal is None else goal)
        self.radius = radius

    def wanted(self, t):
        """A pose whose attitude is held, and at rest in which a wrench counts from."""
        level = jnp.array([1.0, 0.0, 0.0, 0.0], self.centre.dtype)
        return Wanted(jnp.concatenate([level, self.centre]), jnp.zeros_like(self.centre, shape=6))

    def running_cost(self, t, X_WB, V_WB_B):
        """The cost per second: of distance beyond the circle or off its depth, and of speed."""
        off = X_WB[4:] - self.centre[:, None]
        beyond = jnp.maximum(jnp.hypot(off[0], off[1]) - self.radius, 0)
        return 50 * beyond**2 + 2 * off[2] ** 2 + 0.1 * jnp.sum(V_WB_B**2, axis=0)


def main(duration: float = 15.0) -> float:
    """Watch in a current of 0.15 m/s and return the largest distance from the centre (m)."""
    jax.config.update("jax_enable_x64", True)
    current = GaussMarkovCurrent(mean_speed=0.15, std_speed=0.0, std_direction=0.0)
    station = StationConfig(disturbances=(current,), seed=1)
    task = OwnTask(f"{__file__}:WatchCircle")
    planner = MppiConfig(horizon=40, dt=0.1, sequences=120, realisations=2, shown_paths=8)
    diagram = build_diagram(station, MppiImpedance(task, planner))
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    seeded(diagram, context, station.seed)
    simulator.AdvanceTo(duration)
    logs = logged(diagram, context)
    p, F = logs["X_WB_cheat"].value[:, 4:], logs["F_Bo_B"].value
    strayed = float(np.hypot(p[:, 0], p[:, 1]).max())
    force = np.hypot(F[:, 0], F[:, 1]).mean()
    print(f"within {strayed:.2f} m for {duration:.0f} s, with {force:.1f} N on average")
    return strayed


if __name__ == "__main__":
    main()
