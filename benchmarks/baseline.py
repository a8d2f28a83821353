"""Records results of the code, and compares the results of a later revision with them.

```
python benchmarks/baseline.py record before.json --work runs/baseline
python benchmarks/baseline.py compare before.json --work runs/baseline --checkout ../changed
```

It uses the command line and the files that commands write, and imports no module of the package, so
that modules may move between the two revisions. Parts (`--only`):

losses     loss and gradient of the first step of every training method, on generated data
diagnosis  names, places, parameters and verdicts on blind cases: the first seed of every cause,
           6 nulls, 4 pairs, 3 unmodelled structures
demo       the table of the demo's held-out errors
mppi       times of `bench_mppi.py` over its reference, in one run

`--work` holds the data, generated once, and the results by a fingerprint of the code: an
interrupted command resumes, and changed code starts anew. `compare` exits with 1 if anything is
worse. Run both on one machine.
"""

import argparse
import csv
import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from importlib import metadata
from pathlib import Path
from typing import Any, TextIO

from baseline_compare import BANDS, ERRORS, SLOWER, Entries, Row, compare, table

ROOT = Path(__file__).resolve().parent.parent
FORM = 1
CASES = ("*-1-0", "null-*-[0-5]", "pair-[0-3]", "swirl-0", "memory-0", "backlash-0")
"""Patterns of the blind cases' names."""
METHODS = (
    "fdm-geodesic",
    "fdm-geodesic+mse",
    "fdm-chordal",
    "fdm-chordal+mse",
    "moments",
    "moments+mse",
    "pinn",
    "euclidean-fdm",
    "euclidean-moments",
    "euclidean-distance-aware",
    "euclidean-unconstrained",
)
GENERATED = ("--trajectories", "4", "--duration", "6", "--seed", "0")
REFERENCE = "test_reference"
_ERRORS = 2  # standard error, where all but the table goes
LIBRARIES = ("jax", "jaxlib", "numpy", "scipy", "equinox", "optax", "drake")


class BaselineError(Exception):
    """A sentence for the user."""


def say(text: str, where: TextIO | None = None) -> None:
    print(text, file=where or sys.stderr, flush=True)


# ---------------------------------------------------------------------------------------- the code


def digest(files: Iterable[tuple[str, Path]], more: str = "") -> str:
    """SHA-256 of names and contents."""
    found = hashlib.sha256(more.encode())
    for name, path in sorted(files):
        content = path.read_bytes()
        found.update(f"\0{name}\0{len(content)}\0".encode() + content)
    return found.hexdigest()


def sources(checkout: Path) -> Iterator[tuple[str, Path]]:
    """Files of the package; `src/spinndrift` holds links to folders."""
    package = checkout / "src" / "spinndrift"
    for folder, _, names in os.walk(package, followlinks=True):
        for name in names:
            path = Path(folder, name)
            if path.suffix != ".pyc":
                yield path.relative_to(package).as_posix(), path


