"""The layout for Foxglove that comes along: 3-D view, plots and log."""

import json
from importlib.resources import files
from pathlib import Path

from ...models.files.atomic import atomic_path

_NAME = "layout.json"


def layout_text() -> str:
    """The layout as Foxglove imports it."""
    return files(__package__ or "").joinpath(_NAME).read_text(encoding="utf-8")


def write_layout(path: Path) -> None:
    """Write the layout, atomically."""
    with atomic_path(path) as partial:
        partial.write_text(layout_text(), encoding="utf-8")


def is_layout(path: Path) -> bool:
    """Whether a file is this package's layout, of any version."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    made = found.get("globalVariables") if isinstance(found, dict) else None
    return isinstance(made, dict) and made.get("made_by") == "spinndrift"
