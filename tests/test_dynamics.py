"""The drift against Drake's MultibodyPlant, a hand-written Fossen model, and energy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces, SpatialInertia, UnitInertia
from scipy.integrate import solve_ivp

from spinndrift.models import se3
from spinndrift.models.dynamics import Flow
from spinndrift.models.rigid_body import FossenDynamics, spatial_inertia

MASS = 11.5
P_CM = np.array([0.02, -0.01, -0.03])
I_CM = np.array([[0.21, 0.01, 0.0], [0.01, 0.25, -0.02], [0.0, -0.02, 0.31]])
ADDED = np.diag([5.5, 12.7, 14.6, 0.12, 0.13, 0.14])
ADDED[0, 4] = ADDED[4, 0] = 0.4
LINEAR = np.diag([4.0, 6.2, 5.2, 0.07, 0.08, 0.09])
QUADRATIC = np.diag([18.2, 21.7, 37.0, 1.5, 1.6, 1.7])
WEIGHT, BUOYANCY, P_CB = 112.8, 114.8, np.array([0.0, 0.01, 0.02])


def vehicle(**changes):
    values = {
        "rigid_inertia": spatial_inertia(MASS, P_CM, I_CM),
        "added_mass": ADDED,
        "linear_drag": LINEAR,
        "quadratic_drag": QUADRATIC,
        "weight": WEIGHT,
        "buoyancy": BUOYANCY,
        "p_BoBcm_B": P_CM,
        "p_BoCb_B": P_CB,
    }
    return FossenDynamics(**(values | changes))


def states(n, seed=0):
    rng = np.random.default_rng(seed)
    X = se3.exp(jnp.asarray(rng.normal(size=(6, n))))
    return X, jnp.asarray(rng.normal(size=(6, n))), jnp.asarray(10 * rng.normal(size=(6, n)))


def no_water():
    zero = np.zeros((6, 6))
    return vehicle(added_mass=zero, linear_drag=zero, quadratic_drag=zero, weight=0.0, buoyancy=0.0)


def test_free_body_agrees_with_drake():
    """Drake's inverse dynamics of our acceleration must give back the wrench that we applied."""
    plant = MultibodyPlant(0.0)
    about_cm = SpatialInertia.MakeFromCentralInertia(
        MASS,
        P_CM,
        MASS * UnitInertia(*np.diag(I_CM) / MASS, *(I_CM[[0, 0, 1], [1, 2, 2]] / MASS)),
    )
    body = plant.AddRigidBody("vehicle", about_cm)
    plant.mutable_gravity_field().set_gravity_vector([0, 0, 0])
    plant.Finalize()
    context = plant.CreateDefaultContext()
    X, V, F = states(20)
    A = no_water().acceleration(X, V, F)
    for i in range(20):
        pose = RigidTransform(np.asarray(se3.as_matrix(X[:, i])))
        R = pose.rotation().matrix()
        v, w = np.asarray(V[:3, i]), np.asarray(V[3:, i])
        plant.SetFreeBodyPose(context, body, pose)
        plant.SetVelocities(context, np.concatenate([R @ w, R @ v]))
        dv = R @ (np.asarray(A[:3, i]) + np.cross(w, v))
        vdot = np.concatenate([R @ np.asarray(A[3:, i]), dv])
        tau = plant.CalcInverseDynamics(context, vdot, MultibodyForces(plant))
        wrench = np.concatenate([R.T @ tau[3:], R.T @ tau[:3]])
        assert wrench == pytest.approx(np.asarray(F[:, i]), abs=1e-9)


def skew(a):
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def fossen_coriolis(M, nu):
    """Fossen (2011), eq. 3.46: C(ν) from the blocks of M."""
    linear = skew(M[:3, :3] @ nu[:3] + M[:3, 3:] @ nu[3:])
    angular = skew(M[3:, :3] @ nu[:3] + M[3:, 3:] @ nu[3:])
    return np.block([[np.zeros((3, 3)), -linear], [-linear, -angular]])


def fossen_restoring(R):
    """Fossen (2011), eq. 4.6, rotated to a z-up world."""
    weight, buoyancy = R.T @ [0, 0, -WEIGHT], R.T @ [0, 0, BUOYANCY]
    moment = np.cross(P_CM, weight) + np.cross(P_CB, buoyancy)
    return -np.concatenate([weight + buoyancy, moment])


def test_agrees_with_a_hand_written_fossen_model():
    X, V, F = states(20, seed=1)
    A = np.asarray(vehicle().acceleration(X, V, F))
    M = spatial_inertia(MASS, P_CM, I_CM) + ADDED
    for i in range(20):
        nu, tau = np.asarray(V[:, i]), np.asarray(F[:, i])
        R = np.asarray(se3.rotation_matrix(X[:, i]))
        C = fossen_coriolis(M, nu)
        np.testing.assert_allclose(C, -C.T)
        drag = LINEAR @ nu + QUADRATIC @ (np.abs(nu) * nu)
        expected = np.linalg.solve(M, tau - C @ nu - drag - fossen_restoring(R))
        assert A[:, i] == pytest.approx(expected, abs=1e-9)


