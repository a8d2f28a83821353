"""Recordings (.nc): variables, attributes and dimensions of the HDF5 file, and its bytes."""

from functools import cache
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
from motion import smooth_motion

from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.store import Recording
from spinndrift.models.recordings.summary import summarize

from .harness import Kind
from .mutate import FLOATS, NUMBERS, WORDS, Rng, bytes_spoiled, part, pick

_LARGE = 10**6
_ATTRIBUTES = (
    "format", "dt", "vehicle", "units", "scale_factor", "_FillValue", "add_offset", "calendar",
    "dtype", "coordinates", "command_period",
)  # fmt: skip


@cache
def _sound() -> bytes:
    """Two runs of unequal length, with a sensor."""
    runs = []
    for name, count in (("surge", 24), ("yaw", 16)):
        X, V, _ = smooth_motion(0.05 * np.arange(count), speed=0.5)
        commands = {"pwm": np.full((count, 8), 1500.0)}
        runs.append(Trajectory(name, X.T, V.T, commands, {"voltage": np.full(count, 15.0)}))
    recording = Recording.from_trajectories(runs, 0.05, vehicle="bluerov2_heavy", notes=["a note"])
    with TemporaryDirectory() as folder:
        path = Path(folder) / "sound.nc"
        recording.save(path)
        return path.read_bytes()


def _spoil(rng: Rng, folder: Path) -> Path:
    data = _sound()
    chance = rng.random()
    if chance < 0.75:
        memory = BytesIO(data)
        with h5py.File(memory, "r+", libver="v110") as file:
            for _ in range(int(rng.integers(1, 4))):
                _spoil_file(rng, file)
        data = memory.getvalue()
    if chance > 0.65:
        for _ in range(int(rng.integers(1, 4))):
            data = bytes_spoiled(rng, data)
    path = folder / "fuzz.nc"
    path.write_bytes(data)
    return path


def _spoil_file(rng: Rng, file: h5py.File) -> None:
    items = {name: item for name, item in file.items() if isinstance(item, h5py.Dataset)}
    names = [name for name, item in items.items() if item.nbytes < _LARGE]
    if not names:
        return
    name = pick(rng, names)
    match int(rng.integers(8)):
        case 0 | 1:
            _spoil_values(rng, file[name])
        case 2 | 3:
            _spoil_attribute(rng, file if rng.random() < 0.6 else file[name])
        case 4:
            del file[name]
        case 5:
            new = pick(rng, (*names, "F_Bo_B", "thruster_force", "elapsed", "extra", "start_time"))
            if new not in file:
                file.move(name, new)
        case 6:
            _replace(rng, file, name)
        case _:
            new = pick(rng, ("F_Bo_B", "thruster_force", "elapsed", "rc", "scenario_2", "x"))
            if new not in file:
                file.copy(file[name], new)


def _spoil_values(rng: Rng, dataset: h5py.Dataset) -> None:
    if not dataset.shape or 0 in dataset.shape:
        return
    values = dataset[...]
    flat = values.reshape(-1)
    where = part(rng, flat.size)
    if values.dtype.kind == "f":
        with np.errstate(over="ignore"):  # in single precision some are infinite
            flat[where] = pick(rng, FLOATS)
    elif values.dtype.kind == "O":
        flat[where] = pick(rng, WORDS).replace("\0", "").encode()
    elif values.dtype.kind in "iub":
        flat[where] = pick(rng, (0, 1, 127))
    dataset[...] = values


def _spoil_attribute(rng: Rng, item: h5py.File | h5py.Dataset) -> None:
    names = list(item.attrs)
    name = pick(rng, (*names, *_ATTRIBUTES))
    match int(rng.integers(5)):
        case 0:
            if name in names:
                del item.attrs[name]
            return
        case 1:
            value = pick(rng, FLOATS)
        case 2:
            value = pick(rng, (*NUMBERS, *WORDS)).replace("\0", "")[:2000]
        case 3:
            value = pick(rng, (np.zeros(3), np.array([], float), np.int8(1), np.uint64(2**64 - 1)))
        case _:
            value = pick(rng, (h5py.Empty("f8"), np.bool_(True), np.complex128(1j), b"\xff\xfe"))
    item.attrs[name] = value


def _replace(rng: Rng, file: Any, name: str) -> None:
    """Another form: type, shape, or a group in its place."""
    shape = file[name].shape
    values = file[name][...]
    scales = [d.label for d in file[name].dims]
    del file[name]
    match int(rng.integers(7)):
        case 0:
            kind = pick(rng, ("f4", "i4", "u1", "c16", "S5", "f2", h5py.string_dtype()))
            file.create_dataset(name, shape, kind)
        case 1:
            file.create_dataset(name, shape[::-1], "f8")
        case 2:
            file.create_dataset(name, data=np.float64(1.0))
        case 3:
            file.create_group(name)
        case 4:  # as large as can be said, of which nothing is stored
            large = tuple(10 ** pick(rng, (2, 4, 6)) for _ in shape)
            file.create_dataset(name, large, "f8", chunks=(1,) * len(shape))
        case 5:
            file.create_dataset(name, (0,) * len(shape), "f8", maxshape=(None,) * len(shape))
        case _:
            if values.dtype.kind == "f" and shape:  # else it is gone
                file.create_dataset(name, data=values[..., : max(values.shape[-1] - 1, 0)])
    for i, label in enumerate(scales):
        new = file.get(name)
        if label and isinstance(new, h5py.Dataset) and i < len(new.dims):
            new.dims[i].label = label


def _read(path: Path) -> None:
    recording = Recording.load(path)
    summarize(recording)
    recording.thrust(recording.vehicle or "bluerov2_heavy")


NETCDF = Kind("netcdf", _spoil, _read)
