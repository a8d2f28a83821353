"""What repeats from run to run is told from what doesn't."""

from dataclasses import replace

import numpy as np
import pytest
from hidden.draw import draw
from hidden.scenarios import Plan

from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.data.arrays import make_data
from spinndrift.training.diagnosis.data.repeats import repeating, repeats, shares


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("null")
    draw(3, "null", plan=Plan(runs=3, seconds=5.0)).write(folder / "data")
    recording = read_csv(folder / "data", resample=False)
    return make_data(recording, load_vehicle("bluerov2_heavy"))


def test_runs_of_one_scenario_repeat_its_commands(data):
    groups = repeats(data)
    assert sorted(len(g) for g in groups) == [3] * 10
    for group in groups:
        assert len(set(data.scenario[group].tolist())) == 1
    other = replace(data, u=np.random.default_rng(0).standard_normal(data.u.shape))
    assert repeats(other) == []
    z = np.zeros((len(data.u), 12, len(data.run)))
    assert np.isnan(shares(z, other).within).all()
    assert repeating(z, other) == {}


def test_variances_of_noise_are_one_and_what_repeats_is_found(data):
    rng = np.random.default_rng(1)
    z = rng.standard_normal((len(data.u), 12, len(data.run)))
    found = shares(z, data)
    n = data.steps / 3
    for values in (found.together, found.within):
        np.testing.assert_allclose(values, 1, atol=6 * np.sqrt(2 / n))
    assert repeating(z, data) == {}
    # slow pushes that are drawn for each run are no error, those that all runs share are
    slow = np.zeros_like(z)
    for k in range(1, len(z)):
        slow[k] = 0.95 * slow[k - 1] + rng.standard_normal(slow.shape[1:])
    assert repeating(slow, data) == {}
    z[:, 8] += 2 * slow[:, 8][:, data.scenario]
    assert set(repeating(z, data)) == {"heave"}