def surroundings() -> dict[str, str]:
    """Versions, processor and flags that results depend on too."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in LIBRARIES},
        "processor": models[0] if models else platform.processor() or platform.machine(),
        "cores": str(os.cpu_count()),
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", ""),
    }


@dataclass(frozen=True)
class Code:
    """A checkout, run by this interpreter, and where its results lie."""

    checkout: Path
    work: Path
    fingerprint: str
    about: dict[str, Any]

    @classmethod
    def of(cls, checkout: Path, work: Path) -> "Code":
        """Raises BaselineError: there is no such checkout."""
        checkout, work = checkout.resolve(), work.resolve()
        for needed in ("pyproject.toml", "src/spinndrift/__init__.py", "benchmarks/bench_mppi.py"):
            if not (checkout / needed).is_file():
                raise BaselineError(f"--checkout {checkout}: lacks {needed}; name a checkout")
        versions = surroundings()
        fingerprint = digest(sources(checkout), json.dumps(versions))
        git = ("git", "-C", str(checkout))
        revision = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True)
        state = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True)
        about = {
            "revision": revision.stdout.strip() or "unknown",
            "changed": bool(state.stdout.strip()),
            "versions": versions,
        }
        work.mkdir(parents=True, exist_ok=True)
        return cls(checkout, work, fingerprint, about)

    @property
    def results(self) -> Path:
        """Of this code alone."""
        folder = self.work / "results" / self.fingerprint[:16]
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def python(self, told: str, *arguments: str, at: Path | None = None) -> None:
        """Run this interpreter on the checkout's package; what it says goes to standard error.

        Raises:
            BaselineError: it failed.
        """
        environment = os.environ | {"PYTHONPATH": str(self.checkout / "src")}
        command = [sys.executable, *arguments]
        with subprocess.Popen(
            command, cwd=at or self.work, env=environment, stdout=_ERRORS
        ) as child:
            try:
                code = child.wait()
            except KeyboardInterrupt:
                child.wait()  # it was interrupted too, and leaves whole files
                raise
        if code:
            raise BaselineError(f"{told}: ended with code {code}; what it said is above")

    def spinndrift(self, *arguments: str) -> None:
        """Run a command of the checkout: what pyproject.toml names, wherever that module lies."""
        project = tomllib.loads((self.checkout / "pyproject.toml").read_text(encoding="utf-8"))
        module, _, function = project["project"]["scripts"]["spinndrift"].partition(":")
        start = f"import sys; from {module} import {function}; sys.exit({function}())"
        self.python(" ".join(("spinndrift", *arguments)), "-c", start, *arguments)

    def check(self) -> None:
        """Raises BaselineError: an installed copy hides the checkout."""
        package = self.checkout / "src" / "spinndrift" / "__init__.py"
        program = "import spinndrift, sys; sys.exit(spinndrift.__file__ != sys.argv[1])"
        try:
            self.python("import", "-c", program, str(package))
        except BaselineError as error:
            raise BaselineError(
                f"--checkout {self.checkout}: this interpreter imports another spinndrift"
            ) from error


# --------------------------------------------------------------------------------------- the parts


@dataclass(frozen=True)
class Task:
    """What to do: `recorded` holds what it is compared with, or nothing yet."""

    code: Code
    cases: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    workers: int = 0
    recorded: Entries | None = None


def read_json(path: Path) -> Any:
    """Raises BaselineError: there is no such file, or it isn't JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BaselineError(f"{path}: can't be read ({error})") from error


def check_data(recorded: Entries | None, name: str, data: str, path: Path) -> None:
    """Raises BaselineError: results on other data can't be compared."""
    known = (recorded or {}).get(name, {}).get("data", data)
    if known != data:
        raise BaselineError(
            f"{path}: is not what {name} was recorded with; give the --work of the record, or the "
            "checkout that made its data first"
        )


def losses(task: Task) -> Entries:
    """Loss and gradient norm of one step: the first row of metrics.csv."""
    code, data = task.code, task.code.work / "recording.nc"
    if not data.exists():
        code.spinndrift("generate", *GENERATED, "--out", str(data))
    made = digest([("recording", data)])
    found: Entries = {}
    for number, method in enumerate(task.methods):
        check_data(task.recorded, method, made, data)
        say(f"losses: {number + 1} of {len(task.methods)}, {method}")
        out = code.results / "losses" / method
        if not (out / "report.html").exists():  # written last
            out.parent.mkdir(exist_ok=True)
            options = ("--method", method, "--steps", "1", "--seed", "0")
            with tempfile.TemporaryDirectory(dir=out.parent) as folder:
                begun = Path(folder, method)
                code.spinndrift("train", str(data), *options, "--out", str(begun))
                begun.replace(out)
        with (out / "metrics.csv").open(encoding="utf-8", newline="") as handle:
            row = next(csv.DictReader(handle))
        numbers = {name: float(row[name]) for name in ("loss", "gradient_norm")}
        found[method] = {"data": made, **numbers}
    return found


def write_cases(code: Code, patterns: Sequence[str]) -> list[str]:
    """Write those blind cases that are not there yet; names of all that fit."""
    environment = os.environ | {"PYTHONPATH": str(code.checkout / "tests")}
    command = [sys.executable, "-m", "hidden", str(code.work / "cases"), "--scale", "small"]
    names: list[str] = []
    with subprocess.Popen(
        [*command, "--only", *patterns],
        cwd=code.work, env=environment, stdout=subprocess.PIPE, text=True,
    ) as child:  # fmt: skip
        assert child.stdout is not None
        for line in child.stdout:
            names.append(line.strip())
            say(f"diagnosis: case {len(names)} is there, {names[-1]}")
    if child.returncode:
        raise BaselineError(f"cases {' '.join(patterns)}: can't be written; see above")
    return names


