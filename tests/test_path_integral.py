import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from spinndrift.systems.planning import path_integral
from spinndrift.systems.planning.path_integral import combine_risk, effective_count, spline_basis

path_integral_weights = jax.jit(path_integral.path_integral_weights, static_argnums=1)
chance_violation = jax.jit(path_integral.chance_violation, static_argnums=(1, 2))


def test_splines_give_unit_variance_and_neighbours_that_agree():
    basis = spline_basis(80, 5)
    assert basis.shape == (80, 8)
    covariance = basis @ basis.T
    np.testing.assert_allclose(np.diag(covariance), 1, rtol=1e-12)
    assert covariance[40, 41] > 0.99
    assert covariance[0, 79] == 0  # five pieces apart, no spline reaches both


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
def test_weights_are_a_distribution_with_the_wanted_effective_size(dtype, scale):
    cost = jnp.asarray(np.random.default_rng(0).normal(size=250) * scale, dtype)
    weights, temperature = path_integral_weights(cost, 12.0)
    assert weights.dtype == dtype
    assert float(jnp.sum(weights)) == pytest.approx(1, abs=1e-5)
    assert float(effective_count(weights)) == pytest.approx(12, rel=1e-2)
    assert jnp.argmax(weights) == jnp.argmin(cost)
    expected = jnp.exp(-(cost - cost.min()) / temperature)
    np.testing.assert_allclose(weights, expected / expected.sum(), rtol=2e-3, atol=1e-6)


def test_collisions_far_above_change_nothing_among_the_good():
    """Normalising costs by their range would make all good samples equal here."""
    good = jnp.asarray(np.random.default_rng(1).normal(size=100))
    outliers = jnp.concatenate([good, jnp.full(150, 1e9)])
    alone, temperature = path_integral_weights(good, 12.0)
    among, temperature_among = path_integral_weights(outliers, 12.0)
    np.testing.assert_allclose(among[:100], alone, rtol=1e-6)
    assert np.all(among[100:] == 0)
    assert float(temperature_among) == pytest.approx(float(temperature))


def test_weights_survive_costs_that_are_not_numbers():
    cost = jnp.array([jnp.nan, 3.0, jnp.inf, 2.0, jnp.nan])
    weights, _ = path_integral_weights(cost, 3.0)
    assert np.all(np.isfinite(weights))
    assert float(weights.sum()) == pytest.approx(1)
    assert np.all(weights[jnp.array([0, 2, 4])] == 0)
    for broken in (jnp.full(5, jnp.nan), jnp.full(5, jnp.inf)):
        weights, temperature = path_integral_weights(broken, 3.0)
        np.testing.assert_allclose(weights, 0.2)
        assert np.isfinite(temperature)


def test_equal_costs_get_equal_weights():
    weights, _ = path_integral_weights(jnp.full(40, 7.0), 10.0)
    np.testing.assert_allclose(weights, 1 / 40)


def test_risks_are_ordered_from_mean_to_worst():
    cost = jnp.asarray(np.random.default_rng(2).normal(size=(8, 30)))
    mean = combine_risk(cost, "mean", 0.5)
    half = combine_risk(cost, "cvar", 0.5)
    worst = combine_risk(cost, "worst", 0.5)
    np.testing.assert_allclose(worst, jnp.max(cost, axis=0))
    np.testing.assert_allclose(half, np.sort(cost, axis=0)[-4:].mean(axis=0))
    np.testing.assert_allclose(combine_risk(cost, "cvar", 1.0), mean)
    assert np.all((mean < half) & (half < worst))


def test_a_normal_clearance_gets_its_own_probability():
    """With many realisations the estimate is Φ(−μ/σ) of the law they come from."""
    rng = np.random.default_rng(3)
    clearance = jnp.asarray(rng.normal(0.2, 0.15, (200_000, 1)))
    probability, excess, missing = chance_violation(clearance, 0.05, 0.05)
    std = np.hypot(0.15, 0.05)
    true = norm.cdf(-0.2 / std)
    assert float(probability[0]) == pytest.approx(true, abs=2e-3)
    assert float(excess[0]) == pytest.approx(true - 0.05, abs=2e-3)
    assert float(missing[0]) == pytest.approx(norm.ppf(0.95) * std - 0.2, abs=2e-3)


def test_the_constraint_binds_exactly_at_alpha_and_grows_beyond_certainty():
    std, alpha = 0.1, 0.05
    edge = norm.ppf(1 - alpha) * std
    clearance = jnp.asarray([[edge + 1e-6, edge, edge - 0.01, -0.5, -1.0]])
    probability, excess, missing = chance_violation(clearance, alpha, std)
    assert float(probability[1]) == pytest.approx(alpha)
    np.testing.assert_allclose(missing, [0, 0, 0.01, edge + 0.5, edge + 1], atol=1e-9)
    assert excess[0] == 0 < excess[2]
    assert missing[4] > missing[3]  # where the probability no longer tells them apart


def test_spread_realisations_are_riskier_than_alike_ones_of_the_same_mean():
    alike, spread = jnp.full((4, 1), 0.3), jnp.asarray([[0.0], [0.2], [0.4], [0.6]])
    clearance = jnp.concatenate([alike, spread], axis=1)
    probability, _, missing = chance_violation(clearance, 0.05, 0.05)
    assert probability[0] < 0.01 < 0.05 < probability[1]
    assert missing[0] == 0 < missing[1]
