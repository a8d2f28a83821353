"""JSON of dataclasses, and its schema, from the dataclasses themselves."""

import dataclasses
import inspect
import math
import re
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints


def plain(value: Any) -> Any:
    """Plain values for JSON; numbers that are not finite become None."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def schema_of(cls: type) -> dict[str, Any]:
    """JSON Schema (2020-12) of a dataclass."""
    definitions: dict[str, Any] = {}
    body = _schema(cls, definitions)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **body, "$defs": definitions}


def described(cls: type) -> dict[str, str]:
    """Each field's description, from the attributes in a dataclass' docstring."""
    text = inspect.cleandoc(cls.__doc__ or "").partition("Attributes:\n")[2]
    entries = re.findall(r"^    (\w+): (.*(?:\n        .*)*)", text, re.MULTILINE)
    return {name: " ".join(words.split()) for name, words in entries}


def _schema(kind: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        name = kind.__name__
        if name not in definitions:
            definitions[name] = {}
            hints, descriptions = get_type_hints(kind), described(kind)
            definitions[name] = {
                "type": "object",
                "description": (kind.__doc__ or "").split("\n")[0],
                "properties": {
                    k: {**_schema(v, definitions), "description": descriptions.get(k, "")}
                    for k, v in hints.items()
                },
                "required": [f.name for f in dataclasses.fields(kind)],
                "additionalProperties": False,
            }
        return {"$ref": f"#/$defs/{name}"}
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Literal:
        return {"enum": list(arguments)}
    if origin is list:
        return {"type": "array", "items": _schema(arguments[0], definitions)}
    if origin is tuple:
        size = len(arguments)
        items = _schema(arguments[0], definitions)
        return {"type": "array", "items": items, "minItems": size, "maxItems": size}
    if origin is dict:
        return {"type": "object", "additionalProperties": _schema(arguments[1], definitions)}
    if origin in (Union, UnionType):
        return {"anyOf": [_schema(a, definitions) for a in arguments]}
    plain_types = {
        float: ["number", "null"],
        int: "integer",
        str: "string",
        bool: "boolean",
        type(None): "null",
    }
    return {"type": plain_types[kind]}
