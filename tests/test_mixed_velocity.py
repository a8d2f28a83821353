"""Runs with and without a measured velocity in one recording."""

import numpy as np
import pytest

from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.data.generate import GenerateConfig, generate
from spinndrift.training.diagnosis.data.arrays import make_data
from spinndrift.training.diagnosis.data.readings import with_velocity

VEHICLE = load_vehicle("bluerov2_heavy")
MANEUVERS = ("surge-forward", "yaw-left", "sway-left")


@pytest.fixture(scope="module")
def recording() -> Recording:
    return generate(GenerateConfig(MANEUVERS, trajectories=1, duration=4.0), VEHICLE)


def hidden(recording: Recording, runs: int) -> Recording:
    """Without the horizontal velocity of the first runs."""
    V = recording.dataset["V_WB_B"].copy(deep=True)
    V.to_numpy()[:runs, ..., :2] = np.nan
    return Recording(recording.dataset.assign(V_WB_B=V))


def test_runs_without_a_velocity_are_left_out_where_most_have_it(recording):
    kept, told = with_velocity(hidden(recording, 1))
    assert "4 of 12 s" in told
    data = make_data(kept, VEHICLE)
    assert data.latent == []
    assert len(np.unique(data.run)) == 2
    whole = make_data(recording, VEHICLE)
    own = np.isin(whole.run, [1, 2])
    np.testing.assert_array_equal(data.V, whole.V[..., own])
    assert len(data.labels) == 2


def test_where_most_lack_it_it_counts_as_not_measured_in_any(recording):
    kept, told = with_velocity(hidden(recording, 2))
    assert told == ""
    data = make_data(kept, VEHICLE)
    assert data.latent == [0, 1]
    assert len(np.unique(data.run)) == 3
    assert with_velocity(recording) == (recording, "")
