"""Vehicles that files name: a preset, or a vehicle's file at a path."""

import os
from pathlib import Path

from ..config.errors import UserError
from ..files.places import found_in
from .vehicle import Vehicle, load_vehicle


def absolute(named: str) -> str:
    """A preset's name unchanged, a file's path from the root: it holds in any folder."""
    return os.path.abspath(named) if Path(named).suffix else named


def named_in(named: str, folder: str | os.PathLike[str]) -> str:
    """A vehicle as a file in `folder` names it: a preset, or where its file is (`found_in`)."""
    return found_in(named, folder) if Path(named).suffix else named


def load_named(named: str, source: str, option: str = "--vehicle") -> Vehicle:
    """The vehicle that `source` names; `option` of a command names another.

    Raises:
        UserError: it can't be read; the sentence names `source` and the remedy.
    """
    try:
        return load_vehicle(named)
    except UserError as error:
        raise UserError(f"{source}: {error} ({option} names another)") from error
