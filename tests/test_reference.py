import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import se3
from spinndrift.models.config.errors import UserError
from spinndrift.models.config.typed_yaml import loads
from spinndrift.models.integrate import step
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.controllers.kinds import TrackReference
from spinndrift.systems.estimation.disturbance_observer import MomentumObserver
from spinndrift.systems.planning.paths import FigureEight, HoldPose, PoseConfig, Waypoints
from spinndrift.systems.planning.plan import PlanLayout
from spinndrift.systems.planning.reference import Reference, feedforward

PATHS = {
    "hold": HoldPose(PoseConfig((1.0, 2.0, -1.0), (5.0, -3.0, 120.0))),
    "waypoints": Waypoints(
        (
            PoseConfig((0.0, 0.0, -1.0)),
            PoseConfig((2.0, 0.5, -1.5), (0.0, 10.0, 90.0)),
            PoseConfig((1.0, -1.0, -1.0), (0.0, 0.0, -170.0)),
        ),
        pause=1.0,
    ),
    "eight": FigureEight(PoseConfig((1.0, 0.0, -2.0), (0.0, 0.0, 30.0))),
    "eight_along": FigureEight(follow=True, length=3.0, width=1.0, period=20.0),
}
DYNAMICS = load_vehicle("bluerov2_heavy").dynamics()
motion_of = jax.jit(lambda path, t: path.motion(t), static_argnums=0)
times_of = jax.jit(lambda path: path.times(), static_argnums=0)
log_between = jax.jit(se3.local)
wrenches = jax.jit(feedforward)


@pytest.mark.parametrize("name", PATHS)
def test_twist_and_acceleration_lead_from_pose_to_pose(name):
    """Integrating ξ over a short time on the group gives the next pose, ξ̇ the next twist."""
    path, h = PATHS[name], 1e-3
    t = jnp.linspace(0.05, 24.9, 40)
    now, later = motion_of(path, t), motion_of(path, t + h)
    middle = motion_of(path, t + h / 2)
    moved = log_between(now.X_WB, later.X_WB)
    np.testing.assert_allclose(moved / h, middle.V_WB_B, atol=2e-6)
    np.testing.assert_allclose((later.V_WB_B - now.V_WB_B) / h, middle.A_WB_B, atol=2e-5)
    np.testing.assert_allclose(jnp.sum(now.X_WB[:4] ** 2, axis=0), 1, atol=1e-12)


def test_waypoints_begin_pass_and_end_at_rest_where_they_should():
    path = PATHS["waypoints"]
    begins, lengths = times_of(path)
    ends = begins + lengths
    assert begins[0] == 1.0
    assert begins[1] == pytest.approx(ends[0] + 1.0)
    poses = [p.pose() for p in path.poses]
    rests = [0.0, float(ends[0]) + 0.5, float(ends[1]) + 100.0]
    motion = motion_of(path, jnp.array([*rests, *np.linspace(0.0, 30.0, 600)]))
    error = log_between(motion.X_WB[:, :3], jnp.stack(poses, axis=1))
    np.testing.assert_allclose(error, 0, atol=1e-9)
    np.testing.assert_allclose(motion.V_WB_B[:, :3], 0, atol=1e-12)
    peak = np.linalg.norm(motion.V_WB_B[:3], axis=0).max()
    assert peak == pytest.approx(path.speed * 15 / 8, rel=1e-3)


def test_a_figure_eight_starts_at_rest_returns_and_looks_where_it_goes():
    path = PATHS["eight_along"]
    t = jnp.array([0.0, path.ramp / 2 + path.period, 7.3, 13.1])
    motion = motion_of(path, t)
    np.testing.assert_allclose(motion.V_WB_B[:, 0], 0, atol=1e-9)
    np.testing.assert_allclose(motion.X_WB[4:, 1], motion.X_WB[4:, 0], atol=1e-9)
    np.testing.assert_allclose(motion.V_WB_B[1:3, 2:], 0, atol=1e-9)
    assert np.all(motion.V_WB_B[0, 2:] > 0.1)


