"""Training over several devices: the numbers are those of one device."""

import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from diagonal import Diagonal, simulated

from spinndrift.training.config import TrainingConfig
from spinndrift.training.fitting.fit import fit
from spinndrift.training.fitting.step import usable_devices
from spinndrift.training.losses.distance_aware_losses import DistanceAwareObjective
from spinndrift.training.losses.matching import Fdm

CONFIG = TrainingConfig(
    objective=Fdm(
        pose_kernel="chordal",
        samples=4,
        lags_s=(0.5,),
        time_pairs=2,
        scales=(1.0,),
        substeps=1,
        mse_weight=0.0,
    ),
    steps=5,
    batch=6,
    learning_rate=1e-2,
    warm_up=1,
    refit_at=(),
    validate_every=2,
)
START = Diagonal.of(mass=14.0, drag=5.0, diffusion=2.0)


def learned() -> np.ndarray:
    """Parameters after a few steps, then the training losses, then the validation's."""
    truth = Diagonal.of(mass=10.0, drag=8.0, diffusion=1.0)
    result = fit(CONFIG, START, simulated(truth, 20), validation=simulated(truth, 8))
    model, metrics = result.last, result.metrics
    assert isinstance(model, Diagonal)
    parameters = [model.log_mass, model.log_drag, model.log_diffusion]
    assert all(len(a.sharding.device_set) == 1 for a in parameters)
    parts = [np.asarray(a).ravel() for a in (*parameters, metrics["loss"], metrics["validation"])]
    return np.concatenate(parts)


@pytest.mark.slow
def test_two_devices_learn_what_one_does(tmp_path):
    """With the noise they draw: that of a window is a matter of its place in the batch.

    And the step is compiled once, though its start lies on one device.
    """
    out = tmp_path / "two.npy"
    code = (
        "import sys, jax, numpy; jax.config.update('jax_num_cpu_devices', 2);"
        "jax.config.update('jax_enable_x64', True); import test_devices as t;"
        "objective = t.CONFIG.objective.build(t.START, t.simulated(t.START, 8));"
        "assert [t.usable_devices(objective, n) for n in (6, 7, 8)] == [2, 1, 2];"
        "import spinndrift.training.fitting.fit as f; made, Step = [], f.TrainStep;"
        "f.TrainStep = lambda *given: made.append(Step(*given)) or made[-1];"
        "numpy.save(sys.argv[1], t.learned());"
        "assert [step.traces for step in made] == [1]"
    )
    here = Path(__file__).parent
    command = [sys.executable, "-c", code, str(out)]
    subprocess.run(command, check=True, cwd=here, timeout=300)
    one = learned()
    # sums over windows are taken in another order: float32's rounding, through a few Adam steps
    np.testing.assert_allclose(np.load(out), one, atol=1e-3 * CONFIG.learning_rate * CONFIG.steps)


def test_a_loss_that_is_no_mean_of_windows_stays_on_one_device(monkeypatch):
    monkeypatch.setattr(jax, "devices", lambda: [None, None])
    objective = Fdm(substeps=1).build(START, simulated(START, 4))
    assert usable_devices(objective, 4) == 2
    assert usable_devices(object.__new__(DistanceAwareObjective), 4) == 1
