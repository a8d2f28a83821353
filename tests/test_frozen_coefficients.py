"""Substeps of the planner's model: their number, and what holding its coefficients means."""

import jax
import jax.numpy as jnp
import numpy as np

from spinndrift.models.integrate import step
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.planning.mppi_config import MppiConfig
from spinndrift.systems.plant.frozen_coefficients import FrozenCoefficients

RNG = np.random.default_rng(0)


def test_constant_coefficients_may_be_held_without_error():
    model = load_vehicle("bluerov2_heavy").dynamics(np.full(6, 0.5))
    X = jnp.concatenate([jnp.tile(jnp.array([[1.0], [0], [0], [0]]), (1, 5)), jnp.zeros((3, 5))])
    V, F, dW = (jnp.asarray(RNG.standard_normal((6, 5))) for _ in range(3))
    held = FrozenCoefficients(model, jnp.zeros_like(V))
    for noise in (None, 0.1 * dW):
        expected = jax.jit(step)(model, X, V, F, 0.02, noise)
        found = jax.jit(step)(held, X, V, F, 0.02, noise)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)


def test_a_trained_model_is_stepped_as_it_was_trained():
    trained = {"dt": 0.1, "substeps": 4}
    assert MppiConfig().steps_of_model == 2
    assert MppiConfig(dt=0.05).with_substeps_of(trained).steps_of_model == 2
    assert MppiConfig(dt=0.1).with_substeps_of(trained).steps_of_model == 4
    assert MppiConfig(substeps=1).with_substeps_of(trained).steps_of_model == 1
    assert MppiConfig().with_substeps_of({}).steps_of_model == 2
