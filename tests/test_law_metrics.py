"""Metrics of laws: closed forms of W₂, scores that prefer the truth, floors that a truth meets."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diagonal import Diagonal
from scipy.optimize import linear_sum_assignment

from spinndrift.models import se3
from spinndrift.models.config.errors import UserError
from spinndrift.training.evaluation.law_metrics import (
    GroundMetric,
    LawSamples,
    compare_laws,
    group_mean,
    overall,
    wasserstein2,
)
from spinndrift.training.predict import predict

T, S = 4, 399
SCALE = np.array([0.3, 0.2, 0.4, 0.1, 0.2, 0.15])


def gaussian(seed, scale=1.0, shift=0.0, count=S):
    """Samples whose pose is exp of a Gaussian about a fixed pose, and whose twist is Gaussian."""
    rng = np.random.default_rng(seed)
    e = scale * SCALE[:, None] * rng.standard_normal((T, 6, count)) + shift
    center = se3.exp(jnp.asarray([1.0, -2, 0.5, 0.4, -0.3, 2.0]))
    X = jnp.stack([se3.retract(center[:, None], jnp.asarray(step)) for step in e])
    V = 0.2 * (scale * rng.standard_normal((T, 6, count)) + shift)
    return LawSamples(np.array(X), V)


def twists(values):
    """Samples that differ in V alone: (S, 6) at one time."""
    X = np.tile(np.asarray(se3.identity())[None, :, None], (1, 1, len(values)))
    return LawSamples(X, np.asarray(values, float).T[None])


@pytest.fixture(scope="module")
def truth():
    return gaussian(0), gaussian(1)


def test_w2_is_the_best_assignment():
    """For as many samples on both sides the best coupling is an assignment (Birkhoff)."""
    rng = np.random.default_rng(0)
    C = ((rng.standard_normal((60, 1, 5)) - rng.standard_normal((1, 60, 5))) ** 2).sum(-1)
    i, j = linear_sum_assignment(C)
    assert wasserstein2(C) == pytest.approx(np.sqrt(C[i, j].mean()), rel=1e-12)


def test_w2_of_unequal_counts_is_that_of_repeated_samples():
    rng = np.random.default_rng(1)
    C = ((rng.standard_normal((10, 1, 3)) - rng.standard_normal((1, 15, 3))) ** 2).sum(-1)
    repeated = np.repeat(np.repeat(C, 3, axis=0), 2, axis=1)
    assert wasserstein2(C) == pytest.approx(wasserstein2(repeated), rel=1e-10)
    assert wasserstein2(C[:, :1]) == pytest.approx(np.sqrt(C[:, 0].mean()))


def test_w2_of_translated_twists_is_the_translation():
    """W₂(μ, μ + a) = |a|, for any samples, exactly."""
    rng = np.random.default_rng(2)
    values = rng.standard_normal((60, 6))
    a = np.array([0.3, -0.1, 0.2, 0.5, 0.0, -0.4])
    d = compare_laws(twists(values + a), twists(values), twists(values), 0.1)
    assert d["w2"].sel(side="law").item() == pytest.approx(np.linalg.norm(a), rel=1e-9)
    assert d["w2"].sel(side="floor").item() == pytest.approx(0, abs=1e-9)
    row = overall(d)
    assert row["rmse_mean_velocity"]["value"] == pytest.approx(np.linalg.norm(a), rel=1e-9)
    assert row["rmse_mean_geodesic"]["value"] == pytest.approx(0, abs=1e-9)


def test_moving_the_world_moves_no_metric(truth):
    """d(h g, h g') = d(g, g'): the distance is left-invariant."""
    a, b = truth
    h = se3.exp(jnp.asarray([3.0, 1, -1, 0.2, 1.0, -2.0]))[:, None]

    def moved(samples):
        return LawSamples(np.stack([se3.compose(h, jnp.asarray(x)) for x in samples.X]), samples.V)

    here, there = compare_laws(a, b, a, 0.1), compare_laws(moved(a), moved(b), moved(a), 0.1)
    for name in ("w2", "energy_score", "rmse_mean", "rmse_samples", "spread"):
        np.testing.assert_allclose(here[name], there[name], rtol=1e-8, atol=1e-12)


def test_w2_of_gaussians_in_one_axis():
    """W₂² = (m₁ - m₂)² + (s₁ - s₂)² (Dowson and Landau 1982), up to sampling error."""
    rng = np.random.default_rng(3)
    count = 800
    a, b = np.zeros((count, 6)), np.zeros((count, 6))
    a[:, 2] = 1.0 + 0.5 * rng.standard_normal(count)
    b[:, 2] = 0.2 + 1.5 * rng.standard_normal(count)
    found = compare_laws(twists(a), twists(b), twists(b), 0.1)["w2"].sel(side="law").item()
    exact = np.sqrt(0.8**2 + 1.0**2)
    assert found == pytest.approx(exact, abs=4 * 1.5 / np.sqrt(count))
    # in one axis the best coupling is by rank
    by_rank = np.sqrt(np.mean((np.sort(a[:, 2]) - np.sort(b[:, 2])) ** 2))
    assert found == pytest.approx(by_rank, rel=1e-9)


def test_weights_scale_the_distance():
    values = np.random.default_rng(4).standard_normal((60, 6))
    a = np.array([0.3, 0, 0, 0, 0, 0.4])
    metric = GroundMetric(linear_velocity=2.0, angular_velocity=0.5)
    d = compare_laws(twists(values + a), twists(values), twists(values), 0.1, metric=metric)
    # one translation is still the best coupling: weights stretch the axes
    assert d["w2"].sel(side="law").item() == pytest.approx(np.hypot(0.6, 0.2), rel=1e-9)
    with pytest.raises(UserError, match="rotation"):
        GroundMetric(rotation=-1.0)


def test_the_truth_meets_its_floor(truth):
    """Two more sets of samples of the same law: each ratio is 1 but for sampling."""
    d = compare_laws(gaussian(2), *truth, 0.05)
    row = overall(d)
    for name in ("w2", "energy_score", "rmse_samples_geodesic", "spread_geodesic"):
        assert row[name]["ratio"] == pytest.approx(1, abs=0.05), name
    # the error of a mean of S samples against that of S others: √(2/S) of the spread
    for part in ("geodesic", "velocity"):
        expected = row[f"spread_{part}"]["value"] * np.sqrt(2 / S)
        assert row[f"rmse_mean_{part}"]["floor"] == pytest.approx(expected, rel=0.5)
        # and one sample against another: √2 of it
        pair = np.sqrt(2) * row[f"spread_{part}"]["value"]
        assert row[f"rmse_samples_{part}"]["value"] == pytest.approx(pair, rel=0.05)
    assert row["finite"]["value"] == 1
    np.testing.assert_allclose(d["time"], 0.05 * np.arange(1, T + 1))


def test_the_bands_of_the_true_law_cover_what_they_say(truth):
    d = compare_laws(gaussian(2), *truth, 0.05)["coverage"]
    for band in (0.5, 0.9):
        share = d.sel(band=band)
        assert share.shape == (2, 12, T)
        # a band from S samples and a share of S others: each adds the binomial variance
        error = np.sqrt(2 * band * (1 - band) / S)
        assert np.abs(share - band).max() < 4 * error
        assert abs(float(share.mean()) - band) < 4 * error / np.sqrt(48)


@pytest.mark.parametrize("wrong", [{"scale": 0.5}, {"scale": 1.6}, {"shift": 0.15}])
def test_scores_and_distances_prefer_the_truth(truth, wrong):
    """W₂ between samples alone doesn't: half as wide a law comes out at the floor."""
    right = compare_laws(gaussian(2), *truth, 0.05, other_predicted=gaussian(3))
    found = compare_laws(gaussian(2, **wrong), *truth, 0.05, other_predicted=gaussian(3, **wrong))
    row, best = overall(found), overall(right)
    assert row["w2_debiased"]["value"] > 2 * best["w2_debiased"]["value"]
    assert row["w2_debiased"]["value"] > 0.4 * row["w2"]["floor"]
    assert row["w2"]["ratio"] > (0.97 if wrong == {"scale": 0.5} else 1.1)
    assert row["energy_score"]["value"] > 1.02 * best["energy_score"]["value"]
    if "shift" in wrong:
        assert row["rmse_mean_geodesic"]["ratio"] > 3
    else:
        assert row["spread_geodesic"]["ratio"] == pytest.approx(wrong["scale"], rel=0.1)
        assert np.sign(row["coverage_90"]["value"] - 0.9) == np.sign(wrong["scale"] - 1)


