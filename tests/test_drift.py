"""The first fit of the drift: what data tell is found, what they don't tell stays."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models.euclidean import create_spinn
from spinndrift.models.spinn import SpinnConfig
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.config import DriftConfig
from spinndrift.training.data.windows import Windows
from spinndrift.training.fitting.drift import fit_drift
from spinndrift.training.predict import predict_drift

SMALL = SpinnConfig(width=4, depth=1, constant_mass=True)
CONFIG = DriftConfig(iterations=6, length_s=1.0, pieces=40, prior=1e-6)
DT, STEPS, COUNT = 0.05, 20, 40
AXES = np.array([1, 1, 1, 0, 0, 1.0])  # wrenches that drive the vehicle: never roll nor pitch


@pytest.fixture(scope="module")
def truth():
    return load_vehicle("bluerov2_heavy").dynamics(dtype=jnp.float32)


def start(**settings):
    belief = load_vehicle("bluerov2_heavy_ng").dynamics(dtype=jnp.float32)
    return create_spinn(replace(SMALL, **settings), belief, jax.random.key(0), jnp.float32)


@pytest.fixture(scope="module")
def windows(truth):
    """Noise-free motions from rest, one axis at a time: couplings and attitude stay at rest."""
    rng = np.random.default_rng(0)
    axis = np.arange(COUNT) % 4
    F = np.zeros((STEPS, 6, COUNT), np.float32)
    size = np.array([40.0, 40.0, 60.0, 6.0])
    F[:, np.array([0, 1, 2, 5])[axis], np.arange(COUNT)] = size[axis] * rng.uniform(-1, 1, COUNT)
    X_0 = np.zeros((7, COUNT), np.float32)
    X_0[0] = 1
    V_0 = np.zeros((6, COUNT), np.float32)
    X, V = predict_drift(truth, *(jnp.asarray(a) for a in (X_0, V_0, F)), DT, substeps=2)
    index = np.arange(COUNT)
    return Windows(
        X=np.concatenate([X_0[None], np.asarray(X)]),
        V=np.concatenate([V_0[None], np.asarray(V)]),
        F=F,
        dt=DT,
        scenario=0 * index,
        run=index,
        start=0.0 * index,
        names=("all",),
    )


def miss(model, windows):
    """Root mean square error of the twist after a second, by axis."""
    arguments = (jnp.asarray(a) for a in (windows.X[0], windows.V[0], windows.F))
    _, V = predict_drift(model, *arguments, DT, substeps=2)
    return np.sqrt(np.mean((np.asarray(V[-1]) - windows.V[-1]) ** 2, axis=1))


def diagonal(model):
    return np.diag(np.asarray(model.coefficients(jnp.zeros(6, jnp.float32)).mass.matrix()))


@pytest.mark.slow
def test_what_the_data_tell_is_found(truth, windows):
    before = start()
    after = fit_drift(CONFIG, before, windows, 2)
    driven = AXES > 0
    assert (miss(after, windows) < 0.05 * miss(before, windows))[driven].all()
    np.testing.assert_allclose(diagonal(after)[driven], diagonal(truth)[driven], rtol=0.01)
    np.testing.assert_array_equal(after.hidden.weights[0], before.hidden.weights[0])


def test_a_strong_prior_keeps_the_preset(windows):
    before = start()
    after = fit_drift(replace(CONFIG, prior=1e6), before, windows, 2)
    np.testing.assert_allclose(diagonal(after), diagonal(before), rtol=1e-3)


def test_no_iterations_change_nothing(windows):
    model = start()
    assert fit_drift(replace(CONFIG, iterations=0), model, windows, 2) is model
