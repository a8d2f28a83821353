"""Models in one file: a JSON header and the arrays in an npz archive, without pickle.

The header names format, version, kind of `Dynamics`, its configuration and free metadata. Only
registered kinds (`register`) can be loaded, so that reading a file never runs code from it.
"""

import dataclasses
import json
from collections.abc import Callable
from os import PathLike
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..config.errors import UserError
from ..config.typed_yaml import structured
from ..dynamics import Dynamics
from ..effects.base import Effect
from ..effects.extended import Extended
from ..effects.library import kind
from ..euclidean import EuclideanSpinn, create_spinn
from ..growth import Growth
from ..integrate import cast
from ..rigid_body import FossenDynamics
from ..spinn import Spinn, SpinnConfig
from ..thrusters import MOST
from .archive import read_archive
from .atomic import atomic_path

FORMAT = "spinndrift model"
VERSION = 1
_LARGEST = 1e6
"""Upper bound of an effect's options, which are counts, times, lengths and numbers of terms."""


class Kind(NamedTuple):
    """JSON description of the structure of one class of `Dynamics`, and its reconstruction."""

    cls: type[Dynamics]
    describe: Callable[[Any], dict[str, Any]]
    template: Callable[[dict[str, Any]], Dynamics]
    """A model of the described structure with arrays of the right shapes and any values."""


_KINDS: dict[str, Kind] = {}


def register(
    cls: type[Dynamics],
    describe: Callable[[Any], dict[str, Any]],
    template: Callable[[dict[str, Any]], Dynamics],
) -> None:
    """Make a class of `Dynamics` storable under its name."""
    _KINDS[cls.__name__] = Kind(cls, describe, template)


def describe(dynamics: Dynamics) -> dict[str, Any]:
    """The structure of a model: its kind and configuration (also for kinds that wrap a model).

    Raises:
        ValueError: the class is not registered.
    """
    kind = _KINDS.get(type(dynamics).__name__)
    if kind is None or kind.cls is not type(dynamics):
        raise ValueError(f"{type(dynamics).__name__} can't be stored: register it in checkpoint")
    return {"kind": type(dynamics).__name__, "config": kind.describe(dynamics)}


def template(description: Any) -> Dynamics:
    """A model of the structure that `describe` returned, with arbitrary numbers.

    Raises:
        UserError: it is not a mapping, the kind is unknown, or there is no configuration.
        ValueError: the configuration is wrong (LookupError and TypeError likewise).
    """
    if not isinstance(description, dict):
        raise UserError("it is described by no mapping")
    name = description.get("kind")
    if not isinstance(name, str) or name not in _KINDS:
        raise UserError(f"kind {str(name)[:40]!r} is none of {', '.join(sorted(_KINDS))}")
    if "config" not in description:
        raise UserError("there is no config")
    return _KINDS[name].template(description["config"])


def save_model(
    path: str | PathLike[str], dynamics: Dynamics, metadata: dict[str, Any] | None = None
) -> None:
    """Write a model and JSON-like metadata atomically.

    Raises:
        ValueError: the class is not registered, or the metadata is not JSON.

    Example:
        >>> model = load_vehicle("bluerov2_heavy").dynamics()
        >>> save_model("physics.spinn", model, {"data": "none"})
    """
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(dynamics, eqx.is_array))]
    header = {
        "format": FORMAT,
        "version": VERSION,
        **describe(dynamics),
        "arrays": [[list(leaf.shape), str(leaf.dtype)] for leaf in leaves],
        "metadata": metadata or {},
    }
    try:
        text = json.dumps(header, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"metadata must be plain JSON with finite numbers: {error}") from error
    arrays: dict[str, Any] = {f"array_{i:04d}": leaf for i, leaf in enumerate(leaves)}
    arrays["header"] = np.frombuffer(text.encode(), np.uint8)
    with atomic_path(path) as partial, partial.open("wb") as handle:
        np.savez_compressed(handle, **arrays)


def load_model(
    path: str | PathLike[str], dtype: jnp.dtype | type | None = None
) -> tuple[Dynamics, dict[str, Any]]:
    """Read a model and its metadata; `dtype` converts its numbers, None keeps them as stored.

    Raises:
        UserError: the file is missing, of another kind, truncated, damaged or of a later version,
            or holds float64 while JAX runs in float32 and no `dtype` is given.

    Example:
        >>> save_model("physics.spinn", load_vehicle("bluerov2_heavy").dynamics(), {"data": "none"})
        >>> model, metadata = load_model("physics.spinn")
        >>> metadata
        {'data': 'none'}
    """
    header, leaves = _read(path)
    try:
        with np.errstate(over="raise"):
            model = template(header)
    except UserError as error:
        raise UserError(f"{path}: not a model this version can make ({error}).") from error
    except FloatingPointError as error:
        raise UserError(
            f"{path}: not a model this version can make (a number in its description is beyond "
            "single precision); save it again."
        ) from error
    except (LookupError, TypeError, ValueError, RecursionError) as error:
        raise UserError(
            f"{path}: not a model this version can make (its description is damaged, or another "
            "version's); save it again."
        ) from error
    arrays, static = eqx.partition(model, eqx.is_array)
    old, treedef = jax.tree.flatten(arrays)
    if [(a.shape, a.dtype.kind) for a in old] != [(a.shape, a.dtype.kind) for a in leaves]:
        raise UserError(f"{path}: its arrays don't have the shapes of the described model.")
    wide = any(leaf.dtype == np.float64 for leaf in leaves)
    if dtype is None and wide and jnp.asarray(0.0).dtype != jnp.float64:
        raise UserError(
            f"{path}: holds float64 numbers; enable jax_enable_x64 or pass dtype=jnp.float32."
        )
    if dtype is not None:
        with np.errstate(over="ignore"):  # such numbers are refused below
            leaves = [leaf.astype(dtype) if leaf.dtype.kind == "f" else leaf for leaf in leaves]
    if not all(np.isfinite(leaf).all() for leaf in leaves):
        raise UserError(
            f"{path}: holds numbers that are not finite; train or save the model again."
        )
    # `jnp.asarray` would compile a program for every shape
    filled = jax.tree.unflatten(treedef, jax.device_put(leaves))
    return eqx.combine(filled, static), header["metadata"]


