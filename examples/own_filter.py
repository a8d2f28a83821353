"""A state estimator of one's own in the station: dead reckoning in a Drake system.

Run it: `python examples/own_filter.py`. A figure eight is flown by what it says, and how far it has
drifted is printed. In a scenario file the same filter is

    station: {sensing: {filter: !OwnFilter {system: examples/own_filter.py:DeadReckoning}}}
"""

import jax
import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, LeafSystem
from scipy.spatial.transform import Rotation

from spinndrift import OwnFilter, StationConfig, build_diagram, logged, seeded
from spinndrift.models.sensors import Imu
from spinndrift.systems.controllers.kinds import TrackReference
from spinndrift.systems.planning.paths import FigureEight, PoseConfig
from spinndrift.systems.station.config import Sensing


class DeadReckoning(LeafSystem):
    """Turns by the gyro, heads by the compass, moves by the DVL, dives by the depth sensor.

    .. pydrake_system::

        name: DeadReckoning
        input_ports:
        - imu
        - dvl
        - depth
        - compass
        output_ports:
        - X_WB
        - V_WB_B

    """

    def __init__(self, imu: Imu, X0_WB: np.ndarray, turn: float = 0.02):
        """`imu` and the start are the station's; `turn` is the compass' part in a sample."""
        super().__init__()
        self.period, self.turn = 1 / imu.rate, turn
        for name, size in (("imu", 6), ("dvl", 7), ("depth", 3), ("compass", 3)):
            self.DeclareVectorInputPort(name, size)
        self.X = self.DeclareDiscreteState(BasicVector(X0_WB.tolist()))
        self.V = self.DeclareDiscreteState(6)
        self.DeclareStateOutputPort("X_WB", self.X)
        self.DeclareStateOutputPort("V_WB_B", self.V)
        self.DeclarePeriodicDiscreteUpdateEvent(self.period, 0.0, self.update)

    def update(self, context, state):
        """What is shown was measured a period ago; a reading counts once its mark is 1."""
        imu, dvl, depth, compass = (
            np.array(self.get_input_port(i).Eval(context)) for i in range(self.num_input_ports())
        )
        X = np.array(context.get_discrete_state(self.X).value())
        R_WB = Rotation.from_quat(X[:4], scalar_first=True)
        R_WB = R_WB * Rotation.from_rotvec(imu[3:] * self.period)
        if compass[1] == 1:
            yaw = R_WB.as_euler("ZYX")[0]
            off = (compass[0] - yaw + np.pi) % (2 * np.pi) - np.pi
            R_WB = Rotation.from_rotvec([0.0, 0.0, self.turn * off]) * R_WB
        v = dvl[:3] if dvl[3] == 1 else np.array(context.get_discrete_state(self.V).value()[:3])
        p = X[4:] + R_WB.apply(v) * self.period
        if depth[1] == 1:
            p[2] = -depth[0]
        state.set_value(self.X, np.concatenate([R_WB.as_quat(scalar_first=True), p]))
        state.set_value(self.V, np.concatenate([v, imu[3:]]))


def main(duration: float = 20.0) -> float:
    """Fly the figure and return how far the estimate was off at the end (m)."""
    jax.config.update("jax_enable_x64", True)
    sensing = Sensing(filter=OwnFilter(f"{__file__}:DeadReckoning"))
    station = StationConfig(sensing=sensing, seed=1)
    path = FigureEight(PoseConfig((0.0, 0.0, -1.5)))
    diagram = build_diagram(station, TrackReference(path))
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    seeded(diagram, context, station.seed)
    simulator.AdvanceTo(duration)
    logs = logged(diagram, context)
    off = np.linalg.norm(logs["X_WB"].value[:, 4:] - logs["X_WB_cheat"].value[:, 4:], axis=1)
    print(f"after {duration:.0f} s the estimate is {off[-1]:.2f} m off")
    return float(off[-1])


if __name__ == "__main__":
    main()
