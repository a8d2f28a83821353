"""`spinndrift diagnose`: its files appear together, and it says what it assumes."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from killing import killed, litter
from test_cli import called

from spinndrift.models.files.owned import MARKER
from spinndrift.models.recordings.store import Recording, Trajectory
from spinndrift.sims.reports.pages import Page

PREPARE = """
from types import SimpleNamespace
import spinndrift.sims.reports.diagnosis_report, spinndrift.training.diagnosis.pipeline
from test_diagnose_command import Told, ToldPage
spinndrift.training.diagnosis.pipeline.diagnose = lambda recording, vehicle, *_: SimpleNamespace(
    diagnosis=Told(), extended=vehicle.dynamics()
)
spinndrift.sims.reports.diagnosis_report.diagnosis_page = lambda *_: ToldPage()
"""
FILES = {MARKER, "diagnosis.json", "diagnosis.schema.json", "extended/model.spinn", "report.html"}


class Told:
    """A diagnosis in place of a real one, which takes half a minute."""

    sentence = "Nothing differs."
    causes = ()
    against = None

    def __init__(self, words="new"):
        self.words = words

    def save(self, path):
        Path(path).write_text(self.words)


class ToldPage(Page):
    """Its page."""

    def __init__(self, fault=None, words="new"):
        super().__init__("Diagnosis")
        self.fault, self.words = fault, words

    def write(self, path):
        if self.fault is not None:
            raise self.fault
        Path(path).write_text(self.words)


@pytest.fixture
def diagnosing(monkeypatch):
    def stand_in(fault=None, words="new"):
        told, page = Told(words), ToldPage(fault, words)

        def diagnose(recording, vehicle, *_):
            assert vehicle.name == "bluerov2_heavy"
            return SimpleNamespace(diagnosis=told, extended=vehicle.dynamics())

        monkeypatch.setattr("spinndrift.training.diagnosis.pipeline.diagnose", diagnose)
        monkeypatch.setattr(
            "spinndrift.sims.reports.diagnosis_report.diagnosis_page", lambda *_: page
        )

    return stand_in


def recorded(path, vehicle):
    n = 20
    pose = np.tile([1.0, 0, 0, 0, 0, 0, -1], (n, 1))
    F = np.tile([0, 0, -1.0, 0, 0, 0], (n, 1))  # holds its depth
    still = Trajectory("still", pose, np.zeros((n, 6)), {"F_Bo_B": F})
    Recording.from_trajectories([still], 0.05, vehicle=vehicle).save(path)
    return path


def files(folder):
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize(
    ("stated", "given", "said"),
    [("", False, True), ("", True, False), ("bluerov2_heavy", False, False)],
)
def test_a_vehicle_that_nobody_states_is_told(tmp_path, diagnosing, capsys, stated, given, said):
    diagnosing()
    data, out = recorded(tmp_path / "still.nc", stated), tmp_path / "out"
    more = ("--vehicle", "bluerov2_heavy") if given else ()
    assert called("diagnose", data, "--out", out, *more) is None
    told = "still.nc names no vehicle, so bluerov2_heavy is assumed" in capsys.readouterr().err
    assert told == said
    assert files(out) == FILES


def test_an_interrupt_while_writing_leaves_the_folder_as_it_was(tmp_path, diagnosing, capsys):
    diagnosing(KeyboardInterrupt())
    data, out = recorded(tmp_path / "still.nc", "bluerov2_heavy"), tmp_path / "out"
    assert called("diagnose", data, "--out", out) == 130
    assert not out.exists()
    diagnosing(words="old")
    assert called("diagnose", data, "--out", out) is None
    (out / "mine.txt").write_text("mine")
    before = {name: (out / name).read_bytes() for name in files(out)}
    diagnosing(KeyboardInterrupt())
    assert called("diagnose", data, "--out", out) == 130
    assert {name: (out / name).read_bytes() for name in files(out)} == before
    assert "what is on disk is whole" in capsys.readouterr().err
    diagnosing()
    assert called("diagnose", data, "--out", out) is None
    assert files(out) == FILES | {"mine.txt"}
    assert (out / "diagnosis.json").read_text() == "new"


def test_a_diagnosis_that_is_killed_as_it_writes_is_made_anew(tmp_path, diagnosing):
    data, out = recorded(tmp_path / "still.nc", "bluerov2_heavy"), tmp_path / "out"
    killed("report.html", 1, PREPARE, "diagnose", data, "--out", out)
    assert len(litter(tmp_path)) == 2
    diagnosing()
    assert called("diagnose", data, "--out", out) is None
    assert files(out) == FILES
    assert litter(tmp_path) == []
