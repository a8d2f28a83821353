"""Poses that jump to another place or turn over for single samples."""

import numpy as np
import pytest
from motion import smooth_motion

from helpers import ROOT
from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.checks.examine import examine
from spinndrift.models.recordings.checks.finding import findings_of
from spinndrift.models.recordings.checks.flickers import flickers, mended
from spinndrift.models.recordings.csv import read_csv, write_csv
from spinndrift.models.recordings.resample import rotations
from spinndrift.models.recordings.store import Recording
from spinndrift.systems.logs.load import import_log

T = np.arange(0, 20, 0.05)
AT = np.array([60, 130, 131, 200, 201, 202, 330])
"""One, two and three samples in a row."""


def motion():
    X, V, _ = smooth_motion(T, speed=0.5)
    return X, V


def displaced(X, at=AT):
    found = X.copy()
    found[4:, at] += np.array([[0.4], [-0.3], [0.5]])
    return found


def turned_over(X, at=AT):
    found = X.copy()
    q = rotations(X[:4, at]) * rotations(np.array([[0.0, 1, 0, 0]] * at.size).T)
    found[:4, at] = q.as_quat(scalar_first=True).T
    return found


@pytest.mark.parametrize("change", [displaced, turned_over])
@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_flickers_are_found_and_nothing_else(change, noise):
    X, V = motion()
    rng = np.random.default_rng(0)
    X[4:] += noise * rng.standard_normal((3, T.size))
    assert not np.any(flickers(T, X))
    whole = mended(T, change(X), V)
    assert whole is not None
    np.testing.assert_array_equal(np.flatnonzero(whole.bad), AT)
    np.testing.assert_array_equal(whole.V, V)
    # over a gap of 0.2 s the line is off by at most a T²/8, with a below 1 m/s² and 2 rad/s²
    assert np.abs(whole.X[4:] - X[4:]).max() < 5e-3 + 6 * noise
    assert (rotations(whole.X[:4]).inv() * rotations(X[:4])).magnitude().max() < 1e-2


def test_velocities_that_were_derived_from_jumping_poses_are_replaced_too():
    X, V = motion()
    jumped = displaced(X)
    derived = V.copy()
    derived[:3] = rotations(X[:4]).inv().apply(np.gradient(jumped[4:], 0.05, axis=1).T).T
    whole = mended(T, jumped, derived)
    assert whole is not None
    assert np.abs(derived[:3] - V[:3]).max() > 3.0
    # lines of up to 0.35 s: j T²/8, with the second derivative of velocity below 2 m/s³
    assert np.abs(whole.V[:3] - V[:3]).max() < 0.05


@pytest.mark.parametrize("stays", [4, 100])
def test_a_pose_that_stays_elsewhere_is_no_flicker(stays):
    X, _ = motion()
    assert not np.any(flickers(T, displaced(X, np.arange(200, 200 + stays))))


def test_a_folder_of_csv_files_is_mended_before_it_is_resampled(tmp_path):
    X, V = motion()
    command = {"F_Bo_B": np.zeros((T.size, 6))}
    clean = Trajectory("run", X.T, V.T, command)
    flickering = Trajectory("run", turned_over(displaced(X)).T, V.T, command)
    made = [Recording.from_trajectories([one], 0.05) for one in (clean, flickering)]
    for name, one in zip("ab", made, strict=True):
        write_csv(one, tmp_path / name)
    expected, found = (read_csv(tmp_path / name) for name in "ab")
    (told,) = findings_of(found.dataset)
    assert (told.word, told.severity) == ("pose-flicker", "cut")
    assert "7 poses" in told.text
    off = found.dataset["X_WB"].to_numpy() - expected.dataset["X_WB"].to_numpy()
    assert np.abs(off).max() < 1e-2


def test_a_recording_is_mended_where_it_is_examined():
    recording = import_log(ROOT / "sims/data/sitl_dive.tlog.xz")[0].cut(0.0, 20.0)
    assert findings_of(examine(recording, None, "dive").dataset) == ()
    X = recording.dataset["X_WB"].to_numpy().copy()
    X[0, 0, 100, 4] += 1.0
    dims, attrs = recording.dataset["X_WB"].dims, recording.dataset["X_WB"].attrs
    jumped = Recording(recording.dataset.assign(X_WB=(dims, X, attrs)))
    seen = examine(jumped, None, "dive")
    (told,) = findings_of(seen.dataset)
    assert told.word == "pose-flicker"
    before, after = X[0, 0, 99, 4], X[0, 0, 101, 4]
    np.testing.assert_allclose(seen.dataset["X_WB"][0, 0, 100, 4], (before + after) / 2)
