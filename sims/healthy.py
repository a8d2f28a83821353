"""Healthy runs to compare with, and a model of them: from a diagnosis, or from data."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..models.config.errors import UserError
from ..models.files.checkpoint import load_model
from ..models.recordings.store import Recording
from ..training.diagnosis.against.pipeline import Healthy

RESULT, MODEL = "diagnosis.json", Path("extended") / "model.spinn"
SOURCE, OPTIONS = "source", "read_with"
"""Metadata of an extended model: its data, and the options by which they were read."""

_FILES = (".nc", ".nc4", ".h5", ".tlog", ".bin", ".xz", ".bag", ".mcap", ".db3")

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
        UserError: there is no such file, a diagnosis lacks its model or its data, or is given
            together with another belief.
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
    if folder is not None:
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
    """The recording at a path, or all recordings in a folder joined.

    Scenarios of several files are apart, for each file is another session.

    Raises:
        UserError: they differ in rate, vehicle or commands.
    """
    files = sorted(p for p in path.iterdir() if p.suffix.lower() in _FILES) if path.is_dir() else []
    if not files or (path / "recording.yaml").exists() or (path / "metadata.yaml").exists():
        return one(path)
    parts = [one(file) for file in files]
    return Recording.concat([_of_file(r, f.stem) for r, f in zip(parts, files, strict=True)])


def _of_file(recording: Recording, stem: str) -> Recording:
    """The recording with its file's name before those of its scenarios."""
    names = [f"{stem}: {name}" for name in recording.scenarios]
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
