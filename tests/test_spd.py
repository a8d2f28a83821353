import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import spd, symmetric
from spinndrift.models.spd import CholeskySpd, EigenSpd

KINDS = [CholeskySpd, EigenSpd]
positive = jax.jit(symmetric.positive)
SCALE = np.diag([4.0, 5.0, 6.0, 0.4, 0.5, 0.6]) + np.tril(np.full((6, 6), 0.1), -1)


def raw_numbers(seed, *batch, spread=1.0):
    return np.random.default_rng(seed).normal(scale=spread, size=(21, *batch))


def symmetric_matrices(seed, count):
    A = np.random.default_rng(seed).normal(size=(6, 6, count))
    return A + A.swapaxes(0, 1)


def squareplus_of_matrix(A):
    w, Q = np.linalg.eigh(np.moveaxis(A, (0, 1), (-2, -1)))
    F = (Q * ((w + np.sqrt(w * w + 4)) / 2)[..., None, :]) @ np.swapaxes(Q, -1, -2)
    return np.moveaxis(F, (-2, -1), (0, 1))


@functools.partial(jax.jit, static_argnums=0)
def evaluate(kind, raw, scale, x):
    A = kind.from_raw(raw, scale, jnp.linalg.inv(scale))
    return A.matvec(x), A.solve(x), A.matrix()


@functools.partial(jax.jit, static_argnums=0)
def there_and_back(kind, raw, scale, x):
    A = kind.from_raw(raw, scale, jnp.linalg.inv(scale))
    return A.solve(A.matvec(x))


