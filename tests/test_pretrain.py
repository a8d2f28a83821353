"""A SPINN's potential follows its reference's."""

import jax
import jax.numpy as jnp
import pytest

from spinndrift.models.euclidean import create_spinn
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.config import TrainingConfig
from spinndrift.training.fitting.pretrain import _attitudes, _potential_error, fit_potential

REFERENCE = load_vehicle("bluerov2_heavy").dynamics(dtype=jnp.float32)


@pytest.mark.slow
def test_a_potential_follows_its_target():
    config, key = TrainingConfig(), jax.random.key(0)
    first = create_spinn(config.model, REFERENCE, key, jnp.float32)
    fitted = fit_potential(first, REFERENCE, config.pretrain, key)
    X = _attitudes(jax.random.key(1), 256, jnp.float32)
    before, after = (float(_potential_error(m, REFERENCE, X)) for m in (first, fitted))
    assert after < before / 4, "errors of less than half"
    # nothing else has changed
    V = 0.5 * jax.random.normal(jax.random.key(2), (6, 8), jnp.float32)
    for a, b in zip(first.coefficients(V), fitted.coefficients(V), strict=True):
        same = a is b or jax.tree.all(jax.tree.map(lambda x, y: bool(jnp.all(x == y)), a, b))
        assert same
