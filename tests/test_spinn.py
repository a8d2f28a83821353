import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import integrate, se3
from spinndrift.models.config import typed_yaml
from spinndrift.models.config.errors import UserError
from spinndrift.models.rigid_body import FossenDynamics, spatial_inertia
from spinndrift.models.spinn import Spinn, SpinnConfig

SMALL = {"width": 8, "depth": 2}


def body(dtype=float, **changes):
    """Return a vehicle with full matrices: nothing about it is diagonal."""
    A = np.random.default_rng(0).normal(size=(6, 6))
    coupling = 0.05 * (A + A.T)
    values = {
        "rigid_inertia": spatial_inertia(
            11.5, np.array([0.01, 0, -0.02]), np.diag([0.2, 0.2, 0.3])
        ),
        "added_mass": np.diag([5.5, 12.7, 14.6, 0.12, 0.12, 0.12]) + 0.3 * coupling,
        "linear_drag": np.diag([4.0, 6.2, 5.2, 0.7, 0.7, 0.7]) + coupling,
        "quadratic_drag": np.diag([18.0, 21.7, 37.0, 1.6, 1.6, 1.6]) + coupling,
        "weight": 112.8,
        "buoyancy": 114.8,
        "p_BoBcm_B": np.array([0.01, 0, -0.02]),
        "p_BoCb_B": np.array([0.0, 0.0, 0.01]),
        "diffusion": np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]),
    }
    return FossenDynamics(**{**values, **changes}, dtype=dtype)


def states(seed, *batch, dtype=float):
    rng = np.random.default_rng(seed)
    X = jax.jit(se3.exp)(jnp.asarray(rng.normal(size=(6, *batch)), dtype))
    return X, jnp.asarray(0.5 * rng.normal(size=(6, *batch)), dtype)


def shaken(model, seed=1, size=0.3):
    """Return the model with all parameters moved off their start, where heads are zero."""
    learned, rest = eqx.partition(model, model.trainable())
    leaves, tree = jax.tree.flatten(learned)
    rng = np.random.default_rng(seed)
    moved = [p + jnp.asarray(size * rng.normal(size=p.shape), p.dtype) for p in leaves]
    return eqx.combine(jax.tree.unflatten(tree, moved), rest)


@functools.cache
def spinn(**settings):
    return shaken(Spinn.create(SpinnConfig(**SMALL, **settings), body(), jax.random.key(0)))


energy = eqx.filter_jit(lambda model, X: model.potential(X))
wrench = eqx.filter_jit(lambda model, X: model.potential_wrench(X))


@eqx.filter_jit
def matrices(model, V):
    c = model.coefficients(V)
    return c.mass.matrix(), c.linear_drag.matrix(), c.quadratic_drag.matrix(), c.diffusion


@pytest.mark.parametrize("kind", ["cholesky", "eigenvalues"])
@pytest.mark.parametrize("constant_mass", [False, True])
def test_a_new_model_has_the_reference_coefficients(kind, constant_mass):
    config = SpinnConfig(**SMALL, spd=kind, constant_mass=constant_mass)
    model = Spinn.create(config, body(), jax.random.key(0))
    M, D, Df, b = matrices(model, states(1, 4)[1])
    expected = body()
    for found, wanted in (
        (M, expected.mass),
        (D, expected.linear_drag),
        (Df, expected.quadratic_drag),
    ):
        wanted = np.asarray(wanted.matrix())
        entries = np.asarray(found).reshape(6, 6, -1)
        np.testing.assert_allclose(
            entries, np.broadcast_to(wanted[..., None], entries.shape), atol=1e-9
        )
    np.testing.assert_allclose(b, np.broadcast_to(expected.diffusion[:, None], (6, 4)), rtol=1e-12)


def test_scale_start_keeps_only_the_diagonals():
    config = SpinnConfig(**SMALL, start="scale")
    model = Spinn.create(config, body(), jax.random.key(0))
    M, D, _, _ = matrices(model, jnp.zeros(6))
    np.testing.assert_allclose(M, np.diag(np.diag(body().mass.matrix())), atol=1e-12)
    np.testing.assert_allclose(D, np.diag(np.diag(body().linear_drag.matrix())), atol=1e-12)


