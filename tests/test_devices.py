"""Training over several devices: the numbers are those of one device."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
from diagonal import Diagonal, simulated

from spinndrift.sims.compile_cache import compiled_folder
from spinndrift.training.config import TrainingConfig
from spinndrift.training.fit import fit
from spinndrift.training.losses import Mse
from spinndrift.training.step import usable_devices

CONFIG = TrainingConfig(
    objective=Mse(substeps=1),
    steps=5,
    batch=6,
    learning_rate=1e-2,
    warm_up=1,
    refit_at=(),
)


def learned() -> tuple[np.ndarray, int]:
    """Parameters after a few steps, and the number of devices that hold them."""
    truth = Diagonal.of(mass=10.0, drag=8.0, diffusion=1.0)
    start = Diagonal.of(mass=14.0, drag=5.0, diffusion=2.0)
    model = fit(CONFIG, start, simulated(truth, 20)).last
    assert isinstance(model, Diagonal)
    parameters = [model.log_mass, model.log_drag]
    return np.stack([np.asarray(a) for a in parameters]), len(model.log_mass.sharding.device_set)


def test_two_devices_learn_what_one_does(tmp_path):
    out = tmp_path / "two.npy"
    code = (
        "import sys, jax, numpy; jax.config.update('jax_num_cpu_devices', 2);"
        "jax.config.update('jax_enable_x64', True); import test_devices;"
        "found, devices = test_devices.learned(); assert devices == 2, devices;"
        "numpy.save(sys.argv[1], found)"
    )
    here = Path(__file__).parent
    kept = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(compiled_folder())}
    command = [sys.executable, "-c", code, str(out)]
    subprocess.run(command, check=True, cwd=here, timeout=300, env=kept)
    one, devices = learned()
    assert devices == 1
    # sums over windows are taken in another order: float32's rounding, through a few Adam steps
    np.testing.assert_allclose(np.load(out), one, atol=1e-3 * CONFIG.learning_rate * CONFIG.steps)


def test_devices_share_a_batch_equally():
    assert len(jax.devices()) == 1
    assert usable_devices(7) == 1
