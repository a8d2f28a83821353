"""Pushes that last: a latent state of the model, in training and in the diagram."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import integrate
from spinndrift.models.config.errors import UserError
from spinndrift.models.disturbances import OrnsteinUhlenbeckWrench
from spinndrift.models.files.checkpoint import load_model, save_model
from spinndrift.models.lasting import whitened
from spinndrift.models.mean_reverting import MeanReverting
from spinndrift.models.spinn import Spinn, SpinnConfig
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.station.config import StationConfig
from spinndrift.training.data.generate import GenerateConfig, generate
from spinndrift.training.fitting.noise_growth import Twists, with_growth
from spinndrift.training.predict import predict

B = np.array([2.0, 2.0, 2.0, 0.2, 0.2, 0.2])
TIME = np.array([0.5, 1.0, 2.0, 0.5, 1.0, 2.0])
RATIO = 1.5


@pytest.fixture(scope="module")
def model() -> Spinn:
    """A SPINN at a preset, with pushes of the given time constants."""
    config = SpinnConfig(width=4, depth=1, mean_reverting=True)
    reference = load_vehicle("bluerov2_heavy").dynamics(B)
    made = Spinn.create(config, reference, jax.random.key(0))
    lasting = MeanReverting(jnp.full(6, np.log(RATIO)), jnp.asarray(np.log(TIME)))
    return eqx.tree_at(lambda m: m.lasting, made, lasting)


def test_pushes_are_stationary_and_forget_with_their_time_constant(model):
    dt, T, n = 0.25, 9, 20_000
    w = jax.random.normal(jax.random.key(1), (T, 6, n))
    F = np.asarray(eqx.filter_jit(model.lasting_push)(w, dt))
    std = RATIO * B / np.sqrt(2 * TIME)
    np.testing.assert_allclose(model.lasting.std(model.scales.diffusion), std, rtol=1e-12)
    np.testing.assert_allclose(F.std(axis=2), np.tile(std, (T, 1)), rtol=0.03)
    for lag in (1, 4, 8):
        found = np.mean(F[0] * F[lag], axis=1) / std**2
        np.testing.assert_allclose(found, np.exp(-lag * dt / TIME), atol=0.03)


@pytest.mark.slow
def test_a_rollout_feels_them_as_a_wrench(model):
    rng, dt, S = np.random.default_rng(0), 0.05, 2
    X = jnp.tile(jnp.eye(7)[:, :1], (1, 5))
    V, F = jnp.asarray(0.3 * rng.normal(size=(6, 5))), jnp.asarray(rng.normal(size=(4, 6)))
    dW = jnp.asarray(rng.normal(size=(4, S, 12, 5))) * np.sqrt(dt / S)
    roll = eqx.filter_jit(integrate.rollout)
    found = roll(model, X, V, F, dt, dW)
    w = dW[:, :, 6:].reshape(8, 6, 5) / np.sqrt(dt / S)
    push = model.lasting_push(w, dt / S)
    plain = replace(model, lasting=None)
    held = jnp.repeat(F, S, axis=0)[:, :, None] + push
    wanted = roll(plain, X, V, held, dt / S, dW[:, :, :6].reshape(8, 1, 6, 5))
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(a, b[S - 1 :: S], rtol=1e-10, atol=1e-12)
    quiet = roll(model, X, V, F, dt, dW[:, :, :6])
    for a, b in zip(quiet, roll(plain, X, V, F, dt, dW[:, :, :6]), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_white_noise_of_the_same_strength_strays_as_far_over_long_times(model):
    """Without drag's help: after 20 τ the impulse of both has the same variance within 5 %."""
    dt, T, n = 0.05, 800, 4000
    axis = 0
    w = jax.random.normal(jax.random.key(2), (T, 6, n))
    impulse = np.asarray(eqx.filter_jit(model.lasting_push)(w, dt)).sum(axis=0)[axis] * dt
    own = np.asarray(model.scales.diffusion)[axis]
    white = np.asarray(model.whitened().scales.diffusion)[axis]
    expected = (white**2 - own**2) * T * dt * (1 - TIME[axis] / (T * dt))
    assert np.var(impulse) == pytest.approx(expected, rel=0.05)
    assert model.whitened().brownian_size == 6


@pytest.mark.slow
def test_training_can_move_them(model):
    """Samples' spread grows with the pushes, and its gradient reaches strength and time."""
    W, T = 4, 6
    X = jnp.tile(jnp.eye(7)[:, :1], (1, W))
    V, F = jnp.zeros((6, W)), jnp.zeros((T, 6, W))
    learned, rest = eqx.partition(model, model.trainable())

    def spread(learned):
        _, V_end = predict(eqx.combine(learned, rest), X, V, F, 0.1, jax.random.key(0), 64)
        return jnp.mean(V_end[-1, 0] ** 2)

    slope = eqx.filter_jit(eqx.filter_grad(spread))(learned).lasting
    assert slope.log_ratio[0] > 0
    assert slope.log_time[0] != 0
    np.testing.assert_allclose(slope.log_ratio[1], 0, atol=0.1 * float(slope.log_ratio[0]))


def test_a_checkpoint_brings_them_into_the_diagram(model, tmp_path):
    path = tmp_path / "model.spinn"
    save_model(path, model)
    again = load_model(path, float)[0]
    assert isinstance(again, Spinn)
    assert again.lasting is not None
    np.testing.assert_array_equal(again.lasting.log_time, model.lasting.log_time)
    water = StationConfig(model=path).disturbance()
    (found,) = [m for m in water.members if isinstance(m, OrnsteinUhlenbeckWrench)]
    np.testing.assert_allclose(found.time_constant, TIME)
    np.testing.assert_allclose(found.std, RATIO * B / np.sqrt(2 * TIME))


def test_simulated_recordings_have_them(model):
    vehicle = load_vehicle("bluerov2_heavy")
    config = GenerateConfig(("surge-forward",), 200, 2.0, rate=10.0, substeps=2, effort=0.01)
    plain = replace(model, lasting=None, config=replace(model.config, mean_reverting=False))

    def spread(made: Spinn) -> np.ndarray:
        V = generate(config, vehicle, dynamics=made).dataset["V_WB_B"].to_numpy()
        return V.reshape(200, -1, 6)[:, -1].std(axis=0)

    # 1.5 b over long times, and half of it in two seconds of drag: a third more; 200 runs tell 7 %
    assert (spread(model) > 1.15 * spread(plain))[:3].all()


def test_white_noise_instead_of_them_keeps_what_grows_with_speed(model):
    seen = Twists(np.ones(6), np.full(6, 2.0))
    grown = with_growth(model, np.ones((6, 7)), seen)
    V = jnp.asarray([0.5, 1.0, -0.5, 1.5, 0.2, 0.1])
    own = np.asarray(grown.mass_and_diffusion(V)[1])
    white = np.asarray(whitened(grown).mass_and_diffusion(V)[1])
    np.testing.assert_allclose(white**2, own**2 + (RATIO * B) ** 2, rtol=1e-6)
    assert whitened(grown).brownian_size == 6


@pytest.mark.parametrize("other", [{"stochastic": False}, {"coordinates": "euler"}])
def test_they_need_a_stochastic_model_on_the_group(other):
    with pytest.raises(UserError, match=r"SpinnConfig.mean_reverting"):
        SpinnConfig(mean_reverting=True, **other)
