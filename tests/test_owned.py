"""Folders and files of this package: nothing foreign is touched, one process at a time writes."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.models.files.locks import BusyError, locked
from spinndrift.models.files.owned import (
    MARKER,
    FolderKind,
    ForeignError,
    check_file,
    claim,
    output_file,
    run_folder,
)

KIND = FolderKind("survey", ("log.nc", "page.md", "deep/model.spinn"), edited=("page.md",))
OTHER = FolderKind("dive", ("log.nc",))
HOLD = """
import sys, time
from pathlib import Path
from spinndrift.models.files.owned import FolderKind, run_folder
with run_folder(sys.argv[1], FolderKind(sys.argv[2], ("log.nc",))) as folder:
    (folder / "log.nc").write_text("half")
    print("held", flush=True)
    time.sleep(60)
"""


def tree(folder: Path) -> dict[str, bytes | None]:
    """All that is in a folder: contents of files, None for folders."""
    found = sorted(folder.rglob("*"))
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in found}


def write(folder: Path, words: str = "ours") -> None:
    for name in KIND.files:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(words)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A finished folder."""
    with run_folder(tmp_path / "out", KIND) as folder:
        write(folder)
    return tmp_path / "out"


@contextmanager
def held_elsewhere(out: Path, kind: str = KIND.name) -> Iterator[subprocess.Popen]:
    """Another process at work in a folder."""
    code = [sys.executable, "-c", HOLD, str(out), kind]
    with subprocess.Popen(code, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        try:
            yield other
        finally:
            other.kill()


@pytest.mark.smoke
def test_a_folder_says_what_it_is(out: Path):
    told = json.loads((out / MARKER).read_text())
    assert told["kind"] == "survey"
    assert told["version"]
    assert told["finished"]
    assert set(told["files"]) == set(KIND.files)
    assert set(tree(out)) == {*KIND.files, "deep", MARKER}


@pytest.mark.parametrize("name", ["notes.txt", *KIND.files, "training/checkpoint.npz", MARKER])
def test_a_folder_that_is_not_ours_is_refused_by_name(tmp_path: Path, name: str):
    at = tmp_path / "proj" / name
    at.parent.mkdir(parents=True)
    at.write_text("mine")
    before = tree(tmp_path)
    words = rf"--out \S+/proj: .*{Path(name).parts[0]}|spinndrift.json: is no marker"
    with pytest.raises(UserError, match=words), run_folder(tmp_path / "proj", KIND):
        pytest.fail("the block ran")
    with pytest.raises(UserError):
        claim(tmp_path / "proj", KIND)
    assert tree(tmp_path) == before


def test_what_is_ours_is_replaced_and_the_rest_stays(out: Path):
    for name in ("notes.txt", "deep/notes.txt", "mine/log.nc"):
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text("mine")
    before = tree(out)
    with run_folder(out, KIND) as folder:
        write(folder, "new")
    after = tree(out)
    assert {k: v for k, v in after.items() if k not in (*KIND.files, MARKER)} == {
        k: v for k, v in before.items() if k not in (*KIND.files, MARKER)
    }
    assert after["log.nc"] == b"new"


@pytest.mark.parametrize("name", ["log.nc", "deep/model.spinn"])
@pytest.mark.parametrize("how", ["changed", "folder", "link", "removed before"])
def test_a_file_that_took_the_place_of_ours_is_refused(out: Path, name: str, how: str):
    (out / name).unlink()
    if how == "folder":
        (out / name).mkdir()
        (out / name / "notes.txt").write_text("mine")
    elif how == "link":
        (out.parent / "mine").write_text("ours")
        (out / name).symlink_to(out.parent / "mine")
    else:
        if how == "removed before":
            with run_folder(out, KIND):
                pass
        (out / name).write_text("mine")
    before = tree(out.parent)
    words = f"{name} in it (was changed|is not of)"
    with pytest.raises(UserError, match=words), run_folder(out, KIND):
        pytest.fail("the block ran")
    assert tree(out.parent) == before


def test_a_file_where_a_folder_has_to_be_is_refused(tmp_path: Path):
    with run_folder(tmp_path / "out", KIND) as out:
        (out / "log.nc").write_text("ours")
    (out / "deep").write_text("mine")
    with pytest.raises(UserError, match="deep in it is no folder"), run_folder(out, KIND):
        pytest.fail("the block ran")


def test_pages_that_people_may_write_in_are_no_conflict(out: Path):
    (out / "page.md").write_text("ours, with words of mine")
    with run_folder(out, KIND):
        assert (out / "page.md").read_text() == "ours, with words of mine"


def test_other_kinds_and_later_versions_are_refused(out: Path):
    with pytest.raises(ForeignError, match="holds a survey, no dive"), run_folder(out, OTHER):
        pytest.fail("the block ran")
    told = json.loads((out / MARKER).read_text())
    (out / MARKER).write_text(json.dumps(told | {"format": 99}))
    with pytest.raises(UserError, match="later version"), run_folder(out, KIND):
        pytest.fail("the block ran")


def test_a_marker_by_hand_adopts_a_folder(tmp_path: Path):
    write(tmp_path)
    (tmp_path / MARKER).write_text('{"kind": "survey"}')
    with run_folder(tmp_path, KIND) as folder:
        write(folder, "new")
    assert (tmp_path / "log.nc").read_text() == "new"


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("fault", [UserError, KeyboardInterrupt])
def test_a_block_that_fails_before_it_writes_leaves_no_trace(tmp_path: Path, there, fault):
    if there:
        (tmp_path / "deep" / "out").mkdir(parents=True)
    before = tree(tmp_path)

    def fail() -> None:
        with run_folder(tmp_path / "deep" / "out", KIND) as folder:
            assert (folder / MARKER).exists()
            raise fault("no")

    with pytest.raises(fault):
        fail()
    assert tree(tmp_path) == before


def test_a_block_that_fails_leaves_a_finished_folder_finished(out: Path):
    before = tree(out)
    with pytest.raises(UserError), run_folder(out, KIND):
        raise UserError("no")
    assert tree(out) == before

    def fail() -> None:
        with run_folder(out, KIND):
            (out / "log.nc").write_text("half")
            raise UserError("no")

    with pytest.raises(UserError):
        fail()
    assert not json.loads((out / MARKER).read_text())["finished"]
    with run_folder(out, KIND, new=True):  # an unfinished one may be begun anew
        write(out)
    with pytest.raises(UserError, match="holds a survey already"), run_folder(out, KIND, new=True):
        pytest.fail("the block ran")


def test_the_second_process_is_refused_and_the_lock_goes_with_the_first(tmp_path: Path):
    out = tmp_path / "out"
    with held_elsewhere(out) as other:
        before = tree(tmp_path)
        words = "--out .*another spinndrift command is writing there"
        with pytest.raises(BusyError, match=words), run_folder(out, KIND):
            pytest.fail("the block ran")
        assert tree(tmp_path) == before
        other.send_signal(signal.SIGKILL)
        assert other.wait() == -signal.SIGKILL
    left = {".spinndrift.lock", ".partial-0123456789abcdef.nc"}
    (out / ".partial-0123456789abcdef.nc").write_text("ha")
    assert left < set(os.listdir(out))
    with run_folder(out, KIND) as folder:
        assert (folder / "log.nc").read_text() == "half"
        write(folder)
    assert set(tree(out)) == {*KIND.files, "deep", MARKER}


def test_what_a_killed_process_left_is_not_foreign(tmp_path: Path):
    for name in (".spinndrift.lock", ".partial-0123456789abcdef.json"):
        (tmp_path / name).write_text("")
    with run_folder(tmp_path, KIND) as folder:
        write(folder)
    assert set(tree(tmp_path)) == {*KIND.files, "deep", MARKER}


def test_a_lock_outlives_the_file_that_another_one_removes(tmp_path: Path):
    """Who opened the file before it was removed must not hold what nobody else can see."""
    at = tmp_path / "lock"
    with locked(at, "--out x"):
        at.unlink()
        with locked(at, "--out x"):
            assert at.exists()
    assert not at.exists()
    with locked(at, "--out x"), pytest.raises(BusyError), locked(at, "--out x"):
        pytest.fail("the block ran")


def own(path: Path) -> bool:
    return path.read_text().startswith("ours")


def test_single_files_replace_their_like_alone(tmp_path: Path):
    at = tmp_path / "deep" / "dive.nc"
    with pytest.raises(RuntimeError), output_file(at, own, "recording"):
        raise RuntimeError
    assert tree(tmp_path) == {}
    for words in ("ours", "ours, anew"):
        with output_file(at, own, "recording") as path:
            path.write_text(words)
    assert tree(tmp_path) == {"deep": None, "deep/dive.nc": b"ours, anew"}
    at.write_text("mine")
    with (
        pytest.raises(UserError, match=r"--out \S+dive.nc: is no recording, so it is not replaced"),
        output_file(at, own, "recording"),
    ):
        pytest.fail("the block ran")
    with (
        output_file(tmp_path / "a.nc", own, "recording"),
        pytest.raises(BusyError),
        output_file(tmp_path / "a.nc", own, "recording"),
    ):
        pytest.fail("the block ran")
    with pytest.raises(UserError, match="is no regular file"):
        check_file(tmp_path, own, "recording")


def test_a_single_file_takes_no_place_in_a_folder_of_ours(out: Path):
    for name in ("log.nc", MARKER):
        with pytest.raises(UserError, match=f"belongs to what {out} holds"):
            check_file(out / name, own, "recording")
    check_file(out / "more.nc", own, "recording")
