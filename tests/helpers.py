"""What several test files need: where data lies, how to run code in a fresh interpreter."""

import importlib.util
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("models", "training", "systems", "sims")


def shared_data(*parts: str) -> Path:
    """Return a path under the `shared` folder beside the checkout, or skip the test without it."""
    path = Path(os.environ.get("SPINNDRIFT_SHARED", ROOT.parent / "shared")).joinpath(*parts)
    if not path.exists():
        pytest.skip(f"needs {Path('shared', *parts)} beside the checkout")
    return path


@contextmanager
def full_disk(size: int = 0) -> Iterator[None]:
    """No file of this process may grow beyond `size` bytes: an `OSError` as of a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def module_files(*rooms: str) -> dict[str, Path]:
    """Return every module of the named rooms (all by default): dotted name to source file."""
    found = {}
    for room in rooms or ROOMS:
        for path in sorted((ROOT / room).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(("spinndrift", *parts)).removesuffix(".__init__")] = path
    return found


def run_python(code: str, *arguments: str, timeout: float = 300) -> str:
    """Run `code` in a fresh interpreter and return its standard output; fail with its errors."""
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    if done.returncode != 0:
        pytest.fail(f"exit code {done.returncode}:\n{done.stdout}\n{done.stderr}", pytrace=False)
    return done.stdout


def load_example(name: str) -> ModuleType:
    """Return the module of `examples/<name>.py`."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run_script(path: Path, *arguments: str, timeout: float = 300) -> tuple[int, str, str]:
    """Run a script in a fresh interpreter; return exit code, standard output and errors."""
    command = [sys.executable, str(path), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    return done.returncode, done.stdout, done.stderr
