"""Reads ArduPilot DataFlash (.BIN) into arrays: one pass over the headers, then NumPy decodes.

A file of 44 MB takes about a second; pymavlink's reader takes half a minute. Names, widths and
field types of the records come from the file's own FMT records (ArduPilot, AP_Logger).
"""

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from ...models.config.errors import UserError
from .clock import epochs, in_words
from .log_bytes import Progress, no_progress
from .table import Table, numbers

_HEAD = b"\xa3\x95"
_FMT_TYPE, _FMT_LENGTH = 128, 89
_TYPES: dict[str, tuple[str, float | None]] = {
    "a": ("(32,)<i2", None),
    "b": ("i1", None),
    "B": ("u1", None),
    "c": ("<i2", 0.01),
    "C": ("<u2", 0.01),
    "d": ("<f8", None),
    "e": ("<i4", 0.01),
    "E": ("<u4", 0.01),
    "f": ("<f4", None),
    "g": ("<f2", None),
    "h": ("<i2", None),
    "H": ("<u2", None),
    "i": ("<i4", None),
    "I": ("<u4", None),
    "L": ("<i4", 1e-7),
    "M": ("u1", None),
    "n": ("S4", None),
    "N": ("S16", None),
    "q": ("<i8", None),
    "Q": ("<u8", None),
    "Z": ("S64", None),
}

_RECURRING = 10
"""Records of one number without a layout, above which they are no accident of damaged bytes."""
_NO_NUMBER = "anNZ"
"""Types of an array and of text."""


@dataclass(frozen=True)
class BinLog:
    """Tables of a DataFlash log by message name, each with `t` (s since boot) and its fields.

    `boots` are the times at which the clock stepped back; `shift` of a table is what was added to
    its times, so that later parts follow earlier ones.
    """

    tables: Mapping[str, Table]
    notes: tuple[str, ...]
    boots: tuple[float, ...] = ()


@dataclass(frozen=True)
class _Format:
    name: str
    length: int
    codes: str
    columns: tuple[str, ...]

    def dtype(self) -> np.dtype | None:
        """Layout of a record, of the length in its FMT record; None if the format is invalid.

        It is invalid if a column has no name or a duplicate one, the time is not a number, or the
        columns are longer than a record.
        """
        columns = list(zip(self.columns, self.codes, strict=False))
        names = [column for column, _ in columns]
        if "" in names or len(set(names)) < len(names):
            return None
        if dict(columns).get("TimeUS", "Q") in _NO_NUMBER:
            return None
        types = [np.dtype(_TYPES[code][0]) for _, code in columns]
        offsets = np.cumsum([3, *(kind.itemsize for kind in types)]).tolist()
        if offsets[-1] > self.length:
            return None
        layout = {"names": names, "formats": types, "offsets": offsets[:-1]}
        return np.dtype({**layout, "itemsize": self.length})  # pyright: ignore[reportCallIssue, reportArgumentType]


def read_bin(data: bytes, wanted: Collection[str], progress: Progress = no_progress) -> BinLog:
    """Decode the wanted message types; damaged stretches are skipped and reported in the notes.

    Raises:
        UserError: the records that tell the layout of the others are lost.
    """
    formats, offsets, skipped, unknown = _scan(data, wanted, progress)
    if len(formats) == 1 and sum(unknown.values()) > 0:
        raise UserError(
            "the log's beginning is lost, with the FMT records that tell the layout of the others; "
            "download the log again, or give the telemetry log (.tlog) of the dive"
        )
    tables: dict[str, Table] = {}
    places: dict[str, np.ndarray] = {}
    unreadable = []
    for number, found in offsets.items():
        layout = formats[number]
        dtype = layout.dtype()
        if dtype is None or layout.name in tables:  # two kinds of one name: an FMT is damaged
            unreadable.append(layout.name)
            continue
        places[layout.name] = np.asarray(found)
        tables[layout.name] = _decode(data, places[layout.name], layout, dtype)
    boots, notes = _in_order(tables, places)
    if skipped:
        notes.append(f"{skipped} of {len(data)} bytes of the log are damaged and were skipped.")
    lost = {number: count for number, count in unknown.items() if count >= _RECURRING}
    if lost:
        notes.append(
            f"The layout of {len(lost)} kind{'s' * (len(lost) > 1)} of records "
            f"({sum(lost.values())} records) is lost with their FMT record; they were left out."
        )
    if unreadable:
        notes.append(f"Records of unknown layout were left out: {', '.join(sorted(unreadable))}.")
    return BinLog(tables, tuple(notes), boots)


