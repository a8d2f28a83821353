"""`diagnose --against`: what it compares with, and what it refuses before it computes."""

from types import SimpleNamespace

import numpy as np
import pytest
from test_cli import called
from test_diagnose_command import Told, ToldPage, recorded

from spinndrift.models.config.errors import UserError
from spinndrift.models.files.checkpoint import load_model, save_model
from spinndrift.models.files.owned import MARKER
from spinndrift.models.recordings.csv import write_csv
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.healthy import MODEL, OPTIONS, SOURCE, check_healthy, recordings_in

VEHICLE = load_vehicle("bluerov2_heavy")


@pytest.fixture
def compared(monkeypatch):
    """Diagnoses of the healthy runs, and what new runs were compared with."""
    seen = SimpleNamespace(diagnosed=[], healthy=[])

    def finding(vehicle):
        return SimpleNamespace(diagnosis=Told(), extended=vehicle.dynamics())

    def diagnose(recording, vehicle, *_):
        seen.diagnosed.append(recording)
        return finding(vehicle)

    def against(recording, vehicle, healthy, *_):
        seen.healthy.append(healthy)
        return finding(vehicle)

    module = "spinndrift.training.diagnosis"
    monkeypatch.setattr(f"{module}.pipeline.diagnose", diagnose)
    monkeypatch.setattr(f"{module}.against.pipeline.diagnose_against", against)
    monkeypatch.setattr(
        "spinndrift.sims.reports.diagnosis_report.diagnosis_page", lambda *_: ToldPage()
    )
    return seen


def test_healthy_data_are_diagnosed_first(tmp_path, compared):
    new = recorded(tmp_path / "new.nc", "bluerov2_heavy")
    old = recorded(tmp_path / "old.nc", "bluerov2_heavy")
    assert called("diagnose", new, "--against", old, "--out", tmp_path / "out") is None
    assert len(compared.diagnosed) == 1
    [healthy] = compared.healthy
    assert healthy.name == str(old)
    assert healthy.recording.scenarios == ("still",)


def test_several_recordings_in_a_folder_are_sessions_apart(tmp_path, compared):
    new = recorded(tmp_path / "new.nc", "bluerov2_heavy")
    folder = tmp_path / "healthy"
    folder.mkdir()
    for day in ("monday", "tuesday"):
        recorded(folder / f"{day}.nc", "bluerov2_heavy")
    (folder / "notes.txt").write_text("calm water")
    assert called("diagnose", new, "--against", folder, "--out", tmp_path / "out") is None
    assert compared.healthy[0].recording.scenarios == ("monday: still", "tuesday: still")


def test_recordings_of_every_form_in_a_folder_are_read(tmp_path):
    """Files, compressed logs, CSV folders and bags; notes and figures are none."""
    write_csv(Recording.load(recorded(tmp_path / "a.nc", "bluerov2_heavy")), tmp_path / "runs.1")
    for name in ("b.tlog.gz", "c.BIN", "d.mcap", "notes.txt"):
        (tmp_path / name).touch()
    for bag, inside in (("bag", "metadata.yaml"), ("open_bag", "bag_0.db3"), ("figures", "a.png")):
        (tmp_path / bag).mkdir()
        (tmp_path / bag / inside).touch()
    still, seen = Recording.load(tmp_path / "a.nc"), []
    joined = recordings_in(tmp_path, lambda path: (seen.append(path.name), still)[1])
    assert seen == ["a.nc", "b.tlog.gz", "bag", "c.BIN", "d.mcap", "open_bag", "runs.1"]
    assert joined.scenarios[-1] == "runs.1: still"
    for alone in ("a.nc", "runs.1", "bag", "figures"):
        seen.clear()
        recordings_in(tmp_path / alone, lambda path: (seen.append(path.name), still)[1])
        assert seen == [alone]


def test_the_dives_of_a_collection_are_not_recordings_beside_its_own(tmp_path):
    recorded(tmp_path / "recording.nc", "bluerov2_heavy")
    (tmp_path / "dive-1").mkdir()
    recorded(tmp_path / "dive-1" / "log.nc", "bluerov2_heavy")
    with pytest.raises(UserError, match="dive-1 would be left out"):
        check_healthy(tmp_path)
    (tmp_path / MARKER).touch()
    check_healthy(tmp_path)


def test_a_diagnosis_is_compared_with_by_its_model_and_its_data(tmp_path, compared):
    old = recorded(tmp_path / "old.nc", "bluerov2_heavy")
    base = tmp_path / "base"
    assert called("diagnose", old, "--out", base, "--accept", "no-commands") is None
    _, metadata = load_model(base / MODEL, dtype=float)
    assert metadata[SOURCE] == str(old)
    assert metadata[OPTIONS] == {"water_density": None, "accept": ["no-commands"]}
    new = recorded(tmp_path / "new.nc", "bluerov2_heavy")
    for given in (base, base / "diagnosis.json"):
        compared.diagnosed.clear()
        assert called("diagnose", new, "--against", given, "--out", tmp_path / "out") is None
        assert compared.diagnosed == []
        assert compared.healthy[-1].name == str(base)
        expected = Recording.load(old).dataset["V_WB_B"].to_numpy()
        np.testing.assert_array_equal(
            compared.healthy[-1].recording.dataset["V_WB_B"].to_numpy(), expected
        )


def test_what_can_not_be_compared_with_is_refused_at_once(tmp_path, compared, capsys):
    new = recorded(tmp_path / "new.nc", "bluerov2_heavy")
    lone = tmp_path / "lone"
    (lone / MODEL).parent.mkdir(parents=True)
    save_model(lone / MODEL, VEHICLE.dynamics(), {SOURCE: str(tmp_path / "gone.nc")})
    half = tmp_path / "half"
    half.mkdir()
    (half / "diagnosis.json").write_text("{}")
    model = tmp_path / "own.spinn"
    save_model(model, VEHICLE.dynamics(), {"vehicle": "bluerov2_heavy"})
    days = tmp_path / "days"
    (days / "monday").mkdir(parents=True)
    recorded(days / "monday" / "dive.nc", "bluerov2_heavy")
    for more, words in (
        ((tmp_path / "none",), "no such file or folder"),
        ((days,), "folder monday would be left out"),
        ((lone,), "gone.nc) are gone"),
        ((half,), "model.spinn is missing"),
        ((lone, "--model", model), "--model: the diagnosis"),
        ((lone, "--diffusion", *"111111"), "--diffusion: the diagnosis"),
    ):
        assert called("diagnose", new, "--against", *more, "--out", tmp_path / "out") == 2
        told = capsys.readouterr().err
        assert words in told.replace("\n", " "), told
        assert len(told.strip().splitlines()) == 1
    assert not compared.healthy
    assert not (tmp_path / "out").exists()
