"""`python -m fuzz`: many mutated inputs; the last line says how many were tried, and how many not
refused as they should be.

Input number n of a kind is the same every time, so `--first` goes on where a run ended. What was
wrong is kept in a folder with what was raised.
"""

import argparse
import resource
import shutil
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

KINDS = ("tlog", "bin", "bag", "netcdf", "csv", "yaml", "checkpoint", "mavlink")
_MEMORY = 8 << 30
"""Bytes of addresses that a reader of such small files may have; JAX alone maps four GB."""


def main() -> int:
    """Try them; 1 if any was wrong."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--count", type=int, default=100_000, help="inputs of each kind")
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS), help="kinds")
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--limit", type=float, default=20.0, help="longest time for one (s)")
    parser.add_argument("--out", type=Path, default=Path("runs/fuzz"), help="what was wrong")
    given = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    import jax

    jax.config.update("jax_enable_x64", True)
    from .harness import judge
    from .kinds import KINDS as known

    warnings.simplefilter("error")  # after the imports, some of which set filters of their own

    tried, wrong = Counter[str](), Counter[str]()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as scratch:
        for name in given.only:
            folder, fates = Path(scratch) / name, Counter[str]()
            began = time.monotonic()
            for number in range(given.first, given.first + given.count):
                folder.mkdir(exist_ok=True)
                verdict = judge(known[name], number, folder, given.limit)
                fates[verdict.fate] += 1
                tried[name] += 1
                if not verdict.sound:
                    wrong[name] += 1
                    _keep(given.out / name, number, folder, verdict.told)
                    print(f"{name} {number}: {verdict.fate}", flush=True)
                if tried[name] % 1000 == 0:
                    seconds = time.monotonic() - began
                    told = ", ".join(f"{count} {fate}" for fate, count in fates.most_common(2))
                    print(f"{name} {number + 1}: {told}, {seconds:.0f} s", flush=True)
                shutil.rmtree(folder)
    parts = ", ".join(f"{count} {name}" for name, count in tried.items())
    print(f"{tried.total()} inputs tried ({parts}): {wrong.total()} raised something else")
    return int(wrong.total() > 0)


def _keep(out: Path, number: int, folder: Path, told: str) -> None:
    """Put an input and what was raised where they can be looked at."""
    target = out / str(number)
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(folder, target)
    (target / "raised.txt").write_text(told, encoding="utf-8", errors="replace")


if __name__ == "__main__":
    sys.exit(main())
