"""Commands in a process of their own that is killed when a file is about to take its place."""

import os
import signal
import subprocess
import sys
from pathlib import Path

from helpers import ROOT

_DIE = """
import os, signal, sys
name, times, prepare, replace = sys.argv[1], int(sys.argv[2]), sys.argv[3], os.replace

def die(old, new):
    global times
    times -= os.path.basename(new) == name
    if times == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    replace(old, new)

os.replace = die
exec(prepare)
from spinndrift.sims.cli import main
main(sys.argv[4:])
"""


def killed(name: str, times: int, prepare: str, *arguments: object) -> None:
    """Run a command until a file of this name is to take its place for so many times.

    `prepare` is run before it, to put what compiles fast in place of what does not.
    """
    paths = os.pathsep.join([str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", _DIE, name, str(times), prepare, *map(str, arguments)],
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr


def litter(folder: Path) -> list[str]:
    """Names of files that were being written, and of locks."""
    return [p.name for p in folder.rglob("*") if ".partial" in p.name or p.name.endswith(".lock")]