def test_the_energy_score_by_hand():
    a, b = np.zeros((3, 6)), np.zeros((2, 6))
    a[:, 0], b[:, 0] = (0.0, 1.0, 3.0), (2.0, 4.0)
    d = compare_laws(twists(a), twists(b), twists(b), 0.1)["energy_score"]
    cross = np.mean([2, 1, 1, 4, 3, 1])
    assert d.sel(side="law").item() == pytest.approx(cross - np.mean([1, 3, 2]) / 2)


def test_a_deterministic_law_is_one_motion(truth):
    """It has no spread and no bands, W₂ is the root mean square distance, and √½ of the floor is
    all that its samples' error says of it."""
    mean = np.asarray(group_mean(jnp.asarray(truth[0].X)))[:, :, None]
    law = LawSamples(mean, truth[0].V.mean(axis=2, keepdims=True))
    row = overall(compare_laws(law, *truth, 0.05))
    assert row["spread_geodesic"]["value"] == pytest.approx(0, abs=1e-9)
    assert row["coverage_90"]["value"] == 0
    assert row["rmse_samples_geodesic"]["ratio"] == pytest.approx(np.sqrt(0.5), rel=0.05)
    sizes = np.hypot(row["spread_geodesic"]["floor"], row["spread_velocity"]["floor"])
    assert row["w2"]["value"] == pytest.approx(sizes, rel=0.05)
    copies = LawSamples(np.repeat(law.X, 25, axis=2), np.repeat(law.V, 25, axis=2))
    again = overall(compare_laws(copies, *truth, 0.05))
    for name in ("w2", "rmse_mean_geodesic", "rmse_samples_velocity", "energy_score"):
        assert again[name]["value"] == pytest.approx(row[name]["value"], rel=1e-9), name


