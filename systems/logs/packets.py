"""MAVLink packets in a telemetry log: framing, checksums, fields; not their interpretation.

The layout of a packet is that of the MAVLink serialisation guide (versions 1 and 2); checksum
seeds, message ids and field layouts are those of pymavlink's ArduPilot dialect.
"""

import re
from dataclasses import dataclass
from functools import cache

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect
from pymavlink.generator.mavcrc import x25crc

from .log_bytes import Progress, no_progress

_V2, _V1 = 0xFD, 0xFE
_MAGICS = (_V2, _V1)
_MAGIC = re.compile(rb"[\xfd\xfe]")
_SIGNATURE = 13
_COPY_S = 2.0
_CYCLE = 192
"""Packets after which numbers may recur: 256, less those that are lost."""
_CODES = {
    "b": "i1",
    "B": "u1",
    "h": "<i2",
    "H": "<u2",
    "i": "<i4",
    "I": "<u4",
    "q": "<i8",
    "Q": "<u8",
    "f": "<f4",
    "d": "<f8",
    "s": "S1",
}
_IDS = {cls.msgname: number for number, cls in dialect.mavlink_map.items()}

# payload start, payload length, message id, system, component, end
Packet = tuple[int, int, int, int, int, int]


@dataclass(frozen=True)
class Packets:
    """Offsets and headers of a log's packets in file order; `record` is that of the time stamp."""

    record: np.ndarray
    payload: np.ndarray
    length: np.ndarray
    message: np.ndarray
    system: np.ndarray
    component: np.ndarray
    end: np.ndarray
    skipped: int

    def stamps(self, data: bytes) -> np.ndarray:
        """The logger's clock at each packet (s)."""
        raw = np.frombuffer(data, np.uint8)
        words = raw[self.record[:, None] + np.arange(8)].view(">u8")[:, 0]
        return words.astype(np.float64) * 1e-6


def message_id(name: str) -> int:
    """Number of a message; -1 if the dialect has none of that name."""
    return _IDS.get(name, -1)


def message_name(number: int) -> str:
    """Name of a message, or `MSG_<number>`."""
    known = dialect.mavlink_map.get(number)
    return f"MSG_{number}" if known is None else str(known.msgname)


def scan(data: bytes, progress: Progress = no_progress) -> Packets:
    """Find the packets; after a damaged stretch the search continues at the next valid packet."""
    rows: list[tuple[int, int, int, int, int, int, int]] = []
    append = rows.append
    i, size, skipped = 0, len(data), 0
    report = step = max(size // 50, 1)
    while i + 20 <= size:
        # inlines `_packet`, to avoid a call for each of a million packets
        magic, length, after = data[i + 8], data[i + 9], 0
        if magic == _V2:
            after = i + 20 + length + (_SIGNATURE if data[i + 10] & 1 else 0)
        elif magic == _V1:
            after = i + 16 + length
        if 0 < after < size - 8 and data[after + 8] in _MAGICS:
            if magic == _V2:
                message = data[i + 15] | data[i + 16] << 8 | data[i + 17] << 16
                append((i, i + 18, length, message, data[i + 13], data[i + 14], after))
            else:
                append((i, i + 14, length, data[i + 13], data[i + 11], data[i + 12], after))
            i = after
        else:
            packet = _packet(data, i + 8, size)
            if packet is not None and (packet[5] + 8 >= size or _sound(data, i + 8, packet)):
                append((i, *packet))
                i = packet[5]
            else:
                found = _resync(data, i + 1, size)
                if found == size and packet is None and i + 400 > size:
                    break  # the last record, cut off
                skipped += found - i
                i = found
        if i > report:
            report += step
            progress(0.3 + 0.4 * i / size)
    columns = np.array(rows, np.int64).reshape(-1, 7).T
    return Packets(*columns, skipped=skipped)


def _packet(data: bytes, at: int, size: int) -> Packet | None:
    magic, length = data[at], data[at + 1]
    if magic == _V2 and at + 12 + length <= size:
        message = data[at + 7] | data[at + 8] << 8 | data[at + 9] << 16
        end = at + 12 + length + (_SIGNATURE if data[at + 2] & 1 else 0)
        return (at + 10, length, message, data[at + 5], data[at + 6], end) if end <= size else None
    if magic == _V1 and at + 8 + length <= size:
        return (at + 6, length, data[at + 5], data[at + 3], data[at + 4], at + 8 + length)
    return None


def _sound(data: bytes, at: int, packet: Packet) -> bool:
    """Check the CRC with the seed of the message."""
    known = dialect.mavlink_map.get(packet[2])
    if known is None:
        return False
    after = packet[0] + packet[1]
    crc = x25crc(data[at + 1 : after])
    crc.accumulate(bytes([known.crc_extra]))
    return crc.crc == data[after] | data[after + 1] << 8


def _resync(data: bytes, start: int, size: int) -> int:
    """Return the next record from `start` whose packet has a valid checksum, or the end."""
    for match in _MAGIC.finditer(data, start + 8):
        at = match.start()
        if at + 8 > size:
            break
        packet = _packet(data, at, size)
        if packet is not None and _sound(data, at, packet):
            return at - 8
    return size


def repeated(data: bytes, packets: Packets, which: np.ndarray) -> np.ndarray:
    """Which of the chosen packets came before, byte for byte with number and checksum.

    A vehicle numbers its packets from 0 to 255, so equal ones are copies if they are less than two
    seconds and clearly less than 256 packets apart.
    """
    stamps = packets.stamps(data)
    seen: dict[bytes, tuple[int, float]] = {}
    found = np.zeros(which.size, bool)
    for count, i in enumerate(np.flatnonzero(which).tolist()):
        packet, t = data[packets.record[i] + 8 : packets.end[i]], float(stamps[i])
        before, earlier = seen.get(packet, (-_CYCLE, t))
        found[i] = count - before < _CYCLE and abs(t - earlier) < _COPY_S
        seen[packet] = count, t
    return found


@cache
def layout(name: str) -> np.dtype:
    """NumPy layout of a message's full payload (MAVLink 2, with extensions)."""
    cls = dialect.mavlink_map[_IDS[name]]
    codes = re.findall(r"(\d*)([a-zA-Z])", cls.unpacker.format)
    fields = []
    for field, (count, code) in zip(cls.ordered_fieldnames, codes, strict=True):
        if code == "s":
            fields.append((field, f"S{count or 1}"))
        elif count:
            fields.append((field, _CODES[code], (int(count),)))
        else:
            fields.append((field, _CODES[code]))
    return np.dtype(fields)


def rows_of(
    data: bytes, packets: Packets, candidates: np.ndarray, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Decode packets of one message: their fields, and the indices of those with a valid checksum.

    MAVLink 2 truncates trailing zeros of a payload; they are restored.
    """
    dtype = layout(name)
    size = dtype.itemsize
    seed = bytes([dialect.mavlink_map[_IDS[name]].crc_extra])
    parts, good = [], []
    for i in candidates.tolist():
        start, length = int(packets.payload[i]), int(packets.length[i])
        after = start + length
        crc = x25crc(data[int(packets.record[i]) + 9 : after])
        crc.accumulate(seed)
        if crc.crc == data[after] | data[after + 1] << 8:
            parts.append(data[start:after][:size].ljust(size, b"\0"))
            good.append(i)
    return np.frombuffer(b"".join(parts), dtype), np.asarray(good, np.int64)