def test_zeros_of_the_reference_leave_usable_scales():
    bare = body(
        linear_drag=np.zeros((6, 6)), quadratic_drag=np.zeros((6, 6)), diffusion=np.zeros(6)
    )
    model = Spinn.create(SpinnConfig(**SMALL), bare, jax.random.key(0))
    _, D, Df, b = matrices(model, jnp.zeros(6))
    mass = np.diag(bare.mass.matrix())
    np.testing.assert_allclose(np.diag(D), 0.01 * mass, rtol=1e-9)
    np.testing.assert_allclose(np.diag(Df), 0.01 * mass, rtol=1e-9)
    np.testing.assert_allclose(b, 0.001 * mass, rtol=1e-9)


def test_a_new_model_keeps_net_buoyancy_and_righting_moment_of_the_reference():
    model = Spinn.create(SpinnConfig(**SMALL), body(), jax.random.key(0))
    X, _ = states(2, 50)
    found, wanted = wrench(model, X), body().potential_wrench(X)
    np.testing.assert_allclose(found[:3], wanted[:3], atol=1e-12)
    np.testing.assert_allclose(found[3:], wanted[3:], atol=0.1 * np.abs(wanted[3:]).max())


@pytest.mark.parametrize("potential", ["gravity", "pose"])
def test_potential_wrench_is_minus_the_derivative_along_the_group(potential):
    model, (X, _), h = spinn(potential=potential), states(3, 2, 5), 1e-5
    moved = [jax.jit(se3.compose)(X, se3.exp(s * h * e)) for e in jnp.eye(6) for s in (1, -1)]
    values = np.asarray([energy(model, X) for X in moved]).reshape(6, 2, 2, 5)
    found = wrench(model, X)
    np.testing.assert_allclose(found, -(values[:, 0] - values[:, 1]) / (2 * h), atol=1e-6)
    np.testing.assert_allclose(wrench(model, X[:, 1, 2]), found[:, 1, 2], atol=1e-12)


def test_gravity_potential_sees_neither_place_nor_heading_and_lifts_by_its_net_buoyancy():
    model, (X, _) = spinn(), states(4, 30)
    turn = se3.from_position_rpy(jnp.asarray([3.0, -7.0, 0.0]), jnp.asarray([0.0, 0.0, 1.9]))
    turned = se3.compose(turn, X)
    F = wrench(model, X)
    np.testing.assert_allclose(wrench(model, turned), F, atol=1e-12)
    np.testing.assert_allclose(energy(model, turned), energy(model, X), atol=1e-9)
    lift = float(model.learned_potential.net_buoyancy)
    up = np.broadcast_to([[0.0], [0.0], [lift]], (3, 30))
    np.testing.assert_allclose(se3.rotate(X, F[:3]), up, atol=1e-12)
    deep = X.at[6].add(-100.0)
    np.testing.assert_allclose(energy(model, deep) - energy(model, X), 100 * lift)


@pytest.mark.parametrize("potential", ["gravity", "pose"])
def test_learned_energy_is_bounded_by_lambda(potential):
    model = shaken(spinn(potential=potential), size=10.0)
    X, _ = states(5, 500)
    learned = model.learned_potential
    scalar = learned.restoring if potential == "gravity" else learned.scalar
    weightless = X.at[6].set(0) if potential == "gravity" else X
    assert np.abs(energy(model, weightless)).max() <= abs(float(scalar.bound))


@pytest.mark.parametrize("constant_mass", [False, True])
@pytest.mark.parametrize("stochastic", [False, True])
def test_second_stage_repeats_mass_and_diffusion_of_the_first(constant_mass, stochastic):
    model = spinn(constant_mass=constant_mass, stochastic=stochastic)
    V = states(6, 7)[1]

    @eqx.filter_jit
    def stages(model, V):
        c = model.coefficients(V)
        mass, b = model.mass_and_diffusion(V)
        return (c.mass.solve(V), c.diffusion), (mass.solve(V), b)

    first, (solved, b) = stages(model, V)
    np.testing.assert_allclose(solved, first[0], rtol=1e-12)
    np.testing.assert_allclose(b, first[1], rtol=1e-12)
    assert np.all(b > 0) if stochastic else np.all(b == 0)


