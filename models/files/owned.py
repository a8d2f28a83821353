"""Ownership of output: marked as this package's, locked by one process, other files are kept.

Every folder that a command writes has a marker, `spinndrift.json`, with its kind, the version that
wrote it and its files. A non-empty folder without a marker is not touched, nor is a file that is
not in the marker or that was changed since. docs/files.md is the user's page.
"""

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from ..config.errors import UserError
from .atomic import atomic_path, check_writable, made_folder, remove
from .locks import locked

MARKER = "spinndrift.json"
_FORMAT = 1
_LOCK = ".spinndrift.lock"
_PARTIAL = re.compile(r"\.partial-[0-9a-f]{16}(\..*)?")
_LOCKS = re.compile(r"\.spinndrift(-[0-9a-f]{16})?\.lock")
_SHOWN = 3  # names in a sentence


class ForeignError(UserError):
    """The output path holds something that this package did not write."""


@dataclass(frozen=True)
class FolderKind:
    """A kind of folder, and its files.

    Attributes:
        name: name of the kind, in the marker and in messages.
        files: paths of all files that may be written in it, without those of subfolders that have
            their own marker.
        edited: those of `files` that users may edit, because their writer keeps the edits.
    """

    name: str
    files: tuple[str, ...]
    edited: tuple[str, ...] = ()


@dataclass(frozen=True)
class Marker:
    """Content of a folder's marker.

    Attributes:
        kind: name of the folder's kind.
        finished: whether the command that wrote it has finished.
        files: the files of this package, with digests of those that are finished.
    """

    kind: str
    finished: bool
    files: dict[str, str | None]


@contextmanager
def run_folder(
    path: str | os.PathLike[str], kind: FolderKind, called: str = "--out", *, new: bool = False
) -> Iterator[Path]:
    """Lock a folder for one command, from before its work until all is written.

    The folder is made and marked at once, so that no other command uses it; it is removed if the
    block fails before anything was written there. A folder of this kind may be reused: this
    package's files in it may be replaced, all others stay.

    Args:
        path: path of the folder.
        kind: kind of the folder.
        called: beginning of messages: the option that named it.
        new: refuse a finished folder.

    Raises:
        UserError: before the block: the path holds or would replace something foreign, another
            process writes there, or it is not writable. After it: the disk is full.
    """
    about = f"{called} {path}".strip()
    folder = Path(os.path.realpath(path))
    _checked(path, kind, called, new)
    with made_folder(folder, about), locked(folder / _LOCK, about):
        before = _checked(path, kind, called, new)  # again, as the lock now excludes other writers
        _begin(folder, kind, before)
        sweep(folder)
        try:
            yield Path(path)
            finish(folder, kind)
        except BaseException:
            with suppress(OSError, UserError):
                _undo(folder, kind, before)
            raise


def check_folder(path: str | os.PathLike[str], kind: FolderKind, called: str = "") -> None:
    """Refuse a folder that can't become, or isn't, one of this kind; nothing is written.

    Raises:
        UserError: as `run_folder`.
    """
    _checked(path, kind, called, new=False)


def claim(path: str | os.PathLike[str], kind: FolderKind) -> None:
    """Make and mark a folder that is already protected from other processes.

    Raises:
        UserError: as `run_folder`.
    """
    before = _checked(path, kind, "", new=False)
    folder = Path(os.path.realpath(path))
    if before is not None and not before.finished and set(kind.files) <= set(before.files):
        return
    with made_folder(folder, str(path)):
        _begin(folder, kind, before)


def sweep(folder: Path) -> None:
    """Remove partial files of a killed process from a folder of this package that is locked."""
    if (folder / MARKER).exists():
        for litter in folder.iterdir():
            if _PARTIAL.fullmatch(litter.name):
                remove(litter)


def finish(folder: str | os.PathLike[str], kind: FolderKind) -> None:
    """Write the existing files and their digests into the marker."""
    files = {
        name: None if name in kind.edited else _digest(Path(folder) / name)
        for name in kind.files
        if (Path(folder) / name).is_file()
    }
    _write(Path(folder), Marker(kind.name, True, files))


@contextmanager
def output_file(
    path: str | os.PathLike[str], own: Callable[[Path], bool], what: str, called: str = "--out"
) -> Iterator[Path]:
    """Lock the path of a single file, from before the work until it is written.

    Args:
        path: path of the file.
        own: whether an existing file is of the kind that the command writes.
        what: description of that kind, such as `recording of spinndrift`.
        called: beginning of messages: the option that named it.

    Raises:
        UserError: another file exists, it belongs to a folder of this package, another process
            writes there, or the path is not writable.
    """
    about = f"{called} {path}".strip()
    final = Path(os.path.realpath(path))
    check_file(path, own, what, called)
    lock = f".spinndrift-{hashlib.sha256(os.fsencode(final.name)).hexdigest()[:16]}.lock"
    with made_folder(final.parent, about), locked(final.with_name(lock), about):
        check_file(path, own, what, called)
        yield Path(path)