def diagnosis(task: Task) -> Entries:
    """What is in diagnosis.json of every case, and whether that is right by judged.json."""
    code = task.code
    names = write_cases(code, task.cases)
    made = {}
    for name in names:
        folder = code.work / "cases" / name / "data"
        made[name] = digest((path.name, path) for path in folder.iterdir())
        check_data(task.recorded, name, made[name], folder)
    out = code.results / "check"
    if left := [name for name in names if not (out / name / "judged.json").exists()]:
        say(f"diagnosis: {len(names) - len(left)} of {len(names)} cases are judged")
        where = ("--cases", str(code.work / "cases"), "--out", str(out))
        code.spinndrift(
            "check", "diagnosis", *where, "--workers", str(task.workers), "--only", *left
        )
    return {
        name: {
            "data": made[name],
            **diagnosed(
                read_json(out / name / "diagnosis.json"), read_json(out / name / "judged.json")
            ),
        }
        for name in names
    }


def diagnosed(said: dict[str, Any], judged: dict[str, Any]) -> dict[str, Any]:
    """What is kept of a case."""
    right = {key: int(judged[key]) for key in ("verdict_right", "first_right", "recalled")}
    causes = [
        {
            "name": cause["name"],
            "where": cause["where"],
            "parameters": {
                name: {key: value[key] for key in ("value", "unit", "interval95")}
                for name, value in cause["parameters"].items()
            },
        }
        for cause in said["causes"]
    ]
    right |= {
        "place_right": int(judged["place_right"] is not False),
        "not_spurious": -judged["spurious"],
    }
    return {"verdict": said["verdict"], "right": right, "causes": causes}


def demo(task: Task) -> Entries:
    """The held-out errors that summary.json holds and the demo prints."""
    out = task.code.results / "demo"
    if not (out / "summary.json").exists():
        say("demo: trains and flies, some minutes")
        task.code.spinndrift("demo", "--out", str(out))
    held_out = read_json(out / "summary.json")["held_out"]
    kept = {"preset": tuple(ERRORS), "learned": (*ERRORS, *BANDS)}
    return {model: {name: held_out[model][name] for name in kept[model]} for model in kept}


def mppi(task: Task) -> Entries:
    """Shortest time of each benchmark over that of the reference in the same run."""
    code = task.code
    bench = code.checkout / "benchmarks" / "bench_mppi.py"
    out = code.results / f"mppi-{digest([('', bench)])[:8]}.json"
    if not out.exists():
        say("mppi: measures, some minutes")
        with tempfile.TemporaryDirectory(dir=code.results) as folder:
            partial = Path(folder, "mppi.json")
            usual = ("-q", "-o", "addopts=", "--import-mode=importlib", "--benchmark-only")
            file = ("-p", "no:cacheprovider", f"--benchmark-json={partial}")
            code.python("bench_mppi", "-m", "pytest", *usual, *file, str(bench), at=code.checkout)
            partial.replace(out)
    return ratios(read_json(out), code.checkout)


def ratios(measured: dict[str, Any], checkout: Path) -> Entries:
    """From the file that pytest-benchmark writes.

    Raises:
        BaselineError: the reference is not in it.
    """
    times = {one["name"]: one["stats"]["min"] for one in measured["benchmarks"]}
    reference = times.pop(REFERENCE, None)
    if reference is None:
        raise BaselineError(f"{checkout}/benchmarks/bench_mppi.py: has no {REFERENCE}")
    return {n: {"ratio": t / reference, "seconds": t} for n, t in times.items()}


PARTS: dict[str, Callable[[Task], Entries]] = {
    "losses": losses,
    "diagnosis": diagnosis,
    "demo": demo,
    "mppi": mppi,
}


# ------------------------------------------------------------------------------------ the commands


def read_record(path: Path) -> dict[str, Any]:
    """Raises BaselineError: the file is no baseline."""
    found = read_json(path)
    if not isinstance(found, dict) or found.get("baseline") != FORM:
        raise BaselineError(f"{path}: is no baseline of this form; name another file")
    return found