def test_correlated_noise_starts_uncorrelated_and_can_have_any_correlation():
    settings = SpinnConfig(**SMALL, correlated=True)
    new, V = Spinn.create(settings, body(), jax.random.key(0)), states(9, 5)[1]
    np.testing.assert_allclose(
        eqx.filter_jit(new.noise_correlation_root)(V), np.eye(6)[..., None] * np.ones(5), atol=1e-15
    )
    A = np.random.default_rng(3).normal(size=(6, 9))
    wanted = np.corrcoef(A)
    C = np.linalg.cholesky(wanted)
    free = (C / np.diag(C)[:, None])[np.tril_indices(6, -1)]
    assert new.diffusion_head is not None
    model = eqx.tree_at(
        lambda m: m.diffusion_head.bias, new, new.diffusion_head.bias.at[0, 6:].set(free)
    )

    @eqx.filter_jit
    def increments(model, V):
        dW = jnp.broadcast_to(jnp.eye(6)[:, :, None], (6, 6, 5))
        return jnp.stack([model.noise_acceleration(V, e) for e in jnp.swapaxes(dW, 0, 1)], axis=1)

    mass = model.coefficients(V).mass.matrix()
    F = jnp.einsum(
        "ijb,jkb->ikb", jnp.broadcast_to(mass.reshape(6, 6, -1), (6, 6, 5)), increments(model, V)
    )
    covariance = jnp.einsum("ikb,jkb->ijb", F, F)
    b = np.asarray(body().diffusion)
    np.testing.assert_allclose(covariance[..., 2], wanted * np.outer(b, b), rtol=1e-9)


def test_the_size_of_correlated_noise_is_b_whatever_the_velocity():
    model, V = spinn(correlated=True), states(9, 5)[1]
    C = np.asarray(eqx.filter_jit(model.noise_correlation_root)(V))
    np.testing.assert_allclose(np.sum(C**2, axis=1), 1, rtol=1e-12)
    assert np.ptp(C[3, 1]) > 1e-3  # the networks say it by velocity
    np.testing.assert_array_equal(C[np.triu_indices(6, 1)], 0)


@pytest.mark.parametrize("other", [{"stochastic": False}, {"diffusion": "distance-aware"}])
def test_correlation_needs_a_network_of_b(other):
    with pytest.raises(UserError, match=r"SpinnConfig.correlated"):
        SpinnConfig(correlated=True, **other)


@pytest.mark.parametrize("kind", ["cholesky", "eigenvalues"])
def test_viscous_drag_dissipates_and_mass_is_positive(kind):
    V = np.asarray(states(7, 200)[1])
    M, D, _, _ = matrices(spinn(spd=kind), V)
    assert np.all(np.einsum("ib,ijb,jb->b", V, D, V) > 0)
    assert np.all(np.einsum("ib,ijb,jb->b", V, M, V) > 0)


def test_constant_mass_is_constant_and_its_variation_zero():
    model, V = spinn(constant_mass=True), states(8, 9)[1]
    M = matrices(model, V)[0]
    np.testing.assert_array_equal(M, matrices(model, -V)[0])
    assert model.mass_variation(V, jnp.ones_like(V)) == 0


def test_mass_variation_estimates_the_squared_jacobian_of_the_mass_outputs():
    model, V = spinn(velocity_scale=(1.0, 1.0, 2.0, 0.5, 0.5, 0.5)), states(9, 1)[1]

    @jax.jit
    @jax.jacfwd
    def slope(V):
        L = model.coefficients(V).mass
        return jnp.concatenate([L.diagonal - 1 / L.diagonal, L.below])  # undoes squareplus

    scale = np.asarray(model.config.velocity_scale)
    exact = np.sum(np.square(np.asarray(slope(V[:, 0])) * scale))
    variation = jax.jit(lambda V, d: model.mass_variation(V, d))
    total = sum(variation(V, jnp.eye(6)[:, i : i + 1]) for i in range(6))
    np.testing.assert_allclose(total, exact, rtol=1e-9)


