"""Messages about typed YAML: what was found at which field, and what to write there."""

import dataclasses
import difflib
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

import numpy as np
from cattrs import ForbiddenExtraKeysError
from cattrs.errors import AttributeValidationNote, BaseValidationError, IterableValidationNote

from .errors import FieldError
from .yaml_text import Tagged

FieldPath = tuple[str | int, ...]
_SHOWN = 60
"""Number of characters of a found value that a message shows."""


def _show(value: Any) -> str:
    match value:
        case None:
            return "nothing"
        case bool():
            return f"`{str(value).lower()}` (a boolean)"
        case str():
            return f"`{short(value)}` (text)"
        case int() if abs(value) > 10**30:
            return f"`{str(value)[:30]}…` (a number)"
        case int() | float():
            return f"`{value}` (a number)"
        case list():
            return f"a list of {len(value)}"
        case dict():
            return "a mapping" + (f" with {short(', '.join(map(str, value)))}" if value else "")
        case Tagged():
            return f"`!{short(value.tag)}`"
    return short(repr(value))


def short(text: str) -> str:
    """The text, shortened to what a message shows."""
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


class Fault(ValueError):
    """A value that its field can't take."""


def fault(value: Any, remedy: str) -> Fault:
    """The error of a value that its field can't take."""
    return Fault(f"found {_show(value)}; write {remedy}")


def faults(error: BaseException, path: FieldPath, cls: Any) -> list[tuple[FieldPath, str]]:
    """Every leaf of the exception tree as (path of the field, message that names it)."""
    names = [
        note.name if isinstance(note, AttributeValidationNote) else note.index
        for note in getattr(error, "__notes__", ())
        if isinstance(note, AttributeValidationNote | IterableValidationNote)
    ]
    path = path + tuple(name if isinstance(name, str | int) else str(name) for name in names)
    if isinstance(error, BaseValidationError):
        return [found for part in error.exceptions for found in faults(part, path, error.cl)]
    if isinstance(error, ForbiddenExtraKeysError):
        known = fields(error.cl)
        strange = sorted(map(str, error.extra_fields))
        return [_named((*path, key), _unknown(key, known)) for key in strange]
    if isinstance(error, KeyError) and names:
        kind = next((f.type for f in dataclasses.fields(cls) if f.name == names[-1]), str)
        return [_named(path, f"is missing; write {wanted(kind)}")]
    if isinstance(error, FieldError) and (within := _place(error, cls)) is not None:
        path = (*path, *within)
        return [(path, f"{dotted(path)} {error.told}")]
    return [_named(path, str(error))]


def _named(path: FieldPath, message: str) -> tuple[FieldPath, str]:
    return path, f"{dotted(path)}: {message}" if path else message


def _place(error: FieldError, cls: Any) -> FieldPath | None:
    """The field's path from a `cls`, which the error names or which has one of what it names."""
    if getattr(cls, "__name__", "") == error.kind:
        return error.path
    parts = dataclasses.fields(cls) if dataclasses.is_dataclass(cls) else ()
    for part in parts:
        kinds = (part.type, *get_args(part.type))
        if any(getattr(kind, "__name__", "") == error.kind for kind in kinds):
            return (part.name, *error.path)
    return None


def needed(cls: Any) -> list[str]:
    """Fields of a dataclass that have no default."""
    missing = dataclasses.MISSING
    return [
        field.name
        for field in dataclasses.fields(cls)
        if field.init and field.default is missing and field.default_factory is missing
    ]


def wanted(cls: Any) -> str:
    """Description of the values of a type, for messages."""
    plain = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
    if cls in plain:
        return plain[cls]
    if cls is Path:
        return "a path"
    if get_origin(cls) is Literal:
        return "one of " + ", ".join(map(str, get_args(cls)))
    if get_origin(cls) in (list, tuple):
        inner = [part for part in get_args(cls) if part is not Ellipsis]
        size = f" of {len(inner)}" if get_origin(cls) is tuple and len(inner) > 1 else ""
        return f"a list{size}"
    if is_array(cls):
        return "a list of numbers"
    if is_union(cls):
        members: tuple[Any, ...] = get_args(cls)
        words = [
            f"!{getattr(m, '__name__', m)} {{…}}" if dataclasses.is_dataclass(m) else wanted(m)
            for m in members
            if m is not NoneType
        ]
        return words[0] if len(words) == 1 else "one of " + ", ".join(words)
    if dataclasses.is_dataclass(cls):
        return f"a mapping with {', '.join(needed(cls) or fields(cls))}"
    return "a mapping" if get_origin(cls) is dict else "a value"


def _unknown(key: Any, known: list[str]) -> str:
    close = difflib.get_close_matches(str(key), known, 1)
    hint = f"did you mean `{close[0]}`?" if close else f"known are {', '.join(known)}"
    return f"is no key of this part; {hint}"


def dotted(path: FieldPath) -> str:
    """A field's path as it is written: `station.effects[0].name`."""
    parts = (f"[{part}]" if isinstance(part, int) else f".{short(str(part))}" for part in path)
    text = "".join(parts)
    return text.removeprefix(".")


def fields(cls: Any) -> list[str]:
    """Fields of a dataclass that a file may give."""
    return [field.name for field in dataclasses.fields(cls) if field.init]


def is_array(cls: Any) -> bool:
    """Whether a type is a NumPy array, with or without a shape."""
    return cls is np.ndarray or getattr(cls, "array_type", None) is np.ndarray


def is_union(cls: Any) -> bool:
    """Whether a type is a union."""
    return get_origin(cls) in (Union, UnionType)
