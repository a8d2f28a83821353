"""Whatever goes wrong while a file is written, the old one stays and nothing else is left."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.models.files.atomic import atomic_files, atomic_path, check_writable


@pytest.fixture
def target(tmp_path: Path) -> Path:
    path = tmp_path / "log.nc"
    path.write_text("old")
    return path


def test_new_content_replaces_old_only_when_the_block_ends(target: Path):
    with atomic_path(target) as partial:
        partial.write_text("new")
        assert target.read_text() == "old"
        assert partial.parent == target.parent  # one file system, so the rename is atomic
        assert partial.suffix == target.suffix
    assert target.read_text() == "new"
    assert os.listdir(target.parent) == ["log.nc"]


def test_missing_folders_are_made(tmp_path: Path):
    with atomic_path(tmp_path / "runs" / "one" / "metrics.yaml") as partial:
        partial.write_text("a: 1")
    assert (tmp_path / "runs" / "one" / "metrics.yaml").read_text() == "a: 1"


@pytest.mark.parametrize("fault", [RuntimeError, KeyboardInterrupt, SystemExit, GeneratorExit])
@pytest.mark.parametrize("when", ["before writing", "half way", "after writing"])
def test_a_fault_leaves_the_old_file_and_no_litter(target: Path, fault, when: str):
    def write():
        with atomic_path(target) as partial:
            if when != "before writing":
                partial.write_text("ne" if when == "half way" else "new")
            raise fault

    with pytest.raises(fault):
        write()
    assert target.read_text() == "old"
    assert os.listdir(target.parent) == ["log.nc"]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failing_disk_leaves_the_old_file_and_no_litter(target: Path, monkeypatch, step: str):
    def fail(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, step, fail)
    words = r"log\.nc: can't be written \(No space left on device\); make room"
    with pytest.raises(UserError, match=words), atomic_path(target) as partial:
        partial.write_text("new")
    monkeypatch.undo()
    assert target.read_text() == "old"
    assert os.listdir(target.parent) == ["log.nc"]


def test_a_killed_process_leaves_the_old_file(target: Path):
    script = (
        "import os, signal, sys\n"
        "from spinndrift.models.files.atomic import atomic_path\n"
        "with atomic_path(sys.argv[1]) as partial:\n"
        "    partial.write_text('ne')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(target)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert target.read_text() == "old"
    left = [name for name in os.listdir(target.parent) if name != "log.nc"]
    assert all(name.startswith(".partial-") for name in left)


def test_a_block_that_writes_nothing_is_an_error(target: Path):
    with pytest.raises(FileNotFoundError, match="nothing was written"), atomic_path(target):
        pass
    assert target.read_text() == "old"


def test_a_writer_that_adds_its_own_suffix_is_told_and_leaves_no_litter(tmp_path: Path):
    with (
        pytest.raises(FileNotFoundError, match="nothing was written"),
        atomic_path(tmp_path / "weights") as partial,
    ):
        np.save(partial, np.zeros(3))
    assert os.listdir(tmp_path) == []


def test_a_writer_that_looks_at_the_suffix_finds_it(tmp_path: Path):
    with atomic_path(tmp_path / "weights.v1.npy") as partial:
        np.save(partial, np.arange(3))
    np.testing.assert_array_equal(np.load(tmp_path / "weights.v1.npy"), np.arange(3))


def test_a_block_that_makes_a_folder_is_told_and_leaves_no_litter(target: Path):
    with (
        pytest.raises(FileNotFoundError, match="nothing was written"),
        atomic_path(target) as partial,
    ):
        (partial / "inside").mkdir(parents=True)
    assert target.read_text() == "old"
    assert os.listdir(target.parent) == ["log.nc"]


def test_folders_and_devices_are_refused_before_any_work(tmp_path: Path):
    for path in (tmp_path, Path(os.devnull)):
        with pytest.raises(UserError, match="no regular file"), atomic_path(path):
            pytest.fail("the block ran")
    assert Path(os.devnull).is_char_device()


def test_a_file_in_place_of_the_folder_is_refused(target: Path):
    for path in (target / "metrics.yaml", target / "deep" / "metrics.yaml"):
        with pytest.raises(UserError, match="is no folder"), atomic_path(path):
            pytest.fail("the block ran")
    assert target.read_text() == "old"


def test_a_link_stays_a_link(target: Path, tmp_path: Path):
    link = tmp_path / "latest.nc"
    link.symlink_to(target.name)
    with atomic_path(link) as partial:
        partial.write_text("new")
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_the_mode_of_the_old_file_is_kept(target: Path):
    target.chmod(0o600)
    with atomic_path(target) as partial:
        partial.write_text("new")
    assert target.stat().st_mode & 0o777 == 0o600


def test_the_longest_name_a_folder_takes_works(tmp_path: Path):
    path = tmp_path / f"{'n' * 250}.yaml"
    with atomic_path(path) as partial:
        partial.write_text("a: 1")
    assert path.read_text() == "a: 1"


def test_relative_paths_follow_the_working_folder(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with atomic_path("a.yaml") as partial:
        partial.write_text("a: 1")
    assert (tmp_path / "a.yaml").read_text() == "a: 1"


def fill(partial: Path, words: str) -> None:
    (partial / "deep").mkdir()
    for name in ("a.json", "b.html", "deep/c.spinn"):
        (partial / name).write_text(words)


def content(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_text() for path in files}


WHOLE = {"a.json": "new", "b.html": "new", "deep/c.spinn": "new"}


def test_files_of_a_new_folder_appear_together(tmp_path: Path):
    out = tmp_path / "runs" / "out"
    with atomic_files(out) as partial:
        fill(partial, "new")
        assert content(out) == {f"{partial.name}/{name}": "new" for name in WHOLE}
    assert content(tmp_path / "runs") == {f"out/{name}": text for name, text in WHOLE.items()}


def test_files_replace_their_namesakes_and_leave_the_others(tmp_path: Path):
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / "a.json").write_text("old")
    (tmp_path / "a.json").chmod(0o600)
    with atomic_files(tmp_path) as partial:
        fill(partial, "new")
        assert (tmp_path / "a.json").read_text() == "old"
    assert content(tmp_path) == WHOLE | {"mine.txt": "mine"}
    assert {p.name for p in tmp_path.iterdir()} == {"mine.txt", "a.json", "b.html", "deep"}
    assert (tmp_path / "a.json").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("fault", [RuntimeError, KeyboardInterrupt])
def test_a_fault_among_files_leaves_the_folder_as_it_was(tmp_path: Path, fault, there: bool):
    out = tmp_path / "out"
    if there:
        out.mkdir()
        (out / "a.json").write_text("old")

    def write():
        with atomic_files(out) as partial:
            fill(partial, "new")
            raise fault

    with pytest.raises(fault):
        write()
    assert content(tmp_path) == ({"out/a.json": "old"} if there else {})
    assert out.exists() == there


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_between_replacements_waits_until_all_are_done(tmp_path: Path, monkeypatch):
    (tmp_path / "b.html").write_text("old")
    replace, moved = os.replace, []

    def interrupted(*paths):
        replace(*paths)
        moved.append(paths)
        if len(moved) == 1:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(os, "replace", interrupted)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), atomic_files(tmp_path) as partial:
        fill(partial, "new")
    assert signal.getsignal(signal.SIGINT) is before
    assert content(tmp_path) == WHOLE
    assert len(moved) == 3


@pytest.mark.parametrize(("name", "words"), [("deep", "no folder"), ("b.html", "no regular file")])
def test_what_can_not_be_replaced_is_told_before_anything_is(tmp_path: Path, name, words):
    (tmp_path / "a.json").write_text("old")
    if name == "deep":
        (tmp_path / name).write_text("mine")
    else:
        (tmp_path / name).mkdir()
    before = content(tmp_path)
    with pytest.raises(UserError, match=words), atomic_files(tmp_path) as partial:
        fill(partial, "new")
    assert content(tmp_path) == before


def test_places_that_can_be_written_are_let_through_untouched(target: Path):
    for path in (target, target.parent, target.parent / "a" / "b" / "c"):
        check_writable(path)
    assert content(target.parent) == {target.name: "old"}
    assert os.listdir(target.parent) == [target.name]


def test_places_that_can_not_be_written_are_refused(target: Path):
    for path in (target / "out", target / "deep" / "out"):
        with pytest.raises(UserError, match=r"^--out .*is no folder; name"):
            check_writable(path, "--out")
    with pytest.raises(UserError, match=r"^--out /proc/nope: nothing can be written there"):
        check_writable("/proc/nope", "--out")
    with pytest.raises(UserError, match="nothing can be written there"):
        check_writable(target.parent / ("n" * 300) / "out")
