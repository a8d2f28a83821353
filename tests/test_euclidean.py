"""The Euclidean SPINN: kinematics in R¹², their singularities, and its place among models."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spinndrift.models import euclidean, integrate, se3
from spinndrift.models.euclidean import EuclideanSpinn, coordinates, create_spinn
from spinndrift.models.files.checkpoint import load_model, save_model
from spinndrift.models.spinn import Spinn, SpinnConfig
from spinndrift.models.vehicles.vehicle import load_vehicle

SMALL = {"width": 6, "depth": 1, "constant_mass": True, "coordinates": "euler"}


@functools.cache
def model(potential="gravity"):
    made = create_spinn(
        SpinnConfig(**SMALL, potential=potential),
        load_vehicle("bluerov2_heavy").dynamics(),
        jax.random.key(0),
    )
    assert isinstance(made, EuclideanSpinn)
    return made


displace = eqx.filter_jit(lambda m, X, twist_dt: m.displace(X, twist_dt))
energy = eqx.filter_jit(lambda m, X: m.potential(X))
wrench = eqx.filter_jit(lambda m, X: m.potential_wrench(X))
retract = eqx.filter_jit(se3.retract)
poses, coordinates_of = eqx.filter_jit(euclidean.pose), eqx.filter_jit(coordinates)


def shaken(potential):
    """Return a model whose learned potential has moved off its start."""
    head = 0.3 * np.random.default_rng(0).normal(size=(1, 1, 6))
    return eqx.tree_at(lambda m: m.learned_potential.head.weight, model(potential), jnp.array(head))


def attitudes(seed, count, pitch=1.2):
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-1, 1, (3, count)) * np.array([[3.0], [pitch], [3.0]])
    return np.concatenate([rng.normal(size=(3, count)), angles])


def scipy_rotation(q):
    return Rotation.from_euler("ZYX", q[[5, 4, 3]].T)


def matrix(rows):
    return np.stack([np.stack(row) for row in rows])


def test_the_rotation_matrix_is_scipys():
    q = attitudes(0, 20)
    expected = np.moveaxis(scipy_rotation(q).as_matrix(), 0, -1)
    np.testing.assert_allclose(
        matrix(eqx.filter_jit(euclidean.rotation)(jnp.asarray(q))), expected, atol=1e-14
    )


def test_angle_rates_are_the_derivative_of_scipys_angles():
    q = attitudes(1, 20)
    T = matrix(eqx.filter_jit(euclidean.angle_rates)(jnp.asarray(q)))
    h = 1e-6
    for i, e in enumerate(np.eye(3)):
        ahead, behind = (
            (scipy_rotation(q) * Rotation.from_rotvec(s * h * e)).as_euler("ZYX")[:, ::-1].T
            for s in (1, -1)
        )
        np.testing.assert_allclose(T[:, i], (ahead - behind) / (2 * h), atol=2e-8)


def test_coordinates_and_pose_are_inverse_up_to_full_turns():
    q = jnp.asarray(attitudes(2, 10))
    np.testing.assert_allclose(coordinates_of(poses(q)), q, atol=1e-12)
    turned = q + 2 * jnp.pi * jnp.asarray([0, 0, 0, 1.0, 0, -1])[:, None]
    np.testing.assert_allclose(coordinates_of(poses(turned)), q, atol=1e-12)


def test_models_on_the_group_are_displaced_by_the_exponential():
    X = eqx.filter_jit(se3.exp)(jnp.asarray(np.random.default_rng(0).normal(size=(6, 4))))
    V = jnp.asarray(np.random.default_rng(1).normal(size=(6, 4)))
    dynamics = load_vehicle("bluerov2_heavy").dynamics()
    np.testing.assert_array_equal(displace(dynamics, X, V), retract(X, V))


def test_the_euler_step_is_the_groups_to_first_order():
    q = jnp.asarray(attitudes(3, 30, pitch=1.0))
    X, V = poses(q), jnp.asarray(np.random.default_rng(2).normal(size=(6, 30)))
    gaps = []
    for h in (1e-2, 5e-3):
        moved, exact = displace(model(), X, h * V), retract(X, h * V)
        gaps.append(np.max(np.abs(eqx.filter_jit(se3.local)(moved, exact))))
    assert gaps[0] / gaps[1] == pytest.approx(4, rel=0.1)  # one step errs by O(h²)


def test_steps_of_integrate_and_of_diffrax_use_the_models_own_displacement():
    X, V, F = poses(jnp.asarray(attitudes(4, 1))[:, 0]), 0.5 * jnp.ones(6), jnp.zeros(6)
    expected = displace(model(), X, V * 0.2)
    assert np.max(np.abs(expected - retract(X, V * 0.2))) > 1e-3

    path = diffrax.UnsafeBrownianPath((6,), jax.random.key(0))

    @eqx.filter_jit
    def both(m, X, V):
        terms = integrate.sde_terms(m, lambda t: F, path)
        solution = diffrax.diffeqsolve(
            terms, integrate.LieEulerHeun(), 0.0, 0.2, 0.2, (X, V), adjoint=diffrax.DirectAdjoint()
        )
        return integrate.step(m, X, V, F, 0.2), jax.tree.map(lambda a: a[0], solution.ys)

    for moved, _ in both(model(), X, V):
        np.testing.assert_allclose(moved, expected, atol=1e-14)


@pytest.mark.parametrize("potential", ["gravity", "pose"])
def test_the_wrench_is_minus_the_derivative_along_the_group(potential):
    moved = shaken(potential)
    X = poses(jnp.asarray(attitudes(5, 8)))
    step = 1e-5
    slopes = []
    for e in np.eye(6)[:, :, None]:
        h = jnp.asarray(np.broadcast_to(step * e, (6, 8)))
        slopes.append((energy(moved, retract(X, h)) - energy(moved, retract(X, -h))) / (2 * step))
    np.testing.assert_allclose(wrench(moved, X), -np.stack(slopes), atol=1e-5)


def test_it_starts_at_the_restoring_wrench_of_the_geometric_model():
    vehicle = load_vehicle("bluerov2_heavy").dynamics()
    X = poses(jnp.asarray(attitudes(6, 8)))
    config = SpinnConfig(width=6, depth=1)
    geometric = Spinn.create(config, vehicle, jax.random.key(0))
    np.testing.assert_allclose(wrench(model(), X), wrench(geometric, X), atol=1e-10)


def test_coordinates_pass_half_a_turn_in_a_rollout_where_data_jump():
    V = jnp.asarray([0, 0, 0, 0, 0, 1.0])
    q = jnp.asarray([0, 0, 0, 0, 0, 3.0])
    F = jnp.zeros((10, 6))
    qs, _ = eqx.filter_jit(lambda m, q, V: m.rollout(q, V, F, 0.05))(model(), q, V)
    assert float(qs[-1, 5]) > np.pi
    assert float(coordinates_of(poses(qs[-1]))[5]) < -2.5


def test_rates_grow_without_bound_towards_vertical():
    V = jnp.asarray([0, 0, 0, 0, 0, 1.0])
    rates = eqx.filter_jit(euclidean.coordinate_rates)
    sizes = [
        np.max(np.abs(rates(jnp.asarray([0, 0, 0, 0, p, 0.0]), V)))
        for p in (1.0, 1.5, 1.57, np.pi / 2)
    ]
    assert sizes == sorted(sizes)
    assert sizes[2] > 1e3
    assert sizes[3] > 1e15


def test_the_rollout_in_coordinates_is_that_of_poses_where_nothing_wraps():
    rng = np.random.default_rng(7)
    q, V = jnp.asarray(0.3 * rng.normal(size=(6, 4))), jnp.asarray(0.3 * rng.normal(size=(6, 4)))
    F = jnp.asarray(5 * rng.normal(size=(10, 6, 4)))
    dW = jnp.asarray(0.2 * rng.normal(size=(10, 6, 4)))

    @eqx.filter_jit
    def both(m, q, V):
        Xs, twists = integrate.rollout(m, euclidean.pose(q), V, F, 0.05, dW[:, None])
        return m.rollout(q, V, F, 0.05, dW), (jax.vmap(coordinates)(Xs), twists)

    for found, expected in zip(*both(model(), q, V), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-10)


@pytest.mark.parametrize("diffusion", ["network", "distance-aware", "unconstrained"])
def test_a_stored_model_is_the_same_one(tmp_path, diffusion):
    config = SpinnConfig(**SMALL, diffusion=diffusion)
    vehicle = load_vehicle("bluerov2_heavy").dynamics(dtype=jnp.float32)
    made = create_spinn(config, vehicle, jax.random.key(3), jnp.float32)
    save_model(tmp_path / "model.spinn", made)
    read, _ = load_model(tmp_path / "model.spinn")
    assert isinstance(read, EuclideanSpinn)
    assert read.config == config
    for a, b in zip(jax.tree.leaves(read), jax.tree.leaves(made), strict=True):
        np.testing.assert_array_equal(a, b)
