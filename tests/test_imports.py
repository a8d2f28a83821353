"""Importing the package does nothing else: no settings, no variables, no output, no generators."""

import json
import os
from pathlib import Path

import pytest

import spinndrift
from helpers import module_files, run_python

pytestmark = pytest.mark.smoke

IMPORT_ALL = """
import importlib, json, os, random, sys, threading
import jax, jax.numpy, numpy, pydrake.all, matplotlib.pyplot, xarray
import rich.style  # draws once from the global generator

def world():
    return {
        "jax settings": repr(sorted(jax.config.values.items())),
        "os.environ": dict(os.environ),
        "working folder": os.getcwd(),
        "sys.path": list(sys.path),
        "NumPy's global generator": repr(numpy.random.get_state()),
        "random's global generator": repr(random.getstate()),
        "NumPy's error handling": numpy.geterr(),
        "matplotlib's settings": repr(dict(matplotlib.rcParams)),
        "threads": threading.active_count(),
    }

changed = {}
before = world()
for name in sys.argv[1:]:
    importlib.import_module(name)
    after = world()
    told = [key for key in before if before[key] != after[key]]
    if told:
        changed[name] = told
    before = after
print("CHANGED", json.dumps(changed))
"""


def test_importing_any_module_changes_nothing_and_prints_nothing():
    output = run_python(IMPORT_ALL, *module_files())
    head, _, changed = output.partition("CHANGED ")
    assert head == ""
    assert json.loads(changed) == {}


def test_the_copy_under_test_is_the_one_asked_for():
    # `make test` sets this when it runs the smoke part against the built wheel.
    wanted = os.environ.get("SPINNDRIFT_EXPECTED_UNDER")
    if wanted is None:
        pytest.skip("SPINNDRIFT_EXPECTED_UNDER names no folder")
    folder = Path(wanted).resolve(strict=True)
    assert Path(spinndrift.__file__).resolve().is_relative_to(folder)
    script = "import spinndrift.models as m, sys; print(m.__file__)"
    assert Path(run_python(script).strip()).resolve().is_relative_to(folder)


def test_version_is_the_installed_one():
    assert spinndrift.__version__[0].isdigit()
    assert spinndrift.__version__ != "0+unknown"


def test_the_package_runs_as_the_command():
    told = run_python(
        "import runpy, sys; sys.argv[1:] = ['--version']; "
        "runpy.run_module('spinndrift', run_name='__main__')"
    )
    assert told.strip() == spinndrift.__version__
