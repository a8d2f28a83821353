"""Models (.spinn) and checkpoints of training runs: header, arrays, archive and bytes."""

import io
import json
import struct
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from spinndrift.models.effects.extended import Extended
from spinndrift.models.effects.library import kind
from spinndrift.models.files.checkpoint import load_model, save_model
from spinndrift.models.spinn import Spinn, SpinnConfig
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.config import TrainingConfig
from spinndrift.training.fitting.run_folder import RunFolder, TrainState

from .harness import Kind
from .mutate import FLOATS, WORDS, Rng, bytes_spoiled, part, pick

_DATA = "0123456789abcdef"


def _state() -> TrainState:
    """A training run's state: arrays of any tree."""
    tree = {"a": jnp.arange(4.0, dtype=jnp.float32), "b": jnp.ones((2, 3), jnp.float32)}
    return TrainState(tree, tree, {"bandwidth": jnp.ones(2, jnp.float32)}, tree)


@cache
def _sound() -> dict[str, bytes]:
    """Bytes of sound files by their names."""
    vehicle = load_vehicle("bluerov2_heavy")
    body = vehicle.dynamics(np.ones(6), jnp.float32)
    spinn = Spinn.create(SpinnConfig(width=4, depth=1), body, jax.random.key(0))
    effects = (
        kind("thruster_lag").of(time_constant=0.1),
        kind("proximity").neutral(jnp.float32, walls=(1.0, 2.0, 3.0, 4.0)),
    )
    extended = Extended.create(body, effects, vehicle.thrusters(jnp.float32))
    metadata = {"vehicle": vehicle.name, "dt": 0.05, "substeps": 2}
    with TemporaryDirectory() as folder:
        base = Path(folder)
        for name, model in (("fossen", body), ("spinn", spinn), ("extended", extended)):
            save_model(base / f"{name}.spinn", model, metadata)
        RunFolder(base).save(_state(), TrainingConfig(), _DATA)
        return {path.name: path.read_bytes() for path in sorted(base.iterdir())}


def _spoil(rng: Rng, folder: Path) -> Path:
    name = pick(rng, sorted(_sound()))
    data = _sound()[name]
    chance = rng.random()
    if chance < 0.75:
        with np.load(io.BytesIO(data)) as archive:
            arrays = {key: archive[key] for key in archive.files}
        members: dict[str, bytes] = {}
        for _ in range(int(rng.integers(1, 4))):
            _spoil_arrays(rng, arrays, members)
        data = _packed(rng, arrays, members)
    if chance > 0.65:
        for _ in range(int(rng.integers(1, 4))):
            data = bytes_spoiled(rng, data)
    path = folder / name
    path.write_bytes(data)
    return path


def _packed(rng: Rng, arrays: dict[str, Any], members: dict[str, bytes]) -> bytes:
    """An archive of arrays without times; `members` are files that stand in it as they are."""
    memory = io.BytesIO()
    form = zipfile.ZIP_DEFLATED if rng.random() < 0.5 else zipfile.ZIP_STORED
    with zipfile.ZipFile(memory, "w", form) as archive:
        for key, value in arrays.items():
            if key not in members:
                one = io.BytesIO()
                np.lib.format.write_array(one, np.asarray(value), allow_pickle=True)
                archive.writestr(
                    zipfile.ZipInfo(f"{key}.npy"), one.getvalue(), form
                )  # no time in it
        for key, raw in members.items():
            archive.writestr(zipfile.ZipInfo(f"{key}.npy"), raw, form)
    return memory.getvalue()


def _spoil_arrays(rng: Rng, arrays: dict[str, Any], members: dict[str, bytes]) -> None:
    if not arrays:
        return
    stored = np.asarray(arrays.get("header"))
    if rng.random() < 0.5 and stored.dtype == np.uint8:
        try:
            header = json.loads(stored.tobytes())
        except ValueError:
            return
        text = json.dumps(_json_spoiled(rng, header))
        arrays["header"] = np.frombuffer(text.encode("utf-8", "surrogatepass"), np.uint8)
        return
    key = pick(rng, list(arrays))
    value = np.asarray(arrays[key])
    match int(rng.integers(8)):
        case 0 | 1:
            if value.dtype.kind == "f" and value.size:
                changed = value.copy()
                with np.errstate(over="ignore"):
                    changed.reshape(-1)[part(rng, value.size)] = pick(rng, FLOATS)
                arrays[key] = changed
        case 2:
            with np.errstate(all="ignore"):
                forms = ("f2", "f8", "i4", "c16", "S3", "?", "M8[s]")
                arrays[key] = np.zeros(value.shape, pick(rng, forms))
        case 3:
            shapes: tuple[Callable[[], Any], ...] = (
                lambda: value[..., None], lambda: value.reshape(-1), lambda: value.reshape(-1)[:0],
                lambda: value.T, lambda: np.concatenate([value.reshape(-1)] * 2),
            )  # fmt: skip
            arrays[key] = pick(rng, shapes)()
        case 4:
            del arrays[key]
        case 5:
            arrays[key] = np.array([{"a": 1}, None], dtype=object)
        case 6:
            arrays[pick(rng, (*list(arrays), "array_0001", "array_9999", "header", "x"))] = value
        case _:  # a header that promises more than there is
            shape = pick(rng, ("(1000000000000,)", "(-1,)", "()", "(2, 10000000000)", "(1e9,)"))
            head = (
                f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
            )
            members[key] = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode()


def _places(value: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) of a JSON value."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    found = []
    for key, inner in items:
        found.append((value, key))
        if isinstance(inner, dict | list):
            found += _places(inner)
    return found


def _json_spoiled(rng: Rng, header: Any) -> Any:
    places = _places(header) if isinstance(header, dict | list) else []
    if not places:
        return pick(rng, ([], {}, None, 1))
    container, key = pick(rng, places)
    match int(rng.integers(5)):
        case 0:
            del container[key]
        case 1:
            container[key] = pick(rng, FLOATS)
        case 2:
            container[key] = pick(
                rng, (*WORDS, None, True, [], {}, [[]], 10**40, -1, 0, 2, "Spinn")
            )
        case 3:
            other, k = pick(rng, places)
            if isinstance(other, dict) and k in other and not isinstance(other[k], dict | list):
                container[key] = other[k]
        case _:
            if isinstance(container, dict):
                container[str(key) + "x"] = container.pop(key)
            else:
                container.insert(key, container[key])
    return header


def _read(path: Path) -> None:
    if path.suffix == ".spinn":
        model, _ = load_model(path, dtype=float)
        for leaf in jax.tree.leaves(model):
            if hasattr(leaf, "dtype") and not np.isfinite(np.asarray(leaf)).all():
                raise AssertionError("a number that isn't finite was loaded")
        return
    RunFolder(path.parent).load(_state(), TrainingConfig(), _DATA)


CHECKPOINT = Kind("checkpoint", _spoil, _read)
