"""Which functions are equal: a key of a function's code and of the values that it refers to.

Two functions made by the same lines of code from equal values (parameters, configurations, arrays)
are traced to the same program. The key tells it without tracing, which takes longer than to compile
for a filter or a vehicle with sensors. Values of kinds that are not known here, such as systems
with ports, have no key: their functions are compared by their programs.
"""

import dataclasses
import enum
import functools
import types
from collections import deque
from collections.abc import Hashable, Mapping
from pathlib import PurePath
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

_OWN = "spinndrift"
_CHECKERS = ("jaxtyping", "beartype")
"""Packages whose wrappers check types, and change nothing."""


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
        return _key(function, {})
    except _NoKeyError:
        return None


def _key(value: Any, seen: dict[int, int]) -> Hashable:
    """The key of a value; `seen` numbers the objects on the way to it, for those in a circle."""
    if value is None or isinstance(value, bool | int | str | bytes | np.dtype):
        return type(value), value
    if isinstance(value, type | types.ModuleType | types.BuiltinFunctionType | np.ufunc):
        return _Same(value)
    if isinstance(value, float | complex | enum.Enum | PurePath | slice | range):
        return type(value), repr(value)
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return _array(value)
    if id(value) in seen:
        return "again", seen[id(value)]
    return type(value), _compound(value, seen | {id(value): len(seen)})


def _array(value: Any) -> Hashable:
    if isinstance(value, Tracer):
        raise _NoKeyError
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return "key", str(jax.random.key_impl(value)), _array(jax.random.key_data(value))
    array = np.asarray(value)
    if array.dtype.hasobject:
        raise _NoKeyError
    return type(value), array.shape, array.dtype.str, array.tobytes()


def _compound(value: Any, seen: dict[int, int]) -> Hashable:
    """The key of the parts of a value."""
    if isinstance(value, tuple | list | deque):
        return tuple(_key(each, seen) for each in value)
    if isinstance(value, Mapping):
        return tuple((_key(k, seen), _key(each, seen)) for k, each in value.items())
    if isinstance(value, set | frozenset):
        return frozenset(_key(each, seen) for each in value)
    if isinstance(value, functools.partial):
        return tuple(_key(each, seen) for each in (value.func, value.args, value.keywords))
    if isinstance(value, types.MethodType):
        return _key(value.__func__, seen), _key(value.__self__, seen)
    if isinstance(value, types.FunctionType):
        return _function(value, seen)
    if hasattr(value, "__wrapped__"):  # compiled or cached functions
        return _key(value.__wrapped__, seen)
    if hasattr(type(value), "__index__"):  # numbers of a system's states and ports
        return int(value)
    own = type(value).__module__.partition(".")[0] == _OWN and type(value).__bases__ == (object,)
    if not own and not dataclasses.is_dataclass(value):
        return _hashable(value)
    fields = dataclasses.fields(value) if dataclasses.is_dataclass(value) else ()
    names = {field.name for field in fields}
    names |= {n for n in getattr(value, "__dict__", ()) if not _cached(type(value), n)}
    return tuple((n, _key(getattr(value, n), seen)) for n in sorted(names))


def _hashable(value: Any) -> Hashable:
    """A value whose own equality compares what is in it."""
    if type(value).__eq__ is object.__eq__ or type(value).__hash__ is None:
        raise _NoKeyError
    try:
        hash(value)
    except TypeError as error:
        raise _NoKeyError from error
    return value


def _cached(cls: type, name: str) -> bool:
    """Whether an attribute was computed from the others."""
    return isinstance(getattr(cls, name, None), functools.cached_property)


def _function(function: types.FunctionType, seen: dict[int, int]) -> Hashable:
    """The key of a function: its code, defaults, closure and what it names of its module."""
    function = _unchecked(function)
    code = function.__code__
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    given = (function.__defaults__, function.__kwdefaults__, cells)
    names = {n: function.__globals__[n] for n in sorted(_names(code)) if n in function.__globals__}
    return code, _key(given, seen), tuple((n, _named(v, seen)) for n, v in names.items())


def _unchecked(function: types.FunctionType) -> types.FunctionType:
    """The function without the check of its arguments' types, which is made anew for each."""
    while inner := getattr(function, "__wrapped__", None):
        made_by = str(function.__globals__.get("__name__")), function.__code__.co_filename
        if not any(name.removeprefix("<@").startswith(_CHECKERS) for name in made_by):
            break
        function = inner
    return function


def _names(code: types.CodeType) -> set[str]:
    """Names that a function and those in it may take from its module."""
    inner = [part for part in code.co_consts if isinstance(part, types.CodeType)]
    return set(code.co_names).union(*(_names(part) for part in inner))


def _named(value: Any, seen: dict[int, int]) -> Hashable:
    """The key of something that a module names: functions and classes are equal to themselves."""
    if callable(value):
        return _Same(value)
    try:
        return _key(value, seen)
    except _NoKeyError:
        return _Same(value)
