"""The planner's truths; `test_path_integral` has those of its weights and risks."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, RandomSource
from scipy.linalg import solve_discrete_lyapunov

from spinndrift.models import se3
from spinndrift.models.config.errors import UserError
from spinndrift.models.effects import Extended, kind
from spinndrift.models.integrate import rollout
from spinndrift.models.rigid_body import FossenDynamics
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.controllers.impedance import ImpedanceGains
from spinndrift.systems.planning.mppi import FIGURES, Mppi, key_from_gaussians
from spinndrift.systems.planning.mppi_config import MppiConfig
from spinndrift.systems.planning.mppi_core import MppiPlanner, MppiState
from spinndrift.systems.planning.obstacles import Cylinders, Pylon, SphereHull
from spinndrift.systems.planning.plan_samples import SampleLayout
from spinndrift.systems.planning.rollouts import Situation
from spinndrift.systems.planning.sampling import command_of_felt
from spinndrift.systems.planning.tasks import PoseTask, StateCost
from spinndrift.systems.plant.wrench_limits import BoxLimits, ThrusterLimits

HULL = SphereHull.cover((0.4, 0.4, 0.3), (1, 1))
MASS = np.diag([20.0, 20.0, 20.0, 1.0, 1.0, 1.0])
LIMIT = BoxLimits(jnp.array([40.0, 40.0, 40.0, 5.0, 5.0, 5.0]))
PYLON = [Pylon(1.0, 0.05)]
step = jax.jit(lambda planner, state, key, X, V, bias: planner.step(state, key, X, V, bias))
clearance = jax.jit(lambda X_WB: HULL.clearance(X_WB, Cylinders.create(PYLON)))
NONE = jnp.zeros(6)


def neutral(drag=0.0, diffusion=0.0):
    return FossenDynamics(
        rigid_inertia=MASS,
        added_mass=np.zeros((6, 6)),
        linear_drag=drag * MASS,
        quadratic_drag=np.zeros((6, 6)),
        weight=200.0,
        buoyancy=200.0,
        p_BoBcm_B=np.zeros(3),
        p_BoCb_B=np.zeros(3),
        diffusion=diffusion * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]),
    )


def at(x, y=0.0, z=0.0):
    return se3.identity().at[4:].set(jnp.array([x, y, z]))


def reach(goal, pylons=(), hull=HULL, cost=None):
    """The task to reach a pose."""
    return PoseTask(cost or StateCost(), Cylinders.create(pylons), hull, goal)


def situation(planner, X, dW=None):
    """At rest at X with a time, a hold and a command before of zero."""
    zero, h = jnp.zeros(6, jnp.float32), planner.config.horizon
    times = planner.times(jnp.zeros(1))
    return Situation(X.astype("f4"), zero, zero, zero, times, jnp.zeros((h, 6), "f4"), dW)


def settle(planner, X, V, count, seed=0, bias=NONE):
    """Plan again and again from the same state: rows put in front undo the shift in time."""
    rows = planner.config.shift
    state, output = planner.init(), []
    for i in range(count):
        longer = jnp.concatenate([jnp.zeros((rows, 6), state.F_Bo_B.dtype), state.F_Bo_B])
        key = jax.random.key(seed + i)
        state, *output = step(planner, MppiState(longer), key, X, V, bias)
    return state, output[0]


# ------------------------------------------------------------------------------------- optimality

FREE = MppiConfig(
    substeps=1,  # the steps of the optimum it is compared with
    horizon=40,
    dt=0.1,
    sequences=400,
    realisations=1,
    terminal_time=1.0,
    effort_weight=4.0,
    rate_weight=0.0,
    noise=(0.3, 0.0, 0.0, 0.0, 0.0, 0.0),
    smallest_noise=0.02,
)
COST = StateCost(pose_weight=(1.0,) * 6, twist_weight=(0.5,) * 6, speed_limit=None)


def double_integrator_optimum(config, distance, mass, limit):
    """Least cost of x⁺ = x + h v, v⁺ = v + h F/m from rest at `distance`: least squares."""
    n, h = config.horizon, config.dt
    v_of_F = np.tril(np.ones((n, n))) * h / mass
    x_of_F = np.vstack([np.zeros(n), np.cumsum(v_of_F, axis=0)[:-1]]) * h
    time = np.full(n, h)
    time[-1] += config.terminal_time
    rows = [
        np.sqrt(time * COST.pose_weight[0])[:, None] * x_of_F,
        np.sqrt(time * COST.twist_weight[0])[:, None] * v_of_F,
        np.sqrt(h * config.effort_weight) / limit * np.eye(n),
    ]
    aim = np.concatenate([np.sqrt(time * COST.pose_weight[0]) * distance, np.zeros(2 * n)])
    A = np.vstack(rows)
    F = np.linalg.lstsq(A, aim, rcond=None)[0]
    return float(np.sum((A @ F - aim) ** 2)), F


def test_without_obstacles_it_finds_the_optimum_of_a_double_integrator():
    distance = 1.0
    planner = MppiPlanner(neutral(), LIMIT, reach(at(distance), cost=COST), FREE)
    optimum, F = double_integrator_optimum(FREE, distance, 20.0, 40.0)
    idle = distance**2 * (FREE.horizon * FREE.dt + FREE.terminal_time)
    _, plan = settle(planner, at(0.0), NONE, 40)
    assert optimum < float(plan.cost) * (1 + 1e-5)
    assert float(plan.cost) - optimum < 0.01 * (idle - optimum)
    assert np.max(np.abs(np.asarray(plan.F_Bo_B[0]) - F)) < 0.15 * np.max(np.abs(F))


def test_holding_counters_what_effects_add():
    """At rest at the goal nothing is left over: of net buoyancy, current, and an observed bias."""
    vehicle = load_vehicle("bluerov2_heavy")
    effects = (kind("net_buoyancy").of(force=-12.0), kind("current_steady").of(east=0.4, north=0.1))
    model = Extended.create(vehicle.dynamics(), effects, vehicle.thrusters())
    X_WG = se3.retract(at(1.0, 2.0, -3.0), jnp.array([0, 0, 0, 0, 0, 0.7]))
    bias = jnp.array([3.0, 0.0, 2.0, 0.0, 0.0, 0.5])
    planner = MppiPlanner(model, LIMIT, reach(X_WG), FREE, dtype=jnp.float64)
    hold = planner.rollouts.hold_wrenches(jnp.zeros(1), bias)[0]
    v_C = se3.rotate_inverse(X_WG, jnp.array([0.4, 0.1, 0.0]))
    drag = vehicle.dynamics().drag_wrench(-jnp.concatenate([v_C, jnp.zeros(3)]))
    expected = -drag - jnp.array([0, 0, 2.0 - 12.0, 0, 0, 0])  # 2 N: the preset's own buoyancy
    turned = jnp.concatenate([se3.rotate_inverse(X_WG, f) for f in (bias[:3], bias[3:])])
    # the Munk moment of a hull that a current passes stays for the balance to tell
    rest = model.balance(X_WG, jnp.zeros(6), hold + turned)[1]
    np.testing.assert_allclose(rest, 0, atol=1e-9)
    np.testing.assert_allclose((hold + turned)[:3], expected[:3], atol=1e-9)


def test_sampled_commands_are_felt_along_the_axes():
    """With a dead thruster the commands' noise is coupled so that what the body feels is not."""
    vehicle = load_vehicle("bluerov2_heavy")
    scale = np.array([30.0, 30.0, 20.0, 0.1, 0.2, 0.5])
    plain = vehicle.dynamics()
    assert command_of_felt(plain, at(0.0), scale) is None
    dead = Extended.create(plain, (kind("thruster_gain").of("2", gain=-1.0),), vehicle.thrusters())
    command = command_of_felt(dead, at(0.0), scale)
    assert command is not None
    felt = jax.vmap(lambda F: dead.balance(at(0.0), NONE, F)[1], 1, 1)(jnp.asarray(command))
    felt = felt - dead.balance(at(0.0), NONE, NONE)[1][:, None]
    np.testing.assert_allclose(felt, np.eye(6), atol=1e-9)
    blind = Extended.create(
        plain, (kind("thruster_dead_zone").of("all", width=15.0),), vehicle.thrusters()
    )
    assert command_of_felt(blind, at(0.0), scale) is None  # moments of this size do nothing at all
    limit = BoxLimits(1e3 * jnp.ones(6))
    config = replace(FREE, noise=(0.01, 0.01, 0.01, 0.01, 0.01, 0.01))
    planner = MppiPlanner(dead, limit, reach(at(0.0)), config)
    nominal = jnp.zeros((config.horizon, 6), jnp.float32)
    F = planner.sampler.sequences(jax.random.key(0), nominal, nominal)[:, :, 2:]
    felt = np.linalg.solve(command, np.asarray(F, float).reshape(-1, 6, F.shape[2]))
    plain_sampler = eqx.tree_at(lambda s: s.command, planner.sampler, None)
    plainly = plain_sampler.sequences(jax.random.key(0), nominal, nominal)
    np.testing.assert_allclose(felt, plainly[:, :, 2:], atol=1e-4)


