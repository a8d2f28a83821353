"""A user-defined task of a planner: be within a watch circle, wherever in it.

Run it: `python examples/own_task.py`. The vehicle comes from outside; where in the circle it
stays is free. In a scenario file it is

    name: my_run
    controller: !MppiImpedance
      task: !OwnTask {system: examples/own_task.py:WatchCircle, parameters: {radius: 0.5}}
    success: !ReachGoal {goal: [0.0, 0.0, -1.5]}

A scenario needs these three; all else has defaults.
"""

import jax
import jax.numpy as jnp
import numpy as np
from pydrake.systems.analysis import Simulator

from spinndrift.systems.closed_loop import build_diagram, logged, seeded
from spinndrift.systems.controllers.kinds import MppiImpedance
from spinndrift.systems.planning.mppi_config import MppiConfig
from spinndrift.systems.planning.paths import PoseConfig
from spinndrift.systems.planning.task import Task, Wanted
from spinndrift.systems.planning.tasks import OwnTask
from spinndrift.systems.station.config import StationConfig


class WatchCircle(Task):
    """No cost within a radius of a point; `t` is a time (s), states are columns."""

    centre: jax.Array
    radius: float

    def __init__(self, radius: float = 0.5, goal: np.ndarray | None = None, z: float = -1.5):
        """The station passes the run's `goal`; `vehicle`, `obstacles` and `station` likewise.

        The planner casts JAX arrays to its precision.
        """
        self.centre = jnp.array([0.0, 0.0, z] if goal is None else goal)
        self.radius = radius

    def wanted(self, t):
        """The state whose attitude is held; wrenches cost beyond the one that keeps it at rest."""
        level = jnp.array([1.0, 0.0, 0.0, 0.0], self.centre.dtype)
        return Wanted(jnp.concatenate([level, self.centre]), jnp.zeros_like(self.centre, shape=6))

    def running_cost(self, t, X_WB, V_WB_B):
        """The cost per second: of distance beyond the circle or off its depth, and of speed."""
        off = X_WB[4:] - self.centre[:, None]
        beyond = jnp.maximum(jnp.hypot(off[0], off[1]) - self.radius, 0)
        return 10 * (beyond**2 + off[2] ** 2) + 5 * jnp.sum(V_WB_B**2, axis=0)


def main(duration: float = 10.0) -> float:
    """Come from 1.5 m away and return the distance from the centre at the end (m)."""
    jax.config.update("jax_enable_x64", True)
    start = PoseConfig((1.5, 0.0, -1.5))
    station = StationConfig(disturbance_set="calm", start=start, seed=1)
    task = OwnTask(f"{__file__}:WatchCircle")
    planner = MppiConfig(horizon=40, dt=0.1, sequences=120, realisations=2, shown_paths=8)
    diagram = build_diagram(station, MppiImpedance(task, planner))
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    seeded(diagram, context, station.seed)
    simulator.AdvanceTo(duration)
    p_WB = logged(diagram, context)["X_WB_cheat"].value[:, 4:]
    distance = np.hypot(p_WB[:, 0], p_WB[:, 1])
    print(f"from {distance[0]:.2f} m to {distance[-1]:.2f} m in {duration:.0f} s")
    return float(distance[-1])


if __name__ == "__main__":
    main()
