"""Rooms build on each other in one direction: models, then training and systems, then sims."""

import ast
import json
from pathlib import Path

import pytest

from helpers import ROOMS, module_files, run_python

ALLOWED = {
    "models": {"models"},
    "training": {"training", "models"},
    "systems": {"systems", "models"},
    "sims": {"sims", "systems", "training", "models"},
}
WITHOUT = {
    "models": {"pydrake", "pymavlink"},
    "training": {"pydrake", "pymavlink"},
    "systems": set(),
}

IMPORT_EACH = """
import importlib, json, sys
forbidden, names = map(json.loads, sys.argv[1:])
for name in names:
    importlib.import_module(name)
    found = [other for other in forbidden if other in sys.modules]
    if found:
        sys.exit(f"importing {name} imports {found}")
"""


def imported(name: str, path: Path) -> set[str]:
    """Return the dotted names that a module's import statements reach, wherever they stand."""
    package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parent = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*parent, *([node.module] if node.module else [])])
            found.update(f"{source}.{alias.name}" for alias in node.names)
    return found


@pytest.mark.smoke
@pytest.mark.parametrize("room", ALLOWED)
def test_import_statements_reach_only_rooms_below(room: str):
    for name, path in module_files(room).items():
        for target in imported(name, path):
            top, _, rest = target.partition(".")
            if top == "spinndrift" and rest.split(".")[0] in ALLOWED:
                assert rest.split(".")[0] in ALLOWED[room], f"{name} imports {target}"
            assert top not in WITHOUT.get(room, set()), f"{name} imports {target}"
            assert top not in ALLOWED, f"{name} imports {target} without its package"


@pytest.mark.smoke
@pytest.mark.parametrize("room", ["models", "training", "systems"])
def test_importing_a_room_pulls_in_nothing_it_must_not(room: str):
    # One interpreter imports the modules one after the other and names the first offender.
    above = {f"spinndrift.{other}" for other in set(ALLOWED) - ALLOWED[room]}
    forbidden = sorted(above | WITHOUT.get(room, set()))
    names = list(module_files(room))
    assert f"spinndrift.{room}" in names
    run_python(IMPORT_EACH, json.dumps(forbidden), json.dumps(names))


def test_the_check_of_import_statements_sees_every_form(tmp_path: Path):
    path = tmp_path / "m.py"
    path.write_text(
        "import pydrake.all as drake\n"
        "from . import a\n"
        "from .. import systems\n"
        "from ..sims.cli import main\n"
        "def f():\n"
        "    from pymavlink import mavutil\n"
    )
    assert imported("spinndrift.models.m", path) == {
        "pydrake.all",
        "spinndrift.models.a",
        "spinndrift.systems",
        "spinndrift.sims.cli.main",
        "pymavlink.mavutil",
    }


@pytest.mark.smoke
def test_modules_import_each_other_in_one_direction():
    files = {name: path for room in ROOMS for name, path in module_files(room).items()}
    arrows: dict[str, set[str]] = {}
    for name, path in files.items():
        reached = imported(name, path)
        arrows[name] = {t if t in files else t.rpartition(".")[0] for t in reached}
        arrows[name] = arrows[name] & files.keys() - {name}
    done: set[str] = set()

    def visit(name: str, way: tuple[str, ...]) -> None:
        assert name not in way, " → ".join((*way[way.index(name) :], name))
        if name not in done:
            for target in sorted(arrows[name]):
                visit(target, (*way, name))
            done.add(name)

    for name in sorted(files):
        visit(name, ())
    assert sum(map(len, arrows.values())) > len(files)