# ------------------------------------------------------------------------------- among obstacles

AMONG = MppiConfig(
    horizon=40,
    dt=0.1,
    sequences=120,
    realisations=8,
    terminal_time=1.0,
    collision_risk=0.05,
    clearance_std=0.02,
    margin=0.05,
    margin_weight=5.0,
    risk_weight=300.0,
    shown_paths=7,
)


def among(diffusion=0.0, pylons=PYLON, config=AMONG, **more):
    return MppiPlanner(
        neutral(drag=0.5, diffusion=diffusion),
        LIMIT,
        reach(more.pop("goal", at(2.0)), pylons),
        config,
        **more,
    )


def test_weights_sum_to_one_and_the_plan_is_the_models_own_path():
    planner = among()
    _, plan = settle(planner, at(0.0), NONE, 3)
    assert float(jnp.sum(plan.weights)) == pytest.approx(1, abs=1e-5)
    assert float(plan.effective_samples) == pytest.approx(12, rel=0.02)
    assert plan.X_WB.shape == (7, 41)
    assert plan.F_Bo_B.shape == (6, 40)
    assert plan.paths.shape == (40, 3, 7)
    assert plan.valid
    model = planner.rollouts.dynamics
    X, V = rollout(model, plan.X_WB[:, 0], plan.V_WB_B[:, 0], plan.F_Bo_B.T, 0.1, substeps=2)
    np.testing.assert_allclose(plan.X_WB[:, 1:].T, X, atol=2e-5)
    np.testing.assert_allclose(plan.V_WB_B[:, 1:].T, V, atol=2e-5)