def check_file(
    path: str | os.PathLike[str], own: Callable[[Path], bool], what: str, called: str = ""
) -> None:
    """Refuse a file that can't be written or that isn't this package's; nothing is written.

    Raises:
        UserError: as `output_file`.
    """
    about = f"{called} {path}".strip()
    final = Path(os.path.realpath(path))
    if final.exists() and not final.is_file():
        raise UserError(f"{about}: is no regular file; name a file to write")
    check_writable(path, called)
    marker = read_marker(final.parent) if (final.parent / MARKER).is_file() else None
    if final.name == MARKER or (marker is not None and final.name in marker.files):
        raise UserError(f"{about}: belongs to what {final.parent} holds; name another file")
    if final.exists() and not own(final):
        raise UserError(
            f"{about}: is no {what}, so it is not replaced; move it away or name another file"
        )


def read_marker(folder: Path) -> Marker | None:
    """Content of a folder's marker; None if there is none.

    Raises:
        UserError: it can't be read, or a later version wrote it.
    """
    at = folder / MARKER
    if not os.path.lexists(at):
        return None
    try:
        told = json.loads(at.read_text(encoding="utf-8"))
        form, kind = int(told.get("format", _FORMAT)), str(told["kind"])
        files = told.get("files")
        if files is not None:
            files = {str(k): None if v is None else str(v) for k, v in files.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{at}: is no marker of a folder of spinndrift; name another folder") from (
            error
        )
    if form > _FORMAT:
        raise UserError(f"{at}: a later version wrote it; update spinndrift or name another folder")
    finished = told.get("finished") is True
    return Marker(kind, finished, {"*": None} if files is None else files)


def _checked(
    path: str | os.PathLike[str], kind: FolderKind, called: str, new: bool
) -> Marker | None:
    """The marker of a folder that may be written, None if it has none yet."""
    about = f"{called} {path}".strip()
    folder = Path(os.path.realpath(path))
    if folder.exists() and not folder.is_dir():
        raise ForeignError(f"{about}: is a file; name a folder")
    check_writable(path, called)
    if not folder.exists():
        return None
    marker = read_marker(folder)
    if marker is None:
        if foreign := sorted(name for name in os.listdir(folder) if not _passing(name)):
            raise ForeignError(
                f"{about}: holds what spinndrift did not write or has not marked "
                f"({_some(foreign)}); name a new folder"
            )
        return None
    if marker.kind != kind.name:
        raise ForeignError(f"{about}: holds a {marker.kind}, no {kind.name}; name another folder")
    if new and marker.finished:
        raise UserError(f"{about}: holds a {kind.name} already; name a new folder")
    for name in kind.files:
        _check_own(folder, name, marker, about)
    return marker


def _check_own(folder: Path, name: str, marker: Marker, about: str) -> None:
    """Refuse an existing file of this name unless this package wrote it."""
    at = folder / name
    for above in at.relative_to(folder).parents:
        if (folder / above).exists() and not (folder / above).is_dir():
            raise UserError(f"{about}: {above} in it is no folder; move it away")
    if not os.path.lexists(at):
        return
    known = name in marker.files or "*" in marker.files
    if not known or at.is_symlink() or not at.is_file():
        raise ForeignError(
            f"{about}: {name} in it is not of spinndrift's making; move it away or name another "
            "folder"
        )
    told = marker.files.get(name)
    if told is not None and told != _digest(at):
        raise UserError(
            f"{about}: {name} in it was changed after spinndrift wrote it; move it away or name "
            "another folder"
        )


def _begin(folder: Path, kind: FolderKind, before: Marker | None) -> None:
    files = {} if before is None else {k: v for k, v in before.files.items() if k != "*"}
    _write(folder, Marker(kind.name, False, files | dict.fromkeys(kind.files)))


def _undo(folder: Path, kind: FolderKind, before: Marker | None) -> None:
    """Restore the previous marker, if the folder's content has not changed."""
    if before is None:
        if all(_passing(name) or name == MARKER for name in os.listdir(folder)):
            (folder / MARKER).unlink()
    elif before.finished:
        there = {n for n in kind.files if (folder / n).is_file()}
        known = {n for n, told in before.files.items() if told is not None}
        if there - set(kind.edited) == known and all(
            _digest(folder / n) == before.files[n] for n in known
        ):
            _write(folder, before)


def _write(folder: Path, marker: Marker) -> None:
    told = {
        "kind": marker.kind,
        "format": _FORMAT,
        "version": _version(),
        "finished": marker.finished,
        "files": marker.files,
    }
    with atomic_path(folder / MARKER) as partial:
        partial.write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")


def _version() -> str:
    try:
        return metadata.version("spinndrift")
    except metadata.PackageNotFoundError:  # run from sources without installation
        return ""


def _passing(name: str) -> bool:
    """Whether a name is that of a lock or of a partial file."""
    return bool(_PARTIAL.fullmatch(name) or _LOCKS.fullmatch(name))


def _digest(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def _some(names: list[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more
