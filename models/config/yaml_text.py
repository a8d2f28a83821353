"""YAML text to plain Python values and back, with the core schema of YAML 1.2 and `!Tags` kept.

PyYAML follows YAML 1.1, where `no` is false, `1e-3` is text, `1:30` is 90 and `010` is 8. Here
(YAML 1.2.2, 2021, ch. 10.3.2) they are text, 0.001, text and 10. Duplicate keys are errors.
"""

import math
import re
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

import yaml

from .errors import UserError

_BOOL = r"true|True|TRUE|false|False|FALSE"
_NULL = r"~|null|Null|NULL|"
_INT = r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+"
_FLOAT = (
    r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?(?:\.inf|\.Inf|\.INF)|\.nan|\.NaN|\.NAN"
)
_CORE = (
    ("bool", _BOOL, "tTfF"),
    ("null", _NULL, ["~", "n", "N", ""]),
    ("int", _INT, "-+0123456789"),
    ("float", _FLOAT, "-+0123456789."),
)


_DIGITS = 4000
"""Largest number of digits: more than any double needs, within Python's own limit."""


@dataclass(frozen=True)
class Tagged:
    """A value with a local tag: `!Kind {…}`; a tag without a value has the value {}."""

    tag: str
    value: Any


class _Loader(yaml.SafeLoader):
    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        lines: dict[Any, int] = {}
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            line = key_node.start_mark.line + 1
            if not isinstance(key, str | int | float | None):
                raise yaml.constructor.ConstructorError(
                    None, None, "a key must be a plain word or number", key_node.start_mark
                )
            if key in lines:
                raise yaml.constructor.ConstructorError(
                    None,
                    None,
                    f"key `{key}` stands here and in line {lines[key]}; keep one of them",
                    key_node.start_mark,
                )
            lines[key] = line
        return super().construct_mapping(node, deep=deep)

    def construct_scalar(self, node: Any) -> Any:
        """The text of a node; one with a null character is no name, and no path can hold it."""
        found = super().construct_scalar(node)
        if isinstance(found, str) and "\0" in found:
            raise yaml.constructor.ConstructorError(
                None, None, "a text holds a null character; remove it", node.start_mark
            )
        return found

    def _int(self, node: yaml.ScalarNode) -> int:
        text = self.construct_scalar(node)
        if len(text) > _DIGITS:
            raise yaml.constructor.ConstructorError(
                None, None, f"a number of {len(text)} digits is too long", node.start_mark
            )
        return int(text, 0) if text[:2] in ("0o", "0x") else int(text)

    def _tagged(self, suffix: str, node: yaml.Node) -> Tagged:
        if isinstance(node, yaml.MappingNode):
            return Tagged(suffix, self.construct_mapping(node, deep=True))
        if isinstance(node, yaml.SequenceNode):
            return Tagged(suffix, self.construct_sequence(node, deep=True))
        assert isinstance(node, yaml.ScalarNode)
        return Tagged(suffix, self.construct_scalar(node) or {})


class _Dumper(yaml.SafeDumper):
    """Quotes a string that either YAML 1.1 or 1.2 would read as another type."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def _tagged(self, data: Tagged) -> yaml.Node:
        node = self.represent_data(data.value)
        node.tag = f"!{data.tag}"
        return node

    def _float(self, value: float) -> yaml.Node:
        if not math.isfinite(value):
            raise ValueError(f"{value} is not finite and can't be written; give a finite number")
        return self.represent_float(value)


_Loader.yaml_implicit_resolvers = {}  # drop those of YAML 1.1
for _name, _pattern, _first in _CORE:
    for _cls in (_Loader, _Dumper):
        _cls.add_implicit_resolver(
            f"tag:yaml.org,2002:{_name}", re.compile(rf"^(?:{_pattern})$"), list(_first)
        )
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader._int)
_Loader.add_multi_constructor("!", _Loader._tagged)
_Dumper.add_representer(Tagged, _Dumper._tagged)
_Dumper.add_representer(float, _Dumper._float)


def parse(text: str, source: str) -> tuple[Any, yaml.Node | None]:
    """Plain value of one YAML document and its node tree (for line numbers).

    Raises:
        UserError: the text is not YAML, has duplicate keys or more than one document; the message
            names `source` and the line.
    """
    try:
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
            return (None if node is None else loader.construct_document(node)), node
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f":{error.problem_mark.line + 1}"
        context = "" if error.context is None else f" {error.context}"
        raise UserError(f"{source}{line}: {error.problem}{context}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise UserError(f"{source}: this is no YAML text: {error}") from error


def line_of(node: yaml.Node | None, path: tuple[str | int, ...]) -> int | None:
    """Line (from 1) of the deepest part of `path` that is in the text."""
    if node is None:
        return None
    line = node.start_mark.line + 1
    for part in path:
        found = None
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                if key.value == str(part):
                    found, line = value, key.start_mark.line + 1
        elif (
            isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value)
        ):
            found = node.value[part]
            line = found.start_mark.line + 1
        if found is None:
            break
        node = found
    return line


def emit(value: Any) -> str:
    """YAML text that `parse` reads back as the same value; order kept, short parts on one line.

    Raises:
        ValueError: a float is not finite.
    """
    return yaml.dump(
        value,
        Dumper=_Dumper,
        sort_keys=False,
        default_flow_style=None,
        allow_unicode=True,
        width=100,
    )
