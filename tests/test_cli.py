"""The console command: it teaches, it refuses bad input in one sentence, it leaves whole files."""

import json
import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import full_disk, run_python
from spinndrift.models.config import typed_yaml as yaml
from spinndrift.models.config.errors import UserError
from spinndrift.models.effects.extended import Extended
from spinndrift.models.effects.library import kind
from spinndrift.models.files.checkpoint import load_model, save_model
from spinndrift.models.files.owned import MARKER
from spinndrift.models.integrate import cast
from spinndrift.models.recordings.csv import write_csv
from spinndrift.models.recordings.store import Recording
from spinndrift.models.spinn import Spinn, SpinnConfig
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.cli import main
from spinndrift.sims.demo import EMBEDDED
from spinndrift.training.config import (
    DriftConfig,
    PretrainConfig,
    TrainingConfig,
    WindowConfig,
)
from spinndrift.training.fitting.run_folder import TRAINING
from spinndrift.training.losses.matching import Mse

pytestmark = pytest.mark.whole

TINY = TrainingConfig(
    objective=Mse(),
    model=SpinnConfig(width=4, depth=1, constant_mass=True),
    windows=WindowConfig(length_s=0.5, stride_s=0.5, gap_s=0.25),
    pretrain=PretrainConfig(steps=2, batch=8),
    drift=DriftConfig(iterations=1, pieces=4, length_s=0.25),
    steps=4,
    batch=2,
    validate_every=2,
    checkpoint_every=2,
    refit_at=(),
)


COMMANDS = (
    "import", "generate", "train", "evaluate", "run", "collect", "diagnose", "check", "study",
    "vehicle", "demo",
)  # fmt: skip
GENERATED = (
    "--maneuvers", "surge-forward", "yaw-left", "--disturbances", "calm", "--trajectories", "3",
    "--duration", "2", "--substeps", "2",
)  # fmt: skip


def called(*arguments):
    """Exit code of the command; None is success."""
    try:
        main([str(a) for a in arguments])
    except SystemExit as end:
        return end.code
    return None


@pytest.fixture(scope="module")
def generated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("generated")
    path = folder / "tiny.nc"
    assert called("generate", "--out", path, *GENERATED) is None
    return path


@pytest.mark.smoke
def test_help_names_every_command(capsys):
    assert called("--help") == 0
    told = capsys.readouterr().out
    for command in COMMANDS:
        assert re.search(rf"\b{command}\b", told)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_is_explained(command, capsys):
    assert called(command, "--help") == 0
    told = capsys.readouterr().out
    for option in re.findall(r"^│ (?:-\w, )?(--[\w-]+)", told, re.MULTILINE):
        after = told.split(option, 1)[1]
        words = re.sub(r"[│\s]+", " ", after.split("│ --")[0])
        assert len(words.split()) > 4, f"{command} {option} has no explanation"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("import", "missing.tlog"), ("missing.tlog", "no such file")),
        (("import", EMBEDDED, "--out", "x.csv"), ("x.csv", ".nc")),
        (("import", EMBEDDED, "--rate", "0"), ("rate",)),
        (("import", EMBEDDED, "--vehicle", "submarine"), ("submarine", "bluerov2_heavy")),
        (("train", "garbage.nc"), ("garbage.nc",)),
        (("train", EMBEDDED, "--config", "garbage.yaml"), ("garbage.yaml", "stepz")),
        (("evaluate", "garbage.spinn", EMBEDDED), ("garbage.spinn",)),
        (("run", "no_such_scenario"), ("no_such_scenario", "pylon_crossing_calm")),
        (("run", "station_keeping_calm", "--scenario-text", "duration: -1"), ("duration",)),
        (("demo", "--log", "empty.tlog"), ("empty.tlog",)),
        (("generate", "--maneuvers", "loop"), ("loop", "surge")),
        (("diagnose", EMBEDDED, "--out", "/proc/nope"), ("--out /proc/nope", "written")),
        (("diagnose", EMBEDDED, "--out", "empty.tlog"), ("--out empty.tlog", "is a file")),
        (("diagnose", EMBEDDED, "--alpha", "2"), ("--alpha 2", "at most 0.499")),
        (("check", "diagnosis", "--alpha", "2"), ("--alpha 2", "at most 0.499")),
        (("diagnose", EMBEDDED, "--alpha", "nan"), ("--alpha nan",)),
        (
            ("diagnose", EMBEDDED, "--diffusion", "nan", *"11111"),
            ("--diffusion nan", "give a number from 0"),
        ),
        (("train", EMBEDDED, "--out", "empty.tlog/deep"), ("--out", "empty.tlog is no folder")),
    ],
)
def test_bad_input_is_refused_in_one_sentence(arguments, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "garbage.nc").write_bytes(b"no recording")
    (tmp_path / "garbage.spinn").write_bytes(b"no model")
    (tmp_path / "garbage.yaml").write_text("stepz: 3\n")
    (tmp_path / "empty.tlog").write_bytes(b"")
    before = {p.name for p in tmp_path.iterdir()}
    assert called(*arguments) == 2
    told = capsys.readouterr().err
    for word in words:
        assert word in told
    assert "Traceback" not in told
    left = {p.name for p in tmp_path.rglob("*") if p.is_file()}
    assert left == before, "something half written was left"


