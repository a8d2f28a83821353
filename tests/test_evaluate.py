"""Evaluation: errors by hand, bands that cover what they say, proper scores, tables."""

import csv
import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from diagonal import Diagonal, simulated

from spinndrift.models import se3
from spinndrift.models.se3 import CHANNELS
from spinndrift.sims.reports.figures_learning import coverage_figure, error_figure, learning_figure
from spinndrift.training.evaluation.evaluate import evaluate
from spinndrift.training.evaluation.metrics import energy_score, order_statistics

pytestmark = pytest.mark.whole

TRUTH = Diagonal.of()
WRONG = Diagonal.of(mass=13.0, drag=5.0, diffusion=0.4)
SILENT = Diagonal.of(diffusion=1e-30)
COUNT = 320


@pytest.fixture(scope="module")
def windows():
    return simulated(TRUTH, COUNT, steps=12, seed=5)


@pytest.fixture(scope="module")
def evaluation(windows):
    return evaluate({"truth": TRUTH, "wrong": WRONG}, windows, samples=39)


def test_the_true_laws_bands_cover_what_they_say(evaluation):
    """The mean over windows is binomial about the band's probability, on every axis and horizon."""
    covered = evaluation.dataset["coverage"].sel(model="truth").isel(horizon=slice(1, None))
    # (the pose after one Lie-Euler step follows from the start alone and has no band)
    for band in (0.5, 0.9):
        share = covered.sel(band=band).to_numpy()
        assert share.shape == (12, 11)
        error = np.sqrt(band * (1 - band) / COUNT)
        assert np.abs(share - band).max() < 4.2 * error  # 132 places, not all independent
        assert abs(share.mean() - band) < 2 * error


def test_a_law_too_narrow_covers_less_and_scores_worse(evaluation):
    table = evaluation.overall()
    assert table["wrong"]["coverage_0.9"] < table["truth"]["coverage_0.9"] - 0.1
    for name in ("energy_pose", "energy_velocity", "rmse_geodesic", "rmse_velocity"):
        assert table["truth"][name] < table["wrong"][name]
    assert table["truth"]["finite"] == 1.0


def test_errors_grow_with_the_horizon_and_add_up(evaluation):
    d = evaluation.dataset.sel(model="truth")
    squares = d["rmse"].sel(norm="position") ** 2 + d["rmse"].sel(norm="rotation") ** 2
    np.testing.assert_allclose(squares, d["rmse"].sel(norm="geodesic") ** 2, rtol=1e-5)
    by_axis = (d["rmse_axis"] ** 2).sel(axis=["x", "y", "z"]).sum("axis")
    np.testing.assert_allclose(by_axis, d["rmse"].sel(norm="position") ** 2, rtol=1e-5)
    position = d["rmse"].sel(norm="position").to_numpy()
    assert (np.diff(position) > 0).all()
    assert (d["rmse_samples"] > d["rmse_mean"]).isel(horizon=slice(1, None)).all()
    np.testing.assert_allclose(d["horizon"], 0.1 * np.arange(1, 13))


def test_errors_by_hand():
    """A law without noise against its own motion moved aside by 3 and 4 cm."""
    windows = simulated(SILENT, 5, steps=4)
    moved = windows.X.copy()
    moved[1:, 4] += 0.03
    moved[1:, 5] += 0.04
    found = evaluate({"m": SILENT}, replace(windows, X=moved), samples=19).dataset.isel(model=0)
    np.testing.assert_allclose(found["rmse"].sel(norm="position"), 0.05, rtol=1e-4)
    np.testing.assert_allclose(found["rmse"].sel(norm="rotation"), 0, atol=1e-6)
    np.testing.assert_allclose(found["rmse"].sel(norm="velocity"), 0, atol=1e-6)


