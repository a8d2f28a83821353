"""Healthy runs to compare with, and a model of them: from a diagnosis, or from data."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..models.config.errors import UserError
from ..models.files.checkpoint import load_model
from ..models.files.owned import MARKER
from ..models.recordings.csv_columns import METADATA as CSV_FOLDER
from ..models.recordings.store import Recording
from ..systems.logs.bags.bag import METADATA as BAG_FOLDER
from ..systems.logs.bags.bag import bag_kind
from ..training.diagnosis.against.pipeline import Healthy

RESULT, MODEL = "diagnosis.json", Path("extended") / "model.spinn"
SOURCE, OPTIONS = "source", "read_with"
"""Metadata of an extended model: its data, and the options by which they were read."""

_FILES = (".nc", ".nc4", ".h5", ".tlog", ".bin", ".xz", ".gz", ".bag", ".mcap", ".db3")

Read = Callable[[Path, dict[str, Any]], Recording]
"""Reads and checks data; options of the command may be replaced."""


def diagnosis_at(path: Path) -> Path | None:
    """The folder of a diagnosis, named by itself or by its `diagnosis.json`; None for data."""
    folder = path.parent if path.name == RESULT else path
    return folder if (folder / MODEL).is_file() else None


def check_healthy(path: Path, beliefs: Sequence[str] = ()) -> None:
    """Refuse what can't be compared with, before anything is computed.

    Args:
        path: of healthy data or a diagnosis.
        beliefs: options that were given and name a model to believe.

    Raises:
        UserError: there is no such file, recordings in a folder would be left out, a diagnosis
            lacks its model or its data, or is given together with another belief.
    """
    if not path.exists():
        raise UserError(
            f"--against {path}: no such file or folder; name healthy data or a diagnosis"
        )
    folder = diagnosis_at(path)
    if folder is None and (path.name == RESULT or (path / RESULT).is_file()):
        raise UserError(
            f"--against {path}: its {MODEL} is missing; diagnose the healthy data again"
        )
    if folder is not None and beliefs:
        raise UserError(
            f"{beliefs[0]}: the diagnosis {folder} has a model of its own, which is the belief; "
            "leave one out"
        )
    if folder is None:
        _check_sessions(path)
    else:
        _source(folder, load_model(folder / MODEL, dtype=float)[1])


def healthy_of_diagnosis(folder: Path, read: Read) -> Healthy:
    """The model of a diagnosis and the runs that it was made from, which are read again.

    Raises:
        UserError: as `check_healthy`.
    """
    model, metadata = load_model(folder / MODEL, dtype=float)
    source = _source(folder, metadata)
    return Healthy(read(source, dict(metadata.get(OPTIONS, {}))), model, str(folder))


def recordings_in(path: Path, one: Callable[[Path], Recording]) -> Recording:
    """The recording at a path, or all recordings in a folder joined: files, CSV folders, bags.

    Scenarios of several recordings are apart, for each is another session.

    Raises:
        UserError: they differ in rate, vehicle or commands.
    """
    found = _sessions(path)
    if not found:
        return one(path)
    return Recording.concat([_of_session(one(p), p.stem if p.is_file() else p.name) for p in found])


def _sessions(path: Path) -> list[Path]:
    """The recordings in a folder; none of a file, or of a folder that is one recording."""
    if not path.is_dir() or any((path / name).exists() for name in (CSV_FOLDER, BAG_FOLDER)):
        return []
    return sorted(p for p in path.iterdir() if p.suffix.lower() in _FILES or _is_recording(p))


def _is_recording(path: Path) -> bool:
    """Whether a path is a folder with CSV runs or a ROS 2 bag."""
    if not path.is_dir() or not os.access(path, os.R_OK | os.X_OK):
        return False
    return (path / CSV_FOLDER).exists() or bag_kind(path) is not None


def _check_sessions(path: Path) -> None:
    """Refuse a folder whose recordings are partly in folders deeper than those that are read."""
    # dives of a collection are in its recording; what lies beside CSV runs belongs to them
    if not path.is_dir() or (path / MARKER).exists() or _is_recording(path):
        return
    for inner in sorted(set(path.iterdir()) - set(_sessions(path))):
        readable = inner.is_dir() and os.access(inner, os.R_OK | os.X_OK)
        if readable and _sessions(inner):
            raise UserError(
                f"--against {path}: the recordings in its folder {inner.name} would be left out; "
                f"move them into {path.name}"
            )


def _of_session(recording: Recording, session: str) -> Recording:
    """The recording with the name of its file or folder before those of its scenarios."""
    names = [f"{session}: {name}" for name in recording.scenarios]
    return Recording(recording.dataset.assign_coords(scenario=names))


def _source(folder: Path, metadata: dict[str, Any]) -> Path:
    """The data that a diagnosis was made from."""
    source = Path(str(metadata.get(SOURCE, "")))
    if not metadata.get(SOURCE) or not source.exists():
        raise UserError(
            f"--against {folder}: the data that it was made from ({source}) are gone; put "
            "them back, or give --against the healthy data"
        )
    return source
