"""Atomic writing of files and folders."""

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..config.errors import UserError
from .interrupts import interrupts_held

_PARTIAL = ".partial-"
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)
"""Error numbers of a full, failing or read-only disk."""


@contextmanager
def disk_errors_told(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn the error of a full or failing disk while `path` is written into a `UserError`.

    Raises:
        UserError: the block raised an `OSError` of `DISK_ERRORS`.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in DISK_ERRORS:
            raise
        parts = (part for part in Path(path).parts if not part.startswith(_PARTIAL))
        raise UserError(
            f"{Path(*parts)}: can't be written ({error.strerror}); make room there or name another "
            "place"
        ) from error


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary sibling of `path` with its suffix that replaces it when the block ends.

    The parent folder is made if missing; a link is followed, and its target is replaced. On an
    error or an interrupt the temporary file is removed and an existing file at `path` is unchanged.
    A killed process may leave a `.partial-*` file in the folder.

    Raises:
        UserError: `path` is a folder or a device, its parent is a file, or the disk is full.
        FileNotFoundError: the block ended without writing the temporary file.
    """
    final = Path(os.path.realpath(path))
    if final.exists() and not final.is_file():
        raise UserError(f"{path} is no regular file; name a file to write.")
    with disk_errors_told(path):
        try:
            final.parent.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            raise UserError(f"{path} can't be written: {final.parent} is no folder.") from error
        prefix = partial_name()
        partial = final.with_name(prefix + final.suffix)
        try:
            yield partial
            if not partial.is_file():
                raise FileNotFoundError(
                    f"nothing was written at {partial}, so {path} stays as it was"
                )
            if final.exists():
                shutil.copymode(final, partial)
            with partial.open("rb") as handle:
                os.fsync(handle.fileno())
            os.replace(partial, final)
        finally:  # some writers add their own suffix or make a folder
            for litter in final.parent.glob(f"{prefix}*"):
                remove(litter)


def partial_name() -> str:
    """A new name prefix for a temporary file or folder."""
    return f"{_PARTIAL}{secrets.token_hex(8)}"


def remove(path: Path) -> None:
    """Remove a file, a link or a folder with its content."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


def check_writable(path: str | os.PathLike[str], called: str = "") -> None:
    """Refuse a file or folder that can't be made or replaced, before anything is computed for it.

    A trial folder is made and removed in the nearest existing parent of `path`; `called` begins the
    message, such as an option's name.

    Raises:
        UserError: a parent of `path` is a file, or nothing can be written there.
    """
    about = f"{called} {path}".strip()
    at = Path(os.path.realpath(path))
    try:
        if not at.is_dir():
            at = at.parent
            while not at.exists():
                at = at.parent
        tried = at / partial_name()
        tried.mkdir()
        tried.rmdir()
    except NotADirectoryError as error:
        raise UserError(f"{about}: {at} is no folder; name a place in a folder") from error
    except OSError as error:
        raise UserError(
            f"{about}: nothing can be written there ({error.strerror}); name another place"
        ) from error


@contextmanager
def made_folder(folder: Path, about: str) -> Iterator[None]:
    """Make a folder and its parents; new ones that are still empty at the block's end are removed.

    Raises:
        UserError: a folder can't be made.
    """
    missing = []
    while not folder.exists():
        missing.append(folder)
        folder = folder.parent
    made: list[Path] = []
    try:
        for one in reversed(missing):
            try:
                one.mkdir()
                made.append(one)
            except FileExistsError:
                continue  # another process made it in the meantime
            except OSError as error:
                raise UserError(f"{about}: can't make this folder ({error.strerror})") from error
        yield
    finally:
        for one in reversed(made):
            try:
                one.rmdir()
            except FileNotFoundError:
                continue
            except OSError:
                break  # not empty


@contextmanager
def atomic_files(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary folder whose files are moved into `folder` when the block ends.

    Each file replaces one of the same name, in one go with Ctrl-C deferred; other files stay. On an
    error or an interrupt before that the temporary folder is removed and `folder` is unchanged.

    Raises:
        UserError: the folder can't be made, the disk is full, or a path to be replaced is not a
            regular file.
    """
    final = Path(os.path.realpath(folder))
    partial = final / partial_name()
    with disk_errors_told(folder), made_folder(partial, str(folder)):
        try:
            yield partial
            files = {p: final / p.relative_to(partial) for p in partial.rglob("*") if p.is_file()}
            for at in files.values():
                if at.exists() and not at.is_file():
                    raise UserError(f"{at} is no regular file; move it away or name another folder")
                try:
                    at.parent.mkdir(parents=True, exist_ok=True)
                except (FileExistsError, NotADirectoryError) as error:
                    raise UserError(
                        f"{at.parent} is no folder; move it away or name another folder"
                    ) from error
            for new, at in files.items():
                if at.exists():
                    shutil.copymode(at, new)
                with new.open("rb") as handle:
                    os.fsync(handle.fileno())
            with interrupts_held():
                for new, at in files.items():
                    os.replace(new, at)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