def test_the_attitude_is_held_by_part_of_the_plans_own_wrench():
    """The plan holds what the planned vehicle is given, within U, and leads where it says."""
    gains = (np.diag([0.0, 0.0, 0.0, 4.0, 4.0, 4.0]), np.diag([0.0, 0.0, 0.0, 4.0, 4.0, 4.0]))
    planner = among(0.5, pylons=[], tracking=gains)
    turned = se3.exp(jnp.array([0.0, 0.0, 0.0, 0.3, -0.2, 1.5], jnp.float32))
    _, plan = settle(planner, turned, NONE, 1)
    hold, limit = planner.init().F_Bo_B[0], np.asarray(LIMIT.limit)[:, None]
    assert np.all(np.abs(plan.F_Bo_B) <= limit * (1 + 1e-6))
    assert np.abs(plan.F_Bo_B[3:, 0] - hold[3:]).max() > 2  # from the first step
    model = planner.rollouts.dynamics
    X, _ = rollout(model, plan.X_WB[:, 0], plan.V_WB_B[:, 0], plan.F_Bo_B.T, 0.1, substeps=2)
    np.testing.assert_allclose(plan.X_WB[:, 1:].T, X, atol=2e-5)
    np.testing.assert_allclose(plan.X_WB[:4, -1], [1, 0, 0, 0], atol=0.05)


