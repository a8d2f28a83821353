"""The keys of a scenario, `docs/scenario.md`, from the dataclasses that are the schema."""

import dataclasses
import inspect
import re
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from .scenario import Scenario

_HEAD = """# Keys of a scenario

A scenario is a YAML file of these keys (`spinndrift run my_scenario.yaml`), or a shipped one with
some of them changed (`--scenario-text 'station: {disturbance_set: calm}'`). Where a value has one
of several forms, its tag names the form: `controller: !TrackReference {…}`. A finished run's
`scenario.yaml` has every key with its value. This page is written from the classes themselves
(`spinndrift.sims.scenarios.page.scenario_page()`); units are SI, frames as in
[glossary.md](glossary.md).
"""
_WORDS: dict[Any, str] = {
    bool: "true or false", int: "integer", float: "number", str: "text", Path: "path",
    Any: "anything", np.ndarray: "numbers",
}  # fmt: skip


def scenario_page() -> str:
    """The text of `docs/scenario.md`."""
    lines, seen, waiting = [_HEAD], set[type](), [Scenario]
    while waiting:
        cls = waiting.pop(0)
        if cls in seen:
            continue
        seen.add(cls)
        hints = get_type_hints(cls)
        own = [field for field in dataclasses.fields(cls) if field.init]
        meanings = _meanings(cls)
        lines += [f"## {cls.__name__}", "", _first_sentence(cls), ""]
        if own:
            lines += ["| key | value | if left out | meaning |", "|---|---|---|---|"]
        for field in own:
            kind = hints[field.name]
            cells = f"`{field.name}`", _value(kind), _default(field), meanings.get(field.name, "")
            lines.append(f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |")
            waiting += _classes(kind)
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def _first_sentence(cls: type) -> str:
    return " ".join((inspect.getdoc(cls) or "").split("\n\n")[0].split())


def _meanings(cls: type) -> dict[str, str]:
    """What a class and its bases say of their attributes."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        part = re.search(r"^Attributes:\n((?:    .*\n?|\n)+)", inspect.getdoc(base) or "", re.M)
        for names, text in re.findall(
            r"^    ([\w, ]+): ((?:.*)(?:\n {8,}.*)*)", part[1] if part else "", re.M
        ):
            found |= {name.strip(): " ".join(text.split()) for name in names.split(",")}
    return found


def _parts(kind: Any) -> tuple[Any, ...]:
    return get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)


def _classes(kind: Any) -> list[type]:
    """The dataclasses that a value may consist of."""
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        return [] if inspect.isabstract(kind) else [kind]
    return [cls for part in get_args(kind) for cls in _classes(part)]


def _value(kind: Any) -> str:
    """A type in words, dataclasses as links to their sections."""
    parts = [part for part in _parts(kind) if part is not NoneType]
    tagged = len(_classes(kind)) > 1 and len(parts) > 1
    words = [_word(part, tagged) for part in parts if not _abstract(part)]
    return " or ".join([*words, *(["null"] if NoneType in _parts(kind) else [])])


def _abstract(kind: Any) -> bool:
    return isinstance(kind, type) and inspect.isabstract(kind)


def _word(kind: Any, tagged: bool) -> str:
    origin, inner = get_origin(kind), get_args(kind)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        name = kind.__name__
        return f"[{'!' * tagged}{name}](#{name.lower()})"
    if isinstance(kind, type) and issubclass(kind, Enum):
        return " or ".join(f"`{each.value}`" for each in kind)
    if origin is Literal:
        return " or ".join(f"`{each}`" for each in inner)
    if origin is tuple and inner[-1] is not Ellipsis:
        return f"{len(inner)} {_several(inner[0])}"
    if origin in (tuple, list):
        return f"list of {_several(inner[0])}"
    if origin in (dict, Mapping):
        return f"mapping to {_value(inner[1])}"
    if origin is not None and not inner:
        return _WORDS.get(origin, str(kind))
    return _WORDS.get(kind, getattr(kind, "__name__", str(kind)))


def _several(kind: Any) -> str:
    return {float: "numbers", int: "integers", str: "names"}.get(kind) or _value(kind)


def _default(field: Any) -> str:
    if field.default is not dataclasses.MISSING:
        return "–" if field.default in (None, (), "") else f"`{_shown(field.default)}`"
    if field.default_factory is dataclasses.MISSING:
        return "required"
    made = field.default_factory()
    return "its defaults" if dataclasses.is_dataclass(made) else f"`{made}`" if made else "–"


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(_shown(each) for each in value) + "]"
    if dataclasses.is_dataclass(value):
        return "its defaults"
    return f"{value:g}" if isinstance(value, float) else str(value)