@pytest.mark.parametrize("kind", KINDS)
def test_operator_agrees_with_its_own_dense_matrix(kind):
    x = np.random.default_rng(1).normal(size=(6, 3, 5))
    applied, solved, dense = evaluate(kind, raw_numbers(0, 3, 5), SCALE, x)
    np.testing.assert_allclose(applied, np.einsum("ij...,j...->i...", dense, x))
    matrices = np.moveaxis(np.asarray(dense), (0, 1), (-2, -1))
    expected = np.linalg.solve(matrices, np.moveaxis(x, 0, -1)[..., None])[..., 0]
    np.testing.assert_allclose(np.moveaxis(np.asarray(solved), 0, -1), expected, rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_a_single_matrix_equals_its_batch_entry(kind):
    raw, x = raw_numbers(0, 3, 5), np.random.default_rng(1).normal(size=(6, 3, 5))
    many = evaluate(kind, raw, SCALE, x)
    one = evaluate(kind, raw[:, 2, 1], SCALE, x[:, 2, 1])
    for batch, single in zip(many, one, strict=True):
        np.testing.assert_allclose(batch[..., 2, 1], single, rtol=1e-11)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("batch", [(), (5,)])
def test_vectors_ahead_of_the_batch_are_separate_right_hand_sides(kind, batch):
    raw, x = raw_numbers(3, *batch), np.random.default_rng(4).normal(size=(6, 2, 5))
    applied, solved, _ = evaluate(kind, raw, SCALE, x)
    for k in range(2):
        one = evaluate(kind, raw, SCALE, x[:, k])
        np.testing.assert_allclose(applied[:, k], one[0], rtol=1e-9)
        np.testing.assert_allclose(solved[:, k], one[1], rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_matrices_are_symmetric_and_positive_for_large_outputs(kind):
    _, _, dense = evaluate(kind, raw_numbers(2, 200, spread=5.0), np.eye(6), np.ones((6, 200)))
    A = np.moveaxis(np.asarray(dense), -1, 0)
    np.testing.assert_allclose(A, A.swapaxes(1, 2), atol=1e-12 * np.abs(A).max())
    np.linalg.cholesky(A)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_zeros_give_the_scale_times_its_transpose_in_the_given_precision(kind, dtype):
    results = evaluate(kind, np.zeros((21, 2), dtype), SCALE.astype(dtype), np.ones((6, 2), dtype))
    np.testing.assert_allclose(results[2][..., 0], SCALE @ SCALE.T, rtol=1e-6, atol=1e-6)
    assert all(result.dtype == dtype for result in results)


@pytest.mark.parametrize("kind", KINDS)
def test_float32_solve_undoes_matvec(kind):
    raw = raw_numbers(5, 1000, spread=0.5).astype(np.float32)
    x = np.random.default_rng(6).normal(size=(6, 1000)).astype(np.float32)
    np.testing.assert_allclose(there_and_back(kind, raw, np.float32(SCALE), x), x, atol=2e-4)


def test_packing_and_unpacking_are_inverse():
    A = symmetric_matrices(7, 3)
    rows = spd.unpack_symmetric(spd.pack(jnp.asarray(A)))
    np.testing.assert_array_equal(np.asarray(rows), A)


def test_squareplus_is_positive_reciprocal_and_keeps_digits():
    x = jnp.asarray([-1e4, -30.0, -1.0, 0.0, 2.0, 1e4], jnp.float32)
    y = spd.squareplus(x)
    assert np.all(y > 0)
    assert y[3] == 1
    np.testing.assert_allclose(y * spd.squareplus(-x), 1, rtol=1e-6)
    exact = np.asarray(x, float)
    np.testing.assert_allclose(y[3:], (exact + np.sqrt(exact**2 + 4))[3:] / 2, rtol=1e-6)


@pytest.mark.parametrize(("dtype", "tolerance"), [(jnp.float32, 1e-5), (jnp.float64, 1e-13)])
def test_jacobi_reaches_rounding_also_for_meeting_eigenvalues(dtype, tolerance):
    rng = np.random.default_rng(8)
    w = rng.normal(size=(300, 6))
    w[100:200, 1] = w[100:200, 0]
    w[200:, 1:4] = w[200:, :1] * (1 + 1e-7 * rng.normal(size=(100, 3)))
    w[0], w[1] = 0.0, 2.0
    Q = np.linalg.qr(rng.normal(size=(300, 6, 6)))[0]
    A = jnp.asarray(np.moveaxis((Q * w[:, None]) @ Q.swapaxes(1, 2), 0, -1), dtype)
    values, vectors = (np.asarray(a, float) for a in jax.jit(symmetric.jacobi)(A))
    np.testing.assert_allclose(np.sort(values, axis=0), np.sort(w, axis=1).T, atol=tolerance)
    back = np.einsum("ikb,kb,jkb->ijb", vectors, values, vectors)
    np.testing.assert_allclose(back, A, atol=tolerance)
    gram = np.einsum("kib,kjb->ijb", vectors, vectors)
    np.testing.assert_allclose(
        gram, np.broadcast_to(np.eye(6)[..., None], gram.shape), atol=tolerance
    )


def test_positive_is_the_function_of_the_eigenvalues():
    A = symmetric_matrices(9, 20)
    up, down = positive(jnp.asarray(A))
    np.testing.assert_allclose(up, squareplus_of_matrix(A), atol=1e-12)
    np.testing.assert_allclose(down, squareplus_of_matrix(-A), atol=1e-12)


@pytest.mark.parametrize("gap", [1.0, 1e-3, 1e-9, 0.0])
def test_derivative_of_positive_is_right_where_eigenvalues_meet(gap):
    rng = np.random.default_rng(10)
    Q = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    A = (Q * (0.7 + gap * np.array([0.0, 1.0, -1.0, 0.5, 2.0, 0.3]))) @ Q.T
    dA = symmetric_matrices(11, 1)[..., 0]
    h = 1e-5
    slope = (squareplus_of_matrix(A + h * dA) - squareplus_of_matrix(A - h * dA)) / (2 * h)
    (_, _), (up, down) = jax.jvp(positive, (jnp.asarray(A),), (jnp.asarray(dA),))
    np.testing.assert_allclose(up, slope, atol=1e-8)
    slope = (squareplus_of_matrix(-A - h * dA) - squareplus_of_matrix(-A + h * dA)) / (2 * h)
    np.testing.assert_allclose(down, slope, atol=1e-8)
    weight = rng.normal(size=(6, 6))
    pull = jax.grad(lambda A: jnp.sum(weight * positive(A)[0]))(jnp.asarray(A))
    np.testing.assert_allclose(jnp.sum(pull * dA), jnp.sum(weight * up), rtol=1e-9)


def test_eigh_differentiates_to_nan_at_a_multiple_of_the_identity_and_positive_does_not():
    def through_eigh(A):
        w, Q = jnp.linalg.eigh(A)
        return jnp.sum((Q * spd.squareplus(w)[None]) @ Q.T * jnp.arange(36.0).reshape(6, 6))

    def ours(A):
        return jnp.sum(positive(A)[0] * jnp.arange(36.0).reshape(6, 6))

    assert np.all(np.isnan(jax.grad(through_eigh)(0.5 * jnp.eye(6))))
    slope = (1 + 0.5 / np.sqrt(4.25)) / 2
    np.testing.assert_allclose(
        jax.grad(ours)(0.5 * jnp.eye(6)), slope * np.arange(36.0).reshape(6, 6), rtol=1e-12
    )


@pytest.mark.parametrize("kind", [CholeskySpd, pytest.param(EigenSpd, marks=pytest.mark.slow)])
def test_gradients_of_solve_agree_with_differences(kind):
    scale = jnp.asarray(SCALE)
    raw, y = jnp.asarray(raw_numbers(12)), jnp.asarray(np.random.default_rng(13).normal(size=6))

    @jax.jit
    def value(raw, y):
        return jnp.sum(jnp.sin(kind.from_raw(raw, scale, jnp.linalg.inv(scale)).solve(y)))

    direction, h = jnp.asarray(raw_numbers(14)), 1e-6
    slope = (value(raw + h * direction, y) - value(raw - h * direction, y)) / (2 * h)
    np.testing.assert_allclose(jnp.sum(jax.grad(value)(raw, y) * direction), slope, rtol=1e-6)
