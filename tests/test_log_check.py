"""`check logs` and the last lines of an import: what comes out of files, and what commands take."""

import subprocess
import sys

import pytest
from log_writers import dive

from helpers import ROOT, shared_data
from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.acceptance import acceptance
from spinndrift.sims.cli import main
from spinndrift.sims.learning import split_parts
from spinndrift.systems.logs.load import import_log
from spinndrift.training.config import TrainingConfig


@pytest.fixture(scope="module")
def recorded() -> Recording:
    return import_log(ROOT / "sims/data/sitl_dive.tlog.xz")[0]


def lines(recording):
    return dict(line.split(": ", 1) for line in acceptance(recording))


def test_a_good_dive_is_taken_by_all(recorded):
    told = lines(recorded)
    assert told["diagnose"] == "178 s"
    # 89.7 s of each of two stretches: windows of 4 s, one second of them to the next
    assert told["evaluate"] == "176 s in windows of 4 s"
    assert told["train"].endswith("s held out, in windows of 4 s")


@pytest.mark.parametrize("seconds", [3.0, 12.0])
def test_what_is_refused_here_is_refused_by_training(recorded, seconds):
    short = recorded.cut(0.0, seconds)
    refused = lines(short)["train"].startswith("nothing (")
    config, vehicle = TrainingConfig().windows, load_vehicle("bluerov2_heavy")
    assert refused
    with pytest.raises(UserError):
        split_parts(short, vehicle, config)


def test_missing_velocities_are_told(recorded):
    hidden = recorded.dataset["V_WB_B"].copy()
    hidden[..., :2] = float("nan")
    told = lines(Recording(recorded.dataset.assign(V_WB_B=hidden)))
    assert told["diagnose"] == "178 s; u, v not measured, so simulated by the model"
    assert told["evaluate"] == "176 s in windows of 4 s"
    hidden[..., 3] = float("nan")
    told = lines(Recording(recorded.dataset.assign(V_WB_B=hidden)))
    assert told["diagnose"].startswith("nothing (V_WB_B p is missing")


def test_a_folder_of_logs_is_checked_and_written_down(tmp_path, capsys):
    folder = tmp_path / "logs"
    folder.mkdir()
    (folder / "README.md").write_text("# Two dives\n")
    (folder / "a.tlog").write_bytes(dive(duration=8.0).bytes())
    (folder / "b.BIN").write_bytes(b"nothing")
    page = tmp_path / "page.md"
    main(["check", "logs", str(folder), "--docs", str(page)])
    text = page.read_text(encoding="utf-8")
    assert "| `a.tlog` | Two dives | 1 stretch, 7 s, bluerov2_heavy |" in text
    assert "| `b.BIN` | Two dives | refused: neither MAVLink nor" in text
    assert "a.tlog: 1 stretch" in capsys.readouterr().err
    with pytest.raises(SystemExit) as end:
        main(["check", "logs", str(tmp_path / "none")])
    assert end.value.code == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("reversed", "output-reversed (SERVO3_REVERSED of thruster 3)"),
        ("frame_vectored", "4 stretches, 263 s, bluerov2 |"),
        ("frame_bluerov1", "refused: FRAME_CONFIG 0"),
        ("lost_lock", "velocity-held (01_MANUAL, 92.5 to 132.3 s, u,v)"),
        ("no_voltage", "no-voltage (BATTERY_STATUS, SYS_STATUS)"),
        ("unknown_voltage", "4 stretches, 263 s, bluerov2_heavy | – |"),
        ("second_port", "3 stretches, 266 s, bluerov2_heavy | – |"),
        ("copter", "refused: HEARTBEAT: the log is not ArduSub's: it is a quadrotor"),
    ],
)
def test_a_log_with_one_thing_wrong_says_so(tmp_path, name, said):
    """Copies of a dive of a real autopilot, changed as users have reported it."""
    mutate = shared_data("data", "mutations", "mutate.py")
    subprocess.run([sys.executable, str(mutate), str(tmp_path / "logs"), name], check=True)
    page = tmp_path / "page.md"
    main(["check", "logs", str(tmp_path / "logs"), "--docs", str(page)])
    assert said in page.read_text(encoding="utf-8")
