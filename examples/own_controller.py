"""A controller of one's own: a PID law in a Drake system, plugged into the station.

Run it: `python examples/own_controller.py`. It holds a pose in a current of a harbour and prints
how far it strayed. In a scenario file the same controller is

    name: my_run
    controller: !Own {system: examples/own_controller.py:PidController, parameters: {yaw: 0.5}}
    success: !ReachGoal {goal: [1.0, 0.0, -1.5]}

A scenario needs these three; all else has defaults.
"""

import jax
import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem

from spinndrift import Own, StationConfig, Vehicle, build_diagram, logged, seeded

PERIOD = 0.02  # s


class PidController(LeafSystem):
    """Keeps a position and a heading: P on the error, I against the current, D on the velocity.

    .. pydrake_system::

        name: PidController
        input_ports:
        - X_WB
        - V_WB_B
        - health
        output_ports:
        - F_Bo_B

    """

    def __init__(
        self,
        vehicle: Vehicle,
        goal: np.ndarray | None = None,
        x: float = 0.0,
        y: float = 0.0,
        z: float = -1.5,
        yaw: float = 0.0,
    ):
        """Metres and radians; without a `goal` it holds x, y, z.

        The station's `vehicle`, which gives the gains their size, and the run's `goal` are handed
        to arguments of these names; `obstacles` and `station` would be as well.
        """
        super().__init__()
        self.goal, self.yaw = np.array([x, y, z]) if goal is None else goal, yaw
        mass = vehicle.mass + np.array(vehicle.added_mass[:3])
        inertia = vehicle.inertia[2] + vehicle.added_mass[5]
        self.P, self.I, self.D = 2.0 * mass, 0.5 * mass, 2.5 * mass
        self.P_yaw, self.D_yaw = 3.0 * inertia, 3.0 * inertia
        self.DeclareVectorInputPort("X_WB", 7)
        self.DeclareVectorInputPort("V_WB_B", 6)
        self.health = self.DeclareVectorInputPort("health", 5)
        integral = self.DeclareDiscreteState(3)
        command = self.DeclareDiscreteState(6)
        self.DeclareStateOutputPort("F_Bo_B", command)
        self.integral, self.command = integral, command
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self.update)

    def update(self, context, state):
        """Everything that changes is in the context; ports are read by name.

        The first number of `health` is 2 while the estimate is lost: there is nothing to hold then.
        """
        if self.health.HasValue(context) and np.asarray(self.health.Eval(context))[0] >= 2:
            state.set_value(self.command, np.zeros(6))
            return
        X_WB = np.asarray(self.GetInputPort("X_WB").Eval(context))
        V_WB_B = np.asarray(self.GetInputPort("V_WB_B").Eval(context))
        w, i, j, k = X_WB[:4]
        R_WB = np.array(
            [
                [1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)],
                [2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)],
                [2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)],
            ]
        )
        error = self.goal - X_WB[4:]
        integral = context.get_discrete_state(self.integral).value()
        integral = np.clip(integral + PERIOD * error, -2.0, 2.0)
        push = self.P * error + self.I * integral - self.D * (R_WB @ V_WB_B[:3])
        turn = self.yaw - np.arctan2(R_WB[1, 0], R_WB[0, 0])
        turn = (turn + np.pi) % (2 * np.pi) - np.pi
        moment = [0.0, 0.0, self.P_yaw * turn - self.D_yaw * V_WB_B[5]]
        state.set_value(self.integral, integral)
        state.set_value(self.command, np.concatenate([R_WB.T @ push, moment]))


def main(duration: float = 20.0) -> float:
    """Hold station in the harbour and return the error (m) at the end."""
    jax.config.update("jax_enable_x64", True)
    station = StationConfig(disturbance_set="harbour", seed=1)
    controller = Own(system=f"{__file__}:PidController")
    diagram = build_diagram(station, controller)
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    seeded(diagram, context, station.seed)
    simulator.AdvanceTo(duration)
    X_WB = logged(diagram, context)["X_WB_cheat"].value
    error = np.linalg.norm(X_WB[:, 4:] - np.array([0.0, 0.0, -1.5]), axis=1)
    print(f"largest error {error.max():.2f} m, after {duration:.0f} s {error[-1]:.2f} m")
    return float(error[-1])


if __name__ == "__main__":
    main()