def _in_order(
    tables: Mapping[str, Table], offsets: Mapping[str, np.ndarray]
) -> tuple[tuple[float, ...], list[str]]:
    """Add the column `shift` to every table; return the steps back of the clock, also in words."""
    known = {name: np.isfinite(table["t"]) for name, table in tables.items() if table["t"].size}
    if not known:
        return (), []
    at = np.concatenate([offsets[name][good] for name, good in known.items()])
    raw = np.concatenate([tables[name]["t"][good] for name, good in known.items()])
    order = np.argsort(at, kind="stable")
    at = at[order]
    shift, boots, steps = epochs(raw[order])
    for name, table in tables.items():
        i = np.clip(np.searchsorted(at, offsets[name], side="right") - 1, 0, None)
        table["shift"] = shift[i] if at.size else np.zeros(table["t"].size)
        table["t"] = table["t"] + table["shift"]
    return boots, in_words(boots, steps)


def _scan(
    data: bytes, wanted: Collection[str], progress: Progress
) -> tuple[dict[int, _Format], dict[int, list[int]], int, Counter[int]]:
    formats = {_FMT_TYPE: _Format("FMT", _FMT_LENGTH, "BBnNZ", ())}
    lengths = [0] * 256
    lengths[_FMT_TYPE] = _FMT_LENGTH
    keep: list[list[int] | None] = [None] * 256
    i, end, skipped = 0, len(data), 0
    unknown: Counter[int] = Counter()
    report = step = max(end // 50, 1)
    while i + 3 <= end:
        number = data[i + 2]
        length = lengths[number]
        if data[i] != 0xA3 or data[i + 1] != 0x95 or length == 0:
            if length == 0 and data[i : i + 2] == _HEAD:
                unknown[number] += 1
            found = data.find(_HEAD, i + 1)
            i, skipped = (found, skipped + found - i) if found >= 0 else (end, skipped + end - i)
            continue
        if i + length > end:  # the log's last record, cut off
            break
        if number == _FMT_TYPE:
            layout = _format(data[i : i + _FMT_LENGTH])
            known = data[i + 3]
            if layout is not None and known not in formats:
                formats[known], lengths[known] = layout, layout.length
                if layout.name in wanted and keep[known] is None:
                    keep[known] = []
        else:
            kept = keep[number]
            if kept is not None:
                kept.append(i)
        i += length
        if i > report:
            report += step
            progress(0.3 + 0.5 * i / end)
    return formats, {n: k for n, k in enumerate(keep) if k}, skipped, unknown


def _format(record: bytes) -> _Format | None:
    name, codes, columns = (
        part.split(b"\0")[0].decode("ascii", "replace")
        for part in (record[5:9], record[9:25], record[25:89])
    )
    length = record[4]
    if length < 3 or not name or any(code not in _TYPES for code in codes):
        return None
    return _Format(name, length, codes, tuple(columns.split(",")))


def _decode(data: bytes, offsets: np.ndarray, layout: _Format, dtype: np.dtype) -> Table:
    raw = np.frombuffer(data, np.uint8)
    rows = raw[offsets[:, None] + np.arange(layout.length)].view(dtype)[:, 0]
    table = Table(layout.name)
    for column, code in zip(layout.columns, layout.codes, strict=False):
        values = rows[column]
        if values.dtype.kind == "S":
            table[column] = values
        else:
            table[column] = numbers(values) * (_TYPES[code][1] or 1.0)
    table["t"] = table["TimeUS"] * 1e-6
    return table
