"""The root folders, the links under src/ and the wheel hold the same package."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from helpers import ROOMS, ROOT, module_files

PACKAGE = ROOT / "src" / "spinndrift"
DATA_SUFFIXES = {".yaml", ".csv", ".xz", ".html", ".css", ".json"}  # as in pyproject.toml


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.Path:
    # Built from a copy: a build/ folder left in the tree can't fill in what the sources lack.
    folder = tmp_path_factory.mktemp("wheel")
    tree = folder / "tree"
    for name in (*ROOMS, "src"):
        ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
        shutil.copytree(ROOT / name, tree / name, symlinks=True, ignore=ignored)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tree)
    options = ["--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--wheel-dir", folder]
    subprocess.run(
        [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", *options, tree],
        check=True,
    )
    (built,) = folder.glob("*.whl")
    return zipfile.Path(built)


@pytest.mark.parametrize("room", ROOMS)
def test_each_room_is_linked_into_the_package(room: str):
    link = PACKAGE / room
    assert link.is_symlink(), f"{link} must be a link; does git keep links here (core.symlinks)?"
    assert link.readlink() == Path("..", "..", room)
    assert link.resolve() == ROOT / room


def test_every_folder_of_modules_is_a_package():
    for path in module_files().values():
        assert (path.parent / "__init__.py").is_file(), f"{path.parent} lacks __init__.py"


def test_the_wheel_holds_every_module_and_every_data_file(wheel: zipfile.Path):
    names = set(wheel.root.namelist())
    expected = {f"spinndrift/{name}" for name in ("__init__.py", "__main__.py", "py.typed")}
    for room in ROOMS:
        for path in (ROOT / room).rglob("*"):
            if path.suffix == ".py" or path.suffix in DATA_SUFFIXES:
                expected.add(f"spinndrift/{path.relative_to(ROOT).as_posix()}")
    assert expected - names == set()
    extra = {n for n in names - expected if ".dist-info/" not in n and not n.endswith("/")}
    assert extra == set()


def test_every_data_file_has_a_suffix_that_the_wheel_takes():
    known = DATA_SUFFIXES | {".py", ".pyc", ".md"}
    for room in ROOMS:
        for path in (ROOT / room).rglob("*"):
            assert path.is_dir() or path.suffix in known, f"{path} would not be in the wheel"


def test_the_wheel_tells_licence_version_and_command(wheel: zipfile.Path):
    (info,) = (entry for entry in wheel.iterdir() if entry.name.endswith(".dist-info"))
    metadata = (info / "METADATA").read_text(encoding="utf-8")
    assert "License-Expression: BSD-3-Clause" in metadata
    assert "Requires-Python: >=3.11" in metadata
    assert "spinndrift = spinndrift.sims.cli:main" in (info / "entry_points.txt").read_text()
    assert (info / "licenses" / "LICENSE").exists()
