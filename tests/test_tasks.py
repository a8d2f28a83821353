"""A planner's tasks: what they ask for, what they cost, and those of a user's own."""

import ast
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import logm
from scipy.spatial.transform import Rotation

from helpers import ROOT
from spinndrift.models.config.errors import UserError
from spinndrift.models.config.typed_yaml import dump, loads
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.systems.controllers.impedance import ImpedanceGains
from spinndrift.systems.controllers.kinds import MppiImpedance
from spinndrift.systems.planning.mppi_config import MppiConfig
from spinndrift.systems.planning.mppi_core import MppiPlanner, MppiState
from spinndrift.systems.planning.obstacles import Pylon
from spinndrift.systems.planning.paths import FigureEight, PoseConfig
from spinndrift.systems.planning.task import Task, Wanted
from spinndrift.systems.planning.tasks import (
    OwnTask,
    PathFollowing,
    PylonCrossing,
    StationKeeping,
    TaskKind,
)
from spinndrift.systems.plant.wrench_limits import ThrusterLimits
from spinndrift.systems.station.config import StationConfig

STATION = StationConfig(obstacles=(Pylon(2.0, 0.0, diameter=0.4),))
OPEN = StationConfig()
SMALL = MppiConfig(horizon=20, dt=0.1, sequences=60, realisations=2, shown_paths=4)
EIGHT = FigureEight(PoseConfig((0.0, 0.0, -1.5)), follow=True)


def planner(task: Task) -> MppiPlanner:
    vehicle = load_vehicle("bluerov2_heavy")
    dynamics = vehicle.dynamics(np.array([3.0, 3.0, 3.0, 0.2, 0.2, 0.2]))
    limits = ThrusterLimits.create(vehicle.thrusters(), fraction=SMALL.wrench_fraction)
    gains = ImpedanceGains().matrices(vehicle.dynamics())
    return MppiPlanner(dynamics, limits, task, SMALL, gains)


def matrix(X_WB) -> np.ndarray:
    w, x, y, z, *p = np.asarray(X_WB, float)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), p
    return T


def test_the_state_costs_what_the_paper_says():
    """‖log(g⁻¹ g_w)‖²_L + ‖ξ_w − ξ‖²_Q by matrix logarithms, plus the speed beyond its limit."""
    pose = PoseConfig((0.4, -0.2, -1.0), (10.0, -5.0, 60.0)).pose()
    V = np.array([0.6, 0.3, -0.1, 0.2, -0.1, 0.3])
    config = PathFollowing(path=EIGHT)
    task = config.build(OPEN)
    t = jnp.asarray(11.0)
    wanted = jax.jit(lambda t: task.wanted(t))(t)
    motion = jax.jit(EIGHT.motion)(t[None])
    np.testing.assert_allclose(wanted.X_WB, motion.X_WB[:, 0], atol=1e-15)
    np.testing.assert_allclose(wanted.V_WB_B, motion.V_WB_B[:, 0], atol=1e-15)
    twist = np.real(logm(np.linalg.inv(matrix(pose)) @ matrix(wanted.X_WB)))
    error = np.array([*twist[:3, 3], twist[2, 1], twist[0, 2], twist[1, 0]])
    expected = np.array(config.pose_weight) @ error**2
    expected += np.array(config.twist_weight) @ (np.asarray(wanted.V_WB_B) - V) ** 2
    expected += config.speed_weight * (np.linalg.norm(V[:3]) - 0.5) ** 2
    found = task.running_cost(t, pose[:, None], jnp.asarray(V)[:, None])
    np.testing.assert_allclose(found, [expected], rtol=1e-9)
    assert task.clearance(t, pose[:, None], jnp.asarray(V)[:, None]) is None


def test_kinds_differ_in_what_they_ask_for():
    start = PoseConfig((0.0, 0.0, -1.5))
    X, V = jnp.asarray(start.pose())[:, None], jnp.zeros((6, 1))
    t = jnp.asarray(3.0)
    crossing = PylonCrossing(PoseConfig((4.0, 0.0, -1.5))).build(STATION)
    np.testing.assert_array_equal(crossing.wanted(t).X_WB, [1, 0, 0, 0, 4, 0, -1.5])
    keeping = StationKeeping().build(STATION)
    np.testing.assert_array_equal(keeping.wanted(t).X_WB, start.pose())
    assert float(keeping.running_cost(t, X, V)[0]) == 0
    clearance = keeping.clearance(t, X, V)
    assert clearance is not None
    size = load_vehicle(STATION.vehicle).size
    nearest = 2.0 - 0.2 - size[0] / 2  # of a box; its spheres are wider, not beyond their radius
    radius = np.hypot(size[0], size[1]) / 4
    assert nearest - radius < float(clearance[0]) <= nearest


