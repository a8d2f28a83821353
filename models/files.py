"""Files that appear whole or not at all."""

import os
import secrets
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import UserError


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary sibling of `path`, of its suffix, that replaces it when the block ends.

    The parent folder is made if missing; a link is followed, and the file it names is replaced.
    On an error or an interrupt nothing is left of the temporary file, and whatever stood at
    `path` before stays as it was. A killed process may leave a `.partial-*` file beside it.

    Raises:
        UserError: `path` is a folder or a device, or a file stands where its folder should be.
        FileNotFoundError: the block ended without writing the file that it was given.
    """
    final = Path(os.path.realpath(path))
    if final.exists() and not final.is_file():
        raise UserError(f"{path} is no regular file; name a file to write.")
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise UserError(f"{path} can't be written: {final.parent} is no folder.") from error
    prefix = f".partial-{secrets.token_hex(8)}"
    partial = final.with_name(prefix + final.suffix)
    try:
        yield partial
        if not partial.is_file():
            raise FileNotFoundError(f"nothing was written at {partial}, so {path} stays as it was")
        if final.exists():
            shutil.copymode(final, partial)
        with partial.open("rb") as handle:
            os.fsync(handle.fileno())
        os.replace(partial, final)
    finally:  # some writers add a suffix of their own or make a folder
        for litter in final.parent.glob(f"{prefix}*"):
            if litter.is_dir() and not litter.is_symlink():
                shutil.rmtree(litter)
            else:
                litter.unlink()


def check_writable(path: str | os.PathLike[str], called: str = "") -> None:
    """Refuse a file or folder that can't be made or replaced, before anything is computed for it.

    A folder is made and removed again where the nearest folder of `path` is; `called` is what the
    sentence begins with, such as an option's name.

    Raises:
        UserError: a file stands where a folder should be, or nothing can be written there.
    """
    about = f"{called} {path}".strip()
    at = Path(os.path.realpath(path))
    try:
        if not at.is_dir():
            at = at.parent
            while not at.exists():
                at = at.parent
        os.rmdir(tempfile.mkdtemp(prefix=".partial-", dir=at))
    except NotADirectoryError as error:
        raise UserError(f"{about}: {at} is no folder; name a place in a folder") from error
    except OSError as error:
        raise UserError(
            f"{about}: nothing can be written there ({error.strerror}); name another place"
        ) from error


@contextmanager
def partial_folder(partial: Path, called: str | os.PathLike[str]) -> Iterator[Path]:
    """Make a folder that is gone when the block ends, unless it was moved to its place: `called`.

    Raises:
        UserError: it can't be made.
    """
    try:
        partial.mkdir(parents=True)
    except OSError as error:
        raise UserError(f"{called}: can't make this folder ({error.strerror})") from error
    try:
        yield partial
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def atomic_files(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary folder whose files take their places in `folder` when the block ends.

    A new `folder` appears by one rename. In one that is there each file replaces its namesake, all
    without a pause and with Ctrl-C held back until they have; other files stay. On an error or an
    interrupt before that nothing is left of the temporary folder, and `folder` is as it was.

    Raises:
        UserError: the folder can't be made, or what stands in it isn't what is to be replaced.
    """
    final = Path(os.path.realpath(folder))
    name = f".partial-{secrets.token_hex(8)}"
    partial = final / name if final.is_dir() else final.with_name(name)
    with partial_folder(partial, folder):
        yield partial
        if not final.exists():
            os.replace(partial, final)
            return
        files = {p: final / p.relative_to(partial) for p in partial.rglob("*") if not p.is_dir()}
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
        with interrupts_held():
            for new, at in files.items():
                os.replace(new, at)


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Let Ctrl-C wait until the block ends; it reaches the main thread alone."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if before is None else before)
    if came:
        signal.raise_signal(signal.SIGINT)
