"""Geometry has ArduSub's signs, allocation is the best there is, lag is exact."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from spinndrift.models.se3 import AXES
from spinndrift.models.thruster_curves import QuadraticCurve, T200Curve
from spinndrift.models.thrusters import Thrusters
from spinndrift.models.vehicles.vehicle import load_vehicle, vehicle_names

# ArduPilot, AP_Motors6DOF.cpp: roll, pitch, yaw, throttle, forward, lateral
FACTORS = np.array(
    [
        [0, 0, 1, 0, -1, 1],
        [0, 0, -1, 0, -1, -1],
        [0, 0, -1, 0, 1, 1],
        [0, 0, 1, 0, 1, -1],
        [1, -1, 0, -1, 0, 0],
        [-1, -1, 0, -1, 0, 0],
        [1, 1, 0, -1, 0, 0],
        [-1, 1, 0, -1, 0, 0],
    ]
)
VECTORED = np.concatenate([FACTORS[:4], [[1, 0, 0, -1, 0, 0], [-1, 0, 0, -1, 0, 0]]])
FLU_TO_FRD = np.array([1, -1, -1, 1, -1, -1])[:, None]
S = np.sqrt(0.5)
# Heavy with von Benzon's positions, forward-starboard-down, rows Fx Fy Fz Mx My Mz
HEAVY_FRD = np.array(
    [
        [-S, -S, S, S, 0, 0, 0, 0],
        [S, -S, S, -S, 0, 0, 0, 0],
        [0, 0, 0, 0, 1, 1, 1, 1],
        [-0.0601, 0.0601, -0.0601, 0.0601, 0.218, -0.218, 0.218, -0.218],
        [-0.0601, -0.0601, 0.0601, 0.0601, -0.12, -0.12, 0.12, 0.12],
        [0.1888, -0.1888, -0.1888, 0.1888, 0, 0, 0, 0],
    ]
)


@pytest.fixture(scope="module")
def heavy():
    return load_vehicle("bluerov2_heavy").thrusters()


@pytest.fixture(scope="module")
def allocate():
    return eqx.filter_jit(lambda thrusters, F, scale: thrusters.allocate(F, scale=scale))


def wrenches(count, size=1.0, seed=0):
    scales = np.array([60, 60, 80, 10, 10, 15.0])[:, None] * size
    return jnp.asarray(np.random.default_rng(seed).normal(size=(6, count)) * scales)


# ---------------------------------------------------------------------------------------- geometry


@pytest.mark.parametrize("name", vehicle_names())
def test_every_row_has_the_signs_of_ardusubs_mixer(name):
    thrusters = load_vehicle(name).thrusters()
    # per positive PWM, forward-starboard-down: forward, lateral, down, roll, pitch, yaw
    signs = np.sign(np.round(np.asarray(thrusters.allocation) * FLU_TO_FRD, 9))
    count = len(thrusters.motor_directions)
    roll, pitch, yaw, throttle, forward, lateral = {8: FACTORS, 6: VECTORED}[count].T
    mixer = np.array([forward, lateral, -throttle, roll, pitch, yaw])
    own = mixer != 0
    np.testing.assert_array_equal(signs[own], mixer[own])
    np.testing.assert_array_equal(signs[:3][~own[:3]], 0)  # no thruster pushes where it shouldn't
    np.testing.assert_array_equal(signs[5], yaw)
    assert np.linalg.matrix_rank(thrusters.allocation) == {8: 6, 6: 5}[count]
    assert thrusters.unactuated == {8: (), 6: ("pitch",)}[count]


def test_allocation_of_the_heavy(heavy):
    np.testing.assert_allclose(np.asarray(heavy.allocation) * FLU_TO_FRD, HEAVY_FRD, atol=6e-5)
    assert np.linalg.cond(heavy.allocation) == pytest.approx(8.4, abs=0.05)


def test_wrench_is_the_sum_of_forces_and_moments(heavy):
    forces = jnp.asarray(np.random.default_rng(1).normal(size=(8, 3)))
    F = np.zeros((6, 3))
    for i in range(8):
        push = np.asarray(heavy.directions)[:, i, None] * np.asarray(forces)[i]
        F[:3] += push
        F[3:] += np.cross(np.asarray(heavy.positions)[:, i, None], push, axis=0)
    np.testing.assert_allclose(heavy.wrench(forces), F, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"motor_directions": np.zeros(8)}, "1 or -1"),
        ({"effort": np.zeros(8)}, "effort"),
        ({"time_constant": -1.0}, "time_constant"),
        ({"resistance": -1.0}, "battery"),
        ({"directions": np.zeros((3, 8))}, "no wrench"),
    ],
)
def test_impossible_thrusters_are_refused(heavy, change, message):
    given = {"positions": np.asarray(heavy.positions), "directions": np.asarray(heavy.directions)}
    with pytest.raises(ValueError, match=message):
        Thrusters(**(given | change), curve=heavy.curve)


# ------------------------------------------------------------------------------------ PWM and force


def test_motor_direction_mirrors_pwm_and_turns_the_propeller_backwards(heavy):
    signs = np.array([1, -1, 1, -1, 1, -1, 1, -1.0])
    mirrored = Thrusters(
        np.asarray(heavy.positions),
        np.asarray(heavy.directions),
        heavy.curve,
        motor_directions=signs,
    )
    pwm = jnp.linspace(1100, 1900, 8)
    other = jnp.where(jnp.asarray(signs) > 0, pwm, 3000 - pwm)
    np.testing.assert_allclose(mirrored.force(other), heavy.force(pwm), atol=1e-12)
    np.testing.assert_allclose(
        mirrored.pwm(heavy.force(pwm)), jnp.where(heavy.force(pwm) != 0, other, 1500)
    )
    full = mirrored.force(jnp.full(8, 1900.0))
    assert float(full[0]) == pytest.approx(5.25 * 9.80665)
    assert float(full[1]) == pytest.approx(-4.07 * 9.80665)


def test_voltage_is_a_number_or_one_a_sample(heavy):
    pwm = jnp.asarray(np.random.default_rng(2).uniform(1100, 1900, (8, 3)))
    volts = jnp.array([12.0, 14.0, 16.0])
    force = heavy.force(pwm, volts)
    low, high = heavy.force_limits(volts)
    for k in range(3):
        np.testing.assert_allclose(force[:, k], heavy.force(pwm[:, k], float(volts[k])))
        np.testing.assert_allclose(high[:, k], heavy.force_limits(float(volts[k]))[1])
    assert jnp.all((low <= force) & (force <= high))
    np.testing.assert_array_equal(heavy.force(pwm), heavy.force(pwm, 16.0))


def test_single_precision_stays_single():
    thrusters = load_vehicle("bluerov2_heavy").thrusters(jnp.float32)

    @jax.jit
    def everything(F):
        forces = thrusters.allocate(F, voltage=15.0)
        pwm = thrusters.pwm(forces, 15.0)
        late = thrusters.lag_from_rest(0 * forces, 0 * forces, forces, 0.02)
        volts = thrusters.loaded_voltage(pwm)
        return forces, pwm, late, volts, thrusters.force(pwm, volts), thrusters.wrench(forces)

    for array in jax.tree.leaves(everything(wrenches(4).astype(jnp.float32))):
        assert array.dtype == jnp.float32


# --------------------------------------------------------------------------------------- allocation


@pytest.mark.parametrize("name", ["bluerov2_heavy", "bluerov2_heavy_ignition", "ardusub_sitl"])
@pytest.mark.parametrize("scale", ["common", "groups"])
def test_wrench_is_met_by_the_least_forces_when_limits_allow(name, scale, allocate):
    thrusters = load_vehicle(name).thrusters()
    F = wrenches(50, 0.2)
    forces = allocate(thrusters, F, scale)
    np.testing.assert_allclose(thrusters.wrench(forces), F, atol=1e-9)
    np.testing.assert_allclose(forces, np.linalg.pinv(thrusters.allocation) @ F, atol=1e-9)


@pytest.mark.parametrize("name", ["bluerov2_heavy", "bluerov2_heavy_ignition", "ardusub_sitl"])
def five(heavy):
    """Two thrusters forward, three vertical: nothing pushes sideways."""
    positions = [[0, 0.1, 0], [0, -0.1, 0], [0.2, 0.1, 0], [0.2, -0.1, 0], [-0.2, 0, 0]]
    directions = [[1, 0, 0]] * 2 + [[0, 0, 1]] * 3
    return Thrusters(np.array(positions, float).T, np.array(directions, float).T, heavy.curve)


def low(heavy):
    """The standard BlueROV2 with its horizontals below Bo: surge pitches, sway rolls."""
    base = load_vehicle("bluerov2").thrusters()
    shift = np.array([0, 0, -0.085])[:, None] * (np.arange(6) < 4)
    return Thrusters(np.asarray(base.positions) + shift, np.asarray(base.directions), heavy.curve)


def lateral(heavy):
    """One thruster athwart at the bow: sway and yaw go together, heave alone is free of them."""
    positions, directions = np.array([[0.3, 0, 0], [0, 0, 0]]), np.array([[0, 1, 0], [0, 0, 1]])
    return Thrusters(positions.T.astype(float), directions.T.astype(float), heavy.curve)


@pytest.mark.parametrize(
    ("make", "axes"),
    [
        (five, ("sway",)),
        (low, ("pitch",)),
        (lateral, ("surge", "roll", "pitch", "yaw")),
    ],
)
@pytest.mark.parametrize("scale", ["common", "groups"])
def test_an_axis_that_is_not_actuated_is_named_and_the_others_are_met(heavy, make, axes, scale):
    """The limit of weighted least squares with less and less weight on the named axes."""
    thrusters = make(heavy)
    assert thrusters.unactuated == axes
    weight = np.where(np.isin(AXES, axes), 1e-6, 1.0)[:, None]
    B, F = np.asarray(thrusters.allocation), wrenches(20, 0.05, seed=7)
    forces = thrusters.allocate(F, scale=scale)
    np.testing.assert_allclose(forces, np.linalg.pinv(weight * B) @ (weight * F), atol=1e-6)
    met = ~np.isin(AXES, axes)
    np.testing.assert_allclose(thrusters.wrench(forces)[met], F[met], atol=1e-9)
    # beyond the limits: within them, and as much as they give
    far = thrusters.allocate(1e4 * F, scale=scale)
    least, most = (np.asarray(limit)[:, None] for limit in thrusters.force_limits())
    assert np.all((far > least - 1e-9) & (far < most + 1e-9))
    room = np.minimum(far - least, most - far)
    assert np.all(room.min(axis=0) < 1e-9)


@pytest.mark.parametrize("name", ["bluerov2_heavy", "bluerov2_heavy_ignition", "ardusub_sitl"])
def test_common_scale_keeps_the_direction_and_gives_the_most_possible(name, allocate):
    thrusters = load_vehicle(name).thrusters()
    B = np.asarray(thrusters.allocation)
    low, high = (np.asarray(limit) for limit in thrusters.force_limits())
    F = np.concatenate([wrenches(30, 3.0), 300 * np.eye(6), -300 * np.eye(6)], axis=1)
    forces = np.asarray(allocate(thrusters, jnp.asarray(F), "common"))
    assert np.all((low[:, None] <= forces) & (forces <= high[:, None]))
    for k in range(F.shape[1]):
        # linear programme: the largest s with B f = s F and f within the limits
        best = linprog(
            np.r_[np.zeros(8), -1],
            A_eq=np.c_[B, -F[:, k]],
            b_eq=np.zeros(6),
            bounds=[*zip(low, high, strict=True), (0, 1)],
        ).x[-1]
        np.testing.assert_allclose(B @ forces[:, k], best * F[:, k], atol=1e-7)


def test_full_surge_uses_forward_and_reverse_limits_together(heavy, allocate):
    F = jnp.zeros(6).at[0].set(500)
    low, high = heavy.force_limits()
    surge = float(heavy.wrench(allocate(heavy, F, "common"))[0])
    assert surge == pytest.approx(2 * S * float(high[0] - low[0]), rel=1e-7)
    assert surge == pytest.approx(129.3, abs=0.1)  # N at 16 V


def test_groups_keep_the_depth_while_the_vehicle_races(heavy, allocate):
    F = jnp.array([900.0, 0, 30.0, 0, 0, 0])
    common, groups = (heavy.wrench(allocate(heavy, F, scale)) for scale in ("common", "groups"))
    np.testing.assert_allclose(common, F * common[0] / 900, atol=1e-9)
    np.testing.assert_allclose(groups, [129.26, 0, 30, 0, 0, 0], atol=0.01)


def test_groups_keep_the_direction_in_the_plane(heavy, allocate):
    F = np.asarray(wrenches(30, 3.0, seed=5))
    forces = allocate(heavy, jnp.asarray(F), "groups")
    low, high = heavy.force_limits()
    assert jnp.all((low[:, None] <= forces) & (forces <= high[:, None]))
    plane = np.array([0, 1, 5])
    reached = np.asarray(heavy.wrench(forces))[plane]
    factor = np.sum(reached * F[plane], axis=0) / np.sum(F[plane] ** 2, axis=0)
    np.testing.assert_allclose(reached, factor * F[plane], atol=1e-9)
    assert np.all((factor > 0) & (factor < 1 + 1e-9))
    assert np.any(factor < 0.9)


def test_effort_relieves_a_weak_thruster(heavy):
    effort = np.ones(8)
    effort[0] = 100
    weighted = Thrusters(
        np.asarray(heavy.positions), np.asarray(heavy.directions), heavy.curve, effort=effort
    )
    F = wrenches(20, 0.1)
    forces = weighted.allocate(F)
    np.testing.assert_allclose(weighted.wrench(forces), F, atol=1e-9)
    plain = heavy.allocate(F)
    assert jnp.all(
        jnp.sum(effort[:, None] * forces**2, 0) <= jnp.sum(effort[:, None] * plain**2, 0)
    )
    assert float(jnp.mean(jnp.abs(forces[0]))) < 0.1 * float(jnp.mean(jnp.abs(plain[0])))


def test_allocation_is_continuous_batched_and_differentiable(heavy, allocate):
    direction = wrenches(1, 1.0, seed=3)
    F = direction * jnp.linspace(0, 5, 2001)[None]
    forces = allocate(heavy, F, "common")
    step = jnp.abs(jnp.diff(forces, axis=1))
    assert float(jnp.max(step)) < 10 * float(jnp.max(step[:, 0]))
    np.testing.assert_allclose(forces[:, 1234], allocate(heavy, F[:, 1234], "common"), atol=1e-9)
    for size in (0.0, 0.3, 5.0):
        J = jax.jacfwd(lambda x: heavy.allocate(x, scale="groups"))(size * direction[:, 0])
        assert jnp.all(jnp.isfinite(J))


# ---------------------------------------------------------------------------------------------- lag


def lagging(heavy, **times):
    return Thrusters(
        np.asarray(heavy.positions), np.asarray(heavy.directions), heavy.curve, **times
    )


def test_lag_is_the_exponential_whatever_the_step(heavy):
    thrusters = lagging(heavy, time_constant=0.15)
    force, command = jnp.linspace(-20, 20, 8), jnp.linspace(30, -30, 8)
    once = thrusters.lag(force, command, 0.3)
    np.testing.assert_allclose(once, command + (force - command) * np.exp(-2), rtol=1e-12)
    twice = thrusters.lag(thrusters.lag(force, command, 0.1), command, 0.2)
    np.testing.assert_allclose(twice, once, rtol=1e-12)
    np.testing.assert_array_equal(lagging(heavy).lag(force, command, 0.01), command)
    tau = jax.grad(lambda m: jnp.sum(m.lag(force, command, 0.3)))(thrusters).time_constant
    assert float(tau) == pytest.approx(float(jnp.sum(force - command) * np.exp(-2) * 0.3 / 0.15**2))


@pytest.mark.parametrize("dt", [0.01, 0.03, 0.5])
def test_start_from_rest_is_late_by_the_delay_whatever_the_step(heavy, dt):
    thrusters = lagging(heavy, time_constant=0.15, start_delay=0.11)
    command = jnp.linspace(5.0, 40.0, 8)
    force, waited = jnp.zeros(8), jnp.zeros(8)
    steps = round(1.5 / dt)
    for _ in range(steps):
        force, waited = thrusters.lag_from_rest(force, waited, command, dt)
    expected = command * (1 - np.exp(-(steps * dt - 0.11) / 0.15))
    np.testing.assert_allclose(force, expected, rtol=1e-9)
    # on the way through zero nothing waits
    there, _ = thrusters.lag_from_rest(force, waited, -command, dt)
    np.testing.assert_allclose(there, thrusters.lag(force, -command, dt), rtol=1e-12)
    # once it has stood still without command it waits again
    for _ in range(8):
        force, waited = thrusters.lag_from_rest(force, waited, 0 * command, 0.5)
    force, waited = thrusters.lag_from_rest(force, waited, command, 0.1)
    assert float(jnp.max(jnp.abs(force))) < 0.1


def test_curves_are_exchangeable(heavy):
    thrusters = Thrusters(
        np.asarray(heavy.positions), np.asarray(heavy.directions), QuadraticCurve(40.0)
    )
    assert isinstance(heavy.curve, T200Curve)
    np.testing.assert_allclose(thrusters.force(jnp.full((8, 2), 1900.0)), 40.0)
    np.testing.assert_allclose(thrusters.loaded_voltage(jnp.full((8, 2), 1900.0)), 16.0)