def _read(path: str | PathLike[str]) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Header and arrays of a file whose format, version and completeness have been checked."""
    header, leaves = read_archive(path, "model")
    if header.get("format") != FORMAT:
        raise UserError(f"{path}: not a spinndrift model file; give one that training wrote.")
    version = header.get("version")
    if isinstance(version, int) and version > VERSION:
        raise UserError(
            f"{path}: model format version {version} is newer than {VERSION}; update spinndrift."
        )
    told = [[list(leaf.shape), str(leaf.dtype)] for leaf in leaves]
    if told != header.get("arrays") or not isinstance(header.get("metadata"), dict):
        raise UserError(f"{path}: header and arrays don't agree; save or copy the file again.")
    return header, leaves


def _unit_body() -> FossenDynamics:
    eye, zero = np.eye(6), np.zeros((6, 6))
    return FossenDynamics(
        rigid_inertia=eye,
        added_mass=zero,
        linear_drag=zero,
        quadratic_drag=zero,
        weight=1.0,
        buoyancy=1.0,
        p_BoBcm_B=np.zeros(3),
        p_BoCb_B=np.zeros(3),
    )


def _spinn(config: dict[str, Any]) -> Spinn:
    made = structured(SpinnConfig, config, "configuration")
    return create_spinn(made, _unit_body(), jax.random.key(0), jnp.float32)


def _describe_fossen(model: FossenDynamics) -> dict[str, Any]:
    return {} if model.growth is None else {"growing": True}


def _fossen(config: Any) -> FossenDynamics:
    if not isinstance(config, dict) or config.get("growing", False) not in (False, True):
        raise ValueError("growing is neither true nor false")
    growth = Growth.none() if config.get("growing") else None
    return cast(_unit_body().with_constants(growth=growth), jnp.float32)


register(FossenDynamics, _describe_fossen, _fossen)
for _kind in (Spinn, EuclideanSpinn):
    register(_kind, lambda model: dataclasses.asdict(model.config), _spinn)


def _describe_extended(model: Extended) -> dict[str, Any]:
    effects = []
    for effect in model.effects:
        options = {
            field.name: getattr(effect, field.name)
            for field in dataclasses.fields(effect)
            if field.metadata.get("static", False) and field.name != "thrusters"
        }
        effects.append({"name": effect.name, "options": options})
    n = model.positions.shape[1]
    return {"base": describe(model.base), "effects": effects, "thrusters": n}


def _neutral(name: str, options: dict[str, Any], thrusters: int) -> Effect:
    """An effect by name; its options must have the types of their defaults."""
    if not isinstance(name, str):
        raise ValueError("name of an effect")
    cls = kind(name)
    usual = {field.name: field.default for field in dataclasses.fields(cls)}
    if not isinstance(options, dict):
        raise ValueError(f"options of {name}")
    options = {name: value for name, value in options.items() if name != "thrusters"}
    for option, value in options.items():
        numbers = value if isinstance(value, list) else [value]
        plain = all(isinstance(n, int | float) and abs(n) < _LARGEST for n in numbers)
        if not (isinstance(value, str) if isinstance(usual[option], str) else plain):
            raise ValueError(f"{option} of {name}")
        if isinstance(usual[option], int) and not (isinstance(value, int) and value >= 1):
            raise ValueError(f"{option} of {name}")
    return cls.neutral(jnp.float32, thrusters=thrusters, **options)


def _extended(config: dict[str, Any]) -> Extended:
    n = config["thrusters"]
    if n not in range(1, MOST + 1):
        raise ValueError(f"{n} thrusters")
    effects = tuple(_neutral(e["name"], e["options"], n) for e in config["effects"])
    places, inverse = jnp.zeros((3, n), jnp.float32), jnp.zeros((n, 6), jnp.float32)
    base = template(config["base"])
    return Extended(base, effects, places, places, inverse)  # pyright: ignore[reportCallIssue]


register(Extended, _describe_extended, _extended)
