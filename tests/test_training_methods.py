"""Every method trains: a few steps on a tiny data set, with what its objective promises."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.models.euclidean import coordinates, create_spinn
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.data.windows import Windows
from spinndrift.training.fitting.fit import fit
from spinndrift.training.fitting.guard import Diagnosis, TrainingError
from spinndrift.training.losses.base import Batch
from spinndrift.training.losses.distance_aware_losses import DistanceAware, Unconstrained
from spinndrift.training.losses.euclidean_losses import EuclideanFdm, predict_coordinates
from spinndrift.training.methods import method_config
from spinndrift.training.predict import predict

STEPS, DT, GROUPS, RUNS = 6, 0.05, 3, 6
NOISE = (2.0, 2.0, 2.0, 0.2, 0.2, 0.2)
ONE_STEP = {"substeps": 1}
SMALL = {
    "fdm": {"samples": 3, "lags_s": (0.3,), "time_pairs": 3, "scales": (1.0,)},
    "moments": {"runs": RUNS, "samples": 1, "iterations": 1},
}


@pytest.fixture(scope="module")
def windows():
    """Groups of runs from rest, told with wrenches half as large again as those that acted."""
    rng = np.random.default_rng(0)
    F = rng.normal(size=(6, GROUPS)) * np.array([20, 20, 20, 1, 1, 3.0])[:, None]
    F = np.repeat(np.repeat(F, RUNS, axis=1)[None], STEPS, axis=0).astype(np.float32)
    W = GROUPS * RUNS
    X = np.zeros((7, W), np.float32)
    X[0] = 1
    V = np.zeros((6, W), np.float32)
    truth = load_vehicle("bluerov2_heavy").dynamics(np.array(NOISE), jnp.float32)
    Xs, Vs = eqx.filter_jit(predict)(
        truth, *(jnp.asarray(a) for a in (X, V, F)), DT, jax.random.key(0), 1, substeps=2
    )
    group, run = np.divmod(np.arange(W), RUNS)
    return Windows(
        X=np.concatenate([X[None], np.asarray(Xs)[:, :, 0]]),
        V=np.concatenate([V[None], np.asarray(Vs)[:, :, 0]]),
        F=1.5 * F,
        dt=DT,
        scenario=group,
        run=run,
        start=np.zeros(W),
        names=("a", "b", "c"),
    )


def small(name):
    """Return a method's settings with tiny networks and few samples."""
    config = method_config(name)
    kind = "fdm" if "fdm" in name else "moments" if "moments" in name else None
    objective = replace(config.objective, **ONE_STEP, **SMALL.get(kind, {}))
    return replace(
        config,
        model=replace(config.model, width=4, depth=1),
        objective=objective,
        steps=6,
        batch=GROUPS * RUNS,
        learning_rate=3e-2,
        head_decay=30.0,
        warm_up=0,
        refit_at=(),
        max_recoveries=2,
    )


def start(config):
    """Return a model at the preset."""
    reference = load_vehicle("bluerov2_heavy").dynamics(np.array(NOISE), jnp.float32)
    return create_spinn(config.model, reference, jax.random.key(0), jnp.float32)


@pytest.mark.parametrize(
    "name",
    [
        "euclidean-fdm",
        pytest.param("euclidean-moments", marks=pytest.mark.slow),
        pytest.param("euclidean-distance-aware", marks=pytest.mark.slow),
        pytest.param("euclidean-unconstrained", marks=pytest.mark.slow),
    ],
)
def test_a_few_steps_make_the_loss_smaller(name, windows):
    config = small(name)
    result = fit(config, start(config), windows)
    losses = result.metrics["loss"]
    assert result.events == ()
    assert np.isfinite(losses).all()
    assert losses[-2:].mean() < losses[:2].mean()


@pytest.mark.slow
def test_instability_ends_training_with_a_report(windows, monkeypatch):
    found = Diagnosis((), (), (), "motion runs away")  # what it looks for is tested with the guard
    monkeypatch.setattr("spinndrift.training.fitting.fit.explain_non_finite", lambda *_: found)
    config = replace(small("euclidean-unconstrained"), max_recoveries=1)
    with pytest.raises(TrainingError, match="step 1: motion runs away; more than 1 bad steps"):
        fit(config, start(config), replace(windows, V=1e25 * windows.V))


def test_predictions_stay_in_coordinates(windows):
    config = small("euclidean-fdm")
    batch = Batch.of(windows)
    q, V = eqx.filter_jit(predict_coordinates)(start(config), batch, DT, None, 1, substeps=1)
    X, twist = eqx.filter_jit(predict)(
        start(config), batch.X[0], batch.V[0], batch.F, DT, jax.random.key(0), 0,
        substeps=1, with_path_of_drift=True,
    )  # fmt: skip
    np.testing.assert_allclose(V, twist, atol=1e-5)
    np.testing.assert_allclose(np.moveaxis(coordinates(jnp.moveaxis(X, 1, 0)), 1, 0), q, atol=1e-5)


@pytest.mark.parametrize("objective", [EuclideanFdm(), DistanceAware(), Unconstrained()])
def test_objectives_in_coordinates_refuse_models_on_the_group(objective, windows):
    on_group = start(small("pinn"))
    with pytest.raises(UserError, match=r"no coordinates in R¹²; set model.coordinates to"):
        objective.build(on_group, windows)


@pytest.mark.parametrize("objective", [DistanceAware(), Unconstrained()])
def test_distance_aware_objectives_need_their_diffusion(objective, windows):
    model = start(small("euclidean-fdm"))
    with pytest.raises(UserError, match=r"diffusion is of kind network; set model.diffusion to"):
        objective.build(model, windows)


@pytest.mark.slow
def test_matching_hears_correlations_of_the_noise(windows):
    """The score of samples is best at the true correlation of sway and yaw, not at none."""
    config = small("fdm-geodesic")
    config = replace(config, model=replace(config.model, correlated=True))
    entry = 6 + 10 + 1  # below the diagonal, row by row: the sixth row begins with number 10
    model = start(config)

    def with_slope(value):
        assert model.diffusion_head is not None
        bias = model.diffusion_head.bias.at[0, entry].set(value)
        return eqx.tree_at(lambda m: m.diffusion_head.bias, model, bias)

    W = 512
    X = np.zeros((7, W), np.float32)
    X[0] = 1
    V, F = np.zeros((6, W), np.float32), np.zeros((STEPS, 6, W), np.float32)
    begin = tuple(jnp.asarray(a) for a in (X, V, F))
    Xs, Vs = eqx.filter_jit(predict)(with_slope(3.0), *begin, DT, jax.random.key(0), 1)
    seen = Windows(
        X=np.concatenate([X[None], np.asarray(Xs)[:, :, 0]]),
        V=np.concatenate([V[None], np.asarray(Vs)[:, :, 0]]),
        F=F,
        dt=DT,
        scenario=np.zeros(W, int),
        run=np.arange(W),
        start=np.zeros(W),
        names=("a",),
    )
    objective = replace(config.objective, samples=8, mse_weight=0.0).build(model, seen)
    score = eqx.filter_jit(lambda m: objective.loss(m, Batch.of(seen), jax.random.key(1))[0])
    true, none, opposite = (float(score(with_slope(s))) for s in (3.0, 0.0, -3.0))
    assert true < none < opposite
