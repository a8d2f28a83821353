"""A log file's bytes, decompressed as far as the file is intact, and the kind of the log."""

import gzip
import lzma
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ...models.config.errors import UserError

Progress = Callable[[float], None]
Kind = Literal["tlog", "bin"]

_XZ = b"\xfd7zXZ\x00"
_GZIP = b"\x1f\x8b"
_DATAFLASH = b"\xa3\x95"
_CHUNK = 1 << 20
_NEEDED = (
    "give a MAVLink telemetry log (.tlog) or an ArduPilot DataFlash log (.BIN), or .xz/.gz of one, "
    "or a ROS bag (.bag, .db3, .mcap, or its folder)"
)


def no_progress(fraction: float) -> None:
    """The progress callback that does nothing."""


@dataclass(frozen=True)
class LogBytes:
    """Decompressed content, its kind, and notes on damage of the file (empty if intact)."""

    data: bytes
    kind: Kind
    notes: tuple[str, ...] = ()


def read_log_bytes(path: Path, progress: Progress = no_progress) -> LogBytes:
    """Read a log, plain or .xz/.gz, and determine its kind from its content, not its name.

    Raises:
        UserError: if the file is missing, empty, broken from its first byte, or no such log.
    """
    if path.is_dir():
        raise UserError(f"{path}: is a folder, not a log; {_NEEDED}")
    if not path.exists():
        raise UserError(f"{path}: no such file; {_NEEDED}")
    raw = path.read_bytes()
    if not raw:
        raise UserError(f"{path}: the file is empty; copy it from the vehicle again")
    data, whole = raw, True
    if raw.startswith(_XZ):
        data, whole = _unpack(raw, _unxz, path, progress)
    elif raw.startswith(_GZIP):
        data, whole = _unpack(raw, _ungzip, path, progress)
    notes = () if whole else ("The compressed file is cut off; what could be unpacked was read.",)
    return LogBytes(data, _kind(data, path), notes)


def _kind(data: bytes, path: Path) -> Kind:
    if data.startswith(_DATAFLASH):
        return "bin"
    if len(data) > 8 and data[8] in (0xFD, 0xFE):
        return "tlog"
    head = data[:4096]
    if head.startswith(b"FMT,") or b"\nFMT," in head:
        raise UserError(f"{path}: a text log; give the binary .BIN it was made from")
    if _DATAFLASH in head:
        return "bin"
    if path.suffix.lower() == ".tlog" and any(magic in head for magic in (b"\xfd", b"\xfe")):
        return "tlog"
    raise UserError(f"{path}: neither MAVLink nor DataFlash by its content; {_NEEDED}")


def _unpack(
    raw: bytes, step: "Callable[[bytes], tuple[bytes, bytes, bool]]", path: Path, progress: Progress
) -> tuple[bytes, bool]:
    parts: list[bytes] = []
    rest, whole = raw, True
    while rest and whole:
        part, rest, whole = step(rest)
        parts.append(part)
        progress(0.3 * (1 - len(rest) / len(raw)))
    data = b"".join(parts)
    if not data:
        raise UserError(f"{path}: the compressed file is broken from its start; copy it again")
    return data, whole


def _unxz(raw: bytes) -> tuple[bytes, bytes, bool]:
    unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ)
    parts = []
    try:
        for i in range(0, len(raw), _CHUNK):
            parts.append(unpacker.decompress(raw[i : i + _CHUNK]))
            if unpacker.eof:
                used = min(i + _CHUNK, len(raw)) - len(unpacker.unused_data)
                return b"".join(parts), raw[used:].lstrip(b"\0"), True
    except lzma.LZMAError:
        pass
    return b"".join(parts), b"", False


def _ungzip(raw: bytes) -> tuple[bytes, bytes, bool]:
    unpacker = zlib.decompressobj(wbits=31)
    parts = []
    try:
        for i in range(0, len(raw), _CHUNK):
            parts.append(unpacker.decompress(raw[i : i + _CHUNK]))
            if unpacker.eof:
                used = min(i + _CHUNK, len(raw)) - len(unpacker.unused_data)
                return b"".join(parts), raw[used:].lstrip(b"\0"), True
    except (zlib.error, gzip.BadGzipFile):
        pass
    return b"".join(parts), b"", False