def test_an_error_in_a_fresh_process_has_exit_code_two():
    code = (
        "import subprocess, sys\n"
        "done = subprocess.run([sys.executable, '-c', 'from spinndrift.sims.cli import main; "
        'main(["import", "missing.BIN"])\'], capture_output=True, text=True)\n'
        "print(done.returncode, len(done.stderr.strip().splitlines()))"
    )
    assert run_python(code).split() == ["2", "1"]


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_while_modules_are_imported_has_exit_code_130():
    code = (
        "import os, signal, subprocess, sys, time\n"
        "script = 'from spinndrift.sims.cli import main; print(flush=True); main([\"train\", '\n"
        "script += '\"no.nc\"])'\n"
        "done = subprocess.Popen([sys.executable, '-c', script], stdout=-1, stderr=-1, text=True)\n"
        "done.stdout.readline()\n"
        "time.sleep(0.2)\n"
        "done.send_signal(signal.SIGINT)\n"
        "told = done.communicate()[1]\n"
        "print(done.returncode, told)"
    )
    told = run_python(code)
    assert told.strip() == "130 spinndrift: interrupted; what is on disk is whole"


def test_import_writes_a_recording(tmp_path, capsys):
    out = tmp_path / "dive.nc"
    assert called("import", EMBEDDED, "--out", out, "--rate", "10") is None
    recording = Recording.load(out)
    assert recording.dt == pytest.approx(0.1)
    assert recording.commands == ("pwm",)
    assert "Thruster outputs" in capsys.readouterr().err


def test_import_keeps_the_rate_of_data_that_are_no_log(tmp_path):
    """20 Hz are for logs; CSV files have the rate of their recording.yaml, else their own."""
    source, folder, out = tmp_path / "source.nc", tmp_path / "runs", tmp_path / "again.nc"
    assert called("generate", "--out", source, *GENERATED, "--rate", "40") is None
    write_csv(Recording.load(source), folder)
    meta = (folder / "recording.yaml").read_text()
    for line, more, rate in (
        ("rate: 10", (), 10.0),
        ("rate: 10", ("--rate", "25"), 25.0),
        ("", (), 40.0),
    ):
        (folder / "recording.yaml").write_text(re.sub(r"^rate: .*", line, meta, flags=re.M))
        assert called("import", folder, "--out", out, *more) is None
        assert 1 / Recording.load(out).dt == pytest.approx(rate)
    assert called("import", source, "--out", out) is None
    assert Recording.load(out).dt == pytest.approx(1 / 40)


def test_generate_writes_what_was_asked_for(generated):
    recording = Recording.load(generated)
    assert recording.scenarios == ("surge-forward", "yaw-left")
    assert recording.lengths.shape == (2, 3)
    surge = recording.select("surge-forward").dataset["V_WB_B"].to_numpy()[..., -1, 0]
    assert np.all(surge > 0.1)


