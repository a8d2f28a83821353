"""A table of numbers from a CSV file, with errors that name the line and the column."""

import codecs
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
    text = _text(path)
    rows = [
        (number, line)
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not rows:
        raise UserError(f"{path}: the file is empty; the first line must name the columns")
    header = rows[0][1]
    separator = next((s for s in ("\t", ";") if s in header), ",")
    names = tuple(name.strip().strip('"') for name in header.split(separator))
    _check_header(path, rows[0][0], names, separator)
    if len(rows) == 1:
        raise UserError(f"{path}: there is a header but no data line")
    cells = []
    for number, line in rows[1:]:
        row = line.split(separator)
        if len(row) != len(names):
            last = number == rows[-1][0]
            remedy = "the file seems cut off there; remove this line" if last else "mend this line"
            raise UserError(
                f"{path}:{number}: {len(row)} fields where {len(names)} belong; {remedy}"
            )
        cells.append(row)
    lines = np.array([number for number, _ in rows[1:]])
    return Table(path, names, _numbers(path, names, cells, lines, separator), lines)


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


def _check_header(path: Path, line: int, names: tuple[str, ...], separator: str) -> None:
    if all(_is_number(name, separator) for name in names):
        raise UserError(
            f"{path}:{line}: no header; the first line must name the columns: t,x,y,z,…"
        )
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise UserError(f"{path}:{line}: column `{sorted(twice)[0]}` appears twice; rename one")


def _is_number(cell: str, separator: str) -> bool:
    try:
        float(cell.replace(",", ".") if separator != "," else cell)
    except ValueError:
        return False
    return True


def _numbers(
    path: Path,
    names: tuple[str, ...],
    cells: list[list[str]],
    lines: np.ndarray,
    separator: str,
) -> np.ndarray:
    def convert(cell: str) -> float:
        cell = cell.strip().strip('"')
        if separator != ",":
            cell = cell.replace(",", ".")
        return float(cell) if cell else np.nan

    values = np.empty((len(cells), len(names)))
    for i, row in enumerate(cells):
        try:
            values[i] = [convert(cell) for cell in row]
        except ValueError:
            column = next(c for c, cell in enumerate(row) if not _parses(convert, cell))
            raise UserError(
                f"{path}:{lines[i]}: column `{names[column]}`: {row[column].strip()!r} is no number"
            ) from None
    return values


def _parses(convert, cell: str) -> bool:
    try:
        convert(cell)
    except ValueError:
        return False
    return True
