"""The kernel score: unbiased, proper on samples, and aware of the correlation between two times."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import se3
from spinndrift.training.losses.kernels import ChordalKernel, GeodesicKernel, VelocityKernel
from spinndrift.training.losses.scores import kernel_score, partners, shifts, time_pairs

N, P, W = 2, 8, 4000
SPREAD = jnp.asarray([0.1, 0.2, 0.3, 0.1, 0.2, 0.3])
FIRST, SECOND = jnp.asarray([0]), jnp.asarray([1])


def gaussian(key, samples, rho=0.7, mean=0.0, scale=1.0):
    """Draw (2, 6, samples, W) at two times with correlation rho and deviations SPREAD · scale."""
    a, b = jax.random.normal(key, (2, 6, samples, W))
    second = rho * a + (1 - rho**2) ** 0.5 * b
    return SPREAD[None, :, None, None] * (mean + scale * jnp.stack([a, second]))


def heavy_tailed(key, samples, rho=0.7):
    """Return a scale mixture with the covariance of `gaussian`."""
    key, other = jax.random.split(key)
    wide = jax.random.bernoulli(other, 0.1, (1, 1, samples, W))
    factor = jnp.where(wide, 2.6, 0.6)  # 0.1 · 2.6² + 0.9 · 0.6² = 1
    return gaussian(key, samples, rho) * factor


LAWS = {
    "mean": lambda k: gaussian(k, P, mean=0.3),
    "narrower": lambda k: gaussian(k, P, scale=0.7),
    "wider": lambda k: gaussian(k, P, scale=1.4),
    "less correlation": lambda k: gaussian(k, P, rho=0.2),
    "opposite correlation": lambda k: gaussian(k, P, rho=-0.7),
    "heavier tail": lambda k: heavy_tailed(k, P),
}


def on_group(e):
    """Poses exp(e) about a pose that is not the identity."""
    X_0 = se3.exp(jnp.asarray([1.0, 2.0, -1.0, 0.5, -0.4, 2.0]))
    return jnp.moveaxis(se3.compose(X_0, se3.exp(jnp.moveaxis(e, 1, 0))), 0, 1)


KERNELS = {
    "velocity": (VelocityKernel, lambda e: e),
    "geodesic": (GeodesicKernel, on_group),
    "chordal": (ChordalKernel, on_group),
}


def bandwidths(kernel, count):
    if kernel is ChordalKernel:
        return jnp.full((12, count), 0.7)
    return 2.0 * jnp.repeat(SPREAD[:, None], count, axis=1)


@pytest.fixture(scope="module", params=list(KERNELS))
def scored(request):
    """Return scores of the truth and of each perturbed law against the same observations."""
    cls, lift = KERNELS[request.param]
    kernel = cls(bandwidths(cls, N), (1.0, 0.5))
    observed = lift(gaussian(jax.random.key(1), 1))[:, :, 0]

    @jax.jit
    def score(e):
        return kernel_score(kernel, lift(e), observed, FIRST, SECOND)

    truth = np.asarray(score(gaussian(jax.random.key(2), P)))
    return truth, {name: np.asarray(score(law(jax.random.key(2)))) for name, law in LAWS.items()}


@pytest.mark.parametrize("name", list(LAWS))
def test_the_true_law_beats_perturbed_ones(scored, name):
    """Propriety: the mean score over windows is least for the truth, by five standard errors."""
    truth, others = scored
    difference = others[name] - truth
    error = difference.std() / np.sqrt(W)
    assert difference.mean() > 5 * error


@pytest.mark.parametrize("name", list(LAWS))
def test_the_energy_score_is_proper_too(name):
    """It is known to feel correlations less (Pinson and Tastu 2013): four times the windows."""
    kernel = VelocityKernel(bandwidths(VelocityKernel, N), profile="energy")

    def score(law, key):
        z, y = law(jax.random.fold_in(key, 0)), gaussian(jax.random.fold_in(key, 1), 1)
        return np.asarray(kernel_score(kernel, z, y[:, :, 0], FIRST, SECOND))

    keys = jax.random.split(jax.random.key(5), 4)
    gap = np.concatenate([score(LAWS[name], k) - score(lambda k: gaussian(k, P), k) for k in keys])
    assert gap.mean() > 5 * gap.std() / np.sqrt(gap.size)


def test_a_score_that_sees_one_time_alone_is_blind_to_correlation():
    """Equal one-time marginals, opposite lag correlation: only the joint law tells them apart."""
    kernel = VelocityKernel(bandwidths(VelocityKernel, N))
    right, wrong = (gaussian(jax.random.key(2), P, rho=r) for r in (0.9, -0.9))
    observed = gaussian(jax.random.key(1), 1, rho=0.9)[:, :, 0]

    def gap(first, second):
        a, b = (
            np.asarray(kernel_score(kernel, z, observed, first, second)) for z in (right, wrong)
        )
        return (b - a).mean() / (a.std() * np.sqrt(2 / W))

    assert gap(FIRST, SECOND) > 10
    alone = [gap(i, i) for i in (FIRST, SECOND)]
    assert max(abs(g) for g in alone) < 3


def test_the_score_is_the_u_statistic():
    """Against the double sum over all pairs p ≠ q, for odd and even numbers of samples."""
    rng = np.random.default_rng(0)
    for samples in (4, 5):
        z = rng.normal(size=(3, 6, samples, 2))
        y = rng.normal(size=(3, 6, 2))
        g = rng.uniform(1, 3, (6, 3))
        first, second = np.array([0, 1]), np.array([2, 2])

        def k(a, b, n, m, g=g):
            d2 = (((a[n] - b[n]) / g[:, n]) ** 2).sum() + (((a[m] - b[m]) / g[:, m]) ** 2).sum()
            return (np.exp(-d2 / 2) + np.exp(-d2 / 8)) / 2

        expected = np.zeros(2)
        for w in range(2):
            for n, m in zip(first, second, strict=True):
                own = [
                    k(z[:, :, p, w], z[:, :, q, w], n, m)
                    for p in range(samples)
                    for q in range(samples)
                    if p != q
                ]
                cross = [k(z[:, :, p, w], y[:, :, w], n, m) for p in range(samples)]
                expected[w] += (np.mean(own) / 2 - np.mean(cross)) / len(first)
        kernel = VelocityKernel(jnp.asarray(g), (1.0, 2.0))
        found = kernel_score(
            kernel, jnp.asarray(z), jnp.asarray(y), jnp.asarray(first), jnp.asarray(second)
        )
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_fewer_pairs_estimate_the_same():
    kernel = VelocityKernel(bandwidths(VelocityKernel, N))
    z = gaussian(jax.random.key(3), P)
    y = gaussian(jax.random.key(4), 1)[:, :, 0]
    every = np.asarray(kernel_score(kernel, z, y, FIRST, SECOND))
    some = np.asarray(kernel_score(kernel, z, y, FIRST, SECOND, pair_shifts=1))
    assert abs((some - every).mean()) < 4 * (some - every).std() / np.sqrt(W)


def test_every_unordered_pair_is_counted_once():
    for samples in range(2, 10):
        seen = np.zeros((samples, samples))
        for s, weight in shifts(samples):
            for p in range(samples):
                q = (p + s) % samples
                seen[p, q] += weight
                seen[q, p] += weight
        off = seen[~np.eye(samples, dtype=bool)]
        np.testing.assert_allclose(off, off[0])
        assert np.all(np.diag(seen) == 0)
    with pytest.raises(ValueError, match="at least 2"):
        shifts(1)


def test_time_pairs_are_uniform_and_inside():
    steps, lags, count = 20, (3, 8), 10
    drawn = jax.vmap(lambda k: jnp.stack(time_pairs(k, steps, lags, count)))(
        jax.random.split(jax.random.key(0), 4000)
    )
    first, second = np.asarray(drawn[:, 0]), np.asarray(drawn[:, 1])
    assert first.min() == 0
    assert second.max() == steps - 1
    for lag in lags:
        n = first[second - first == lag]
        assert n.size == 4000 * 5
        frequency = np.bincount(n, minlength=steps - lag) / n.size
        np.testing.assert_allclose(frequency * (steps - lag), 1, atol=0.08)
    with pytest.raises(ValueError, match="lags"):
        time_pairs(jax.random.key(0), 5, (5,), 3)


def test_the_scores_gradient_is_finite_where_all_samples_coincide():
    kernel = GeodesicKernel(jnp.ones((6, 2), jnp.float32))
    X = jnp.broadcast_to(se3.identity(jnp.float32)[None, :, None, None], (2, 7, 4, 3))
    gradient = jax.jit(
        jax.grad(lambda X: jnp.sum(kernel_score(kernel, X, X[:, :, 0], FIRST, SECOND)))
    )(X)
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize(("count", "kept"), [(5, None), (8, None), (8, 2)])
def test_partners_are_the_samples_turned_by_each_shift(count, kept):
    samples = jax.random.normal(jax.random.key(9), (2, 3, count, 4))
    turned = [jnp.roll(samples, -s, axis=-2) for s, _ in shifts(count, kept)]
    np.testing.assert_array_equal(partners(samples, kept), jnp.stack(turned, axis=-3))
