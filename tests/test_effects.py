"""Every effect is absent at zero, and acts as its own equation says."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from helpers import ROOT
from spinndrift.models import disturbances, se3
from spinndrift.models.config.errors import UserError
from spinndrift.models.effects import KINDS, Extended, Library
from spinndrift.models.effects.base import Effect
from spinndrift.models.effects.deterministic_step import advance
from spinndrift.models.effects.drag import COUPLINGS
from spinndrift.models.effects.following import FOLLOWERS, ramped, taken_up
from spinndrift.models.effects.library import COEFFICIENTS
from spinndrift.models.effects.page import effects_page
from spinndrift.models.effects.recent import Recent
from spinndrift.models.effects.thrust import REFERENCE, ThrustCurve
from spinndrift.models.effects.unknown import Unknown
from spinndrift.models.files.checkpoint import load_model, save_model
from spinndrift.models.integrate import rollout
from spinndrift.models.thrusters import Thrusters
from spinndrift.models.vehicles.vehicle import load_vehicle

VEHICLE = load_vehicle("bluerov2_heavy")
BASE = VEHICLE.dynamics()
THRUSTERS = VEHICLE.thrusters()
RNG = np.random.default_rng(3)
N = 5


def states(seed=0, n=N):
    rng = np.random.default_rng(seed)
    X = se3.exp(jnp.asarray(0.5 * rng.normal(size=(6, n))))
    V = jnp.asarray(0.5 * rng.normal(size=(6, n)))
    u = jnp.asarray(8 * rng.normal(size=(8, n)))
    return X.at[6].add(-4), V, u


X, V, U = states()
UP = np.asarray(se3.rotate_inverse(X, jnp.broadcast_to(jnp.eye(3)[2][:, None], (3, N))))
PLAIN = Extended.create(BASE, (), THRUSTERS)
PLANT = PLAIN.plant


def cross(a, b):
    return np.cross(np.asarray(a), np.asarray(b), axis=0)


@pytest.fixture(scope="module")
def everything():
    return Library([kind.neutral(thrusters=8) for kind in KINDS.values()])


def test_all_effects_at_zero_change_nothing(everything):
    """The program that holds every effect equals the base to the last bits."""
    model = PLAIN.with_effects(everything.filled(jnp.zeros(everything.size)))

    @jax.jit
    def both(model, X, V, u):
        recent = Recent.steady(V, 0.05)
        state = model.infer(X, V, recent)
        a = advance(model, model.inertia(), model.remember(u), *state, u, 0.05, 2)
        b = advance(PLAIN, PLAIN.inertia(), (), X, V, u, 0.05, 2)
        recent = recent.after(Recent.over(state[1], a[2], a[3], 0.05))
        return model.observe(*a[1:3], recent), b[1:3]

    with_all, without = both(model, X, V, U)
    for a, b in zip(with_all, without, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-15)
    np.testing.assert_allclose(
        model.acceleration(X, V, PLAIN.allocate(U)), PLAIN.acceleration(X, V, PLAIN.allocate(U)),
        atol=1e-13,
    )  # fmt: skip


def test_prediction_is_of_fourth_order_and_agrees_with_the_integrator():
    """Halving the step divides the error by 16; small Lie-Euler steps come to the same motion."""
    inertia = PLAIN.inertia()

    def end(substeps):
        X1, V1 = X, V
        for _ in range(substeps):
            X1, V1 = once(X1, V1, 0.2 / substeps)
        return np.concatenate([X1, V1])

    @jax.jit
    def once(X, V, h):
        return advance(PLAIN, inertia, (), X, V, U, h)[1:3]

    fine = end(64)
    errors = [np.abs(end(s) - fine).max() for s in (4, 8)]
    assert 10 < errors[0] / errors[1] < 28
    F = PLAIN.allocate(U)
    steps = []
    for count in (400, 800):
        F_T = jnp.broadcast_to(F, (count, 6, N))
        steps.append(np.concatenate([a[-1] for a in rollout(BASE, X, V, F_T, 0.2 / count)]))
    np.testing.assert_allclose(2 * steps[1] - steps[0], fine, atol=2e-5)


def thrust(effect, voltage=None):
    relative = jnp.ones((1, N)) if voltage is None else voltage
    return np.asarray(effect.for_thrusters(8).thrust(U, V, relative, PLANT))


def test_static_thrust_effects():
    u = np.asarray(U)
    of = {name: KINDS[name].of for name in KINDS}
    lost = np.sign(u) * np.maximum(np.abs(u) - 1.2, 0)
    np.testing.assert_allclose(thrust(of["thruster_dead_zone"](width=1.2)), lost)
    curve = thrust(of["thrust_curve"](exponent=0.1, gain=-0.2))
    np.testing.assert_allclose(
        curve, 0.8 * REFERENCE * np.sign(u) * np.abs(u / REFERENCE) ** 1.1, rtol=1e-12
    )
    np.testing.assert_allclose(
        thrust(of["thrust_asymmetry"](reverse_gain=-0.2)), np.where(u < 0, 0.8 * u, u)
    )
    weak = thrust(of["thruster_gain"]("3", gain=-2.0))
    np.testing.assert_allclose(weak, u * np.where(np.arange(8) == 2, -1, 1)[:, None])
    np.testing.assert_allclose(thrust(of["thrust_scale"](scale=0.1)), 1.1 * u)
    sagged = thrust(of["voltage_sag"](exponent=1.5), jnp.full((1, N), 0.8))
    np.testing.assert_allclose(sagged, u * 0.8**1.5)
    load = np.sum(np.abs(u) ** 1.5, axis=0) / (8 * 40**1.5)
    np.testing.assert_allclose(thrust(of["load_droop"](loss=0.5)), u * (1 - 0.5 * load))
    lever = cross(PLANT.positions, PLANT.directions)
    along = np.asarray(PLANT.directions).T @ np.asarray(V[:3]) + lever.T @ np.asarray(V[3:])
    np.testing.assert_allclose(
        thrust(of["inflow_thrust_loss"](loss=0.3)), u - 0.3 * np.sqrt(np.abs(u)) * along
    )


def test_lag_and_delay_are_exact_over_held_commands():
    """Means over substeps of the exact responses to a staircase."""
    commands = jnp.asarray(np.random.default_rng(1).normal(size=(6, 8)))
    dt, tau, delay = 0.05, 0.08, 0.07
    lag = KINDS["thruster_lag"].of(time_constant=tau)
    late = KINDS["actuation_delay"].of(delay=delay)
    fine = 5000
    t = (np.arange(6 * fine) + 0.5) * dt / fine
    staircase = np.repeat(np.asarray(commands), fine, axis=0)
    shifted = np.asarray(commands)[np.clip(np.floor((t - delay) / dt), 0, None).astype(int)]
    follows = np.empty_like(staircase)
    f = np.asarray(commands[0])
    for i, u in enumerate(staircase):
        middle = u + (f - u) * np.exp(-dt / fine / tau / 2)
        f = u + (f - u) * np.exp(-dt / fine / tau)
        follows[i] = middle
    for effect, expected in ((lag, follows), (late, shifted)):
        memory = effect.initial(commands[0])
        for n in range(6):
            level = jnp.broadcast_to(commands[n][:, None], (8, 2))
            memory, means = effect.actuate(memory, level, jnp.asarray(dt))
            pieces = expected[n * fine : (n + 1) * fine].reshape(2, -1, 8).mean(axis=1)
            np.testing.assert_allclose(means.T, pieces, atol=2e-6)


@pytest.mark.parametrize("tau", [0.02, 0.08])
def test_thrust_that_builds_up_within_a_substep_keeps_the_order(tau):
    """Held at its mean it would act too late where yaw drag is stiff, and leave second order."""
    model = PLAIN.with_effects((KINDS["thruster_lag"].of(time_constant=tau),))
    inertia, before = model.inertia(), model.remember(U)
    turning = V.at[5].set(1.5)

    def end(substeps):
        return np.asarray(advance(model, inertia, before, X, turning, -U, 0.05, substeps)[2])

    fine = end(256)
    errors = [np.abs(end(substeps) - fine).max() for substeps in (4, 8)]
    assert 10 < errors[0] / errors[1] < 28


def wrench(name, where=None, **parameters):
    return np.asarray(KINDS[name].of(where, **parameters).wrench(X, V, PLANT))


def on(axis, values):
    full = np.zeros((6, N))
    full[axis] = values
    return full


def test_wrenches_of_body_and_environment():
    v = np.asarray(V)
    np.testing.assert_allclose(wrench("net_buoyancy", force=2.0)[:3], 2 * UP)
    at_Cb = wrench("net_buoyancy", "centre_of_buoyancy", force=2.0)
    np.testing.assert_allclose(at_Cb[:3], 2 * UP)
    lever = np.asarray(PLANT.p_BoCb_B)[:, None]
    assert lever[2] > 0
    np.testing.assert_allclose(at_Cb[3:], cross(lever, 2 * UP), atol=1e-12)
    shift = wrench("centre_of_gravity", "y", shift=0.01)
    lever = np.array([0, 0.01, 0])[:, None]
    np.testing.assert_allclose(shift[3:], cross(lever, -VEHICLE.weight * UP), atol=1e-12)
    load = wrench("payload", mass=0.0, weight=3.0, moment_x=0.6, moment_y=-0.3)
    np.testing.assert_allclose(load[:3], -3 * UP, atol=1e-12)
    lever = np.array([0.2, -0.1, 0])[:, None]
    np.testing.assert_allclose(load[3:], cross(lever, -3 * UP), atol=1e-12)
    np.testing.assert_allclose(wrench("linear_drag", "heave", change=3.0), on(2, -3 * v[2]))
    np.testing.assert_allclose(
        wrench("quadratic_drag", "yaw", change=3.0), on(5, -3 * np.abs(v[5]) * v[5])
    )
    np.testing.assert_allclose(
        wrench("drag_asymmetry", "surge", difference=2.0), on(0, -2 * v[0] ** 2)
    )
    np.testing.assert_allclose(wrench("cubic_drag", "sway", coefficient=2.0), on(1, -2 * v[1] ** 3))
    for place, i, j in COUPLINGS:
        expected = on(i, -(2 * np.abs(v[j]) + 0.5) * v[j])
        np.testing.assert_allclose(
            wrench("drag_coupling", place, quadratic=2.0, linear=0.5), expected
        )
    np.testing.assert_allclose(
        wrench("lift", "heave_from_surge", coefficient=4.0), on(2, 4 * v[0] ** 2)
    )
    munk = wrench("added_mass_coupling", "munk", change=0.5)
    momentum = np.diag([13.5 + a for a in VEHICLE.added_mass[:3]]) @ v[:3]
    np.testing.assert_allclose(munk[3:], 0.5 * cross(momentum, v[:3]), atol=1e-12)
    spring = wrench("tether", stiffness=2.0, pull_east=1.0, pull_north=-3.0)
    F_W = np.asarray(se3.rotate(X, jnp.asarray(spring[:3])))
    p = np.asarray(X[4:])
    np.testing.assert_allclose(F_W, [1 - 2 * p[0], -3 - 2 * p[1], -2 * p[2]], atol=1e-12)
    arm = jnp.asarray([-0.2, 0.1, 0.05])[:, None]
    aft = wrench("tether", stiffness=2.0, pull_up=1.0, arm_x=-0.2, arm_y=0.1, arm_z=0.05)
    ends = np.asarray(se3.act(X, jnp.broadcast_to(arm, (3, N))))
    F_B = np.asarray(se3.rotate_inverse(X, jnp.asarray([[0.0], [0], [1]] - 2 * ends)))
    np.testing.assert_allclose(aft, [*F_B, *cross(arm, F_B)], atol=1e-12)
    near = wrench("proximity", "surface", force=5.0, gain=0.0)
    np.testing.assert_allclose(near[:3], 5 * np.exp(p[2] / 0.5) * UP, atol=1e-12)
    wall = wrench("proximity", "wall_east", gain=2.0, length=0.6)
    drag = np.asarray(BASE.drag_wrench(V))
    np.testing.assert_allclose(wall, 2 * np.exp((p[0] - 10) / 0.6) * drag, atol=1e-12)


def test_loads_and_moved_centres_act_as_rigid_bodies_do():
    """The mass matrix about Bo of point masses, (Fossen 2011, eq. 3.44), against their sum."""
    r, m = np.array([0.1, -0.05, -0.12]), 0.4
    weight = 2.0
    load = KINDS["payload"].of(
        mass=m, weight=weight, moment_x=weight * r[0], moment_y=weight * r[1], height=r[2]
    )
    v, w = np.asarray(V[:3]), np.asarray(V[3:])
    momentum = m * (v + cross(w, r[:, None]))
    np.testing.assert_allclose(
        np.asarray(load.inertia(PLANT)) @ np.asarray(V),
        np.concatenate([momentum, cross(r[:, None], momentum)]),
        atol=5e-4 * m,  # a load without weight has no place: x, y to w² / (w² + 0.05²)
    )
    np.testing.assert_allclose(
        np.asarray(load.wrench(X, V, PLANT))[3:], cross(r[:, None], -weight * UP), atol=1e-12
    )
    moved = KINDS["centre_of_gravity"].of("z", shift=-0.004)
    first = VEHICLE.mass * np.array([0, 0, -0.004])[:, None]
    np.testing.assert_allclose(
        np.asarray(moved.inertia(PLANT)) @ np.asarray(V),
        np.concatenate([cross(w, first), cross(first, v)]),
        atol=1e-12,
    )


def test_added_mass_acts_as_a_heavier_base():
    """An extended model and a base built with the larger mass accelerate alike."""
    from dataclasses import replace

    added = list(VEHICLE.added_mass)
    added[1] += 4.0
    heavier = replace(VEHICLE, added_mass=tuple(added)).dynamics()
    model = PLAIN.with_effects((KINDS["added_mass"].of("sway", change=4.0),))
    F = PLAIN.allocate(U)
    np.testing.assert_allclose(
        model.acceleration(X, V, F), heavier.acceleration(X, V, F), atol=1e-12
    )
    drift = model.drift(model.inertia(), X, V, U)
    np.testing.assert_allclose(drift, heavier.acceleration(X, V, F), atol=1e-12)


def test_a_steady_current_carries_the_vehicle_like_the_base_in_moving_water():
    from spinndrift.models.dynamics import Flow

    model = PLAIN.with_effects((KINDS["current_steady"].of(east=0.3, north=-0.2),))
    flow = Flow(jnp.asarray([0.3, -0.2, 0.0])[:, None], jnp.zeros((3, 1)))
    F = PLAIN.allocate(U)
    expected = BASE.acceleration(X, V, F, flow)
    np.testing.assert_allclose(model.drift(model.inertia(), X, V, U), expected, atol=1e-11)
    np.testing.assert_allclose(model.acceleration(X, V, F), expected, atol=1e-11)


@pytest.mark.parametrize(
    ("name", "where", "values"),
    [
        ("dvl_lever_arm", "y", {"offset": 0.2}),
        ("dvl_misalignment", "yaw", {"angle": 0.1}),
        ("dvl_scale", None, {"scale": 0.05}),
        ("gyro_bias", "z", {"bias": 0.02}),
        ("heading_error", None, {"sine": 0.02, "cosine": -0.01, "offset": 0.2}),
        ("clock_offset", "twist", {"delay": 0.02}),
        ("clock_offset", "pose", {"delay": -0.02}),
        ("clock_offset", "linear", {"delay": 0.03}),
        ("clock_offset", "angular", {"delay": -0.01}),
    ],
)
def test_measurement_effects_invert(name, where, values):
    effect = KINDS[name].of(where, **values)
    recent = Recent.steady(0.3 * V[::-1], 0.05)
    X1, V1 = effect.measure(X, V, recent)
    assert np.abs(np.asarray(X1 - X)).max() + np.abs(np.asarray(V1 - V)).max() > 1e-4
    X2, V2 = effect.unmeasure(X1, V1, recent)
    np.testing.assert_allclose(X2, X, atol=1e-5)
    np.testing.assert_allclose(V2, V, atol=1e-12)


def test_measurements_by_hand():
    none = Recent.steady(jnp.zeros_like(V), 0.05)
    _, far = KINDS["dvl_lever_arm"].of("x", offset=0.3).measure(X, V, none)
    arm = np.array([0.3, 0, 0])[:, None]
    np.testing.assert_allclose(far[:3], np.asarray(V[:3]) + cross(V[3:], arm))
    _, turned = KINDS["dvl_misalignment"].of("yaw", angle=0.3).measure(X, V, none)
    np.testing.assert_allclose(turned[0], np.cos(0.3) * V[0] + np.sin(0.3) * V[1])

    off, _ = KINDS["heading_error"].of(sine=0.1).measure(X, V, none)
    np.testing.assert_allclose(se3.yaw(off), se3.yaw(X) + 0.1 * np.sin(se3.yaw(X)), atol=1e-12)


@pytest.mark.parametrize("late", [0.03, 0.08, 0.23, -0.02])
def test_late_instruments_show_what_was(late):
    """Against a twist known at all times, sines of 1 to 3 rad/s, in steps of unequal length."""
    rate = jnp.asarray([1.0, 1.4, 1.8, 2.2, 2.6, 3.0])[:, None]

    def twist(t, order=0):
        return 0.4 * rate**order * jnp.sin(rate * t + order * jnp.pi / 2)

    step, now = jnp.asarray([0.05, 0.07, 0.04, 0.1, 0.06]), 1.0
    ends = now - np.concatenate([[0.0], np.cumsum(step)])
    recent = Recent.steady(twist(ends[-1], 1), 0.05)
    for start, end, h in zip(ends[:0:-1], ends[-2::-1], step[::-1], strict=True):
        rates = jnp.concatenate([twist(end, 1), twist(end, 2)])
        recent = recent.after(Recent.over(twist(start), twist(end), rates, float(h)))
    X0, V0 = X[:, :1], twist(now)
    _, V1 = KINDS["clock_offset"].of("linear", delay=late).measure(X0, V0, recent)
    np.testing.assert_allclose(V1, [*twist(now - late)[:3], *V0[3:]], atol=3e-5)
    X1, _ = KINDS["clock_offset"].of("pose", delay=late).measure(X0, V0, recent)
    fine, past = 400, X0
    for k in range(fine):
        past = se3.retract(past, -late / fine * twist(now - (k + 0.5) * late / fine))
    # the second term of Magnus is δ³ [V, V'] / 12
    np.testing.assert_allclose(X1, past, atol=1e-6 + abs(late) ** 3 / 12)


def test_an_instrument_later_than_what_is_remembered_is_extrapolated():
    A = jnp.asarray([0.1, -0.2, 0.3, 0.4, -0.5, 0.6])[:, None]
    recent = Recent.steady(A, 0.05)
    change, way = recent.back(jnp.asarray([[0.9]]))
    np.testing.assert_allclose(change, -0.9 * A, atol=1e-14)
    np.testing.assert_allclose(way, -(0.9**2) / 2 * A, atol=1e-14)


def test_noise_laws_have_their_moments():
    n = 20000
    w = jnp.asarray(np.random.default_rng(5).normal(size=(12, n)))
    colour = KINDS["disturbance_colour"].of("heave", std=2.0, time_constant=1.0)
    a = colour.advance(jnp.zeros((6, n)), w[:6], jnp.asarray(50.0))
    b = colour.advance(a, w[6:], jnp.asarray(0.5))
    assert np.std(a[2]) == pytest.approx(2.0, rel=0.02)
    assert np.mean(a[2] * b[2]) == pytest.approx(4 * np.exp(-0.5), rel=0.05)
    assert np.abs(np.delete(np.asarray(a), 2, axis=0)).max() == 0
    blows = KINDS["disturbance_impacts"].of("surge", impulse=0.5, rate=2.0)
    F = blows.advance(jnp.zeros((6, n)), w, jnp.asarray(0.05))
    assert np.mean(F[0] != 0) == pytest.approx(0.1, rel=0.1)
    assert np.std(0.05 * F[0][F[0] != 0]) == pytest.approx(0.5, rel=0.05)
    grows = KINDS["disturbance_state_dependence"].of("yaw", growth=3.0)
    b = grows.diffusion(V, jnp.ones((6, 1)))
    np.testing.assert_allclose(b[5], np.sqrt(1 + 3 * np.sum(np.asarray(V[:3]) ** 2, axis=0)))


def test_columns_of_values_are_hypotheses():
    """A batch of values gives what each gives alone: one program serves all hypotheses."""
    names = ("quadratic_drag", "added_mass", "thruster_dead_zone")
    everything = Library([KINDS[name].neutral() for name in names])
    theta = np.zeros((everything.size, 3, 1))
    theta[everything.index("quadratic_drag", "surge", "change"), 1] = 30
    theta[everything.index("added_mass", "yaw", "change"), 2] = 0.3
    model = PLAIN.with_effects(everything.filled(jnp.asarray(theta)))
    together = model.drift(model.inertia(), X[:, None], V[:, None], U[:, None])
    for column in range(3):
        alone = PLAIN.with_effects(everything.used(theta[:, column, 0]))
        np.testing.assert_allclose(
            together[:, column], alone.drift(alone.inertia(), X, V, U), atol=1e-10
        )


@pytest.mark.parametrize("count", [(), (64,)])
def test_effects_keep_their_values_whatever_becomes_of_the_vector(everything, count):
    theta = np.random.default_rng(0).normal(size=(everything.size, *count))
    before = theta.copy()
    effects = everything.filled(theta)
    theta[:] = np.nan
    np.testing.assert_array_equal(np.concatenate([e.values for e in effects]), before)
    traced = jax.jit(everything.filled)(before)
    for one, other in zip(effects, traced, strict=True):
        np.testing.assert_array_equal(one.values, other.values)


def test_an_extended_model_is_stored_and_rolls_out(tmp_path):
    effects = (
        KINDS["thruster_lag"].of(time_constant=0.1),
        KINDS["disturbance_colour"].of("yaw", std=0.2, time_constant=2.0),
        KINDS["net_buoyancy"].of(force=1.0),
    )
    model = Extended.create(VEHICLE.dynamics(np.ones(6)), effects, THRUSTERS)
    save_model(tmp_path / "model.spinn", model, {"vehicle": "bluerov2_heavy"})
    again, _ = load_model(tmp_path / "model.spinn")
    assert isinstance(again, Extended)
    w = jnp.asarray(np.random.default_rng(2).normal(size=(20, model.noise_size, N)))
    U_T = jnp.broadcast_to(U[None], (20, 8, N))
    first, second = (m.rollout(X, V, U_T, 0.05, w) for m in (model, again))
    np.testing.assert_array_equal(first[0], second[0])
    quiet = model.rollout(X, V, U_T, 0.05)
    assert np.abs(np.asarray(quiet[1] - first[1])).max() > 1e-3
    assert np.isfinite(np.asarray(first[0])).all()


def test_effects_by_hand_refuse_what_they_do_not_know():
    with pytest.raises(UserError, match="take one of surge"):
        KINDS["linear_drag"].of("up", change=1.0)
    with pytest.raises(UserError, match="say where"):
        KINDS["linear_drag"].of(change=1.0)
    with pytest.raises(UserError, match="give 0 to"):
        KINDS["thruster_lag"].of(time_constant=-1.0)
    with pytest.raises(UserError, match="has no 'lag'"):
        KINDS["thruster_lag"].of(lag=1.0)
    with pytest.raises(UserError, match="say where: the number of a thruster"):
        KINDS["thruster_gain"].of(gain=-0.5)
    with pytest.raises(UserError, match="take all, or the number of a thruster"):
        KINDS["thruster_lag"].of("0", time_constant=0.1)
    with pytest.raises(UserError, match=r"thruster_gain\.where is 9: the vehicle has 8 thrusters"):
        PLAIN.with_effects((KINDS["thruster_gain"].of("9", gain=-0.5),))


@pytest.mark.parametrize("count", [1, 5, 6])
def test_effects_take_the_number_of_thrusters_from_the_vehicle(tmp_path, count):
    """Every effect on thrusters is that of the same thrusters of a larger vehicle."""
    few = Thrusters(
        np.asarray(THRUSTERS.positions)[:, -count:],
        np.asarray(THRUSTERS.directions)[:, -count:],
        THRUSTERS.curve,
    )
    effects = (
        KINDS["thruster_lag"].of(time_constant=0.1),
        KINDS["actuation_delay"].of("1", delay=0.03),
        KINDS["thruster_gain"].of(str(count), gain=-0.5),
        KINDS["load_droop"].of(loss=0.5),
    )
    save_model(tmp_path / "m.spinn", Extended.create(BASE, effects, few))
    model = load_model(tmp_path / "m.spinn", float)[0]
    assert isinstance(model, Extended)
    assert [e.places[-1] for e in model.effects] == [str(count)] * 3 + ["all"]
    memory = model.remember(jnp.zeros((count, 1)))
    _, level = model.actuate(memory, jnp.full((count, 1), 40.0), 0.05, 1)
    arrived = np.where(np.arange(count) == 0, 0.4 * 40, 40)  # the first one's share of the step
    wanted = arrived * (1 - 0.1 / 0.05 * (1 - np.exp(-0.5)))
    np.testing.assert_allclose(level[:, 0, 0], wanted, rtol=1e-5)
    force = model.thrust(jnp.full((count, 1), 40.0), jnp.zeros((6, 1)))
    full = np.where(np.arange(count) == count - 1, 20.0, 40.0)
    droop = 0.5 * np.mean((full / 40) ** 1.5)
    np.testing.assert_allclose(force[:, 0], full * (1 - droop), rtol=1e-6)


def test_further_fields_are_stored(tmp_path):
    near = KINDS["proximity"].of("bottom", force=3.0, options={"floor": -4.5})
    assert near.assumed("bottom") == {"boundary": (-4.5, "m")}
    assert near.assumed("surface") == {"boundary": (0.0, "m")}
    assert near.assumed("wall_east") == {"boundary": (10.0, "m")}
    late = KINDS["actuation_delay"].of(delay=0.3, options={"steps": 30})
    model = Extended.create(BASE, (near, late), THRUSTERS)
    save_model(tmp_path / "model.spinn", model)
    again, _ = load_model(tmp_path / "model.spinn")
    assert isinstance(again, Extended)
    np.testing.assert_array_equal(
        again.extra_wrench(X, V), model.extra_wrench(X, V)
    )  # the bottom lies where it was
    assert again.remember(U)[0].shape == ((8 + 1) * 30, N)


@pytest.mark.parametrize("of", [1, 3])
def test_a_memory_without_a_name_is_its_convolution(of):
    """z(t) = ∫ e^((-1/T + 2πif) s) v(t - s) ds against a fine sum; the wrench weighs it."""
    T, f, dt, steps, fine = 1.4, 0.3, 0.05, 80, 200
    numbers = (T, f) if of == 1 else (T, f, float(of))
    effect = Unknown.neutral(kind="memory", acts_on="sway", numbers=numbers)
    assert effect.terms[1] == f"Re z({'uvwpqr'[of]})"
    effect = dataclasses.replace(effect, values=jnp.array([0.5, 2.0, -1.0]))
    v = np.random.default_rng(0).standard_normal(steps)
    memory, push = jnp.zeros((2, 1)), jnp.zeros((6, 1))
    for x in v:
        memory, push = effect.feel(memory, jnp.zeros((6, 1)).at[of].set(x), dt)
    t = (np.arange(steps * fine) + 0.5) * dt / fine
    kernel = np.exp((-1 / T + 2j * np.pi * f) * (steps * dt - t))
    z = np.sum(kernel * np.repeat(v, fine)) * dt / fine
    np.testing.assert_allclose(np.asarray(memory)[:, 0], [z.real, z.imag], rtol=1e-4)
    assert float(push[1, 0]) != 0
    assert float(jnp.abs(push).sum() - jnp.abs(push[1]).sum()) == 0


@pytest.mark.parametrize(
    ("kind", "acts_on", "numbers"),
    [
        ("motion", "yaw", (5.0, 13.0)),
        ("flow", "W", (0.5, 0.0, 0.0, 1.0, -1.0)),
        ("thruster", "3", (0.0,)),
        ("depth", "W", (-3.0, 0.5)),
        ("pose", "heave", (0.0,)),
        ("damping", "heave", (-3.0, 0.5)),
        ("exchange", "thrusters", (2.0, 5.0)),
    ],
)
def test_what_has_no_name_is_stored_and_moves_the_vehicle(tmp_path, kind, acts_on, numbers):
    effect = Unknown.neutral(kind=kind, acts_on=acts_on, numbers=numbers)
    model = PLAIN.with_effects((dataclasses.replace(effect, values=0.1 + effect.values),))
    save_model(tmp_path / "m.spinn", model)
    again = load_model(tmp_path / "m.spinn")[0]
    assert isinstance(again, Extended)

    def drift(model):
        return np.asarray(model.drift(model.inertia(), X, V, U))

    np.testing.assert_array_equal(drift(model), drift(again))
    plain = drift(PLAIN)
    np.testing.assert_allclose(drift(PLAIN.with_effects((effect,))), plain, atol=1e-12)
    assert np.abs(drift(model) - plain).max() > 1e-4


def test_waves_turn_the_water_as_those_that_run_towards_their_direction():
    """Airy: u = aω cos(ωt) along it and w = -aω sin(ωt) up, fading with depth; std aω / √2."""
    a, omega, way = 0.2, 1.7, 0.6
    waves = KINDS["waves"].of("W", amplitude=a, frequency=omega, direction=way)
    crest = jnp.array([a * omega, 0.0])
    X = jnp.asarray(se3.identity(jnp.float64))
    t = 0.02
    moved = waves.advance(crest, jnp.zeros(2), jnp.asarray(t))
    u, v, w = np.asarray(waves.drift_of_water(moved, X)) / np.exp(-omega * t / 24)
    np.testing.assert_allclose(u * np.cos(way) + v * np.sin(way), a * omega * np.cos(omega * t))
    np.testing.assert_allclose(u * np.sin(way), v * np.cos(way), atol=1e-15)
    np.testing.assert_allclose(w, -a * omega * np.sin(omega * t))
    deep = np.asarray(waves.drift_of_water(moved, X.at[6].set(-3.0)))
    at_surface = np.asarray(waves.drift_of_water(moved, X))
    np.testing.assert_allclose(deep / at_surface, np.exp(-3 * omega**2 / 9.80665), rtol=1e-12)
    # long after they are one deviation for a draw of one
    drawn = np.asarray(waves.advance(crest, jnp.ones(2), jnp.asarray(1e9)))
    np.testing.assert_allclose(drawn, a * omega / np.sqrt(2), rtol=1e-12)


def test_play_encloses_its_area_at_any_speed_and_refinement():
    """Of amplitude A and play δ the loop is a parallelogram of area 4 δ (A - δ)."""
    A, play, steps = 5.0, 1.5, 4001
    command = A * jnp.sin(jnp.linspace(0.0, 6 * np.pi, 3 * steps - 2))

    def followed(u):
        return jax.lax.scan(lambda f, x: taken_up(f, x, 0.1, play), jnp.zeros(1), u[:, None])[1]

    out = np.asarray(followed(command))[:, 0]
    assert np.abs(out - command).max() <= play + 1e-12
    area = abs(np.trapezoid(out[-steps:], np.asarray(command[-steps:])))
    np.testing.assert_allclose(area, 4 * play * (A - play), rtol=1e-5)
    # what is left out between two samples of a monotone piece changes nothing
    turns = np.flatnonzero(np.diff(np.diff(np.asarray(command)) > 0)) + 1
    kept = np.unique([0, *turns, *range(0, len(command), 37)])
    np.testing.assert_array_equal(np.asarray(followed(command[kept]))[:, 0], out[kept])


def test_a_drive_of_limited_rate_follows_as_its_differential_equation():
    """ḟ = R sign(u - f) until f = u, by fine steps; means over steps are exact."""
    rate, h, fine = 25.0, 0.05, 2000
    commands = np.random.default_rng(0).normal(0, 5, (40, 3))
    f, seen = np.zeros(3), []
    for u in commands:
        path = []
        for _ in range(fine):
            after = f + np.clip(u - f, -rate * h / fine, rate * h / fine)
            path.append((f + after) / 2)
            f = after
        seen.append((f, np.mean(path, axis=0)))
    now = jnp.zeros(3)
    for u, (end, mean) in zip(commands, seen, strict=True):
        now, over = ramped(now, jnp.asarray(u), h, rate)
        np.testing.assert_allclose(now, end, atol=1e-9)
        np.testing.assert_allclose(over, mean, atol=1e-5)


@pytest.mark.parametrize("kind", FOLLOWERS)
def test_what_follows_stays_where_its_command_stays(kind):
    u = jnp.array([-4.0, 0.0, 8.0])  # multiples of the step
    for part in FOLLOWERS[kind](u, u, 0.1, 2.0):
        np.testing.assert_array_equal(part, u)


def test_drives_with_few_speeds_do_the_nearest_one():
    end, mean = FOLLOWERS["steps"](jnp.zeros(4), jnp.array([-3.2, 0.9, 1.1, 7.1]), 0.1, 2.0)
    np.testing.assert_array_equal(end, [-4.0, 0.0, 2.0, 8.0])
    np.testing.assert_array_equal(mean, end)


def test_two_exchanged_thrusters_do_what_the_other_is_told():
    force = jnp.arange(8.0)[:, None]
    rest = se3.identity(jnp.float64)[:, None], jnp.zeros((6, 1))
    plain = PLAIN.push(force, *rest)
    swapped = force[np.array([0, 4, 2, 3, 1, 5, 6, 7])]
    effect = Unknown.neutral(kind="exchange", acts_on="thrusters", numbers=(2.0, 5.0))
    for share, wanted in ((0.0, plain), (1.0, PLAIN.push(swapped, *rest))):
        model = PLAIN.with_effects((dataclasses.replace(effect, values=share + effect.values),))
        np.testing.assert_allclose(model.push(force, *rest), wanted, atol=1e-12)


@pytest.mark.parametrize("where", ["thrusters", "3"])
@pytest.mark.parametrize(
    ("kind", "number", "means"),
    # means over the second half of steps of 0.05 s
    [("play", 1.5, (0.5, -2.5, -1.5)), ("slew", 20.0, (0.75, 0.25, 0.0))],
)
def test_followers_act_on_the_thrusters_that_are_such(tmp_path, where, kind, number, means):
    effect = Unknown.neutral(kind=kind, acts_on=where, numbers=(number,))
    model = PLAIN.with_effects((dataclasses.replace(effect, values=1 + effect.values),))
    save_model(tmp_path / "m.spinn", model)
    model = load_model(tmp_path / "m.spinn")[0]
    assert isinstance(model, Extended)
    wanted = np.array([[2.0], [-4.0]])
    memory, forces = model.simulation_state(jnp.zeros((8, 1)))[0], []
    for u in (*wanted, np.zeros(1)):
        memory, level = model.actuate(memory, jnp.broadcast_to(jnp.asarray(u), (8, 1)), 0.05, 2)
        forces.append(np.asarray(level)[:, 0, -1])
    concerned = np.isin(np.arange(1, 9), range(1, 9) if where == "thrusters" else [int(where)])
    for force, follows, prompt in zip(forces, means, (2.0, -4.0, 0.0), strict=True):
        np.testing.assert_allclose(force, np.where(concerned, follows, prompt), atol=1e-12)


def test_a_late_twist_that_differs_from_the_prediction_keeps_what_drag_leaves():
    """Of V' = S (V - V∞): the twist of now from one that is seen late, after a push."""
    S = np.diag([-1.0, -2.0, -3.0, -6.0, -8.0, -9.0])
    S[3, 1], S[4, 2] = 1.5, -2.0
    late, push = 0.04, np.array([0.02, -0.01, 0.03, 0.1, -0.2, 0.1])
    V0, limit = np.linspace(-1, 1, 6), np.linspace(0.5, -0.5, 6)

    def after(V, t):
        return limit + scipy.linalg.expm(S * t) @ (V - limit)

    h = 0.05
    V1 = after(V0, h)
    rate = S @ (V1 - limit)
    rates = jnp.asarray(np.concatenate([rate, S @ rate])[:, None])
    slope = jnp.asarray(S[:, :, None])
    recent = Recent.over(jnp.asarray(V0[:, None]), jnp.asarray(V1[:, None]), rates, h)
    pushed = after(V0, h - late) + push  # seen, δ before now
    seen, now = jnp.asarray(pushed[:, None]), after(pushed, late)
    late = jnp.full((6, 1), late)
    kept = recent.keeping(jnp.asarray(V1[:, None]), slope).now(seen, late)[:, 0]
    without = recent.now(seen, late)[:, 0]
    # a cubic over the step leaves |S|⁴ δ³ (h - δ) / 4! of what decays fastest, 1.5 m/s or less
    np.testing.assert_allclose(kept, now, atol=1.5 * 9**4 * 0.04**3 * 0.01 / 24)
    assert np.abs(without - now).max() > 0.03


