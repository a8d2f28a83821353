"""Archives of arrays with a JSON header, read as untrusted input."""

import json
import zipfile
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from ..config.errors import UserError

_DENSEST = 2000
"""Largest ratio of array bytes to file bytes; deflate compresses by at most 1032."""
_SMALL = 1 << 24


def read_archive(path: str | PathLike[str], called: str) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The header, and `array_0000`, `array_0001`, … of an archive that `np.savez` wrote.

    `called` is the expected kind of file, for messages.

    Raises:
        UserError: the file is missing, or is not a complete archive of this kind.
    """
    path = Path(path)
    if path.is_dir():
        inside = next(iter(sorted(path.glob("*.spinn" if called == "model" else "*.npz"))), None)
        hint = "" if inside is None else f", such as {inside}"
        raise UserError(f"{path}: is a folder; name a {called} file{hint}.")
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(info.file_size for info in archive.infolist()) > _SMALL + _DENSEST * (
                path.stat().st_size
            ):
                raise ValueError("it promises more than fits into it")
            names = set(archive.namelist())
            header = json.loads(_array(archive, "header.npy").tobytes())
            count = len(names - {"header.npy"})
            arrays = [_array(archive, f"array_{i:04d}.npy") for i in range(count)]
    except FileNotFoundError:
        raise UserError(f"{path}: no such {called} file; check the path.") from None
    except OSError as error:
        raise UserError(f"{path}: can't be read ({error.strerror or 'damaged'}).") from error
    except Exception as error:
        raise UserError(
            f"{path}: not a whole spinndrift {called} file, or damaged; save or copy it again."
        ) from error
    if not isinstance(header, dict):
        raise UserError(f"{path}: not a spinndrift {called} file: its header is none.")
    return header, arrays


def _array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """One array of plain numbers, whose size must match its file in the archive."""
    form = np.lib.format
    with archive.open(name) as file:
        version = form.read_magic(file)
        read = form.read_array_header_1_0 if version == (1, 0) else form.read_array_header_2_0
        shape, fortran, dtype = read(file)
        raw = file.read()
    if dtype.kind not in "biuf" or len(raw) != dtype.itemsize * int(np.prod(shape, dtype=object)):
        raise ValueError(f"{name} is no array of numbers, or not whole")
    return np.frombuffer(raw, dtype).reshape(shape, order="F" if fortran else "C").copy()
