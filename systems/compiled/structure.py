"""Which functions are equal: a key of a function's code and of the values that it refers to.

Two functions made by the same lines of code from equal values (parameters, configurations, arrays)
are traced to the same program. The key tells it without tracing, which takes longer than to compile
for a filter or a vehicle with sensors.

Only what is known to be constant has a key: functions and objects of this package, of JAX, NumPy
and Equinox, and plain values. All else, such as a user's functions, whose modules may change, or
systems with ports, has none: such functions are compared by their programs.
"""

import dataclasses
import enum
import functools
import types
from collections.abc import Hashable
from pathlib import PurePath
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

_OWN = ("spinndrift",)
_KNOWN = ("jax", "jaxlib", "numpy", "equinox", "functools")
_CHECKERS = ("jaxtyping", "beartype")
"""Packages whose wrappers check types, and change nothing."""
_PLAIN = (type(None), bool, int, str, bytes)
_EMPTY = "empty cell"


class _NoKeyError(Exception):
    """A value of an unknown kind."""


class _Same:
    """An object that equals itself only; it stays alive, so that no other one takes its place."""

    def __init__(self, value: object):
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


def structure(function: Any) -> Hashable | None:
    """A key that is equal for functions that compute the same; None for those of unknown values.

    Functions and constants of modules are compared too, as far as the function names them itself.
    """
    try:
        key = _key(function, {})
        hash(key)
    except (_NoKeyError, AttributeError, TypeError, ValueError, RecursionError):
        return None
    return key


def _key(value: Any, seen: dict[int, int]) -> Hashable:
    """The key of a value; `seen` numbers the objects on the way to it, for those in a circle."""
    kind = type(value)
    if kind in _PLAIN or isinstance(value, np.dtype):
        return kind, value
    if kind in (float, complex) or isinstance(value, PurePath):
        return kind, repr(value)
    if isinstance(value, type | types.ModuleType | types.BuiltinFunctionType | enum.Enum):
        return _Same(value)
    if kind is np.ndarray or isinstance(value, np.generic | jax.Array):
        return _array(value)
    if id(value) in seen:
        return "again", seen[id(value)]
    return kind, _compound(value, seen | {id(value): len(seen)})


def _array(value: Any) -> Hashable:
    if isinstance(value, Tracer):
        raise _NoKeyError
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return "key", str(jax.random.key_impl(value)), _array(jax.random.key_data(value))
    array = np.asarray(value)
    if array.dtype.hasobject:
        raise _NoKeyError
    weak = getattr(value, "weak_type", False)
    return type(value), weak, array.shape, array.dtype, array.tobytes()


def _compound(value: Any, seen: dict[int, int]) -> Hashable:
    """The key of the parts of a value."""
    kind = type(value)
    if kind in (tuple, list) or (issubclass(kind, tuple) and hasattr(kind, "_fields")):
        return tuple(_key(each, seen) for each in value)
    if kind in (dict, types.MappingProxyType):
        return tuple((_key(k, seen), _key(each, seen)) for k, each in value.items())
    if kind in (set, frozenset):
        return frozenset(_key(each, seen) for each in value)
    if kind in (slice, range):
        return tuple(_key(each, seen) for each in (value.start, value.stop, value.step))
    if kind is functools.partial:
        return tuple(_key(each, seen) for each in (value.func, value.args, value.keywords))
    if kind is types.MethodType:
        return _key(value.__func__, seen), _key(value.__self__, seen)
    if kind is types.FunctionType:
        return _function(value, seen)
    return _object(value, seen)


def _object(value: Any, seen: dict[int, int]) -> Hashable:
    """The key of an object by its attributes, or by an equality of its own."""
    kind = type(value)
    if _from(kind.__module__, ("pydrake",)) and hasattr(kind, "__index__"):
        return int(value)  # the number of a system's state or port
    fields = dataclasses.fields(value) if dataclasses.is_dataclass(value) else None
    own = _from(kind.__module__, _OWN)
    if fields is not None and (own or _from(kind.__module__, _KNOWN)):
        names = {field.name for field in fields}
    elif own and kind.__bases__ == (object,):
        names = set()
    elif not _from(kind.__module__, _KNOWN):
        raise _NoKeyError
    elif kind.__eq__ is not object.__eq__:
        return value
    elif callable(value):
        return _Same(value)
    else:
        raise _NoKeyError
    names |= {n for n in getattr(value, "__dict__", ()) if not _cached(kind, n)}
    return tuple((n, _key(getattr(value, n), seen)) for n in sorted(names))


def _from(module: str | None, packages: tuple[str, ...]) -> bool:
    """Whether a module is of one of the packages."""
    return str(module).partition(".")[0] in packages


def _cached(cls: type, name: str) -> bool:
    """Whether an attribute was computed from the others."""
    return isinstance(getattr(cls, name, None), functools.cached_property)


def _function(function: types.FunctionType, seen: dict[int, int]) -> Hashable:
    """The key of a function: its code, defaults, closure and what it names of its module."""
    inner = _unchecked(function)
    if type(inner) is not types.FunctionType:
        return _key(inner, seen)
    if not _from(inner.__module__, _OWN + _KNOWN):
        raise _NoKeyError
    code, known = inner.__code__, inner.__globals__
    cells = [_content(cell, seen) for cell in inner.__closure__ or ()]
    given = _key((inner.__defaults__, inner.__kwdefaults__), seen)
    names = [n for n in sorted(_names(code)) if n in known]
    return code, given, tuple(cells), tuple((n, _named(known[n], seen)) for n in names)


def _content(cell: types.CellType, seen: dict[int, int]) -> Hashable:
    try:
        value = cell.cell_contents
    except ValueError:
        return _EMPTY
    return _key(value, seen)


def _unchecked(function: Any) -> Any:
    """The function without the check of its arguments' types, which is made anew for each."""
    while type(function) is types.FunctionType:
        inner = getattr(function, "__wrapped__", None)
        file = function.__code__.co_filename.removeprefix("<@")
        module = function.__globals__.get("__name__")
        if inner is None or not (_from(module, _CHECKERS) or file.startswith(_CHECKERS)):
            break
        function = inner
    return function


def _names(code: types.CodeType) -> set[str]:
    """Names that a function and those in it may take from its module."""
    inner = [part for part in code.co_consts if isinstance(part, types.CodeType)]
    return set(code.co_names).union(*(_names(part) for part in inner))


def _named(value: Any, seen: dict[int, int]) -> Hashable:
    """The key of something that a module names: functions and classes are equal to themselves."""
    return _Same(value) if callable(value) else _key(value, seen)
