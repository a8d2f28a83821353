"""The example on tank runs: what it makes of made-up files, and of the real ones."""

from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers import ROOT, load_example, run_script, shared_data
from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.vehicles.vehicle import load_vehicle

example = load_example("tank_runs")
OFFSET = (0.1, -0.22, 0.6)  # rad


def motion(t):
    """A smooth tumble in forward-right-down: Euler angles and positions."""
    euler = np.stack([0.3 * np.sin(0.9 * t), 0.2 * np.sin(0.7 * t + 1), 0.8 * np.sin(0.4 * t)])
    euler += np.array(OFFSET)[:, None]
    p = np.stack([np.sin(0.5 * t), 0.6 * np.cos(0.6 * t), 0.4 * np.sin(0.8 * t)])
    return euler, p


def rows(duration=60.0, flicker=()):
    """What the files hold: averages over bins of 0.1 or 0.2 s in turn, starts taken off."""
    fine = np.arange(0, duration, 0.01)
    euler, p = motion(fine)
    R = Rotation.from_euler("xyz", euler.T)
    v = R.inv().apply(np.gradient(p, 0.01, axis=1).T).T
    w = (R[:-1].inv() * R[1:]).as_rotvec().T / 0.01
    w = np.concatenate([w, w[:, -1:]], axis=1)
    command = (
        np.where(np.sin(0.5 * fine) > 0, 0.25, 0.0)[None] * np.array([1, 0, 0, 0, 0, 0])[:, None]
    )
    first = np.concatenate([p[:, :1], euler[:, :1]])
    all_ = np.concatenate([p - first[:3], euler - first[3:], v, w, command])
    edges, table = [0], []
    while edges[-1] + 20 < fine.size:
        edges.append(edges[-1] + (10 if len(edges) % 2 else 20))
    for a, b in pairwise(edges):
        table.append([fine[a], *all_[:, a:b].mean(axis=1)])
    table = np.array(table)
    for row in flicker:
        table[row, 4] += 0.5
    return table


def write(path, table, columns=example.COLUMNS):
    kept = [example.COLUMNS.index(c) for c in columns]
    text = "\n".join(",".join(f"{x:.9g}" for x in row) for row in table[:, kept])
    path.write_text(",".join(columns) + "\n" + text + "\n")
    return path


def test_bins_hold_at_their_middle_and_the_lost_attitude_is_found(tmp_path):
    run = example.read_run(write(tmp_path / "run.csv", rows()))
    t = example.middles(run.start)
    offset, off = example.lost_attitude(t, run)
    # the mean of a bin differs from its middle by (width²/24) × the second derivative: below 1e-3
    first = motion(np.zeros(1))[0][:, 0]
    np.testing.assert_allclose(offset, first, atol=5e-3)
    assert off.max() < 0.05
    late = example.lost_attitude(run.start, run)[1]
    assert np.median(late) > 3 * np.median(off)


def test_a_folder_becomes_a_recording_of_the_true_motion(tmp_path):
    source = tmp_path / "in"
    source.mkdir()
    write(source / "a.csv", rows(flicker=(200,)))
    write(source / "b.csv", rows(30.0))
    made = example.convert_folder(source, tmp_path / "out")
    assert made.scenarios == ("a", "b")
    assert (made.lengths[0] > 0).sum() == 2  # cut at the flicker
    again = read_csv(tmp_path / "out")
    assert again.commands == ("F_Bo_B",)
    run = next(iter(again.trajectories()))
    t = run.start + 0.1 * np.arange(len(run.X_WB))
    _, p = motion(t)
    _, p0 = motion(np.zeros(1))
    north_east_down = p - p0
    expected = np.stack([north_east_down[1], north_east_down[0], -north_east_down[2]])
    np.testing.assert_allclose(run.X_WB[:, 4:].T, expected, atol=6e-3)


def test_channels_push_along_their_axes():
    """Surge, sway to the right, heave down, and so on, in forward-right-down."""
    vehicle = load_vehicle("bluerov2_heavy")
    sign = np.array([1, -1, -1, 1, -1, -1])  # of these axes in forward-left-up
    thrusters = vehicle.thrusters()
    for i in range(6):
        command = np.zeros((6, 1))
        command[i] = 0.3
        F = example.wrench_of(command, vehicle)[:, 0]
        assert sign[i] * F[i] > 0
        assert np.count_nonzero(F) == 1
        pwm = jnp.asarray(example.pwm_of(command))
        whole = np.asarray(thrusters.wrench(thrusters.force(pwm)))[:, 0]
        assert whole[i] == pytest.approx(F[i])


def test_errors_are_one_sentence(tmp_path):
    short = write(tmp_path / "a.csv", rows(10.0), [c for c in example.COLUMNS if c != "cmd_yaw"])
    with pytest.raises(UserError, match="column `cmd_yaw` is missing"):
        example.read_run(short)
    code, _, errors = run_script(ROOT / "examples" / "tank_runs.py", str(tmp_path / "none"))
    assert code == 2
    assert "fewer than two .csv files" in errors
    assert len(errors.strip().splitlines()) == 1


@pytest.mark.slow
def test_real_runs(tmp_path):
    """Gains alone take a third off the position error on runs left out; times belong mid-bin."""
    folder = shared_data("data", "kth_bluerov2_heavy")
    made = example.convert_folder(folder, tmp_path / "out")
    assert len(made.scenarios) == 3
    yaws = [float(note.split("yaw ")[1].split()[0]) for note in made.notes if "yaw" in note]
    np.testing.assert_allclose(yaws, (0.06, 0.66, 0.08), atol=0.02)
    _, w, judged = example.climb(made, 2, lambda text: None)
    ratio = example.rmse(judged[1].errors, w.block, np.random.default_rng(0), judged[0].errors)[
        "position"
    ]
    assert ratio[2] < 0.7
    for fit in judged[1].fits.values():
        assert np.all(np.abs(fit.theta[list(fit.rows)[:3]] + 0.5) < 0.15)  # surge, sway, heave
