"""Typed YAML: the one loader for vehicles, training settings, scenarios and data folders.

A configuration is a dataclass: its annotations are the schema, its defaults the defaults.
Supported are nested dataclasses, bool, int, float, str, Path, Literal, Optional, list, tuple, dict,
NumPy arrays (`Float[np.ndarray, "3"]` also checks the shape), unions, and Any for YAML's own types:
numbers, text, lists and mappings. In a union of dataclasses the file names the class by a tag, as
in Drake's typed YAML (an abstract member stands for what only Python can give):

    disturbances:
      - !OrnsteinUhlenbeckWrench {time_constant: 3.0}

Unknown, missing and duplicate keys are refused, every float must be finite and no larger than
`checks.LARGEST`, and an int is accepted for a float but not the reverse. Conditions that a field's
type can't express are checked in the dataclass' `__post_init__`, which raises a ValueError; the
loader adds file, line and field to its message.
"""

import dataclasses
import inspect
import math
import sys
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from types import NoneType
from typing import Any, Literal, TypeVar, get_args, get_origin

import numpy as np
from cattrs import Converter
from cattrs.cols import (
    homogenous_tuple_structure_factory,
    list_structure_factory,
    mapping_structure_factory,
)
from cattrs.errors import (
    BaseValidationError,
    IterableValidationError,
    IterableValidationNote,
)
from cattrs.gen import make_dict_structure_fn

from .checks import LARGEST
from .errors import UserError
from .yaml_messages import Fault, fault, faults, fields, is_array, is_union, needed, wanted
from .yaml_text import Tagged, emit, line_of, parse

T = TypeVar("T")
_LARGEST_INT = 2**53
"""Integers up to this one are exact in floating point."""


