"""`python -m hidden FOLDER`: write blind cases for `spinndrift check diagnosis --cases FOLDER`."""

import argparse
import difflib
import shutil
from fnmatch import fnmatchcase
from pathlib import Path

from .blind import DATA, SCALES, table


def main() -> None:
    """Write every case that is not there yet; a case is whole once its truth.yaml is."""
    parser = argparse.ArgumentParser(prog="python -m hidden", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scale", choices=sorted(SCALES), default="small", help="amount of data")
    parser.add_argument("--seeds", type=int, default=1, help="cases of each cause")
    parser.add_argument("--sizes", type=float, nargs="+", default=[1.0], help="of realistic ones")
    parser.add_argument("--nulls", type=int, help="by default as the scale says")
    parser.add_argument("--mixed", type=int, default=4, help="pairs, and triples")
    parser.add_argument("--data", choices=sorted(DATA), nargs="+", default=["usual"])
    parser.add_argument("--only", nargs="+", default=["*"], help="patterns of names of cases")
    given = parser.parse_args()
    plan, nulls = SCALES[given.scale]
    nulls = nulls if given.nulls is None else given.nulls
    names, taken = [], 0
    for blind in table(plan, nulls, given.seeds, given.sizes, given.mixed, given.data):
        folder = given.folder / blind.name
        names.append(blind.name)
        if not any(fnmatchcase(blind.name, only) for only in given.only):
            continue
        taken += 1
        if not (folder / "truth.yaml").exists():
            shutil.rmtree(folder, ignore_errors=True)
            blind.write(folder)
        print(blind.name)  # noqa: T201
    if not taken:
        near = difflib.get_close_matches(given.only[0], dict.fromkeys(names), n=8, cutoff=0.0)
        there = f"{len(names)} cases, such as {', '.join(near)}" if names else "no case at all"
        parser.error(f"--only {' '.join(given.only)}: no case is called so; there are {there}")


if __name__ == "__main__":
    main()
