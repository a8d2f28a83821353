"""Compiled programs on disk: what a killed process leaves does no harm."""

import os
import subprocess
import sys

from spinndrift.sims.compile_cache import mend

STORE = """
import jax, sys
from pathlib import Path
from spinndrift.sims.compile_cache import keep_compiled
keep_compiled(Path(sys.argv[1]))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.jit(lambda x: x + float(sys.argv[2]))(1.0)
"""


def stored(base, number):
    """Names of the programs in the folder after one more process has compiled `number`."""
    kept = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    command = [sys.executable, "-c", STORE, str(base), str(number)]
    subprocess.run(command, check=True, env=kept, timeout=120)
    (folder,) = base.iterdir()
    return folder, {p.name for p in folder.glob("*-cache")}


def test_a_program_half_written_keeps_no_other_from_being_stored(tmp_path):
    folder, first = stored(tmp_path, 1)
    assert first
    broken = folder / "jit_broken-0-cache"
    broken.write_bytes(b"half a pro")
    _, then = stored(tmp_path, 2)
    assert first < then
    assert broken.name not in then


def test_whole_programs_stay(tmp_path):
    for name in ("a-cache", "a-atime", "b-cache"):
        (tmp_path / name).write_bytes(b"12345678")
    mend(tmp_path)
    assert {p.name for p in tmp_path.glob("*-*")} == {"a-cache", "a-atime"}
    mend(tmp_path / "nowhere")
