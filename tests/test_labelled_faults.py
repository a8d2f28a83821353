"""The example on labelled faults: what it tells of made-up runs, and of real ones."""

import numpy as np
import pytest

from helpers import ROOT, load_example, run_script, shared_data
from spinndrift.models.config.errors import UserError

example = load_example("labelled_faults")
NAMES = ["time", "pwm1", "depth", "press", "voltage", "roll", "pitch", "w_yaw"]


def made(rng, weight=0.0, offset=0.0, moment=(0.0, 0.0, 0.0), rows=190):
    """A run of w|w| = 6e-3 + 6e-4 (PWM - 1200) + weight, as the columns of the file."""
    t = 0.05 * np.arange(rows)
    level = rng.uniform(1192, 1204) - (15 if weight else 0)
    on = t >= 0.15
    square = 6e-3 + 6e-4 * (level - 1200) + weight + 4e-4 * rng.normal()
    w = np.sign(square) * np.sqrt(abs(square))
    shown = offset + 0.01 * rng.normal() + np.where(on, w * (t - 0.15), 0)
    press = 600 + (shown - offset) / 0.0094
    trim = [5 + rng.normal(), rng.normal()]
    turned = [
        np.where(on, m + s * rng.normal(), 0) for m, s in zip(moment, (0.5, 0.5, 3), strict=True)
    ]
    roll, pitch = trim[0] + turned[0], trim[1] + turned[1]
    yaw = np.where(on, -20 + turned[2], 0)
    volts = np.full(rows, 12.0 + 0.1 * rng.normal())
    pwm = np.where(on, level, 1100)
    return np.stack([t // 1, pwm, shown, press, volts, roll, pitch, yaw], axis=1)


def write(path, counts=24, drop=None):
    rng = np.random.default_rng(5)
    faults = {
        "Normal": {},
        "AddWeight": {"weight": 9e-3},
        "PressureGain_constant": {"offset": 0.1},
        "PropellerDamage_slight": {"moment": (0.3, 0.1, 1.0)},
        "PropellerDamage_bad": {"moment": (-4.0, -3.0, 20.0)},
    }
    runs = [(label, made(rng, **f)) for label, f in faults.items() for _ in range(counts)]
    names = [n for n in NAMES if n != drop]
    kept = [NAMES.index(n) for n in names]
    np.savez(
        path,
        data=np.concatenate([run for _, run in runs])[:, kept].astype(np.float32),
        lengths=np.array([len(run) for _, run in runs]),
        label=np.array([label for label, _ in runs]),
        columns=np.array(names),
    )
    return path


def test_known_faults_are_told_and_healthy_runs_left_alone(tmp_path):
    runs = example.read_runs(write(tmp_path / "made.npz"))
    said = example.told(example.cross_fitted(runs))
    share = {c: np.bincount(said[runs.label == c], minlength=4) / 24 for c in example.CLASSES}
    assert share["Normal"][0] > 0.7
    assert share["AddWeight"][1] > 0.9
    assert share["PressureGain_constant"][2] > 0.9
    assert share["PropellerDamage_bad"][3] > 0.9
    assert share["PropellerDamage_slight"][3] < 0.3


def test_numbers_of_a_run_are_those_it_was_made_with(tmp_path):
    runs = example.read_runs(write(tmp_path / "made.npz"))
    np.testing.assert_allclose(runs.sensor[:, 1], 0.0094, rtol=1e-3)
    own = runs.label == "PropellerDamage_bad"
    expected = [-4, -3, 0]
    np.testing.assert_allclose(runs.turn[own].mean(axis=0), expected, atol=4 * 3 / np.sqrt(24))
    healthy = runs.label == "Normal"
    law = np.linalg.lstsq(runs.drive[healthy], runs.dive[healthy], rcond=None)[0][:, 0]
    # 4e-4 of noise over 24 runs whose PWM spreads by 12/√12 µs
    assert law[0] == pytest.approx(6e-3, abs=4 * 4e-4 / np.sqrt(24) * 2)
    assert law[1] == pytest.approx(6e-4, abs=4 * 4e-4 / np.sqrt(24) / 3.5)


def test_a_limit_is_exceeded_by_healthy_runs_as_often_as_it_says():
    rng = np.random.default_rng(2)
    n, hits, of = 19, 0, 0
    for _ in range(60):
        x, y = np.ones((n + 50, 1)), rng.standard_t(4, size=(n + 50, 2))
        model = example.Healthy.fit(x[:n], y[:n], 2 / (n + 1))
        hits += int((model.score(x[n:], y[n:]) > model.limit).sum())
        of += 50
    # 2/(n + 1) for one further run; draws of one model hang together, hence the wide margin
    assert hits / of == pytest.approx(2 / (n + 1), abs=0.03)


def test_errors_are_one_sentence(tmp_path):
    for file, message in (
        (tmp_path / "none.npz", "no such file"),
        (write(tmp_path / "less.npz", 3, drop="w_yaw"), "column `w_yaw` is missing"),
    ):
        with pytest.raises(UserError, match=message):
            example.read_runs(file)
        code, _, errors = run_script(ROOT / "examples" / "labelled_faults.py", str(file))
        assert code == 2
        assert message in errors
        assert len(errors.strip().splitlines()) == 1


def test_real_faults():
    """What docs/labelled-faults.md says, with margins of the intervals there."""
    runs = example.read_runs(shared_data("data", "haizhe_auv", "haizhe_train.npz"))
    said = example.told(example.cross_fitted(runs))
    count = {c: np.bincount(said[runs.label == c], minlength=4) for c in example.CLASSES}
    assert count["Normal"][0] >= 50
    assert count["AddWeight"][1] >= 50
    assert count["PressureGain_constant"][2] >= 48
    assert count["PropellerDamage_slight"][3] == 0
    blind = example.told(example.cross_fitted(runs, pwm_known=False))
    assert not np.any(blind[runs.label == "AddWeight"] == 1)
    assert example.beyond(runs, runs.rest, "Normal")["PropellerDamage_bad"] > 50
