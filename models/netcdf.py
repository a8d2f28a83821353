"""NetCDF-4 files that appear whole or not at all, also where the disk is full."""

import os
from collections.abc import Mapping
from typing import Any

import xarray as xr

from .files import atomic_path


def save_netcdf(
    dataset: xr.Dataset, path: str | os.PathLike[str], encoding: Mapping[Any, Any] | None = None
) -> None:
    """Write a dataset as NetCDF-4.

    It is made in memory first: HDF5 that can't write to its file ends the process.

    Raises:
        UserError: the file can't be written.
    """
    content = dataset.to_netcdf(engine="h5netcdf", encoding=encoding)
    with atomic_path(path) as partial:
        partial.write_bytes(content)
