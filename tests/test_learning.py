"""From a recording to a learned model: its parts, and what is chosen in the end."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from diagonal import simulated
from test_demo_diagnosis import recorded

from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.learning import Start, _is_better, split_recording
from spinndrift.training.config import WindowConfig

B = np.array([1.0, 1, 1, 0.1, 0.1, 0.1])
VEHICLE = load_vehicle("bluerov2_heavy")
RIGHT = VEHICLE.dynamics(B, dtype=jnp.float32)
WIDE = VEHICLE.dynamics(5 * B, dtype=jnp.float32)
WILD = VEHICLE.dynamics(1e6 * B, dtype=jnp.float32)  # diverges in all windows
SEEN = simulated(RIGHT, 16, steps=8)


@pytest.mark.parametrize(
    ("start", "learned", "chosen"),
    [(RIGHT, WIDE, True), (WIDE, RIGHT, False), (WILD, RIGHT, False), (RIGHT, WILD, True)],
)
def test_a_start_that_scores_better_than_training_is_chosen(start, learned, chosen):
    models = {"learned": (learned, 1), "start": (start, 1)}
    assert _is_better(Start(start), models, SEEN) is chosen


def test_without_another_start_or_validation_training_is_taken():
    models = {"learned": (WIDE, 1), "start": (RIGHT, 1)}
    assert not _is_better(None, models, SEEN)
    assert not _is_better(Start(RIGHT), models, None)


def test_parts_do_not_overlap_and_short_data_have_no_validation():
    windows = WindowConfig(length_s=1.0, gap_s=0.5)
    recording = recorded(20.0)
    first, middle, last = split_recording(recording, windows)
    assert middle is not None
    ends = [
        (float(t.start), t.start + len(t) * recording.dt)
        for part in (first, middle, last)
        for t in part.trajectories()
    ]
    gaps = [after[0] - before[1] for before, after in itertools.pairwise(ends)]
    assert min(gaps) >= windows.gap_s - 0.051
    assert ends[-1][1] - ends[-1][0] == pytest.approx(0.25 * 20, abs=windows.gap_s + 0.1)
    rest, none, _ = split_recording(recorded(6.0), windows)
    assert none is None
    assert rest.duration > 0.6 * 6