@pytest.mark.slow
def test_in_a_current_a_held_attitude_keeps_sampled_vehicles_on_course():
    """Munk's moment turns a hull that makes way against a current; 4 s of wrenches can't help."""
    vehicle = load_vehicle("bluerov2_heavy")
    current = kind("current_steady").of("W", east=-0.25, north=0.35)
    start = at(0.0).astype("f4")

    @eqx.filter_jit
    def ends(p):
        F = p.sampler.sequences(jax.random.key(2), *[p.init().F_Bo_B] * 2)
        return p.rollouts(F, situation(p, start), lambda X, V, F: (X, F)).states

    broadside = []
    for held in (True, False):
        planner = MppiPlanner(
            Extended.create(vehicle.dynamics(), (current,), vehicle.thrusters()),
            ThrusterLimits.create(vehicle.thrusters(), fraction=0.8),
            reach(at(3.0), hull=SphereHull.cover(vehicle.size)),
            config=MppiConfig(realisations=1, hold_attitude=held),
            tracking=ImpedanceGains().matrices(vehicle.dynamics()),
        )
        X, F = ends(planner)
        turn = np.linalg.norm(np.asarray(se3.local(X[-1], start))[3:], axis=0)
        broadside.append(np.mean(turn > np.pi / 4))
        np.testing.assert_allclose(planner.sampler.cut(F), F, atol=1e-3)
    assert broadside[0] < broadside[1] / 5
    assert broadside[1] > 0.3


def test_wrenches_stay_in_the_feasible_set():
    planner = among(goal=at(50.0))
    _, plan = settle(planner, at(0.0), NONE, 6)
    limit = np.asarray(LIMIT.limit)[:, None]
    assert np.all(np.abs(plan.F_Bo_B) <= limit * (1 + 1e-6))
    hold = planner.init().F_Bo_B
    sampled = planner.sampler.sequences(jax.random.key(0), hold + 30.0, hold)
    assert np.all(np.abs(sampled) <= np.asarray(LIMIT.limit)[None, :, None] * (1 + 1e-6))


