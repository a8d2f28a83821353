"""Recordings' files: damage that HDF5 itself does not notice is refused."""

import io
import struct

import h5py
import pytest

from helpers import run_python
from spinndrift.models.config.errors import UserError
from spinndrift.models.files.netcdf import load_netcdf

READ = """
import sys
from spinndrift.models.config.errors import UserError
from spinndrift.models.files.netcdf import load_netcdf
try:
    load_netcdf(sys.argv[1])
except UserError as error:
    print(error)
"""


def heap() -> tuple[bytearray, list[int]]:
    """A file with text of several lengths, and where the objects of its heap begin."""
    memory = io.BytesIO()
    with h5py.File(memory, "w") as file:
        for n in range(1, 20):
            file.attrs[f"a{n}"] = n * "x"
    data = bytearray(memory.getvalue())
    at = data.index(b"GCOL")
    end = at + struct.unpack_from("<Q", data, at + 8)[0]
    found = [at + 16]
    while end - found[-1] >= 16:
        index, size = struct.unpack_from("<H6xQ", data, found[-1])
        found.append(found[-1] + (16 + (size + 7) // 8 * 8 if index else size))
    assert found[-1] == end
    return data, found[:-1]


def test_a_heap_whose_walk_ends_is_read(tmp_path):
    data, objects = heap()
    assert len(objects) == 20  # the last one is what is free
    (tmp_path / "a.nc").write_bytes(data)
    assert load_netcdf(tmp_path / "a.nc").attrs["a19"] == 19 * "x"


@pytest.mark.parametrize("size", [0, 8, 1 << 20, (1 << 64) - 16])
@pytest.mark.parametrize("which", [3, -1])
def test_a_heap_whose_walk_does_not_end_is_refused(tmp_path, which, size):
    data, objects = heap()
    if which != -1 and size < 16:
        data[objects[which] : objects[which] + 2] = b"\0\0"  # one that is free has its header in it
    struct.pack_into("<Q", data, objects[which] + 8, size)
    (tmp_path / "a.nc").write_bytes(data)
    with pytest.raises(UserError, match=r"a\.nc: a heap in it is damaged"):
        load_netcdf(tmp_path / "a.nc")


def test_what_hdf5_reads_for_ever_is_refused_at_once(tmp_path):
    data, objects = heap()
    struct.pack_into("<Q", data, objects[-1] + 8, 0)
    (tmp_path / "a.nc").write_bytes(data)
    assert "a heap in it is damaged" in run_python(READ, str(tmp_path / "a.nc"), timeout=60)


def test_an_empty_file_is_refused_by_name(tmp_path):
    (tmp_path / "a.nc").write_bytes(b"")
    with pytest.raises(UserError, match=r"a\.nc: can't be read"):
        load_netcdf(tmp_path / "a.nc")