def test_a_disk_that_is_full_in_the_end_is_told_and_the_old_file_stays(generated, capsys):
    before = generated.read_bytes()
    with full_disk(len(before) // 2):
        assert called("generate", "--out", generated, *GENERATED) == 2
    told = capsys.readouterr().err.splitlines()
    assert [line for line in told if "can't be written (File too large); make room" in line]
    assert generated.read_bytes() == before
    assert [path.name for path in generated.parent.iterdir()] == [generated.name]
    assert called("generate", "--out", generated, *GENERATED) is None  # it is one of ours


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("run station_keeping_calm --arm --dry-run", "--arm and --dry-run exclude each other"),
        (
            "train missing.nc --resume --out typo",
            "--resume: typo has no checkpoint; leave --resume out or name the run's folder",
        ),
        ("check logs", "spinndrift: check logs: name one or more folders"),
    ],
)
def test_what_makes_no_sense_is_refused_before_any_work(
    arguments, words, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert called(*arguments.split()) == 2
    told = capsys.readouterr().err
    assert words in told
    assert len(told.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_windows_longer_than_the_data_are_refused_before_the_checks(
    generated, tmp_path, capsys, monkeypatch
):
    vehicle = load_vehicle("bluerov2_heavy")
    lag = kind("thruster_lag").of(time_constant=0.1)
    model = tmp_path / "model.spinn"
    save_model(model, Extended.create(vehicle.dynamics(), (lag,), vehicle.thrusters()))
    monkeypatch.setattr("spinndrift.models.recordings.checks.examine.examine", None)
    assert called("evaluate", model, generated, "--length", "500") == 2
    told = capsys.readouterr().err
    assert "longest trajectory lasts 2 s, a window needs 500 s" in told


def test_pieces_too_short_to_train_on_are_told_with_the_remedy(generated, tmp_path, capsys):
    out = tmp_path / "run"
    assert called("train", generated, "--out", out) == 2
    told = capsys.readouterr().err
    for word in ("held-out part", "lasts", "4 s long", "windows: {length_s: …}", "--config"):
        assert word in told
    assert not out.exists()


@pytest.mark.slow
def test_train_resume_and_evaluate(generated, tmp_path, capsys, monkeypatch):
    settings, out = tmp_path / "tiny.yaml", tmp_path / "run"
    settings.write_text(yaml.dump(TINY))
    assert called("train", generated, "--config", settings, "--out", out) is None
    model, metadata = load_model(out / "model.spinn")
    assert isinstance(model, Spinn)
    assert metadata["vehicle"] == "bluerov2_heavy"
    report = (out / "report.html").read_text()
    assert "Held-out error" in report
    assert "data:image" in report
    assert called("train", generated, "--config", settings, "--out", out) == 2
    assert "--resume" in capsys.readouterr().err
    assert {p.name for p in out.iterdir()} <= {*TRAINING.files, MARKER}
    (out / "mine.txt").write_text("mine")
    more = ("--resume", "--steps", "6")
    monkeypatch.setattr("spinndrift.sims.learning.starting_model", None)  # that work is done
    assert called("train", generated, "--config", settings, "--out", out, *more) is None
    assert len((out / "metrics.csv").read_text().splitlines()) == 7
    assert (out / "mine.txt").read_text() == "mine"
    (out / "report.html").write_text("mine")
    assert called("train", generated, "--config", settings, "--out", out, *more) == 2
    assert "report.html in it was changed" in capsys.readouterr().err
    assert (out / "report.html").read_text() == "mine"
    results = tmp_path / "results.json"
    arguments = (out / "model.spinn", generated, "--length", "0.5", "--out", results)
    for _ in range(2):  # a second time onto its own
        assert called("evaluate", *arguments) is None
    overall = json.loads(results.read_text())
    assert set(overall) == {"preset", "learned"}
    assert 0 < overall["learned"]["rmse_position"] < 1


@pytest.mark.slow
def test_training_starts_from_a_model_with_effects(generated, tmp_path, capsys, monkeypatch):
    """As a diagnosis writes it; what it found stays, a SPINN learns what is left."""
    vehicle, lag = load_vehicle("bluerov2_heavy"), kind("thruster_lag").of(time_constant=0.1)
    believed = tmp_path / "extended.spinn"
    save_model(believed, Extended.create(vehicle.dynamics(), (lag,), vehicle.thrusters()))
    settings, out = tmp_path / "tiny.yaml", tmp_path / "run"
    settings.write_text(yaml.dump(TINY))
    given = ("train", generated, "--config", settings, "--steps", "2")
    assert called(*given, "--model", believed, "--out", out) is None
    model, _ = load_model(out / "model.spinn")
    assert isinstance(model, Extended)
    assert isinstance(model.base, Spinn)
    common, *each = np.asarray(model.effects[0].values)  # then one for each thruster
    np.testing.assert_allclose(common, lag.values[0], rtol=1e-7)
    np.testing.assert_array_equal(each, np.zeros(8))
    overall = json.loads((out / "evaluation.json").read_text())
    assert set(overall) == {"preset", "learned", "start"}
    # what was learned is a start too, as it is and with its own architecture alone
    begun = []

    def begin(config, start, *_, **__):
        begun.append((config.model, start))
        raise UserError("this far and no further")

    monkeypatch.setattr("spinndrift.sims.learning.fit", begin)
    assert called(*given, "--model", out / "model.spinn", "--out", tmp_path / "again") == 2
    ((architecture, start),) = begun
    assert architecture == model.base.config
    assert eqx.tree_equal(cast(start, jnp.float64), cast(model, jnp.float64))
    other = ("train", generated, "--method", "euclidean-fdm", "--out", tmp_path / "no")
    assert called(*other, "--model", out / "model.spinn") == 2
    assert "coordinates" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()