def load(cls: type[T], path: str | PathLike[str], base: T | None = None) -> T:
    """Read a `cls` from a YAML file; missing fields are taken from `base`, or are the defaults.

    Raises:
        UserError: the file can't be read, or its text is not a `cls` (see `loads`).
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise UserError(f"{path}: there is no such file; check the path") from error
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: can't be read as UTF-8 text: {error}") from error
    return loads(cls, text, str(path), base)


def loads(cls: type[T], text: str, source: str = "text", base: T | None = None) -> T:
    """Read a `cls` from YAML text; `source` names the text in messages.

    Mappings are merged into those of `base` key by key, also where only `base` has a tag; lists and
    values of another tag replace it.

    Raises:
        UserError: one line per fault, each `source:line: field: what was found; what to write`.
    """
    data, node = parse(text, source)
    if data is None:
        if base is None and (names := needed(cls)):
            raise UserError(f"{source}: holds nothing; write a mapping with {', '.join(names)}")
        data = {}
    if base is not None:
        data = _overlaid(parse(dump(base), source)[0], data)
    return structured(cls, data, source, node)


def structured(cls: type[T], data: Any, source: str, node: Any = None) -> T:
    """Make a `cls` from plain values; `node` is the node tree of their text, for line numbers.

    Raises:
        UserError: as in `loads`.
    """
    try:
        return _CONVERTER.structure(data, cls)
    except (BaseValidationError, ValueError, TypeError) as error:
        lines = []
        for path, message in faults(error, (), cls):
            line = line_of(node, path)
            where = source if line is None else f"{source}:{line}"
            lines.append(f"{where}: {message}")
        raise UserError("\n".join(lines)) from error


def _overlaid(base: Any, data: Any) -> Any:
    if isinstance(base, Tagged) and isinstance(data, Tagged) and base.tag == data.tag:
        return Tagged(data.tag, _overlaid(base.value, {} if data.value is None else data.value))
    if isinstance(base, Tagged) and isinstance(data, Mapping):
        return Tagged(base.tag, _overlaid(base.value, data))
    if isinstance(base, Mapping) and isinstance(data, Mapping):
        return {**base, **{k: _overlaid(base[k], v) if k in base else v for k, v in data.items()}}
    return data


def dump(obj: Any) -> str:
    """YAML text of a configuration including defaults; `loads(type(obj), …)` returns an equal one.

    Raises:
        ValueError: a float is not finite.
    """
    return emit(_CONVERTER.unstructure(obj, type(obj)))


# ---------------------------------------------------------------- one hook for each kind of field


def _bool(value: Any, _: Any) -> bool:
    if not isinstance(value, bool):
        raise fault(value, "true or false")
    return value


def _int(value: Any, _: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise fault(value, "a whole number")
    if abs(value) > _LARGEST_INT:
        raise fault(value, f"a whole number of at most {_LARGEST_INT}")
    return value


def _float(value: Any, _: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise fault(value, "a number")
    if abs(value) > sys.float_info.max or math.isnan(value):
        raise fault(value, "a finite number")
    if abs(value) > LARGEST:
        raise fault(value, f"a number of at most {LARGEST:g}")
    return float(value)


def _str(value: Any, _: Any) -> str:
    if not isinstance(value, str):
        raise fault(value, "text (in quotes if it looks like a number)")
    return value


def _path(value: Any, _: Any) -> Path:
    if not isinstance(value, str) or not value:
        raise fault(value, "a path")
    return Path(value)


def _any(value: Any, _: Any) -> Any:
    match value:
        case bool() | int() | str() | None:
            return value
        case float():
            return _float(value, float)
        case list():
            return [_any(item, Any) for item in value]
        case dict() if all(isinstance(key, str) for key in value):
            return {key: _any(item, Any) for key, item in value.items()}
    raise fault(value, "numbers, text, lists, or mappings whose keys are text")


def _literal(value: Any, cls: Any) -> Any:
    for choice in get_args(cls):
        if type(value) is type(choice) and value == choice:
            return value
    raise fault(value, "one of " + ", ".join(map(str, get_args(cls))))


def _array(value: Any, cls: Any) -> np.ndarray:
    shape = "" if cls is np.ndarray else f" of shape ({', '.join(cls.dim_str.split())})"

    def convert(item: Any) -> Any:
        return [convert(x) for x in item] if isinstance(item, list) else _float(item, float)

    if not isinstance(value, list):
        raise fault(value, f"a list of numbers{shape}")
    try:
        array = np.asarray(convert(value), dtype=float)
    except ValueError as error:
        if str(error).startswith("found"):
            raise
        raise ValueError(f"found rows of unequal length; write numbers{shape}") from error
    if cls is not np.ndarray and not isinstance(array, cls):
        raise ValueError(f"found numbers of shape {array.shape}; write numbers{shape}")
    return array


def _list(cls: Any, converter: Converter) -> Any:
    inner = list_structure_factory(cls, converter)

    def structure(value: Any, _: Any) -> list:
        if not isinstance(value, list):
            raise fault(value, "a list: [first, second]")
        return inner(value, cls)

    return structure


def _tuple(cls: Any, converter: Converter) -> Any:
    args = get_args(cls)
    if len(args) == 2 and args[1] is Ellipsis:
        inner = homogenous_tuple_structure_factory(cls, converter)
        size = None
    else:
        inner, size = None, len(args)

    def structure(value: Any, _: Any) -> tuple:
        if not isinstance(value, list) or (size is not None and len(value) != size):
            raise fault(value, "a list" + ("" if size is None else f" of {size}"))
        if inner is not None:
            return inner(value, cls)
        items, errors = [], []
        for index, (item, arg) in enumerate(zip(value, args, strict=True)):
            try:
                items.append(converter.structure(item, arg))
            except (ValueError, TypeError, BaseValidationError) as error:
                error.add_note(IterableValidationNote(f"@ index {index}", index, arg))
                errors.append(error)
        if errors:
            note = f"While structuring {cls!r}"
            raise IterableValidationError(note, errors, cls)  # pyright: ignore[reportCallIssue]
        return tuple(items)

    return structure


def _dict(cls: Any, converter: Converter) -> Any:
    inner = mapping_structure_factory(cls, converter)

    def structure(value: Any, _: Any) -> dict:
        if not isinstance(value, dict):
            raise fault(value, "a mapping {key: value}")
        return inner(value, cls)

    return structure


def _dataclass(cls: Any, converter: Converter) -> Any:
    inner = make_dict_structure_fn(cls, converter, _cattrs_forbid_extra_keys=True)

    def structure(value: Any, _: Any) -> Any:
        if isinstance(value, Tagged) and value.tag == cls.__name__:
            value = value.value
        if not isinstance(value, Mapping):
            raise fault(value, f"a mapping with {', '.join(fields(cls)) or 'nothing in it'}")
        return inner(value, cls)

    return structure


def _union(cls: Any, converter: Converter) -> Any:
    members = [m for m in get_args(cls) if m is not NoneType and not inspect.isabstract(m)]
    optional = NoneType in get_args(cls)
    kinds: list[Any] = [member for member in members if dataclasses.is_dataclass(member)]
    classes = {kind.__name__: kind for kind in kinds}
    others = [member for member in members if not dataclasses.is_dataclass(member)]
    choices = [f"!{name} {{…}}" for name in classes] + [wanted(member) for member in others]
    remedy = "one of " + ", ".join(choices + (["null"] if optional else []))

    def structure(value: Any, _: Any) -> Any:
        if value is None and optional:
            return None
        if len(members) == 1:
            try:
                return converter.structure(value, members[0])
            except Fault as error:  # of the value itself; those of its parts come in groups
                raise Fault(f"{error}, or null for none" if optional else str(error)) from error
        if isinstance(value, Tagged):
            if value.tag not in classes:
                raise fault(value, remedy)
            return converter.structure(value, classes[value.tag])
        for member in others:
            try:
                return converter.structure(value, member)
            except (ValueError, TypeError, BaseValidationError):
                continue
        raise fault(value, remedy)

    return structure


def _untagged(cls: Any, converter: Converter) -> Any:
    classes = [member for member in get_args(cls) if dataclasses.is_dataclass(member)]

    def unstructure(value: Any) -> Any:
        plain = converter.unstructure(value, type(value))
        if len(classes) > 1 and dataclasses.is_dataclass(value):
            return Tagged(type(value).__name__, plain)
        return plain

    return unstructure


def _converter() -> Converter:
    converter = Converter(forbid_extra_keys=True, detailed_validation=True)
    scalars = {bool: _bool, int: _int, float: _float, str: _str, Path: _path}
    for cls, hook in scalars.items():
        converter.register_structure_hook(cls, hook)
    converter.register_structure_hook_func(lambda t: get_origin(t) is Literal, _literal)
    converter.register_structure_hook_func(is_array, _array)
    converter.register_structure_hook_func(lambda t: t is Any, _any)
    for predicate, factory in (
        (lambda t: get_origin(t) is list, _list),
        (lambda t: get_origin(t) is tuple, _tuple),
        (lambda t: get_origin(t) is dict, _dict),
        (lambda t: isinstance(t, type) and dataclasses.is_dataclass(t), _dataclass),
        (is_union, _union),
    ):
        converter.register_structure_hook_factory(predicate, factory)
    converter.register_unstructure_hook_factory(is_union, _untagged)
    converter.register_unstructure_hook_func(is_array, lambda value: np.asarray(value).tolist())
    converter.register_unstructure_hook(Path, str)
    return converter


_CONVERTER = _converter()