def test_feedforward_is_inverse_dynamics():
    """The model under the wrench accelerates as the path asks, with the observed push added."""
    motion = motion_of(PATHS["eight_along"], jnp.linspace(1.0, 20.0, 21))
    push = jnp.array([4.0, -6.0, 2.0, 0.1, -0.2, 0.3])
    F = wrenches(DYNAMICS, motion, push)

    @jax.jit
    def accelerate(motion, F):
        felt = [se3.rotate_inverse(motion.X_WB, part) for part in (push[:3], push[3:])]
        return DYNAMICS.acceleration(motion.X_WB, motion.V_WB_B, F + jnp.concatenate(felt))

    A = accelerate(motion, F)
    np.testing.assert_allclose(A, motion.A_WB_B, atol=1e-9)


def test_the_plan_begins_now_and_holds_the_next_second():
    system = Reference(PATHS["eight"], DYNAMICS)
    context = system.CreateDefaultContext()
    context.SetTime(3.0)
    push = np.array([3.0, 0, 0, 0, 0, 0])
    system.GetInputPort("F_bias_Bo_W").FixValue(context, push)
    system._update(context, context.get_mutable_discrete_state())
    plan = system.layout.unpack(jnp.asarray(system.GetOutputPort("plan").Eval(context)))
    assert plan.t0 == 3.0
    motion = motion_of(PATHS["eight"], 3.0 + 0.05 * jnp.arange(21.0))
    np.testing.assert_allclose(plan.X_WB, motion.X_WB, atol=1e-12)
    np.testing.assert_allclose(plan.V_WB_B, motion.V_WB_B, atol=1e-12)
    F = wrenches(DYNAMICS, motion, jnp.asarray(push))
    np.testing.assert_allclose(plan.F_Bo_B, F[:, :-1], atol=1e-9)


def test_paths_are_read_from_yaml_by_tag():
    text = "path: !Waypoints {poses: [{position: [0, 0, -1]}, {position: [1, 0, -1]}], speed: 0.2}"
    controller = loads(TrackReference, text)
    assert isinstance(controller.path, Waypoints)
    assert controller.path.poses[1].position == (1.0, 0.0, -1.0)
    with pytest.raises(UserError, match="at least two"):
        loads(TrackReference, "path: !Waypoints {poses: [{position: [0, 0, -1]}]}")
    with pytest.raises(UserError, match="Spiral"):
        loads(TrackReference, "path: !Spiral {}")


def test_a_plan_must_outlast_the_period():
    with pytest.raises(ValueError, match="period"):
        Reference(HoldPose(), layout=PlanLayout(2, 0.05), period=0.2)


def test_the_observer_finds_a_steady_push_whichever_way_the_vehicle_turns():
    """The plant is the model with a force that is steady in W; the estimate tends to that force."""
    observer = MomentumObserver(DYNAMICS, time_constant=0.5)
    push = jnp.array([6.0, -3.0, 2.0, 0.0, 0.0, 0.0])
    wrench = jnp.array([5.0, 2.0, -2.0, 0.0, 0.0, 0.3])

    def body(carry, _):
        state, X, V = carry
        state = observer.step(state, X, V, wrench, 0.05)
        felt = jnp.concatenate([se3.rotate_inverse(X, push[:3]), jnp.zeros(3)])
        X, V = step(DYNAMICS, X, V, wrench + felt, 0.05)
        return (state, X, V), state.F_bias_Bo_W

    start = (observer.init(), se3.identity(), jnp.zeros(6))
    (_, X, _), bias = jax.jit(lambda s: jax.lax.scan(body, s, None, length=200))(start)
    assert abs(float(se3.yaw(X))) > 1.0
    assert not np.any(bias[0])
    np.testing.assert_allclose(bias[-1], push, atol=0.15)
    decay = np.linalg.norm(bias[10] - push) / np.linalg.norm(push)
    assert decay == pytest.approx(np.exp(-0.05 * 10 / 0.5), abs=0.1)


def test_the_observer_forgets_a_state_of_nan_and_keeps_to_its_limits():
    observer = MomentumObserver(DYNAMICS, limit=(10.0, 1.0))
    state = observer.init()
    X, V = se3.identity(), jnp.zeros(6)
    advance = jax.jit(lambda s, V: observer.step(s, X, V, jnp.zeros(6), 0.05))
    for v in (0.0, jnp.nan, 0.0, 0.5, 0.0, 5.0, 0.0, 5.0):
        state = advance(state, V.at[0].set(v))
        assert np.all(np.isfinite(state.F_bias_Bo_W))
        assert np.linalg.norm(state.F_bias_Bo_W[:3]) <= 10 + 1e-9