def test_no_effect_has_the_class_name_of_a_disturbance():
    """Where both model one thing, the effect's class ends in `Effect`."""
    own = {cls.__name__ for cls in (*KINDS.values(), *COEFFICIENTS.values())}
    assert not own & set(vars(disturbances))


def test_the_page_of_effects_is_that_of_their_classes():
    page = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
    assert page == effects_page(), "write docs/effects.md anew from effects_page()"
    assert all(f"| `{name}` |" in page for name in KINDS)


def test_effects_that_are_constants_of_a_fossen_model_move_it_alike_in_its_constants():
    vehicle = load_vehicle("bluerov2_heavy")
    rng = np.random.default_rng(0)
    kinds = [
        c for c in (KINDS | COEFFICIENTS).values() if c.in_constants is not Effect.in_constants
    ]
    assert {c.name for c in kinds} >= {"added_mass", "linear_drag", "quadratic_drag"}
    effects = []
    for cls in [*kinds, ThrustCurve]:
        effect = cls.neutral(thrusters=8)
        sizes = np.resize([p.probes[0] for p in cls.parameters], effect.values.shape)
        values = jnp.asarray(abs(sizes) * rng.uniform(0.5, 2, sizes.shape))
        effects.append(dataclasses.replace(effect, values=values))
    model = Extended.create(vehicle.dynamics(), tuple(effects), vehicle.thrusters())
    other = model.with_constants_in_base()
    assert [e.name for e in other.effects] == ["thrust_curve"]
    X = se3.exp(jnp.asarray(rng.normal(0, 0.5, 6)))
    V, level = jnp.asarray(rng.normal(0, 0.5, 6)), jnp.asarray(rng.normal(0, 10, 8))
    own, found = (m.drift(m.inertia(), X, V, level, jnp.ones(1)) for m in (model, other))
    np.testing.assert_allclose(found, own, rtol=1e-9)