def test_a_deterministic_model_ignores_brownian_increments():
    model = spinn(stochastic=False)
    X, V = states(10, 3)
    F, dW = jnp.ones((4, 6, 3)), jnp.ones((4, 1, 6, 3))
    noisy = integrate.rollout(model, X, V, F, 0.05, dW)
    quiet = integrate.rollout(model, X, V, F, 0.05)
    np.testing.assert_array_equal(noisy[1], quiet[1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spd", "potential"),
    [("cholesky", "gravity"), pytest.param("eigenvalues", "pose", marks=pytest.mark.slow)],
)
def test_float32_gradients_are_finite_from_rest_and_scales_have_none(spd, potential):
    config = SpinnConfig(**SMALL, spd=spd, potential=potential)
    model = Spinn.create(config, body(jnp.float32), jax.random.key(0), jnp.float32)
    X = jnp.tile(se3.identity(jnp.float32)[:, None], (1, 8))
    V = jnp.zeros((6, 8), jnp.float32)
    F = jnp.zeros((3, 6, 8), jnp.float32)
    dW = integrate.brownian_increments(jax.random.key(1), (3, 1, 6, 8), 0.05, jnp.float32)
    arrays, static = eqx.partition(model, eqx.is_array)

    @jax.jit
    @jax.value_and_grad
    def loss(arrays):
        Xs, Vs = integrate.rollout(eqx.combine(arrays, static), X, V, F, 0.05, dW, remat=False)
        return jnp.mean(se3.log(Xs[-1]) ** 2) + jnp.mean(Vs**2)

    value, gradient = loss(arrays)
    learned, rest = eqx.partition(gradient, model.trainable())
    assert value.dtype == jnp.float32
    assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(learned))
    assert all(
        np.any(g != 0) for g in jax.tree.leaves((learned.matrix_heads, learned.diffusion_head))
    )
    assert all(np.all(g == 0) for g in jax.tree.leaves(rest.scales))


def test_float32_rollout_stays_on_the_group():
    model = Spinn.create(SpinnConfig(**SMALL), body(), jax.random.key(0), jnp.float32)
    model = shaken(model, size=0.02)
    X, V = states(11, 20, dtype=jnp.float32)
    F = jnp.asarray(10 * np.random.default_rng(12).normal(size=(400, 6, 20)), jnp.float32)
    dW = integrate.brownian_increments(jax.random.key(2), (400, 1, 6, 20), 0.05, jnp.float32)
    Xs, Vs = jax.jit(lambda X, V: integrate.rollout(model, X, V, F, 0.05, dW))(X, V)
    np.testing.assert_allclose(jnp.linalg.norm(Xs[:, :4], axis=1), 1, atol=5e-7)
    assert np.all(np.isfinite(Vs))


def test_trainable_names_parameters_and_nothing_else():
    model = spinn(potential="pose")
    spec = model.trainable()
    assert (
        jax.tree.leaves((spec.scales, spec.rigid_inertia, spec.learned_potential.length))
        == [False] * 6
    )
    assert all(jax.tree.leaves((spec.hidden, spec.matrix_heads, spec.diffusion_head)))
    assert spec.learned_potential.scalar.bound


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("width: 0", "width"),
        ("activation: relu", "activation"),
        ("spd: lu", "spd"),
        ("velocity_scale: [1, 1, 1, 1, 1, 0]", "velocity_scale"),
        ("velocity_scale: [1, 1]", "velocity_scale"),
        ("length_scale: -1", "length_scale"),
        ("depht: 3", "depht"),
    ],
)
def test_a_wrong_setting_is_refused_by_name(text, field):
    with pytest.raises(UserError, match=field):
        typed_yaml.loads(SpinnConfig, text)


def test_settings_survive_yaml():
    config = SpinnConfig(spd="eigenvalues", velocity_scale=(1.0, 1.0, 1.0, 2.0, 2.0, 2.0))
    assert typed_yaml.loads(SpinnConfig, typed_yaml.dump(config)) == config
