"""Training: one trace, resuming to the bit, bad steps named and survived, the truth found."""

import os
import signal
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diagonal import Diagonal, simulated

from spinndrift.models.config import typed_yaml as yaml
from spinndrift.models.config.errors import UserError
from spinndrift.models.files.checkpoint import load_model
from spinndrift.models.spinn import Spinn, SpinnConfig
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.config import PretrainConfig, TrainingConfig
from spinndrift.training.data.groups import batch_indices
from spinndrift.training.fitting.fit import Run, fit
from spinndrift.training.fitting.guard import TrainingError
from spinndrift.training.fitting.pretrain import coefficient_error, pretrain
from spinndrift.training.fitting.run_folder import RunFolder
from spinndrift.training.fitting.start import estimate_diffusion
from spinndrift.training.fitting.step import TrainStep, first_moments, learning_rate, partition
from spinndrift.training.losses.base import Batch
from spinndrift.training.losses.matching import Fdm, Mse

TRUTH = Diagonal.of(mass=10.0, drag=8.0, diffusion=1.0)
START = Diagonal.of(mass=14.0, drag=5.0, diffusion=2.0)
OBJECTIVE = Fdm(samples=4, lags_s=(0.2, 0.5), time_pairs=6, mse_weight=0.1, substeps=1)
CONFIG = TrainingConfig(
    objective=OBJECTIVE,
    steps=12,
    batch=6,
    learning_rate=1e-2,
    warm_up=2,
    refit_at=(0.5,),
    validate_every=4,
    checkpoint_every=5,
    max_recoveries=3,
)


@pytest.fixture(scope="module")
def windows():
    return simulated(TRUTH, 40)


@pytest.fixture(scope="module")
def validation():
    return simulated(TRUTH, 12, seed=1)


def leaves(model):
    return [np.asarray(a) for a in jax.tree.leaves(eqx.filter(model, eqx.is_array))]


