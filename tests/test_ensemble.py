"""Several runs in one program: each as if it were alone, also where another fails or a break."""

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pytest
from diagonal import Diagonal, simulated

from spinndrift.training.config import TrainingConfig
from spinndrift.training.fitting.ensemble import fit_ensemble
from spinndrift.training.fitting.fit import TrainingResult, fit
from spinndrift.training.fitting.guard import TrainingError
from spinndrift.training.losses.matching import Mse

TRUTH = Diagonal.of(mass=10.0, drag=8.0, diffusion=1.0)
MODELS = [Diagonal.of(mass=14.0, drag=5.0, diffusion=2.0), Diagonal.of(12.0, 6.0, 0.5)]
SEEDS = [3, 4]
CONFIG = TrainingConfig(
    objective=Mse(substeps=1),
    steps=7,
    batch=6,
    learning_rate=1e-2,
    warm_up=2,
    refit_at=(),
    checkpoint_every=4,
    max_recoveries=1,
)


@pytest.fixture(scope="module")
def data():
    return [simulated(TRUTH, 20, seed=s) for s in SEEDS]


def leaves(model):
    return [np.asarray(a) for a in jax.tree.leaves(eqx.filter(model, eqx.is_array))]


def test_each_run_goes_as_if_it_were_alone(data):
    together = fit_ensemble(CONFIG, SEEDS, MODELS, data)
    for seed, model, own, result in zip(SEEDS, MODELS, data, together, strict=True):
        alone = fit(replace(CONFIG, seed=seed), model, own)
        assert isinstance(result, TrainingResult)
        for a, b in zip(leaves(result.last), leaves(alone.last), strict=True):
            # Adam's steps of about 1e-2 each, from gradients that agree to float32's rounding
            np.testing.assert_allclose(a, b, atol=1e-3 * CONFIG.learning_rate * CONFIG.steps)
        assert isinstance(result.last, Diagonal)
        moved = np.abs(result.last.log_mass - model.log_mass)
        assert moved.max() > CONFIG.learning_rate


def test_a_run_that_fails_leaves_the_others_alone(data):
    spoilt = replace(data[1], V=data[1].V.copy())
    spoilt.V[0] = np.where(np.arange(20) % 3 == 0, 1e30, spoilt.V[0])
    well, failed = fit_ensemble(CONFIG, SEEDS, MODELS, [data[0], spoilt])
    assert isinstance(failed, TrainingError)
    assert "more than 1 bad steps" in str(failed)
    assert isinstance(well, TrainingResult)
    assert well.steps == CONFIG.steps
    assert not well.events


@pytest.mark.slow
def test_a_break_changes_no_bit(data, tmp_path):
    def stop_at_five(step, total, loss):
        if step == 5:
            raise KeyboardInterrupt

    folders = [tmp_path / "broken" / str(s) for s in SEEDS]
    with pytest.raises(KeyboardInterrupt):
        fit_ensemble(CONFIG, SEEDS, MODELS, data, folders, progress=stop_at_five)
    resumed = fit_ensemble(CONFIG, SEEDS, MODELS, data, folders, resume=True)
    whole = fit_ensemble(CONFIG, SEEDS, MODELS, data)
    for a, b in zip(resumed, whole, strict=True):
        assert isinstance(a, TrainingResult)
        assert isinstance(b, TrainingResult)
        assert len(a.metrics["loss"]) == CONFIG.steps
        for x, y in zip(leaves(a.last), leaves(b.last), strict=True):
            np.testing.assert_array_equal(x, y)


def test_runs_must_be_of_one_kind(data):
    with pytest.raises(ValueError, match="2 seeds, 1 models, 2 windows"):
        fit_ensemble(CONFIG, SEEDS, MODELS[:1], data)