def test_the_same_key_gives_the_same_plan_bit_for_bit_and_another_key_another():
    planner = among()
    plans = [settle(planner, at(0.0), NONE, 2, seed)[1] for seed in (5, 5, 6)]
    for a, b in zip(plans[0], plans[1], strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(plans[0].F_Bo_B, plans[2].F_Bo_B)


@pytest.mark.slow
def test_process_noise_makes_the_plan_keep_its_distance():
    """The chance constraint turns noise into room: the same problem with and without noise."""

    def room(planner):
        plans = [settle(planner, at(0.0), NONE, 12, seed)[1] for seed in (0, 100, 200, 300, 400)]
        for plan in plans:
            assert float(plan.X_WB[4, -1]) > 0.9  # beside the pylon, not waiting before it
            assert float(plan.collision_probability) < 0.1
        return np.array([jnp.min(clearance(plan.X_WB.astype(float))) for plan in plans])

    still, noisy = room(among(0.0)), room(among(1.5))
    assert np.all(still > 0)
    assert np.mean(noisy) > np.mean(still) + 0.08
    assert np.min(noisy) > np.max(still)


def test_noise_paths_have_the_brownian_mean_and_spread():
    dW = among().sampler.process_noise(jax.random.key(4), tracked=False)
    assert dW is not None
    assert dW.shape == (40, 2, 6, 8)
    W = jnp.cumsum(dW.reshape(80, 6, 8), axis=0)
    np.testing.assert_allclose(jnp.mean(W, axis=2), 0, atol=1e-6)
    times = 0.05 * np.arange(1, 81)
    np.testing.assert_allclose(jnp.mean(W**2, axis=(0, 2)), np.mean(times), rtol=1e-5)


def test_a_tracked_vehicle_may_pass_closer_than_one_left_to_the_noise():
    """Spread with feedback is that of the linear closed loop, so less room is asked for."""
    w, b = 1.5, 3.0
    gains = (np.diag(w**2 * np.diag(MASS)), np.diag(2 * w * np.diag(MASS)))
    config = replace(AMONG, horizon=120, realisations=40, sequences=50)
    spreads = []
    for tracking in (None, gains):
        planner = among(b, pylons=[], config=config, tracking=tracking)
        dW = planner.sampler.process_noise(jax.random.key(7), planner.rollouts.tracked)
        F = jnp.zeros((120, 6, 1), jnp.float32)
        roll = jax.jit(
            lambda p, dW, F=F: p.rollouts(F, situation(p, at(0.0), dW), lambda X, V, F: (X[4:],))
        )
        spreads.append(jnp.var(roll(planner, dW).states[0][60:, 0], axis=1).mean())
    h, drag = 0.1, 0.5  # x'' + (2w + drag) x' + w² x = (b/m) white noise, in the planner's steps
    A = np.array([[1.0, h], [-h * w**2, 1 - h * (2 * w + drag)]])
    expected = solve_discrete_lyapunov(A, np.diag([0.0, h * (b / 20.0) ** 2]))[0, 0]
    assert float(spreads[1]) == pytest.approx(expected, rel=0.35)  # 40 paths, 10 correlation times
    assert float(spreads[0]) > 20 * float(spreads[1])


def test_a_start_inside_a_pylon_gives_finite_numbers_and_a_way_out():
    planner = among(1.0, pylons=[Pylon(0.05, 0.0, diameter=1.0)])
    _, plan = settle(planner, at(0.0), NONE, 8)
    for part in plan:
        assert np.all(np.isfinite(part))
    assert float(plan.collision_probability) > 0.9
    assert float(jnp.sum(plan.weights)) == pytest.approx(1, abs=1e-5)
    distance = np.hypot(plan.X_WB[4] - 0.05, plan.X_WB[5])
    assert distance[-1] > distance[0] + 0.3


def test_no_goal_is_so_far_that_a_collision_pays():
    """Behind a wall, 300 m away: being nearer would save more than any penalty costs."""
    wall = Pylon(11.5, 0.0, diameter=20.0, bottom=-50.0, top=50.0)
    planner = among(1.5, pylons=[wall], goal=at(300.0))
    for moving in (NONE, NONE.at[0].set(0.3)):
        _, plan = settle(planner, at(0.0), moving, 6)
        assert float(plan.collision_probability) <= planner.config.collision_risk
        assert np.min(np.hypot(plan.X_WB[4] - 11.5, plan.X_WB[5])) > 10.2  # half a hull outside


def test_a_state_of_nan_is_no_plan_and_is_forgotten():
    planner = among()
    state, plan = settle(planner, at(np.nan), NONE, 1)
    assert not plan.valid
    assert np.all(np.isfinite(state.F_Bo_B))
    assert np.all(np.isfinite(plan.weights))
    assert settle(planner, at(0.0), NONE, 1)[1].valid


def test_an_observed_push_is_countered_at_the_goal():
    push = jnp.array([5.0, -8.0, 3.0, 0.0, 0.0, 0.0])
    planner = among(pylons=[Pylon(50.0, 0.0)])
    _, plan = settle(planner, at(2.0), NONE, 10, bias=push)
    np.testing.assert_allclose(np.mean(plan.F_Bo_B, axis=1)[:3], -push[:3], atol=1.0)
    assert np.max(np.abs(np.asarray(plan.X_WB[4:]) - np.array([[2.0], [0.0], [0.0]]))) < 0.1


def test_settings_are_checked():
    with pytest.raises(UserError, match="period"):
        MppiConfig(period=0.07)
    with pytest.raises(UserError, match="effective_samples"):
        MppiConfig(sequences=10, effective_samples=10.0)
    with pytest.raises(UserError, match="collision_risk"):
        MppiConfig(collision_risk=1.0)
    with pytest.raises(UserError, match="threads"):
        MppiConfig(sequences=20, threads=21)
    with pytest.raises(UserError, match="noise"):
        MppiConfig(noise=(0.1, -0.1, 0.1, 0.1, 0.1, 0.1))


# ------------------------------------------------------------------------------------- in Drake


def test_keys_differ_with_any_bit_of_the_noise():
    w = jnp.array([0.3, -1.2, 0.0, 2.5])
    keys = {tuple(np.asarray(key_from_gaussians(w)).tolist())}
    for i in range(4):
        keys.add(tuple(np.asarray(key_from_gaussians(w.at[i].add(1e-12))).tolist()))
    assert len(keys) == 5


def test_the_system_plans_from_its_ports_and_repeats_itself():
    builder = DiagramBuilder()
    system: Any = builder.AddSystem(Mppi(among()))
    for name, value in (("X_WB", at(0.0)), ("V_WB_B", NONE)):
        source = builder.AddSystem(ConstantVectorSource(np.asarray(value)))
        builder.Connect(source.get_output_port(), system.GetInputPort(name))
    noise = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, 4, 0.2))
    builder.Connect(noise.get_output_port(), system.GetInputPort("noise"))
    diagram = builder.Build()
    plans, samples, figures = [], SampleLayout(1, 0.1, 1).unpack(jnp.zeros(5)), {}
    for _ in range(2):
        simulator = Simulator(diagram)
        context = simulator.get_mutable_context()
        diagram.SetRandomContext(context, RandomGenerator(3))
        own = system.GetMyContextFromRoot(context)
        assert not np.any(system.GetOutputPort("plan").Eval(own))
        simulator.AdvanceTo(0.25)
        plans.append(system.GetOutputPort("plan").Eval(own).copy())
        samples = system.samples.unpack(jnp.asarray(system.GetOutputPort("samples").Eval(own)))
        figures = dict(
            zip(FIGURES, system.GetOutputPort("figures").Eval(own).tolist(), strict=True)
        )
    np.testing.assert_array_equal(plans[0], plans[1])
    plan = system.layout.unpack(jnp.asarray(plans[0]))
    assert float(plan.t0) == pytest.approx(0.2)
    np.testing.assert_allclose(plan.X_WB[:, 0], at(0.0), atol=1e-6)
    assert samples.p_WB.shape == (40, 3, 7)
    assert figures["valid"] == 1
    assert figures["effective_samples"] == pytest.approx(12, rel=0.02)
    assert Mppi(among())._programs is system._programs


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 7])
def test_threads_change_nothing_but_the_time(threads):
    """120 sequences in 1 or 7 parts (of 18 and 17) give what one program gives for all."""
    noise = np.array([0.3, -1.2, 0.0, 2.5])
    nominal = among(1.5).init()
    X, V, bias = np.asarray(at(0.2, 0.1)), np.full(6, 0.05), np.array([3.0, -2.0, 1.0, 0, 0, 0])
    state, whole = step(among(1.5), nominal, key_from_gaussians(jnp.array(noise)), X, V, bias)
    planner = among(1.5, config=replace(AMONG, threads=threads))
    system = Mppi(planner)
    values = system.plan(1.5, np.asarray(nominal.F_Bo_B, float).ravel(), X, V, bias, noise)
    again = system.plan(1.5, np.asarray(nominal.F_Bo_B, float).ravel(), X, V, bias, noise)
    for value, same in zip(values, again, strict=True):
        np.testing.assert_array_equal(value, same)
    plan = system.layout.unpack(jnp.asarray(values[1]))
    samples = system.samples.unpack(jnp.asarray(values[2]))
    assert plan.t0 == samples.t0 == 1.5
    np.testing.assert_allclose(values[0].reshape(-1, 6), state.F_Bo_B, atol=2e-3)
    np.testing.assert_allclose(plan.F_Bo_B, whole.F_Bo_B, atol=2e-3)
    np.testing.assert_allclose(plan.X_WB, whole.X_WB, atol=1e-4)
    np.testing.assert_allclose(samples.p_WB, whole.paths, atol=1e-4)
    np.testing.assert_allclose(samples.weights, whole.path_weights, atol=1e-4)
    figures = [getattr(whole, name) for name in FIGURES]
    np.testing.assert_allclose(values[3], np.asarray(figures, float), rtol=1e-3, atol=1e-3)


def test_config_is_replaceable():
    assert replace(AMONG, horizon=80).layout.size == 1534
