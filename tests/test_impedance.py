from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from scipy.linalg import logm

from spinndrift.models import se3
from spinndrift.models.config.errors import UserError
from spinndrift.models.integrate import step
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.controllers.impedance import Impedance, ImpedanceGains, ImpedanceLaw
from spinndrift.systems.planning.plan import Plan, PlanLayout
from spinndrift.systems.plant.wrench_limits import BoxLimits, ThrusterLimits

VEHICLE = load_vehicle("bluerov2_heavy")
DYNAMICS = VEHICLE.dynamics()
K_P, K_D = ImpedanceGains().matrices(DYNAMICS)
WIDE = BoxLimits(jnp.full(6, 1e6))
REST = jnp.zeros(6)
call = jax.jit(lambda law, *arguments: law(*arguments))
pose = jax.jit(se3.from_position_rpy)


def at(position=(0.0, 0.0, 0.0), rpy=(0.0, 0.0, 0.0)):
    return pose(jnp.array(position, float), jnp.array(rpy, float))


def test_the_law_is_that_of_the_paper():
    law = ImpedanceLaw(K_P, K_D, WIDE, (1e9, 1e9))
    rng = np.random.default_rng(0)
    X, X_opt = at(rng.normal(size=3), [0.1, -0.2, 0.7]), at(rng.normal(size=3), [0.3, 0.2, -0.4])
    V, V_opt, F_opt = (jnp.asarray(rng.normal(size=6)) for _ in range(3))
    F = call(law, X, V, X_opt, V_opt, F_opt)
    relative = np.linalg.inv(np.asarray(se3.as_matrix(X))) @ np.asarray(se3.as_matrix(X_opt))
    log = np.real(np.asarray(logm(relative)))
    error = np.array([*log[:3, 3], log[2, 1], log[0, 2], log[1, 0]])
    np.testing.assert_allclose(F, F_opt + K_P @ error + K_D @ (V_opt - V), rtol=1e-9)


def test_far_errors_pull_as_hard_as_one_at_the_limit_and_in_the_same_direction():
    law = ImpedanceLaw(np.eye(6), np.zeros((6, 6)), WIDE, (0.5, 0.2))
    F = call(law, at(), REST, at([30.0, -40.0, 0.0]), REST, REST)
    np.testing.assert_allclose(F, [0.3, -0.4, 0, 0, 0, 0], atol=1e-12)
    F = call(law, at(), REST, at(rpy=(0.0, 0.0, 2.0)), REST, REST)
    np.testing.assert_allclose(F, [0, 0, 0, 0, 0, 0.2], atol=1e-12)
    near = call(law, at(), REST, at([0.1, 0.0, 0.0]), REST, REST)
    np.testing.assert_allclose(near, [0.1, 0, 0, 0, 0, 0], atol=1e-12)


def test_gains_give_each_axis_its_bandwidth_and_damping():
    gains = ImpedanceGains(
        bandwidth=(1.0, 2.0, 3.0, 1.0, 2.0, 3.0), damping=(0.5, 1.0, 1.0, 2.0, 1.0, 1.0)
    )
    K_p, K_d = gains.matrices(DYNAMICS)
    M = np.diag(np.asarray(DYNAMICS.mass.matrix()))
    np.testing.assert_allclose(np.sqrt(np.diag(K_p) / M), gains.bandwidth)
    np.testing.assert_allclose(np.diag(K_d) / (2 * np.sqrt(np.diag(K_p) * M)), gains.damping)


def test_the_loop_settles_at_the_plan_with_the_linear_rate():
    """Without drag and righting moment, a small surge error decays like the chosen oscillator."""
    M = np.diag(np.asarray(DYNAMICS.mass.matrix()))
    law = ImpedanceLaw(K_P, K_D, WIDE)
    X_opt = at([0.01, 0.0, 0.0])
    hold = -DYNAMICS.potential_wrench(X_opt)

    def body(state, _):
        X, V = state
        F = law(X, V, X_opt, REST, hold)
        return step(DYNAMICS, X, V, F, 0.002), X[4]

    _, x = jax.jit(lambda s: jax.lax.scan(body, s, None, length=2000))((at(), REST))
    t = 0.002 * np.arange(2000)
    w = 1.5
    d = np.asarray(DYNAMICS.linear_drag.matrix())[0, 0] / M[0]
    roots = np.roots([1, 2 * w + d, w * w])  # with the model's linear drag on top
    a, b = roots
    expected = 0.01 * (1 - (b * np.exp(a * t) - a * np.exp(b * t)) / (b - a)).real
    np.testing.assert_allclose(x, expected, atol=1e-4)