def test_the_group_mean_is_where_logarithms_cancel(truth):
    X = jnp.asarray(truth[0].X)
    mean = group_mean(X)
    e = se3.local(mean.T[:, :, None], jnp.moveaxis(X, 1, 0))
    np.testing.assert_allclose(e.mean(axis=2), 0, atol=1e-12)


def test_motions_that_run_away_are_counted_and_left_out(truth):
    law = gaussian(2)
    law.V[-1, 0, ::4] = np.nan
    row = overall(compare_laws(law, *truth, 0.05))
    assert row["finite"]["value"] == pytest.approx(0.75, abs=0.01)
    assert row["w2"]["ratio"] == pytest.approx(1, abs=0.1)
    law.X[0, 5] = np.inf
    row = overall(compare_laws(law, *truth, 0.05))
    assert row["finite"]["value"] == 0
    assert np.isnan(row["w2"]["value"])
    with pytest.raises(ValueError, match="truth must be finite"):
        compare_laws(truth[0], law, truth[1], 0.05)
    with pytest.raises(ValueError, match="same times"):
        compare_laws(LawSamples(law.X[1:], law.V[1:]), *truth, 0.05)


def test_a_wrong_model_lies_above_the_floor_and_the_right_one_on_it():
    """Motions of ten steps in float32, as the study has them; W₂ at the times asked for."""
    models = (Diagonal.of(), Diagonal.of(), Diagonal.of(), Diagonal.of(drag=2.0, diffusion=4.0))
    start, rest = se3.identity(jnp.float32)[:, None], jnp.zeros((6, 1), jnp.float32)
    F = jnp.full((10, 6, 1), 2.0, jnp.float32)
    run = jax.jit(predict, static_argnums=(4, 6))
    a, b, c, d = (
        LawSamples(*(np.asarray(y)[..., 0] for y in run(m, start, rest, F, 0.2, key, 200)))
        for m, key in zip(models, jax.random.split(jax.random.key(0), 4), strict=True)
    )
    right = compare_laws(c, a, b, 0.2, times=5)
    np.testing.assert_allclose(right["time"], [0.4, 0.8, 1.2, 1.6, 2.0])
    assert overall(right)["w2"]["ratio"] == pytest.approx(1, abs=0.1)
    assert overall(compare_laws(d, a, b, 0.2, times=5))["w2"]["ratio"] > 1.5