def write_record(path: Path, found: dict[str, Any]) -> None:
    """Whole or not at all."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".partial-")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as partial:
            json.dump(found, partial, indent=1, ensure_ascii=False)
            partial.write("\n")
            partial.flush()
            os.fsync(partial.fileno())
        Path(name).chmod(0o644)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def record(code: Code, given: argparse.Namespace) -> int:
    """Add the parts to FILE; those that are there from the same code stay."""
    path = given.file
    if not path.resolve().parent.is_dir():
        raise BaselineError(f"{path}: its folder is not there; make it")
    whole: dict[str, Any] = {"baseline": FORM, "code": code.fingerprint, **code.about, "parts": {}}
    if path.exists():
        whole = read_record(path)
        if whole["code"] != code.fingerprint:
            raise BaselineError(
                f"{path}: is the baseline of other code (revision {whole['revision'][:12]}) or "
                "another machine; name another file"
            )
    code.check()
    cases, methods = tuple(given.cases or CASES), tuple(given.methods or METHODS)
    for part in given.only or PARTS:
        found = PARTS[part](Task(code, cases, methods, given.workers))
        whole["parts"][part] = {**found, **whole["parts"].get(part, {})}
        write_record(path, whole)
        say(f"{path}: has {len(whole['parts'][part])} of {part}")
    return 0


def compare_all(code: Code, given: argparse.Namespace) -> int:
    """Do the same again, print the table; 1 if anything is worse."""
    whole = read_record(given.file)
    rows: list[Row] = []
    parts: dict[str, Entries] = whole["parts"]
    if missing := [part for part in given.only or () if part not in parts]:
        raise BaselineError(f"{given.file}: has no {', '.join(missing)}; record it first")
    code.check()
    for part in given.only or parts:
        chosen = {"diagnosis": given.cases, "losses": given.methods}.get(part) or ["*"]
        before = {
            item: entry
            for item, entry in parts[part].items()
            if any(fnmatchcase(item, pattern) for pattern in chosen)
        }
        if not before:
            raise BaselineError(f"{given.file}: has no {' '.join(chosen)} of {part}")
        names = tuple(before)
        now = PARTS[part](Task(code, names, names, given.workers, before))
        options = {"slower": given.slower} if part == "mppi" else {}
        rows += compare(part, before, now, **options)
    say(table(rows), sys.stdout)
    for word, about in (("before", whole), ("now", code.about)):
        changed = ", with changes that are not committed" if about["changed"] else ""
        say(f"{word}: revision {about['revision'][:12]}{changed}", sys.stdout)
    for name, version in code.about["versions"].items():
        if (was := whole["versions"].get(name)) != version:
            say(f"{name}: {was} before, {version} now", sys.stdout)
    return int(any(row.outcome == "worse" for row in rows))


def main(arguments: Sequence[str] | None = None) -> int:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("do", choices=("record", "compare"))
    parser.add_argument("file", type=Path, help="the baseline (.json)")
    parser.add_argument("--checkout", type=Path, default=ROOT, help="code to run, by default this")
    parser.add_argument("--work", type=Path, default=Path("runs/baseline"), help="data, results")
    parser.add_argument("--only", nargs="+", choices=list(PARTS), help="parts, by default all")
    parser.add_argument("--cases", nargs="+", metavar="PATTERN", help="fewer or other blind cases")
    parser.add_argument("--methods", nargs="+", metavar="NAME", help="fewer methods of training")
    parser.add_argument("--workers", type=int, default=0, help="processes that diagnose")
    parser.add_argument(
        "--slower", type=float, default=SLOWER, metavar="FACTOR",
        help="times are worse beyond this factor (2), and only told below it",
    )  # fmt: skip
    given = parser.parse_args(arguments)
    if given.slower < 1:
        parser.error(f"--slower: is {given.slower:g}; give at least 1")
    try:
        code = Code.of(given.checkout, given.work)
        return (record if given.do == "record" else compare_all)(code, given)
    except BaselineError as error:
        say(f"baseline: {error}")
        return 2
    except KeyboardInterrupt:
        say("baseline: interrupted; the same command goes on from here")
        return 130


if __name__ == "__main__":
    sys.exit(main())
