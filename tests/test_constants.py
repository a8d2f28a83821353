"""The constants of a SPINN stand alone where its networks give zero."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models.euclidean import create_spinn
from spinndrift.models.spinn import SpinnConfig
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.fitting.constants import constants, without_networks


@pytest.mark.parametrize("settings", [{}, {"coordinates": "euler"}, {"potential": "pose"}])
def test_the_small_networks_are_the_same_function(settings):
    belief = load_vehicle("bluerov2_heavy_ng").dynamics(dtype=jnp.float32)
    config = SpinnConfig(width=4, depth=1, constant_mass=True, **settings)
    model = create_spinn(config, belief, jax.random.key(0), jnp.float32)
    small = without_networks(model)
    assert sum(a.size for a in small.hidden.weights) < sum(a.size for a in model.hidden.weights)
    for mine, other in zip(constants(small), constants(model), strict=True):
        np.testing.assert_array_equal(mine, other)
    key = jax.random.key(1)
    X = jnp.zeros((7, 20), jnp.float32).at[0].set(1)
    V, F = (jax.random.normal(k, (6, 20), jnp.float32) for k in jax.random.split(key))
    expected = model.acceleration(X, V, F)
    np.testing.assert_allclose(small.acceleration(X, V, F), expected, rtol=1e-4, atol=1e-6)
    heads = eqx.tree_at(lambda m: m.matrix_heads.weight, model, replace_fn=lambda w: w + 0.1)
    assert without_networks(heads) is heads
