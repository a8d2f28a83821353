"""Moment matching: the mean on SE(3) and its gradient, and a loss that is least at the truth."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from diagonal import Diagonal, simulated

from spinndrift.models import se3
from spinndrift.training.config import TrainingConfig
from spinndrift.training.data.groups import whole_groups
from spinndrift.training.fitting.fit import fit
from spinndrift.training.losses.base import Batch
from spinndrift.training.losses.moments import Moments, group_mean, pooled, pose_moments

TRUTH = Diagonal.of(mass=10.0, drag=8.0, diffusion=2.0)
mean_of = jax.jit(group_mean)


@jax.jit
def cloud(center, xi):
    """Poses center exp(xi_s)."""
    return se3.retract(center[..., None], xi)


def spread(seed, size, *batch, samples=12):
    return jnp.asarray(size * np.random.default_rng(seed).normal(size=(6, *batch, samples)))


@pytest.fixture(scope="module")
def center():
    return jax.jit(se3.exp)(jnp.asarray(np.random.default_rng(9).normal(size=6)))


local = jax.jit(se3.local)


@jax.jit
def cost(xi, center, X):
    return jnp.sum(se3.local(se3.retract(center, xi)[:, None], X) ** 2)


def least(center, X):
    slope = jax.jit(jax.grad(cost))
    return scipy.optimize.minimize(cost, np.zeros(6), (center, X), jac=slope, tol=1e-12)


def test_the_mean_of_rotations_is_the_minimiser_of_squared_distances(center):
    xi = spread(0, 0.7).at[:3].set(0)
    X = cloud(center, xi)
    np.testing.assert_allclose(local(center, mean_of(X)), least(center, X).x, atol=1e-6)


def test_the_mean_of_poses_is_the_minimiser_to_second_order(center):
    # squared distances are not bi-invariant on SE(3): where position and rotation are correlated,
    # the zero of the mean logarithm (what the iteration finds) is not quite the minimiser
    excess = []
    for size in (0.2, 0.1):
        X = cloud(center, spread(0, size))
        least_cost = least(center, X).fun
        excess.append(float(cost(local(center, mean_of(X)), center, X)) / least_cost - 1)
    assert excess[0] / excess[1] == pytest.approx(4, rel=0.1)


def test_the_mean_of_log_vanishes_there(center):
    X = cloud(center, spread(1, 0.6))
    residual = jnp.mean(local(mean_of(X)[:, None], X), axis=1)
    np.testing.assert_allclose(residual, 0, atol=1e-12)


def test_known_means(center):
    xi = spread(2, 0.8, samples=5)
    both = jnp.concatenate([xi, -xi], axis=1)
    np.testing.assert_allclose(local(center, mean_of(cloud(center, both))), 0, atol=1e-11)
    same = jnp.broadcast_to(center[:, None], (7, 4))
    np.testing.assert_allclose(local(center, mean_of(same)), 0, atol=1e-14)
    signs = jnp.asarray([1, -1, -1, 1.0])  # q and -q are one pose
    flipped = jnp.concatenate([signs[None] * same[:4], same[4:]])
    np.testing.assert_allclose(local(center, mean_of(flipped)), 0, atol=1e-12)
    positions = jnp.concatenate([xi[:3], jnp.zeros((3, 5))])
    X = cloud(se3.identity(), positions)
    np.testing.assert_allclose(mean_of(X)[4:], jnp.mean(xi[:3], axis=1), atol=1e-14)


def test_the_mean_is_left_invariant_and_takes_any_batch(center):
    X = cloud(jnp.broadcast_to(center[:, None, None], (7, 2, 3)), spread(3, 0.5, 2, 3))
    moved = mean_of(se3.compose(center[:, None, None, None], X))
    np.testing.assert_allclose(moved, se3.compose(center[:, None, None], mean_of(X)), atol=1e-12)
    one_by_one = mean_of(X[:, 1, 2])
    np.testing.assert_allclose(mean_of(X)[:, 1, 2], one_by_one, atol=1e-12)


@pytest.mark.parametrize("size", [0.1, 0.7])
def test_its_gradient_is_that_of_the_mean_itself(center, size):
    xi, weight = spread(4, size), jnp.asarray(np.random.default_rng(5).normal(size=6))

    @jax.jit
    def value(xi):
        return jnp.sum(weight * se3.local(center, group_mean(cloud(center, xi))))

    gradient = np.asarray(jax.jit(jax.grad(value))(xi))
    rng = np.random.default_rng(6)
    for _ in range(4):
        d = rng.normal(size=xi.shape)
        h = 1e-6
        slope = float(value(xi + h * d) - value(xi - h * d)) / (2 * h)
        # the series of J_l⁻¹ ends at the sixth power
        assert np.sum(gradient * d) == pytest.approx(slope, rel=1e-6 if size < 0.5 else 1e-4)


def test_the_covariance_is_that_of_the_algebra_where_samples_are_close(center):
    xi = spread(7, 1e-3, samples=50)
    found = jax.jit(pose_moments)(cloud(center, xi))[1]
    np.testing.assert_allclose(found, np.cov(xi, bias=True), rtol=1e-2, atol=1e-9)


def test_pooling_keeps_groups_apart():
    T, C, P, G, K = 2, 3, 4, 5, 6
    a = np.arange(1.0 * T * C * P * G * K).reshape(T, C, P, G * K)
    found = np.asarray(pooled(jnp.asarray(a), K))
    assert found.shape == (C, T, G, P * K)
    for g in range(G):
        expected = a[:, :, :, g * K : (g + 1) * K]
        np.testing.assert_array_equal(
            np.sort(found[:, :, g], axis=-1),
            np.sort(np.moveaxis(expected, 1, 0).reshape(C, T, -1), axis=-1),
        )
    np.testing.assert_array_equal(pooled(jnp.asarray(a[:, :, 0]), K)[1, 0, 2], a[0, 1, 0, 12:18])


def grouped(seed=0, groups=8, size=24, steps=8):
    """Windows in groups with equal starts and commands, and independent noise."""
    ends = simulated(TRUTH, groups, steps=steps)
    repeated = ends.take(np.repeat(np.arange(groups), size))
    again = jax.jit(_simulate, static_argnums=4)(
        jnp.asarray(repeated.X[0]), jnp.asarray(repeated.V[0]), jnp.asarray(repeated.F),
        jax.random.key(seed), repeated.dt,
    )  # fmt: skip
    X, V = (np.concatenate([a[:1], np.asarray(b)]) for a, b in zip(
        (repeated.X, repeated.V), again, strict=True))  # fmt: skip
    group, run = np.divmod(np.arange(groups * size), size)
    return replace(repeated, X=X, V=V, scenario=group % 2, run=run, start=group // 2 * 1.0)


def _simulate(X, V, F, key, dt):
    from spinndrift.training.predict import predict

    Xs, Vs = predict(TRUTH, X, V, F, dt, key, 1)
    return Xs[:, :, 0], Vs[:, :, 0]


@pytest.fixture(scope="module")
def windows():
    return grouped()


def test_the_loss_is_least_at_the_truth(windows):
    config = Moments(runs=24, samples=8, mse_weight=1e-6, substeps=1, iterations=2)
    objective = config.build(TRUTH, windows)
    batch = Batch.of(whole_groups(windows, 24, len(windows)))
    loss = eqx.filter_jit(lambda model: objective.loss(model, batch, jax.random.key(1)))
    truth, parts = loss(TRUTH)
    wrong = {
        "mass": Diagonal.of(mass=14.0, drag=8.0, diffusion=2.0),
        "drag": Diagonal.of(mass=10.0, drag=5.0, diffusion=2.0),
        "more noise": Diagonal.of(mass=10.0, drag=8.0, diffusion=3.0),
        "less noise": Diagonal.of(mass=10.0, drag=8.0, diffusion=1.0),
    }
    for name, model in wrong.items():
        value, found = loss(model)
        assert float(value) > 1.2 * float(truth), name
        part = "covariance" if "noise" in name else "mean"
        assert float(found[f"pose_{part}"]) > float(parts[f"pose_{part}"]), name
        assert float(found[f"velocity_{part}"]) > 2 * float(parts[f"velocity_{part}"]), name


def test_SI_units_are_one(windows):
    objective = Moments(unit="SI", substeps=1).build(TRUTH, windows)
    np.testing.assert_array_equal(objective.pose_unit, 1)
    np.testing.assert_array_equal(objective.velocity_unit, 1)


def test_typical_units_are_the_deviation_within_groups(windows):
    objective = Moments(runs=24, substeps=1).build(TRUTH, windows)
    spreads = np.asarray(objective.velocity_unit)
    V = windows.V[1:].reshape(8, 6, 8, 24)
    np.testing.assert_allclose(spreads, np.sqrt(V.var(axis=3).mean(axis=2)).T, rtol=1e-4)


CONFIG = TrainingConfig(
    objective=Moments(runs=6, samples=1, substeps=1, iterations=1),
    steps=6,
    batch=12,
    warm_up=1,
    refit_at=(),
    checkpoint_every=2,
)


@pytest.mark.slow
def test_training_on_groups_resumes_to_the_same_bits(windows, tmp_path):
    start = Diagonal.of(mass=14.0, drag=5.0, diffusion=3.0)
    whole = fit(CONFIG, start, windows, tmp_path / "whole")

    def stop(step, total, loss):
        if step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(CONFIG, start, windows, tmp_path / "cut", progress=stop)
    resumed = fit(CONFIG, start, windows, tmp_path / "cut", resume=True)
    for a, b in zip(jax.tree.leaves(whole.last), jax.tree.leaves(resumed.last), strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.isfinite(whole.metrics["loss"]).all()


@pytest.mark.slow
def test_a_group_with_broken_data_is_named_and_left_out(windows):
    V = windows.V.copy()
    V[3, 0, 24:48] = np.nan
    result = fit(CONFIG, TRUTH, replace(windows, V=V))
    assert result.steps == CONFIG.steps
    assert 1 <= len(result.events) <= 4
    for event in result.events:
        assert event["text"].count("scenario 'second'") == 6
        assert "left out" in event["text"]
