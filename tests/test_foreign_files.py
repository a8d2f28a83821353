"""Whatever a command finds where it writes: what this package did not write is there afterwards."""

from pathlib import Path

import pytest
from test_cli import COMMANDS, called
from test_owned import held_elsewhere, tree

from helpers import full_disk
from spinndrift.models.files.owned import MARKER, run_folder
from spinndrift.sims.demo import DEMO
from spinndrift.sims.diagnosis_benchmark.run import CHECK
from spinndrift.sims.diagnosis_folder import DIAGNOSIS
from spinndrift.sims.estimator_check.run import ESTIMATOR
from spinndrift.sims.reports.marked_page import BEGIN, END
from spinndrift.sims.run.collection import COLLECTION
from spinndrift.sims.run.folder import RUN
from spinndrift.sims.study.run import STUDY
from spinndrift.sims.vehicle.write import VEHICLE
from spinndrift.training.fitting.run_folder import TRAINING

FOLDERS = {
    "demo": (("demo", "--log", "missing.tlog"), DEMO),
    "train": (("train", "missing.nc"), TRAINING),
    "resume": (("train", "missing.nc", "--resume"), TRAINING),
    "run": (("run", "pylon_crossing_calm", "--model", "missing.spinn"), RUN),
    "collect": (("collect", "pylon_crossing_calm", "--maneuver", "missing.json"), COLLECTION),
    "diagnose": (("diagnose", "missing.nc"), DIAGNOSIS),
    "check": (("check", "diagnosis", "--cases", "missing"), CHECK),
    "estimator": (("check", "estimator", "--model", "missing.spinn"), ESTIMATOR),
    "study": (("study", "ablation", "--config", "missing.yaml"), STUDY),
    "vehicle": (("vehicle", "station_keeping_calm", "--connection", "missing"), VEHICLE),
}
"""Commands that write a folder, with input that is missing: what is refused before is refused
before that is noticed."""
FILES = {
    "import": (("import", "missing.tlog"), "a.nc"),
    "generate": (("generate", "--vehicle", "missing.yaml"), "a.nc"),
    "csv": (("evaluate", "missing.spinn", "missing.nc"), "a.csv"),
    "json": (("evaluate", "missing.spinn", "missing.nc"), "a.json"),
    "nc": (("evaluate", "missing.spinn", "missing.nc"), "a.nc"),
}
IN_THEM = {
    "demo": ("training/model.spinn", "dive/log.nc", "training/a.txt", "dive/a.txt"),
    "study": ("rich/pinn/seed-0/result.json", "rich/pinn/.seed-0.partial/training/a.txt"),
    "check": ("one/judged.json", "one/a.txt"),
    "collect": ("dive-1/log.nc", "dive-1/a.txt"),
}
"""What may be in the way in the folders that a command makes inside its own."""


def drop(at: Path, words: str = "mine") -> None:
    at.parent.mkdir(parents=True, exist_ok=True)
    at.write_text(words)


def names(command: str) -> list[str]:
    kind = FOLDERS[command][1]
    return ["notes.txt", "notes/deep/a.txt", *kind.files, *IN_THEM.get(command, ())]