@pytest.mark.slow
def test_a_planned_vehicle_keeps_up_with_its_path_at_any_time():
    """The plan follows the path from the call's time on, here in a turn that lies far in the run.

    A quarter of the hull is 0.11 m; the path leads 0.4 m on within the plan.
    """
    made = planner(PathFollowing(path=EIGHT).build(OPEN))
    step = jax.jit(lambda state, key, X, V, t: made.step(state, key, X, V, t=t))
    begin = 107.0
    motion = jax.jit(EIGHT.motion)(jnp.asarray(begin + SMALL.dt * np.arange(SMALL.horizon + 1)))
    first = jnp.concatenate([jnp.zeros((2, 6), "f4"), made.init().F_Bo_B])
    state, now = MppiState(first), (motion.X_WB[:, 0], motion.V_WB_B[:, 0], jnp.array([begin]))
    for i in range(5):  # two rows in front, for no time has passed
        state, _ = step(state, jax.random.key(i), *now)
        state = MppiState(jnp.concatenate([jnp.zeros((2, 6), "f4"), state.F_Bo_B]))
    _, plan = step(state, jax.random.key(5), *now)
    assert plan.valid
    assert np.isinf(plan.clearance)
    ahead = np.linalg.norm(np.asarray(motion.X_WB[4:, -1] - motion.X_WB[4:, 0]))
    off = np.linalg.norm(np.asarray(plan.X_WB[4:]) - np.asarray(motion.X_WB[4:]), axis=0)
    assert ahead > 0.35
    assert off.max() < 0.11


class Constant(Task):
    """Costs what it is told, whatever the state."""

    rate: jax.Array
    final: jax.Array | None = None

    def wanted(self, t):
        return Wanted(jnp.eye(7, dtype=t.dtype)[0], jnp.zeros(6, t.dtype))

    def running_cost(self, t, X_WB, V_WB_B):
        return jnp.full_like(V_WB_B[0], 0) + self.rate * t

    def terminal_cost(self, t, X_WB, V_WB_B):
        return None if self.final is None else jnp.full_like(V_WB_B[0], 0) + self.final * t


def test_costs_are_summed_over_the_horizon():
    """Σ l(t_k) dt + terminal_time l(T) + φ(T), t_k = t0 + k dt, k = 1 … H."""
    times = 5.0 + SMALL.dt * np.arange(1, SMALL.horizon + 1)
    weight = np.full(SMALL.horizon, SMALL.dt)
    weight[-1] += SMALL.terminal_time
    for final in (None, 7.0):
        made = planner(Constant(jnp.asarray(0.3), None if final is None else jnp.asarray(final)))
        state, X, V = made.init(), jnp.eye(7)[0], jnp.zeros(6)

        @jax.jit
        def rolled(made=made, state=state, X=X, V=V):
            draw = made.draw(state, jax.random.key(0), X, V, V, jnp.array([5.0]))
            return made.roll(draw.parts[0][:, :, :3], draw.at).cost

        expected = 0.3 * weight @ times + (0.0 if final is None else final * times[-1])
        np.testing.assert_allclose(rolled(), np.full((2, 3), expected), rtol=1e-5)


OWN = """
import jax.numpy as jnp
import numpy as np
from spinndrift.systems.planning.task import Task, Wanted

class Told(Task):
    told: tuple
    def __init__(self, goal, obstacles, weight=1.0):
        self.told = goal.tolist(), len(obstacles), weight
    def wanted(self, t):
        return Wanted(jnp.eye(7, dtype=t.dtype)[0], jnp.zeros(6, t.dtype))
    def running_cost(self, t, X_WB, V_WB_B):
        return X_WB[4]

class Wide(Told):
    def running_cost(self, t, X_WB, V_WB_B):
        return X_WB

class Double(Told):
    def clearance(self, t, X_WB, V_WB_B):
        return X_WB[4].astype(float)
"""


def test_a_task_of_ones_own(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(OWN)
    text = f"task: !OwnTask {{system: '{path}:Told', parameters: {{weight: 2.0}}}}"
    controller = loads(MppiImpedance, text)
    assert loads(MppiImpedance, dump(controller)) == controller
    task: Any = controller.task.build(STATION, np.array([1.0, 2.0, -1.0]))
    assert task.told == ([1.0, 2.0, -1.0], 1, 2.0)
    changed = load_scenario(
        "pylon_crossing_calm", f"{{controller: {{{text}}}, success: {{goal: [1, 0, -1]}}}}"
    )
    assert changed.code == (f"{path}:Told",)
    for name, message in (
        ("Told", "Told takes `goal`, of which there is none here"),
        ("None", "has no Task called `None`"),
        ("np", "has no Task called `np`"),
    ):
        with pytest.raises(UserError, match=f"OwnTask.system: .*{message}"):
            OwnTask(f"{path}:{name}").build(STATION)
    goal = np.zeros(3)
    for name, message in (
        ("Wide", r"Wide.running_cost returns float32\[7, 3\] for 3 .*: return float32\[3\]"),
        ("Double", r"Double.clearance returns float64\[3\]"),
    ):
        with pytest.raises(UserError, match=message):
            OwnTask(f"{path}:{name}").build(STATION, goal)


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (lambda: PylonCrossing(PoseConfig(), pose_weight=(-1.0,) + (0.0,) * 5), "pose_weight"),
        (lambda: StationKeeping(speed_limit=0.0), "speed_limit is 0.0: give a speed above"),
        (lambda: StationKeeping(speed_weight=-1.0), "speed_weight"),
    ],
)
def test_settings_are_checked(task, message):
    with pytest.raises(UserError, match=message):
        task()


def test_every_kind_comes_back_from_yaml():
    for task in (PylonCrossing(PoseConfig()), StationKeeping(), PathFollowing(path=EIGHT)):
        controller = MppiImpedance(task)
        assert isinstance(task, TaskKind)
        assert loads(MppiImpedance, dump(controller)) == controller


def test_the_algorithm_knows_no_task():
    for name in ("mppi_core", "rollouts", "sampling", "mppi", "mppi_config"):
        tree = ast.parse((ROOT / "systems" / "planning" / f"{name}.py").read_text())
        found = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        assert not found & {"obstacles", "tasks", "passage", "paths"}
