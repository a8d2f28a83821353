"""Diffusion that grows with the distance: its bounds, its start and its penalties."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models.distance_aware import DistanceAware
from spinndrift.models.spinn import Spinn, SpinnConfig
from spinndrift.models.vehicles.vehicle import load_vehicle

Z = jnp.asarray(np.random.default_rng(0).normal(size=(6, 5)))
NEAR = 1 / (1 + np.exp(7.0))


call = eqx.filter_jit(lambda a, z: a(z))


def made(kind):
    return DistanceAware.create(kind, jax.random.key(0), jnp.float64)


def raised(aware, by):
    """Return it with η larger by a constant everywhere."""
    return eqx.tree_at(lambda a: a.distance.output.bias, aware, jnp.full((1, 1), by))


def test_the_constrained_one_starts_almost_without_noise_and_ends_at_the_prior():
    np.testing.assert_allclose(call(made("distance-aware"), Z), NEAR, rtol=1e-4)
    np.testing.assert_allclose(call(raised(made("distance-aware"), 40.0), Z), 1, rtol=1e-10)


def test_the_unconstrained_one_has_a_part_that_does_not_depend_on_the_distance():
    near, far = (call(raised(made("unconstrained"), by), Z) for by in (-30.0, 40.0))
    np.testing.assert_allclose(near, 1, atol=0.02)
    np.testing.assert_allclose(far - near, 1, rtol=1e-6)


@pytest.mark.parametrize(("kind", "mu"), [("distance-aware", 10.0), ("unconstrained", 100.0)])
def test_convexity_starts_at_the_published_number(kind, mu):
    np.testing.assert_allclose(made(kind).mu(Z), mu, rtol=1e-2)


@pytest.mark.parametrize("kind", ["distance-aware", "unconstrained"])
def test_the_penalties_are_those_of_a_numerical_gradient(kind):
    aware = raised(made(kind), 7.0)
    d = 0.1 * jnp.asarray(np.random.default_rng(1).normal(size=Z.shape))
    square, lack, there = eqx.filter_jit(lambda a, z: a.hinge(z, d[:, None]))(aware, Z)
    lack, there = lack[0], there[0]
    density = eqx.filter_jit(lambda a, z: a.density(z))
    h = 1e-6
    ends = [[density(aware, Z + s * h * e) for e in np.eye(6)[:, :, None]] for s in (1, -1)]
    slope = (np.stack(ends[0]) - np.stack(ends[1])) / (2 * h)
    np.testing.assert_allclose(square, jnp.sum(slope**2, axis=0), rtol=1e-5, atol=1e-14)
    np.testing.assert_allclose(there, density(aware, Z + d))
    mu = eqx.filter_jit(lambda a, z: a.mu(z))(aware, Z)
    margin = there - density(aware, Z) - np.sum(slope * d, axis=0) - mu * np.sum(d * d, axis=0) / 2
    np.testing.assert_allclose(lack, np.minimum(margin, 0) ** 2, rtol=1e-6)
    assert np.min(lack) > 0  # a nearly flat ρ is not strongly convex


@pytest.mark.parametrize("kind", ["distance-aware", "unconstrained"])
def test_a_spinn_with_it_has_no_other_network_of_the_diffusion(kind):
    vehicle = load_vehicle("bluerov2_heavy").dynamics(np.full(6, 2.0))
    config = SpinnConfig(width=5, depth=1, diffusion=kind)
    model = Spinn.create(config, vehicle, jax.random.key(0))
    assert model.stochastic
    assert model.diffusion_head is None
    assert model.distance_aware is not None
    assert model.hidden.weights[0].shape[0] == 3  # M, D and D^f
    factor, c, (_, b) = eqx.filter_jit(
        lambda m, V: (
            m.distance_aware(m.scaled_velocity(V)),
            m.coefficients(V).diffusion,
            m.mass_and_diffusion(V),
        )
    )(model, Z)
    np.testing.assert_allclose(c, 2 * factor)
    np.testing.assert_allclose(b, 2 * factor)


def test_another_kind_is_refused():
    with pytest.raises(ValueError, match="'network' is neither"):
        made("network")
