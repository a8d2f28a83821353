"""NetCDF-4 files: atomic writing, and detection of damage."""

import io
import mmap
import os
import struct
import warnings
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any

import h5netcdf
import h5py
import xarray as xr
from xarray.backends import H5NetCDFStore

from ..config.errors import UserError
from .atomic import atomic_path

_DENSEST = 2000
"""Largest ratio of data bytes to file bytes; deflate compresses by at most 1032."""
_SMALL = 1 << 24
_HEAP = b"GCOL\x01\0\0\0"
"""Signature of a global heap of HDF5."""
_HEADER = 16
"""Bytes of the header of a global heap, and of each object in it."""


def save_netcdf(
    dataset: xr.Dataset,
    path: str | os.PathLike[str],
    encoding: Mapping[Hashable, Mapping[str, Any]] | None = None,
) -> None:
    """Write a dataset as NetCDF-4, with checksums over data and structure.

    It is made in memory first, as HDF5 ends the process if it can't write to its file. The
    structures of HDF5 1.10 have checksums, without which reading a damaged file may not terminate.

    Raises:
        UserError: the file can't be written.
    """
    checked = {
        name: {"fletcher32": True, **(encoding or {}).get(name, {})}
        for name, variable in dataset.variables.items()
        if variable.ndim and variable.size and variable.dtype.kind in "biuf"
    }
    memory = io.BytesIO()
    with h5netcdf.File(memory, "w", libver="v110") as file:
        dataset.dump_to_store(H5NetCDFStore(file), encoding=checked)
    with atomic_path(path) as partial:
        partial.write_bytes(memory.getbuffer())


def load_netcdf(path: str | os.PathLike[str]) -> xr.Dataset:
    """Read a dataset into memory.

    Raises:
        UserError: the file is missing, not NetCDF-4, damaged, or declares more than it can hold.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: no such file; give a recording (.nc)")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # xarray warns of attributes that it can't decode
        try:
            _check_heaps(path)
            with h5py.File(path, "r") as raw:
                size = _promised(raw)
            if size > _SMALL + _DENSEST * path.stat().st_size:
                raise UserError(
                    f"{path}: promises {size / 1e9:.3g} GB, which is more than such a file can "
                    "hold; it is damaged, so copy it again"
                )
            with xr.open_dataset(path, engine="h5netcdf") as opened:
                return opened.load()
        except UserError:
            raise
        except Exception as error:
            raise UserError(
                f"{path}: can't be read as NetCDF-4 ({_first_line(error)}); write it again"
            ) from error


def _check_heaps(path: Path) -> None:
    """Refuse a file whose global heaps have objects of invalid size.

    Global heaps hold text and the links between dimensions, and have no checksums: an object of
    size zero makes HDF5 loop endlessly. Layout: HDF5 file format specification 3.0, section III.E.

    Raises:
        UserError: a heap is damaged.
    """
    if path.stat().st_size == 0:  # an empty file can't be mapped
        return
    with path.open("rb") as handle, mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ) as data:
        begin = data.find(_HEAP)
        while begin >= 0:
            if not _walks(data, begin):
                raise UserError(f"{path}: a heap in it is damaged; copy or write it again")
            begin = data.find(_HEAP, begin + len(_HEAP))


def _walks(data: mmap.mmap, begin: int) -> bool:
    """Whether the objects of the heap at `begin` are contiguous up to its end."""
    if begin + _HEADER > len(data):
        return False
    at = begin + _HEADER
    end = begin + struct.unpack_from("<Q", data, begin + 8)[0]
    if not at <= end <= len(data):
        return False
    while end - at >= _HEADER:  # a shorter rest is unused
        index, size = struct.unpack_from("<H6xQ", data, at)
        step = size if index == 0 else _HEADER + (size + 7) // 8 * 8  # index 0 is free space
        if not _HEADER <= step <= end - at:
            return False
        at += step
    return True


def _promised(file: h5py.File) -> int:
    """Size of all datasets in memory (bytes), as the file declares it."""
    sizes = [0]

    def add(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            sizes.append(item.nbytes)

    file.visititems(add)
    return sum(sizes)


def _first_line(error: Exception) -> str:
    """The first line of a library's error message, if it is short and readable."""
    text = str(error).strip().split("\n")[0]
    return text if isinstance(error, OSError) and 0 < len(text) < 200 else "its structure is broken"
