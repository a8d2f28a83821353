"""A table of numbers from a CSV file, with errors that name the line and the column."""

import codecs
import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ..config.errors import UserError

_BOMS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


@dataclass(frozen=True)
class Table:
    """Columns by name; empty cells are NaN; `lines` are line numbers in the file, from 1."""

    path: Path
    names: tuple[str, ...]
    values: Float[np.ndarray, "n c"]
    lines: Int[np.ndarray, " n"]

    def __getitem__(self, names: Sequence[str]) -> Float[np.ndarray, "k n"]:
        """Return the named columns, component first."""
        return self.values[:, [self.names.index(name) for name in names]].T

    def at(self, row: int) -> str:
        """Location of a row: `file:line`."""
        return f"{self.path}:{self.lines[row]}"


def read_table(path: Path) -> Table:
    """Read a CSV file with one header line; comma, semicolon or tab; `#` starts a comment line.

    With semicolons or tabs a decimal comma is accepted.

    Raises:
        UserError: naming file, line, column and remedy.
    """
    numbered = [
        (number, line)
        for number, line in enumerate(_text(path).splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not numbered:
        raise UserError(f"{path}: the file is empty; the first line must name the columns")
    (first, header), *rest = numbered
    separator = next((s for s in ("\t", ";") if s in header), ",")
    names = tuple(_cells(f"{path}:{first}", header, separator))
    _check_names(f"{path}:{first}", names, separator)
    if not rest:
        raise UserError(f"{path}: there is a header but no data line")
    rows = []
    for number, line in rest:
        at = f"{path}:{number}"
        cells = _cells(at, line, separator)
        if len(cells) != len(names):
            last = number == rest[-1][0]
            remedy = "the file seems cut off there; remove this line" if last else "mend this line"
            raise UserError(f"{at}: {len(cells)} fields where {len(names)} belong; {remedy}")
        values = [_number(cell, separator) for cell in cells]
        if None in values:
            column = values.index(None)
            raise UserError(f"{at}: column `{names[column]}`: {cells[column]!r} is no number")
        rows.append(values)
    return Table(path, names, np.array(rows, float), np.array([number for number, _ in rest]))


def _text(path: Path) -> str:
    try:
        raw = path.read_bytes()
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such file; check the name") from error
    except OSError as error:
        raise UserError(f"{path}: can't be read ({error.strerror})") from error
    encoding = next((name for bom, name in _BOMS if raw.startswith(bom)), "utf-8")
    try:
        return raw.decode(encoding)
    except UnicodeDecodeError as error:
        raise UserError(
            f"{path}: is no text file (byte {error.start}); save it as UTF-8"
        ) from error


def _cells(at: str, line: str, separator: str) -> list[str]:
    """Cells of one line; by itself, so that a quote left open ends with it."""
    try:
        return [c.strip().strip('"') for c in next(csv.reader([line], delimiter=separator))]
    except csv.Error as error:
        raise UserError(f"{at}: {error}; mend this line") from error


def _check_names(at: str, names: tuple[str, ...], separator: str) -> None:
    if all(name and _number(name, separator) is not None for name in names):
        raise UserError(f"{at}: no header; the first line must name the columns: t,x,y,z,…")
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise UserError(f"{at}: column `{sorted(twice)[0]}` appears twice; rename one")


def _number(cell: str, separator: str) -> float | None:
    """Value of a cell, NaN of an empty one; None if it is no number."""
    try:
        return float(cell.replace(",", ".") if separator != "," else cell) if cell else np.nan
    except ValueError:
        return None