def test_bands_have_exact_ranks():
    assert order_statistics(19, 0.9) == (0, 18)
    assert order_statistics(59, 0.5) == (14, 44)
    rng = np.random.default_rng(0)
    draws = np.sort(rng.normal(size=(20000, 20))[:, :19], axis=1)
    y = np.random.default_rng(1).normal(size=20000)
    for band in (0.5, 0.9):
        lo, hi = order_statistics(19, band)
        share = ((draws[:, lo] <= y) & (y <= draws[:, hi])).mean()
        assert abs(share - band) < 4 * np.sqrt(band * (1 - band) / 20000)
    with pytest.raises(ValueError, match="19, 39, 59"):
        order_statistics(50, 0.9)


def test_the_energy_score_by_its_definition():
    keys = jax.random.split(jax.random.key(0), 4)
    X = se3.exp(jax.random.normal(keys[0], (6, 2, 5, 3)))
    V = jax.random.normal(keys[1], (2, 6, 5, 3))
    Y = se3.exp(jax.random.normal(keys[2], (6, 2, 3)))
    Z = jax.random.normal(keys[3], (2, 6, 3))
    pose, velocity = energy_score(jnp.moveaxis(X, 0, 1), V, jnp.moveaxis(Y, 0, 1), Z)
    every = jax.jit(jax.vmap(jax.vmap(se3.local, (None, 1), 1), (1, None), 1))
    off = ~np.eye(5, dtype=bool)
    for t in range(2):
        for w in range(3):
            x, v = X[:, t, :, w], np.asarray(V[t, :, :, w])
            own = np.linalg.norm(every(x, x), axis=0)[off].mean()
            cross = np.linalg.norm(every(Y[:, t, w : w + 1], x), axis=0).mean()
            assert pose[t, w] == pytest.approx(cross - own / 2, rel=1e-9)
            own = np.linalg.norm(v[:, :, None] - v[:, None], axis=0)[off].mean()
            cross = np.linalg.norm(v - np.asarray(Z)[t, :, w][:, None], axis=0).mean()
            assert velocity[t, w] == pytest.approx(cross - own / 2, rel=1e-9)


def test_tables_are_tidy_and_whole(evaluation, tmp_path):
    for suffix in (".csv", ".json", ".nc"):
        evaluation.save(tmp_path / f"evaluation{suffix}")
    with (tmp_path / "evaluation.csv").open() as handle:
        rows = list(csv.DictReader(handle))
    picked = [
        r
        for r in rows
        if (r["model"], r["quantity"], r["of"], r["band"]) == ("wrong", "coverage", "yaw", "0.9")
    ]
    expected = evaluation.dataset["coverage"].sel(model="wrong", axis="yaw", band=0.9)
    np.testing.assert_allclose([float(r["value"]) for r in picked], expected)
    assert {r["of"] for r in rows if r["quantity"] == "rmse_axis"} == set(CHANNELS)
    assert json.loads((tmp_path / "evaluation.json").read_text())["truth"]["finite"] == 1.0
    xr.testing.assert_allclose(
        xr.load_dataset(tmp_path / "evaluation.nc", engine="h5netcdf"), evaluation.dataset
    )
    assert "truth" in evaluation.summary()
    with pytest.raises(ValueError, match=r"\.csv, \.json or \.nc"):
        evaluation.save(tmp_path / "evaluation.txt")


def test_figures_show_every_model(evaluation):
    lines = [len(ax.lines) for ax in error_figure(evaluation).axes]
    assert lines == [2, 2, 2, 2]
    assert [len(ax.patches) for ax in coverage_figure(evaluation).axes] == [24, 24]
    metrics = {
        "step": np.arange(40),
        "loss": np.linspace(1, 0, 40),
        "score": np.linspace(0, 1, 40),
        "validation": np.where(np.arange(40) % 10 == 9, 0.5, np.nan),
    }
    assert [len(ax.lines) for ax in learning_figure(metrics).axes] == [2, 1]


def test_windows_where_a_model_runs_away_are_counted_and_left_out(windows):
    few = windows.take(range(20))
    V = few.V.copy()
    V[0, 0, 3] = np.inf
    found = evaluate({"truth": TRUTH}, replace(few, V=V), samples=19).dataset.isel(model=0)
    assert float(found["finite"]) == pytest.approx(19 / 20)
    assert np.isfinite(found["rmse"]).all()
