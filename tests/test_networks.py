import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models.networks import ACTIVATIONS, Heads, MlpStack, activate, rational_tanh


@pytest.fixture(scope="module")
def stack():
    return MlpStack.create(4, 6, 8, 3, "tanh", jax.random.key(0))


def test_stack_equals_separate_perceptrons(stack):
    x = np.random.default_rng(1).normal(size=(6, 2, 5))
    y = np.asarray(stack(jnp.asarray(x), 4))
    for n in range(4):
        h = np.moveaxis(x, 0, -1)
        for w, b in zip(stack.weights, stack.biases, strict=True):
            h = np.tanh(h @ np.asarray(w)[n].T + np.asarray(b)[n])
        np.testing.assert_allclose(np.moveaxis(y[n], 0, -1), h, atol=1e-13)


def test_a_prefix_and_a_single_state_are_parts_of_the_batch(stack):
    x = jnp.asarray(np.random.default_rng(2).normal(size=(6, 5)))
    full = stack(x, 4)
    np.testing.assert_allclose(stack(x, 2), full[:2], atol=1e-14)
    np.testing.assert_allclose(stack(x[:, 3], 4), full[:, :, 3], atol=1e-14)


def test_networks_are_drawn_independently_with_variance_one_over_inputs():
    wide = MlpStack.create(2, 6, 200, 2, "tanh", jax.random.key(3))
    w = np.asarray(wide.weights[1])
    np.testing.assert_allclose(w.var(), 1 / 200, rtol=0.02)
    assert abs(np.corrcoef(w[0].ravel(), w[1].ravel())[0, 1]) < 0.02


def test_heads_start_as_constants():
    bias = jnp.arange(6.0).reshape(2, 3)
    y = Heads.constant(bias, 8)(jnp.ones((2, 8, 4)), 2)
    np.testing.assert_array_equal(y, np.broadcast_to(bias[..., None], (2, 3, 4)))


@pytest.mark.parametrize("kind", ACTIVATIONS)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_activations_are_zero_at_zero_1_lipschitz_and_finite(kind, dtype):
    x = jnp.asarray(np.linspace(-50, 50, 20001), dtype)
    y = activate(x, kind)
    slope = jax.vmap(jax.grad(lambda x: activate(x, kind)))(x)
    assert y.dtype == dtype
    assert abs(float(activate(jnp.zeros((), dtype), kind))) < 1e-7
    assert np.all(np.isfinite(y))
    assert np.all(np.isfinite(slope))
    assert np.abs(slope).max() <= 1 + 1e-6


def test_rational_tanh_is_tanh_to_its_stated_error():
    x = jnp.linspace(-9, 9, 20001)
    np.testing.assert_allclose(rational_tanh(x), jnp.tanh(x), atol=1e-4)
    slope = jax.vmap(jax.grad(rational_tanh))(x)
    np.testing.assert_allclose(slope, 1 - jnp.tanh(x) ** 2, atol=4e-4)
    differences = np.gradient(np.asarray(rational_tanh(x)), np.asarray(x))
    np.testing.assert_allclose(slope[2:-2], differences[2:-2], atol=4e-4)
