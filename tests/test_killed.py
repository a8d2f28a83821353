"""A training that is killed in the middle of writing goes on; test_study, test_run and
test_diagnose_command have the same of their commands."""

import os

import numpy as np
import pytest
from diagonal import Diagonal
from killing import killed, litter
from motion import smooth_motion
from test_cli import TINY, called

from spinndrift.models.config import typed_yaml as yaml
from spinndrift.models.files.checkpoint import load_model
from spinndrift.models.files.owned import MARKER
from spinndrift.models.recordings.store import Recording, Trajectory
from spinndrift.sims import learning

PREPARE = """
from diagonal import Diagonal
from spinndrift.sims import learning
learning.starting_model = lambda *_: Diagonal.of(mass=20.0, drag=20.0, diffusion=1.0)
"""


def recorded(path):
    t = 0.05 * np.arange(80)
    X, V, _ = smooth_motion(t)
    runs = [Trajectory("swim", X.T, V.T, {"F_Bo_B": 20 * V.T})]
    Recording.from_trajectories(runs, 0.05, vehicle="bluerov2_heavy").save(path)


@pytest.mark.slow  # test_cli has a training that goes on, test_study one that was killed
def test_training_that_was_killed_goes_on_to_the_same_bits(tmp_path, monkeypatch):
    start = Diagonal.of(mass=20.0, drag=20.0, diffusion=1.0)
    monkeypatch.setattr(learning, "starting_model", lambda *_: start)
    data, settings = tmp_path / "data.nc", tmp_path / "tiny.yaml"
    recorded(data)
    settings.write_text(yaml.dump(TINY))
    given = ("train", data, "--config", settings, "--steps", "8", "--out")
    killed("checkpoint.npz", 2, PREPARE, *given, tmp_path / "cut")
    assert {".spinndrift.lock", "checkpoint.npz", MARKER} <= set(os.listdir(tmp_path / "cut"))
    assert len(litter(tmp_path / "cut")) == 2
    assert called(*given, tmp_path / "cut", "--resume") is None
    assert called(*given, tmp_path / "whole") is None
    assert litter(tmp_path) == []
    cut, whole = (load_model(tmp_path / one / "model.spinn")[0] for one in ("cut", "whole"))
    assert isinstance(cut, Diagonal)
    assert isinstance(whole, Diagonal)
    for name in ("log_mass", "log_drag", "log_diffusion"):
        np.testing.assert_array_equal(getattr(cut, name), getattr(whole, name))
