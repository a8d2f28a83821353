"""Kernels on pairs of states: the fast logarithm, gradients at the hard places, bandwidths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import se3
from spinndrift.training.losses.geodesic import relative_log
from spinndrift.training.losses.kernels import (
    KERNELS,
    ChordalKernel,
    GeodesicKernel,
    VelocityKernel,
    bandwidths_from_differences,
)

ANGLES = np.concatenate([[0.0], np.logspace(-9, 0, 30), np.linspace(1, np.pi - 1e-6, 40)])


def pairs(dtype=np.float64, seed=0):
    """Pose pairs whose relative logarithm is known, over all angles up to the cut locus."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(3, ANGLES.size))
    xi = np.concatenate(
        [rng.normal(size=(3, ANGLES.size)), ANGLES * axis / np.linalg.norm(axis, axis=0)]
    )
    A = se3.exp(jnp.asarray(rng.normal(size=(6, ANGLES.size))))
    B = se3.compose(A, se3.exp(jnp.asarray(xi)))
    flip = np.where(rng.random(ANGLES.size) < 0.5, -1.0, 1.0)  # q and -q are one pose
    B = jnp.concatenate([B[:4] * flip[None], B[4:]])
    return A.astype(dtype), B.astype(dtype), xi


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 2e-13), (np.float32, 5e-6)])
def test_the_fast_logarithm_is_the_logarithm(dtype, tolerance):
    A, B, xi = pairs(dtype)
    e = jnp.stack(relative_log(A, B))
    assert e.dtype == dtype
    np.testing.assert_allclose(e, xi, atol=tolerance)


def test_the_fast_logarithm_has_the_logarithms_derivative():
    A, B, _ = pairs()
    use = np.pi - 1e-2 > ANGLES
    A, B = A[:, use], B[:, use]
    tangent = jnp.asarray(np.random.default_rng(1).normal(size=(6, int(use.sum()))))

    def moved(log):
        return jax.jvp(lambda s: log(A, se3.retract(B, s * tangent)), (0.0,), (1.0,))[1]

    fast = moved(lambda a, b: jnp.stack(relative_log(a, b)))
    np.testing.assert_allclose(fast, moved(se3.local), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["geodesic", "chordal"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_gradients_are_finite_where_samples_coincide_and_at_the_cut_locus(name, dtype):
    A, B, _ = pairs(dtype)
    half_turn = se3.compose(A, jnp.asarray([0, 1, 0, 0, 0.1, 0, 0], dtype))
    others = jnp.concatenate([A, B, half_turn], axis=1)
    A = jnp.concatenate([A, A, A], axis=1)
    kernel = KERNELS[name](jnp.ones((len(KERNELS[name].floors), 1), dtype), (1.0, 0.3))

    def total(a, b):
        return jnp.sum(kernel.value(kernel.squared(a, b, kernel.bandwidths)))

    gradients = jax.grad(total, argnums=(0, 1))(A, others)
    assert all(np.isfinite(g).all() for g in gradients)
    same = jax.grad(total)(A, A)
    # the maximum: no pull in any direction
    np.testing.assert_allclose(same[4:], 0, atol=1e-6)


def test_kernel_values_by_hand():
    a = jnp.zeros((6, 1))
    b = jnp.asarray([[0.2], [0.0], [0.0], [0.0], [0.0], [0.6]])
    g = jnp.asarray([0.1, 1, 1, 1, 1, 0.2])[:, None]
    kernel = VelocityKernel(g, (1.0, 2.0))
    d2 = kernel.squared(a, b, g)
    np.testing.assert_allclose(d2, 2.0**2 + 3.0**2)
    np.testing.assert_allclose(
        kernel.value(d2), (np.exp(-13 / 2) + np.exp(-13 / 8)) / 2, rtol=1e-12
    )
    X = se3.identity()[:, None]
    Y = se3.exp(jnp.asarray([0.3, 0, 0, 0, 0, 1.0]))[:, None]
    ones = jnp.ones((6, 1))
    np.testing.assert_allclose(
        GeodesicKernel(ones).squared(X, Y, ones), jnp.sum(se3.local(X, Y) ** 2, axis=0), rtol=1e-12
    )
    twelve = jnp.ones((12, 1))
    np.testing.assert_allclose(
        ChordalKernel(twelve).squared(X, Y, twelve),
        jnp.sum((se3.chordal(X) - se3.chordal(Y)) ** 2, axis=0),
        rtol=1e-12,
    )


def test_geodesic_kernels_don_t_see_a_change_of_the_world_frame():
    A, B, _ = pairs()
    moved = se3.exp(jnp.asarray([3.0, -2, 1, 0.5, 1, -0.7]))[:, None]
    ones = jnp.ones((6, 1))
    kernel = GeodesicKernel(ones)
    before = kernel.squared(A, B, ones)
    after = kernel.squared(se3.compose(moved, A), se3.compose(moved, B), ones)
    use = np.pi - 1e-3 > ANGLES  # at the cut locus the logarithm jumps
    np.testing.assert_allclose(after[use], before[use], rtol=1e-8)


def test_bandwidths_make_a_typical_pair_one_apart():
    rng = np.random.default_rng(0)
    spread = np.array([0.1, 0.3, 1.0, 0.02, 0.5, 0.05])[None, :, None]
    growth = np.linspace(0.5, 2, 40)[:, None, None]
    e = spread * growth * rng.normal(size=(40, 6, 500))
    gamma = bandwidths_from_differences(VelocityKernel, e, lag=8)
    assert gamma.shape == (6, 40)
    d2 = np.sum((e / gamma.T[..., None]) ** 2, axis=1)
    assert np.median(d2[:-8] + d2[8:]) == pytest.approx(1, rel=1e-6)
    shape = gamma / (spread[0] * growth[:, 0, 0])
    np.testing.assert_allclose(shape / shape.mean(), 1, atol=0.2)  # every axis and time its own
    wide = bandwidths_from_differences(VelocityKernel, e, lag=8, factor=2.0)
    np.testing.assert_allclose(wide, 2 * gamma)


def test_axes_without_variation_get_a_floor():
    e = np.zeros((10, 6, 20))
    e[:, 0] = np.random.default_rng(0).normal(size=(10, 20))
    gamma = bandwidths_from_differences(VelocityKernel, e, lag=2)
    assert (gamma[1:] >= VelocityKernel.floors[0]).all()
    assert np.isfinite(gamma).all()