def test_potential_wrench_is_the_derivative_of_the_potential():
    dynamics = vehicle()
    X, _, _ = states(5, seed=2)
    xi = jnp.zeros((6, 5))
    slope = jax.grad(lambda d: jnp.sum(dynamics.potential(se3.compose(X, se3.exp(d)))))(xi)
    np.testing.assert_allclose(dynamics.potential_wrench(X), -slope, atol=1e-12)


def energy_along(dynamics, V0, seconds, times):
    """Total energy (J) at the given times without input, from a high-order integrator."""

    @jax.jit
    def rate(y):
        X, V = se3.normalize(y[:7]), y[7:]
        w, u = y[0], y[1:4]
        dq = jnp.concatenate([-(u @ V[3:])[None], w * V[3:] + se3.cross(u, V[3:])]) / 2
        dV = dynamics.acceleration(X, V, jnp.zeros(6))
        return jnp.concatenate([dq, se3.rotate(X, V[:3]), dV])

    start = np.concatenate([np.asarray(se3.from_position_rpy(jnp.zeros(3), jnp.ones(3) / 3)), V0])
    solution = solve_ivp(
        lambda t, y: np.asarray(rate(y)),
        (0, seconds),
        start,
        method="DOP853",
        t_eval=times,
        rtol=1e-12,
        atol=1e-13,
        max_step=0.05,
    )
    y = jnp.asarray(solution.y)
    return np.asarray(dynamics.kinetic_energy(y[7:]) + dynamics.potential(se3.normalize(y[:7])))


V_START = np.array([0.5, -0.3, 0.2, 0.4, -0.6, 0.3])


def test_energy_is_conserved_without_drag_and_input():
    dynamics = vehicle(linear_drag=np.zeros((6, 6)), quadratic_drag=np.zeros((6, 6)))
    energy = energy_along(dynamics, V_START, 100.0, np.linspace(0, 100, 101))
    assert np.abs(energy - energy[0]).max() < 1e-8


def test_energy_never_grows_with_drag_alone():
    energy = energy_along(vehicle(), V_START, 20.0, np.linspace(0, 20, 401))
    assert np.all(np.diff(energy) < 1e-10)
    assert energy[-1] < energy[0] - 1.0


def test_steady_current_is_a_moving_frame():
    """In water that moves steadily the vehicle accelerates as in still water at ν_r."""
    dynamics = vehicle()
    X, V, F = states(10, seed=3)
    v_c = jnp.asarray(np.random.default_rng(4).normal(size=(3, 10)))
    v_c_B = se3.rotate_inverse(X, v_c)
    V_r = V - jnp.concatenate([v_c_B, jnp.zeros((3, 10))])
    drift = jnp.concatenate([-se3.cross(V[3:], v_c_B), jnp.zeros((3, 10))])
    moving = dynamics.acceleration(X, V, F, Flow(v_c, jnp.zeros((3, 10))))
    np.testing.assert_allclose(moving, dynamics.acceleration(X, V_r, F) + drift, atol=1e-10)
    still = dynamics.acceleration(X, V, F, Flow(jnp.zeros((3, 10)), jnp.zeros((3, 10))))
    np.testing.assert_allclose(still, dynamics.acceleration(X, V, F), atol=1e-12)


def test_neutral_sphere_follows_accelerating_water():
    sphere = FossenDynamics(
        rigid_inertia=spatial_inertia(10.0, np.zeros(3), 0.1 * np.eye(3)),
        added_mass=np.diag([5.0, 5.0, 5.0, 0, 0, 0]),
        linear_drag=LINEAR,
        quadratic_drag=QUADRATIC,
        weight=10.0 * 9.80665,
        buoyancy=10.0 * 9.80665,
        p_BoBcm_B=np.zeros(3),
        p_BoCb_B=np.zeros(3),
    )
    X, _, _ = states(1, seed=5)
    v, a = jnp.array([0.3, -0.1, 0.2]), jnp.array([0.5, 0.4, -0.2])
    V = jnp.concatenate([se3.rotate_inverse(X[:, 0], v), jnp.zeros(3)])
    A = sphere.acceleration(X[:, 0], V, jnp.zeros(6), Flow(v, a))
    np.testing.assert_allclose(se3.rotate(X[:, 0], A[:3]), a, atol=1e-13)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"added_mass": -np.diag([12.0] * 6)}, "positive definite"),
        ({"added_mass": ADDED * np.nan}, "finite"),
        ({"diffusion": -np.ones(6)}, "diffusion"),
    ],
)
def test_impossible_coefficients_are_refused(change, word):
    with pytest.raises(ValueError, match=word):
        vehicle(**change)