def assert_same_bits(a, b):
    for x, y in zip(leaves(a), leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def poisoned(windows, index, value=np.nan):
    V = windows.V.copy()
    V[7, 2, index] = value
    return replace(windows, V=V)


# the step


def test_the_step_is_traced_once_and_returns_what_it_takes(windows):
    params, static = partition(START)
    step = TrainStep(CONFIG, params, static)
    objective = OBJECTIVE.build(START, windows)
    params = jax.tree.map(jnp.array, params)
    moments = first_moments(CONFIG, params)
    data = Batch.of(windows)
    kinds = [(a.dtype, a.weak_type) for a in jax.tree.leaves((params, moments))]
    for number in range(3):
        params, moments, report = step(
            params, moments, objective, data, np.arange(number, number + 6), 0, number, 0.01
        )
        assert bool(report.ok)
        assert [(a.dtype, a.weak_type) for a in jax.tree.leaves((params, moments))] == kinds
    assert step.traces == 1


def test_every_epoch_shows_every_window_once():
    usable = np.array([0, 1, 3, 4, 5, 8, 9])
    drawn = np.concatenate([batch_indices(3, n, 4, usable) for n in range(7)])
    for epoch in drawn.reshape(4, 7):
        assert sorted(epoch) == sorted(usable)
    assert not np.array_equal(drawn[:7], drawn[7:14])
    np.testing.assert_array_equal(batch_indices(3, 5, 4, usable), drawn[20:24])


def test_the_learning_rate_rises_and_falls():
    config = TrainingConfig(steps=100, warm_up=10, learning_rate=1.0, head_decay=1.0)
    rates = [learning_rate(config, n) for n in range(100)]
    assert rates[0] == pytest.approx(0.1)
    assert max(rates) == rates[9] == pytest.approx(1.0)
    assert rates[99] == pytest.approx(0.01, abs=1e-3)
    constant = replace(config, schedule="constant", warm_up=0)
    assert learning_rate(constant, 0) == learning_rate(constant, 99) == 1.0


# resuming


def test_a_resumed_run_ends_with_the_same_bits(windows, validation, tmp_path):
    whole = fit(CONFIG, START, windows, tmp_path / "whole", validation=validation)

    def stop_at_seven(step, total, loss):
        if step == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(CONFIG, START, windows, tmp_path / "cut", validation=validation, progress=stop_at_seven)
    steps = []
    cut = fit(
        CONFIG,
        START,
        windows,
        tmp_path / "cut",
        validation=validation,
        resume=True,
        progress=lambda step, total, loss: steps.append(step),
    )
    assert steps == list(range(8, 13))
    assert_same_bits(cut.last, whole.last)
    assert_same_bits(cut.model, whole.model)
    assert cut.best_step == whole.best_step
    assert set(cut.metrics) == set(whole.metrics)
    for name in set(whole.metrics) - {"seconds"}:
        np.testing.assert_array_equal(cut.metrics[name], whole.metrics[name])
    stored, _ = load_model(tmp_path / "cut" / "model.spinn")
    assert_same_bits(stored, cut.model)
    # nothing is left to do the third time
    again = fit(CONFIG, START, windows, tmp_path / "cut", validation=validation, resume=True)
    assert_same_bits(again.last, whole.last)


@pytest.mark.slow
def test_a_kill_costs_the_steps_since_the_checkpoint_alone(windows, tmp_path):
    whole = fit(CONFIG, START, windows)

    def die(step, total, loss):
        if step == 8:
            raise MemoryError  # nothing is tidied up on the way out

    with pytest.raises(MemoryError):
        fit(CONFIG, START, windows, tmp_path, progress=die)
    with (tmp_path / "metrics.csv").open("a") as handle:
        handle.write("5,0.1,0.2\n6,0.")  # rows after the checkpoint, the last one torn
    resumed = fit(CONFIG, START, windows, tmp_path, resume=True)
    assert_same_bits(resumed.last, whole.last)
    np.testing.assert_array_equal(resumed.metrics["step"], np.arange(12))


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_ends_the_step_and_leaves_a_checkpoint(windows, tmp_path):
    before = signal.getsignal(signal.SIGINT)
    seen = []

    def interrupt(step, total, loss):
        seen.append(step)
        if step == 3:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        fit(CONFIG, START, windows, tmp_path, progress=interrupt)
    assert seen == [1, 2, 3]
    assert signal.getsignal(signal.SIGINT) is before
    fit(CONFIG, START, windows, tmp_path, progress=interrupt, resume=True)
    assert seen[3] == 4


def test_a_checkpoint_of_other_data_or_settings_is_refused(windows, validation, tmp_path):
    fit(replace(CONFIG, steps=2), START, windows, tmp_path)
    with pytest.raises(UserError, match="other windows"):
        fit(CONFIG, START, validation, tmp_path, resume=True)
    with pytest.raises(UserError, match="batch is 6 there and 5 now"):
        fit(replace(CONFIG, batch=5), START, windows, tmp_path, resume=True)
    whole = (tmp_path / "checkpoint.npz").read_bytes()
    (tmp_path / "checkpoint.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match="not a whole spinndrift checkpoint"):
        fit(CONFIG, START, windows, tmp_path, resume=True)


def test_the_folder_tells_what_was_run(windows, tmp_path):
    fit(replace(CONFIG, steps=2), START, windows, tmp_path, metadata={"note": "here"})
    assert yaml.load(TrainingConfig, tmp_path / "config.yaml") == replace(CONFIG, steps=2)
    told = (tmp_path / "run.json").read_text()
    assert all(word in told for word in ("revision", "jax", '"data"', "first"))
    assert load_model(tmp_path / "model.spinn")[1]["note"] == "here"
    assert not list(tmp_path.glob(".*"))  # no temporary files


# faults


def test_a_poisoned_window_is_named_left_out_and_survived(windows, tmp_path):
    result = fit(replace(CONFIG, steps=20), START, poisoned(windows, 11), tmp_path)
    assert len(result.events) == 1
    text = result.events[0]["text"]
    assert "scenario 'second', run 11" in text
    assert "V_WB_B at 0.70 s" in text
    assert "left out" in text
    assert (result.metrics["ok"] == 0).sum() == 1
    assert all(np.isfinite(a).all() for a in leaves(result.model))


def test_a_poisoned_parameter_is_named_and_restored(windows):
    run = Run(CONFIG, START, windows, None, None, None)

    def poison(step, total, loss):
        if step == 8:
            run.state.params = eqx.tree_at(
                lambda p: p.log_drag, run.state.params, replace_fn=lambda a: a.at[2].set(jnp.nan)
            )

    result = run.go(poison, resume=False)
    (event,) = result.events
    assert event["step"] == 8
    assert "parameter log_drag is not finite" in event["text"]
    assert "state of step 5 restored" in event["text"]
    assert all(np.isfinite(a).all() for a in leaves(result.last))
    with pytest.raises(UserError, match="log_drag is not finite at the start"):
        fit(CONFIG, Diagonal.of(drag=np.nan), windows)


def test_a_motion_that_runs_away_is_named_and_skipped(windows):
    far = poisoned(windows, 4, 1.0)
    far.V[0, :, 4] = 1e30  # finite, but its square is not
    far.V[0, :, 21] = 1e30
    result = fit(replace(CONFIG, steps=8), START, far)
    (event,) = result.events  # both are left out at once, and the rate stays
    assert "scenario 'first', run 4" in event["text"] or "run 1" in event["text"]
    assert "left out from now on, with 1 more that run away" in event["text"]
    reference = fit(replace(CONFIG, steps=8), START, windows)
    np.testing.assert_array_equal(result.metrics["rate"], reference.metrics["rate"])
    assert all(np.isfinite(a).all() for a in leaves(result.model))


def test_a_rate_that_was_cut_recovers(windows):
    run = Run(replace(CONFIG, steps=60, schedule="constant"), START, windows, None, None, None)
    run.state.rate_scale = 1 / 64
    result = run.go(None, resume=False)
    late = result.metrics["rate"][-1] / CONFIG.learning_rate
    np.testing.assert_allclose(late, 2.0 ** (-6 + 59 / 50))


def test_a_start_that_runs_away_everywhere_is_refused(windows):
    stiff = Diagonal.of(mass=0.01, drag=100.0)
    with pytest.raises(UserError, match=r"40 of 40 windows at 0.1 s a step.*substeps"):
        fit(CONFIG, stiff, windows)


def test_it_gives_up_after_so_many_bad_steps_and_keeps_the_good_state(windows, tmp_path):
    spoilt = replace(windows, V=windows.V.copy())
    spoilt.V[0, :, ::3] = 1e30
    with pytest.raises(TrainingError, match=r"runs away.*more than 3 bad steps.*checkpoint.npz"):
        fit(CONFIG, START, spoilt, tmp_path)
    run = Run(CONFIG, START, spoilt, tmp_path, None, None)
    RunFolder(tmp_path).load(run.state, CONFIG, run.data_id)
    assert_same_bits(run.state.params, partition(START)[0])


# learning


@pytest.mark.slow
def test_the_truth_is_found():
    """From 40 % off in M and D and 100 % in b; the caller's own model stays as it was."""
    windows, validation = simulated(TRUTH, 200, seed=2), simulated(TRUTH, 50, seed=3)
    kept = leaves(START)
    config = replace(
        CONFIG,
        objective=replace(OBJECTIVE, samples=8, time_pairs=10),
        steps=250,
        batch=24,
        learning_rate=2e-2,
        validate_every=50,
        checkpoint_every=100,
    )
    result = fit(config, START, windows, validation=validation)
    for before, after in zip(kept, leaves(START), strict=True):
        np.testing.assert_array_equal(before, after)
    for name, tolerance in (("log_mass", 0.1), ("log_drag", 0.15), ("log_diffusion", 0.15)):
        error = np.abs(getattr(result.model, name) - getattr(TRUTH, name))
        assert error.max() < tolerance, name
    scores = result.metrics["validation"]
    assert np.nanmin(scores) < scores[np.isfinite(scores)][0]


def test_a_squared_error_alone_fits_the_drift(windows):
    config = replace(CONFIG, objective=Mse(substeps=1), steps=60, learning_rate=2e-2)
    result = fit(config, START, windows)
    assert isinstance(result.last, Diagonal)
    for name in ("log_mass", "log_drag"):
        before, after = (
            np.abs(getattr(m, name) - getattr(TRUTH, name)) for m in (START, result.last)
        )
        assert after.mean() < 0.5 * before.mean(), name
    np.testing.assert_array_equal(result.last.log_diffusion, START.log_diffusion)


def test_patience_ends_a_run_that_gets_no_better(windows, validation):
    config = replace(CONFIG, learning_rate=1e-12, patience=1, refit_at=(), validate_every=2)
    result = fit(config, START, windows, validation=validation)
    assert result.stopped_early
    assert result.steps < config.steps


def test_steps_that_only_harm_leave_the_start(windows, validation):
    """The start is among the models to choose from, also once bandwidths were fitted anew."""
    config = replace(CONFIG, learning_rate=0.5, head_decay=0.0, validate_every=3)
    result = fit(config, TRUTH, windows, validation=validation)
    assert result.best_step == 0
    assert_same_bits(result.model, TRUTH)
    with pytest.raises(AssertionError):
        assert_same_bits(result.last, TRUTH)


@pytest.mark.slow
def test_pretraining_brings_the_networks_to_the_preset():
    vehicle = load_vehicle("bluerov2_heavy")
    target = vehicle.dynamics(np.full(6, 0.5), jnp.float32)
    model = Spinn.create(
        SpinnConfig(width=8, depth=1, start="scale"),
        vehicle.dynamics(dtype=jnp.float32),
        jax.random.key(0),
        jnp.float32,
    )
    config = PretrainConfig(steps=400, batch=32)
    fitted, losses = pretrain(model, target, config, jax.random.key(1))
    assert losses[-10:].mean() < 0.01 * losses[0]
    same, taken = pretrain(fitted, target, replace(config, tolerance=1.0), jax.random.key(1))
    assert same is fitted
    assert taken.shape == (1,)
    V = jax.random.normal(jax.random.key(2), (6, 20), jnp.float32)
    X = jnp.zeros((7, 20), jnp.float32).at[0].set(1)
    error = [coefficient_error(m, target, V, X) for m in (model, fitted)]
    assert error[1] < 0.05 * error[0]


def test_a_decay_that_overshoots_is_refused():
    with pytest.raises(UserError, match="head_decay is 30"):
        TrainingConfig(learning_rate=0.1)


def test_a_drag_of_zero_needs_no_pretraining():
    target = load_vehicle("bluerov2_heavy_ng").dynamics(dtype=jnp.float32)  # linear about roll: 0
    model = Spinn.create(SpinnConfig(width=8, depth=1), target, jax.random.key(0), jnp.float32)
    assert pretrain(model, target, PretrainConfig(), jax.random.key(1))[0] is model


def test_the_first_guess_of_the_diffusion_is_of_the_right_size():
    vehicle = load_vehicle("bluerov2_heavy")
    b = np.array([2.0, 1.5, 1.0, 0.1, 0.1, 0.2])
    truth = vehicle.dynamics(b, jnp.float32)
    windows = simulated(truth, 400, steps=6, dt=0.05)
    found = estimate_diffusion(vehicle.dynamics(dtype=jnp.float32), windows, horizon_s=0.1)
    np.testing.assert_allclose(found, b, rtol=0.2)  # medians of 400 pieces on either side
