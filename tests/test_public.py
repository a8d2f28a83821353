"""The package's public names: which they are, and that the example in each docstring runs."""

import ast
import dataclasses
import doctest
import inspect
from pathlib import Path

import jax
import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

import spinndrift
from helpers import ROOT, run_python

pytestmark = pytest.mark.whole

NAMES = """
    UserError Vehicle load_vehicle FossenDynamics Spinn EffectConfig save_model load_model
    Recording Trajectory write_csv load_data
    GenerateConfig generate make_windows TrainingConfig fit evaluate DiagnoseConfig diagnose
    StationConfig make_station build_diagram seeded logged CompiledSimulator
    MppiConfig MppiImpedance Own OwnFilter Scenario load_scenario simulate
""".split()  # noqa: SIM905 - grouped by topic
SLOW = ("diagnose", "CompiledSimulator", "fit", "logged")  # they have tests of their own
USED = {"np": np, "jax": jax, "dataclasses": dataclasses, "Path": Path, "Simulator": Simulator}


def test_the_public_names_are_these():
    assert sorted(spinndrift.__all__) == sorted(NAMES)
    assert set(NAMES) <= set(dir(spinndrift))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        spinndrift.nothing  # noqa: B018


def test_type_checkers_see_the_same_names():
    tree = ast.parse(Path(spinndrift.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {
        (alias.asname, node.module)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == {(name, spinndrift._MODULES[name]) for name in NAMES}


@pytest.mark.smoke
def test_a_name_of_models_imports_no_other_room():
    told = run_python(
        "import sys, spinndrift; bare = set(sys.modules); spinndrift.load_vehicle; "
        "print([m for m in ('jax', 'numpy') if m in bare], 'pydrake' in sys.modules, "
        "any(m.startswith(('spinndrift.training', 'spinndrift.systems')) for m in sys.modules))"
    )
    assert told.split() == ["[]", "False", "False"]


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n in SLOW)) for n in NAMES]
)
def test_the_example_in_the_docstring_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    names = {other: getattr(spinndrift, other) for other in NAMES} | USED
    text = inspect.getdoc(names[name])
    assert text is not None
    test = doctest.DocTestParser().get_doctest(text, names, name, None, 0)
    assert test.examples
    failed = []
    doctest.DocTestRunner(verbose=False).run(test, out=failed.append)
    assert not failed, "".join(failed)
