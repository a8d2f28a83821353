"""Files that appear whole or not at all."""

import os
import secrets
import shutil
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
