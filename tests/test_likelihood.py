"""The fit to innovations: as near the truth as the data allow, and left out where it misleads."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from spinndrift.models.euclidean import create_spinn
from spinndrift.models.spinn import SpinnConfig
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.config import DriftConfig
from spinndrift.training.data.generate import GenerateConfig, generate
from spinndrift.training.data.windows import make_windows
from spinndrift.training.fitting.constants import constants
from spinndrift.training.fitting.likelihood import fit_innovations

B = (1.0, 1.0, 1.0, 0.05, 0.05, 0.05)
SUBSTEPS = 2
DATA = GenerateConfig(trajectories=2, duration=8.0, substeps=SUBSTEPS, diffusion=B)
TRUTH = load_vehicle("bluerov2_heavy")
CONFIG = DriftConfig()
SEEDS = 3


@pytest.fixture(scope="module")
def model():
    belief = load_vehicle("bluerov2_heavy_ng").dynamics(dtype=jnp.float32)
    config = SpinnConfig(width=4, depth=1, constant_mass=True)
    return create_spinn(config, belief, jax.random.key(0), jnp.float32)


@pytest.fixture(scope="module")
def data():
    """Several recordings of 20 motions of 8 s each."""
    recordings = (generate(replace(DATA, seed=seed), TRUTH) for seed in range(SEEDS))
    return [make_windows(r, TRUTH, length_s=4.0, stride_s=4.0) for r in recordings]


@pytest.fixture(scope="module")
def found(model, data):
    return [fit_innovations(CONFIG, model, windows, SUBSTEPS) for windows in data]


def inertia(model):
    """Logarithms of M's diagonal."""
    M = model.coefficients(jnp.zeros(6, jnp.float32)).mass.matrix()
    return jnp.log(jnp.diag(M))


TRUE_INERTIA = np.asarray(inertia(TRUTH.dynamics(dtype=jnp.float32)), float)


@pytest.mark.slow
def test_the_constants_spread_as_the_cramer_rao_bound_says(model, found):
    """Errors in units of the bound's own are normal: squares of 18 sum to χ²."""
    unravel = ravel_pytree(constants(model))[1]

    def of(values):
        return inertia(eqx.tree_at(constants, model, unravel(values)))

    squares = []
    for fitted in found:
        J = np.asarray(jax.jacfwd(of)(jnp.asarray(fitted.values, jnp.float32)), float)
        variance = np.diag(J @ np.linalg.solve(fitted.information, J.T))
        error = np.asarray(inertia(fitted.apply(model)), float) - TRUE_INERTIA
        squares.append(error**2 / variance)
    count = 6 * SEEDS
    assert count / 5 < np.sum(squares) < count + 5 * (2 * count) ** 0.5


@pytest.mark.slow
def test_the_diffusion_is_found(data, found):
    for windows, fitted in zip(data, found, strict=True):
        numbers = windows.steps * len(windows)
        # that of M, which b is known in proportion to, comes on top of b's own error
        np.testing.assert_allclose(fitted.diffusion, B, rtol=10 / (2 * numbers) ** 0.5)
        assert fitted.white(CONFIG.white)


@pytest.mark.slow
def test_noisy_states_are_left_to_the_fit_of_pieces(model, data):
    windows = data[0]
    size = np.std(np.diff(windows.V, axis=0), axis=(0, 2))[:, None]
    noise = size * np.random.default_rng(0).standard_normal(windows.V.shape)
    noisy = replace(windows, V=windows.V + noise.astype(np.float32))
    assert fit_innovations(CONFIG, model, noisy, SUBSTEPS) is None
    always = fit_innovations(replace(CONFIG, innovations="always"), model, noisy, SUBSTEPS)
    assert always is not None
    assert not always.white(CONFIG.white)


@pytest.mark.parametrize("change", [{"innovations": "never"}, {"iterations": 0}])
def test_it_can_be_left_out(model, data, change):
    assert fit_innovations(replace(CONFIG, **change), model, data[0], SUBSTEPS) is None
