"""Files that a scenario names: found from its folder."""

import os
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from ...models.files.places import found_in
from ...models.vehicles.places import named_in
from ...systems.own import OwnSystem


def located(value: Any, folder: str | os.PathLike[str]) -> Any:
    """A configuration with the files that it names: paths, vehicles and code, at any depth.

    Relative paths start in `folder`, or else in the working folder (`models.files.places`); of
    `vehicle` the same holds for what is no preset, of `system` for a file with code.
    """
    if isinstance(value, Path):
        return Path(found_in(value, folder))
    if isinstance(value, Mapping):
        return {name: located(part, folder) for name, part in value.items()}
    if isinstance(value, tuple | list):
        return type(value)(located(part, folder) for part in value)
    if not is_dataclass(value) or isinstance(value, type):
        return value
    changed = {}
    for each in fields(value):
        if not each.init:
            continue
        part = getattr(value, each.name)
        moved = located(part, folder)
        if each.name == "vehicle" and isinstance(part, str):
            moved = named_in(part, folder)
        elif each.name == "system" and isinstance(value, OwnSystem):
            where, colon, name = value.system.rpartition(":")
            moved = f"{found_in(where, folder)}:{name}" if colon and where.endswith(".py") else part
        if moved is not part and moved != part:
            changed[each.name] = moved
    return replace(value, **changed) if changed else value
