"""A diagnosis read back from `diagnosis.json`."""

import dataclasses
import json
import math
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from ....models.config.errors import UserError
from . import result


def read_diagnosis(path: Path) -> result.Diagnosis:
    """The diagnosis that `Diagnosis.save` wrote; numbers that are null become NaN.

    Raises:
        UserError: there is no such file, or it is no diagnosis of this version.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["version"] != result.VERSION:
            raise ValueError(f"version {data['version']!r}")
        return _made(result.Diagnosis, data)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path}: is no diagnosis.json of this version; make it anew with spinndrift diagnose"
        ) from error


def _made(kind: Any, value: Any) -> Any:
    """A value of a field's type from plain JSON."""
    if dataclasses.is_dataclass(kind):
        hints = get_type_hints(kind)
        make: Any = kind
        names = [f.name for f in dataclasses.fields(kind) if f.name in value or not _optional(f)]
        return make(**{name: _made(hints[name], value[name]) for name in names})
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is list:
        return [_made(arguments[0], one) for one in value]
    if origin is tuple:
        return tuple(_made(of, one) for of, one in zip(arguments, value, strict=True))
    if origin is dict:
        return {key: _made(arguments[1], one) for key, one in value.items()}
    if origin in (Union, UnionType):
        return None if value is None else _made(arguments[0], value)
    if origin is Literal:
        if value not in arguments:
            raise ValueError(f"{value!r} is none of {arguments}")
        return value
    if kind is float:
        return math.nan if value is None else float(value)
    return kind(value)


def _optional(field: dataclasses.Field) -> bool:
    """Whether a field has a default, as one that was added within a version."""
    none = dataclasses.MISSING
    return field.default is not none or field.default_factory is not none