@pytest.fixture(autouse=True)
def _somewhere(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_every_command_is_tried_here():
    tried = {arguments[0] for arguments, _ in [*FOLDERS.values(), *FILES.values()]}
    assert tried == set(COMMANDS)


@pytest.mark.parametrize("command", FOLDERS)
def test_a_foreign_folder_is_refused_by_name_before_any_work(command, tmp_path, capsys):
    arguments, _ = FOLDERS[command]
    for number, name in enumerate(names(command)):
        out = tmp_path / f"proj-{number}"
        drop(out / name)
        before = tree(tmp_path)
        assert called(*arguments, "--out", out) == 2
        told = capsys.readouterr().err
        assert told.startswith(f"spinndrift: --out {out}: holds what spinndrift did not write")
        assert Path(name).parts[0] in told
        assert tree(tmp_path) == before


@pytest.mark.parametrize("command", FOLDERS)
def test_in_our_own_folder_a_foreign_file_keeps_its_place(command, tmp_path, capsys):
    arguments, kind = FOLDERS[command]
    for number, name in enumerate(names(command)):
        out = tmp_path / f"out-{number}"
        with run_folder(out, kind):
            pass
        drop(out / name)
        before = tree(tmp_path)
        assert called(*arguments, "--out", out) == 2
        told = capsys.readouterr().err
        if command in ("run", "vehicle"):  # each time a new folder
            assert f"holds a {command} already" in told
        else:
            assert (f"{name} in it is not of spinndrift's making" in told) == (name in kind.files)
        assert tree(tmp_path) == before


def test_folders_inside_a_study_are_refused_before_any_work(tmp_path, capsys):
    for number, name in enumerate(IN_THEM["study"]):
        out = tmp_path / f"out-{number}"
        with run_folder(out, STUDY):
            pass
        drop(out / name)
        before = tree(tmp_path)
        given = ("--scale", "tiny", "--methods", "pinn", "--regime", "rich", "--seeds", "1")
        assert called("study", "ablation", *given, "--out", out) == 2
        assert "holds what spinndrift did not write" in capsys.readouterr().err
        assert tree(tmp_path) == before


def test_folders_inside_a_check_are_refused_before_any_work(tmp_path, capsys):
    drop(tmp_path / "cases" / "one" / "truth.yaml", "kind: 'null'\nverdict: adequate\n")
    for number, name in enumerate(IN_THEM["check"]):
        out = tmp_path / f"out-{number}"
        with run_folder(out, CHECK):
            pass
        drop(out / name)
        before = tree(tmp_path)
        assert called("check", "diagnosis", "--cases", tmp_path / "cases", "--out", out) == 2
        assert "holds what spinndrift did not write" in capsys.readouterr().err
        assert tree(tmp_path) == before


def test_a_demo_without_a_name_takes_a_free_one(tmp_path, capsys):
    drop(tmp_path / "runs" / "demo" / "report.html")
    before = tree(tmp_path)
    assert called("demo", "--log", "missing.tlog") == 2
    assert "missing.tlog" in capsys.readouterr().err
    assert tree(tmp_path) == before


@pytest.mark.parametrize("command", FILES)
@pytest.mark.parametrize("words", ["mine", "", '{"mine": 1}', "model,quantity\n"])
def test_a_foreign_file_is_refused_before_any_work(command, words, tmp_path, capsys):
    arguments, name = FILES[command]
    drop(tmp_path / name, words)
    before = tree(tmp_path)
    assert called(*arguments, "--out", name) == 2
    assert capsys.readouterr().err.startswith(f"spinndrift: --out {name}: is no ")
    assert tree(tmp_path) == before


def test_import_takes_no_foreign_file_for_its_default(tmp_path, capsys):
    drop(tmp_path / "dive.nc")
    assert called("import", "dive.tlog") == 2
    assert "dive.nc: is no recording of spinndrift" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "name", "words", "refused"),
    [
        ("study", "page.md", "# Mine\n", True),
        ("study", "page.md", "# Ablation study\n", False),
        ("study", "page-results.png", "mine", True),
        ("study", "page-mine.png", "mine", False),
        ("check", "page.md", "# Mine\n", True),
        ("check", "page.md", f"# Mine\n{BEGIN}\n{END}\n", False),
        ("estimator", "page.md", "# Mine\n", True),
    ],
)
def test_pages_of_people_stay(command, name, words, refused, tmp_path, capsys):
    drop(tmp_path / name, words)
    before = tree(tmp_path)
    arguments, _ = FOLDERS[command]
    assert called(*arguments, "--out", "out", "--docs", "page.md") == 2
    assert ("--docs page.md" in capsys.readouterr().err) == refused
    assert tree(tmp_path) == before


@pytest.mark.parametrize("command", FOLDERS)
def test_the_second_command_on_one_folder_is_refused_at_once(command, tmp_path, capsys):
    arguments, kind = FOLDERS[command]
    with held_elsewhere(tmp_path / "out", kind.name):
        before = tree(tmp_path)
        assert called(*arguments, "--out", "out") == 2
        told = capsys.readouterr().err
        assert told.startswith("spinndrift: --out out: another spinndrift command is writing there")
        assert tree(tmp_path) == before


@pytest.mark.parametrize("command", FOLDERS)
def test_a_full_disk_is_told_before_any_work(command, tmp_path, capsys):
    arguments, _ = FOLDERS[command]
    with full_disk():
        assert called(*arguments, "--out", "out") == 2
    told = capsys.readouterr().err
    assert f"{MARKER}: can't be written (File too large); make room there" in told
    assert len(told.splitlines()) == 1
    assert tree(tmp_path) == {}


def test_a_demo_flies_what_it_is_told_or_refuses_before_any_work(tmp_path, capsys):
    drop(tmp_path / "rov.yaml", "name: rov\n")
    for arguments, words in (
        (("--scenario", "station_keeping_calm"), "--scenario: station_keeping_calm is steered by"),
        (("--vehicle", "rov.yaml"), "rov.yaml"),
        (("--vehicle", "none.yaml"), "none.yaml"),
        (("--steps", "0"), "steps"),
    ):
        assert called("demo", "--out", "out", *arguments) == 2
        told = capsys.readouterr().err
        assert words in told
        assert "training" not in told
        assert set(tree(tmp_path)) == {"rov.yaml"}