def test_wrenches_are_cut_to_what_the_thrusters_give():
    limits = ThrusterLimits.create(VEHICLE.thrusters())
    law = ImpedanceLaw(100 * K_P, K_D, limits)
    F = call(law, at(), REST, at([5.0, 3.0, -2.0], (0.2, 0.1, 1.0)), REST, REST)
    thrusters = VEHICLE.thrusters()
    forces = jax.jit(lambda F: thrusters.allocate(F))(F)
    low, high = thrusters.force_limits()
    assert np.all(forces >= low - 1e-9)
    assert np.all(forces <= high + 1e-9)
    np.testing.assert_allclose(thrusters.wrench(forces), F, atol=1e-6)
    axes_of = jax.jit(lambda limits: limits.axes())
    axes = np.asarray(axes_of(limits))
    assert np.all((axes > 5) & (axes < 250))
    half = ThrusterLimits.create(thrusters, fraction=0.5)
    np.testing.assert_allclose(axes_of(half), axes / 2, rtol=1e-9)


def test_nan_in_gives_no_wrench():
    law = ImpedanceLaw(K_P, K_D, WIDE)
    F = call(law, at([np.nan, 0, 0]), REST, at(), REST, REST)
    np.testing.assert_array_equal(F, np.zeros(6))


def test_faults_are_named():
    with pytest.raises(ValueError, match="K_p"):
        ImpedanceLaw(np.full((6, 6), np.nan), np.eye(6), WIDE)
    with pytest.raises(ValueError, match="error_limit"):
        ImpedanceLaw(np.eye(6), np.eye(6), WIDE, (0.0, 1.0))
    with pytest.raises(UserError, match="bandwidth"):
        ImpedanceGains(bandwidth=(-1.0, 1.0, 1.0, 1.0, 1.0, 1.0))


def system_output(plan, t, X, V):
    """What the system holds after one update at time t."""
    layout = PlanLayout(2, 0.1)
    builder = DiagramBuilder()
    system: Any = builder.AddSystem(Impedance(ImpedanceLaw(K_P, K_D, WIDE), layout))
    for name, value in (("plan", plan), ("X_WB", X), ("V_WB_B", V)):
        source = builder.AddSystem(ConstantVectorSource(np.asarray(value, float)))
        builder.Connect(source.get_output_port(), system.GetInputPort(name))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    context.SetTime(t)
    own = system.GetMyContextFromRoot(context)
    updated = own.get_mutable_discrete_state()
    system._update(own, updated)
    return np.asarray(system.GetOutputPort("F_Bo_B").Eval(own))


def test_the_system_tracks_the_plan_at_the_present_time():
    layout = PlanLayout(2, 0.1)
    X = jnp.stack([at([x, 0.0, 0.0]) for x in (0.0, 0.1, 0.2)], axis=1)
    V = jnp.stack([jnp.zeros(6).at[0].set(1.0)] * 3, axis=1)
    F = jnp.arange(12.0).reshape(6, 2)
    plan = layout.pack(Plan(jnp.asarray(4.0), X, V, F))
    on_plan = system_output(plan, 4.15, at([0.15, 0, 0]), V[:, 0])
    np.testing.assert_allclose(on_plan, F[:, 1], atol=1e-9)
    behind = system_output(plan, 4.15, at([0.10, 0, 0]), V[:, 0])
    np.testing.assert_allclose(behind - on_plan, K_P[:, 0] * 0.05, atol=1e-9)
    ended = system_output(plan, 9.0, at([0.2, 0, 0]), REST)
    np.testing.assert_allclose(ended, F[:, 1], atol=1e-9)


def test_without_a_plan_the_system_asks_for_nothing():
    assert not np.any(system_output(np.zeros(52), 1.0, at([1.0, 2, 3]), REST))
