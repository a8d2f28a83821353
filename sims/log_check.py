"""Imports every log of some folders and tells what came out: docs/real-logs.md."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..models.config.errors import UserError
from ..models.recordings.checks.examine import examine
from ..models.recordings.checks.finding import findings_of
from ..models.recordings.csv_columns import METADATA
from ..models.vehicles.vehicle import load_vehicle
from ..systems.logs.load import load_data
from .acceptance import acceptance

_LOGS = (".tlog", ".bin", ".nc", ".bag", ".db3", ".mcap")
_PACKED = (".xz", ".gz")


@dataclass(frozen=True)
class Imported:
    """What came out of one file.

    Attributes:
        place: its path from the folder that was searched.
        source: first heading of the README nearest to it.
        outcome: stretches that were kept, or the sentence of the refusal.
        findings: the word and place of each.
        takes: what the other commands take of it.
        seconds: time for the import and the checks.
    """

    place: str
    source: str
    outcome: str
    findings: tuple[str, ...]
    takes: tuple[str, ...]
    seconds: float


def find_logs(folders: Sequence[Path]) -> list[tuple[Path, Path]]:
    """Folder and path of every log, recording and CSV folder, in order.

    Raises:
        UserError: a folder is missing, or there is none in them.
    """
    found = [(folder, path) for folder in folders for path in _within(folder)]
    if not found:
        raise UserError(
            f"{', '.join(map(str, folders))}: no log in there (.tlog, .BIN, ROS bag, CSV folder)"
        )
    return found


def _within(folder: Path) -> Iterator[Path]:
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; name one with logs")
    for path in sorted(folder.rglob("*")):
        name = path.name.lower()
        for packed in _PACKED:
            name = name.removesuffix(packed)
        if path.is_file() and name.endswith(_LOGS):
            yield path
        elif path.name == METADATA:
            yield path.parent


def check_logs(
    logs: Sequence[tuple[Path, Path]], progress: Callable[[float, str], None]
) -> list[Imported]:
    """Import and check each log."""
    found = []
    for n, (folder, path) in enumerate(logs):
        progress(n / len(logs), path.name)
        found.append(_import(folder, path))
    return found


def _import(folder: Path, path: Path) -> Imported:
    began = time.monotonic()
    place, source = str(path.relative_to(folder)), _heading(folder, path)
    try:
        recording = load_data(path)
        vehicle = load_vehicle(recording.vehicle) if recording.vehicle else None
        recording = examine(recording, vehicle, place)
    except UserError as error:
        said = str(error).removeprefix(f"{path}: ").removeprefix(f"{place}: ")
        told = f"refused: {said.replace(str(path), place)}"
        return Imported(place, source, told, (), (), time.monotonic() - began)
    count = int((recording.lengths > 0).sum())
    outcome = (
        f"{count} stretch{'es' * (count != 1)}, {recording.duration:.0f} s, "
        f"{recording.vehicle or 'no vehicle'}"
    )
    findings = tuple(
        f"{f.word}{f' ({f.place})' if f.place else ''}" for f in findings_of(recording.dataset)
    )
    takes = tuple(acceptance(recording))
    return Imported(place, source, outcome, findings, takes, time.monotonic() - began)


def _heading(folder: Path, path: Path) -> str:
    for parent in path.parents:
        readme = parent / "README.md"
        if readme.is_file():
            return readme.read_text(encoding="utf-8").split("\n", 1)[0].lstrip("# ").strip()
        if parent == folder:
            break
    return "–"


def page_text(found: Sequence[Imported], command: str) -> str:
    """The results as tables, with the command that made them."""
    head = "| file | source | what came out | findings | time |\n|---|---|---|---|---|\n"
    rows = [
        f"| `{f.place}` | {_cell(f.source)} | {_cell(f.outcome)} | "
        f"{_cell('; '.join(f.findings) or '–')} | {f.seconds:.1f} s |"
        for f in found
    ]
    takes = [
        f"- `{f.place}`\n" + "\n".join(f"  - {line}" for line in f.takes) for f in found if f.takes
    ]
    return (
        f"Made by `{command}`.\n\n{head}" + "\n".join(rows) + "\n\n"
        "What the other commands take of those that were imported:\n\n" + "\n".join(takes) + "\n"
    )


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())
