"""Vehicles' logs: DataFlash (.BIN) and MAVLink telemetry (.tlog), plain and packed."""

import gzip
import lzma
import struct
from functools import cache
from pathlib import Path

import numpy as np
from log_writers import dataflash, dive
from pymavlink.dialects.v20 import ardupilotmega as dialect
from pymavlink.generator.mavcrc import x25crc

from spinndrift.models.recordings.summary import summarize
from spinndrift.systems.logs.load import LogOptions, load_data

from .harness import Kind
from .mutate import FLOATS, Rng, bytes_spoiled, packed_special, part, pick

_DURATION = 0.7
_PARAMETERS = (
    "SERVO1_FUNCTION", "SERVO16_FUNCTION", "SERVO99_FUNCTION", "SERVO0_FUNCTION",
    "MOT_1_DIRECTION", "MOT_0_DIRECTION", "MOT__DIRECTION", "MOT_99_DIRECTION", "INS_GYRO_FILTER",
    "INS_ACCEL_FILTER", "BARO_SPEC_GRAV", "BARO1_GND_PRESS", "BARO2_GND_PRESS", "EK3_SRC1_POSZ",
    "EK3_ACC_P_NSE", "EK3_ALT_M_NSE", "SERVO_FUNCTION", "",
)  # fmt: skip


def _read(path: Path) -> None:
    options = LogOptions(minimum=0.5, water_density=1025.0)
    summarize(load_data(path, rate=50.0, options=options))


def _written(rng: Rng, data: bytes, path: Path) -> Path:
    """The log, now and then packed and the packed bytes spoiled, or spoiled in any case."""
    chance = rng.random()
    if chance < 0.03:
        packed = pick(rng, (gzip.compress, lzma.compress))(data)
        data = bytes_spoiled(rng, packed) if chance < 0.02 else packed
    elif chance < 0.4:
        for _ in range(int(rng.integers(1, 4))):
            data = bytes_spoiled(rng, data)
    path.write_bytes(data)
    return path


# DataFlash

_CODES = {
    "a": "64s", "M": "B", "n": "4s", "N": "16s", "Z": "64s", "c": "h", "C": "H", "e": "i",
    "E": "I", "L": "i", "g": "e",
}  # fmt: skip


@cache
def _bins() -> tuple[tuple[bytes, ...], ...]:
    """Records of sound logs."""
    logs = (
        dataflash(duration=_DURATION),
        dataflash(duration=_DURATION, aided=False, disarm=100.6),
    )
    return tuple(tuple(log.parts) for log in logs)


def _formats(records: tuple[bytes, ...]) -> dict[int, str]:
    """`struct` codes of each type of record, as its FMT record has them."""
    found = {}
    for record in records:
        if record[2] == 128:
            codes = record[9:25].rstrip(b"\0").decode()
            found[record[3]] = "".join(_CODES.get(c, c) for c in codes)
    return found


def _spoil_bin(rng: Rng, folder: Path) -> Path:
    base = pick(rng, _bins())
    records = list(base)
    formats = _formats(base)
    for _ in range(int(rng.integers(1, 4))):
        _spoil_records(rng, records, formats)
    return _written(rng, b"".join(records), folder / "fuzz.BIN")


def _spoil_records(rng: Rng, records: list[bytes], formats: dict[int, str]) -> None:
    if not records:
        return
    chosen = pick(rng, records)
    alike = [i for i, r in enumerate(records) if r[2:3] == chosen[2:3]]
    match int(rng.integers(8)):
        case 0 | 1:
            _spoil_format(rng, records)
        case 2:  # a number in one record, some or all of its type
            for i in alike[part(rng, len(alike))]:
                records[i] = _with_special(rng, records[i], formats)
        case 3:
            for i in reversed(alike[part(rng, len(alike))]):
                del records[i]
        case 4:
            block = part(rng, len(records))
            records[block] = records[block] * 2
        case 5:
            block = part(rng, len(records))
            records[block] = records[block][::-1]
        case 6:  # a parameter that the reader looks at
            name = pick(rng, _PARAMETERS).encode()
            value = packed_special(rng, "<f")
            stamp = struct.pack("<Q", 100_100_000)
            records.append(b"\xa3\x95\x81" + stamp + name.ljust(16, b"\0") + value)
        case _:
            records.insert(int(rng.integers(len(records))), rng.bytes(int(rng.integers(1, 40))))


def _spoil_format(rng: Rng, records: list[bytes]) -> None:
    """One FMT record: length, name, codes or names of columns."""
    places = [i for i, r in enumerate(records) if len(r) == 89 and r[2] == 128]
    if not places:
        return
    i = pick(rng, places)
    number, length = records[i][3], records[i][4]
    name, codes, columns = (records[i][a:b].rstrip(b"\0") for a, b in ((5, 9), (9, 25), (25, 89)))
    names = columns.split(b",")
    k = int(rng.integers(len(names)))
    match int(rng.integers(9)):
        case 0:
            names[k] = pick(rng, names)
        case 1:
            names[k] = pick(
                rng, (b"", b"t", b"_head", b"_rest", b"TimeUS", b"SampleUS", b"\xff", b" ")
            )
        case 2:
            del names[k]
        case 3:
            names.append(pick(rng, (b"X", b"", b"I", b"C")))
        case 4:
            codes = codes[:k] + bytes([pick(rng, b"abBcCdeEfghHiILMnNqQZ?\0\xff")]) + codes[k + 1 :]
        case 5:
            length = pick(rng, (0, 1, 3, 4, length - 1, (length + 1) % 256, 255))
        case 6:
            number = pick(rng, [records[j][3] for j in places])
        case 7:
            name = pick(rng, [records[j][5:9] for j in places] + [b"\xff\xfe", b"", b"PARM"])
        case _:
            codes = pick(rng, (b"", codes[:-1], codes + b"f", codes[::-1]))
    records[i] = (
        b"\xa3\x95\x80"
        + bytes([number, length])
        + name[:4].ljust(4, b"\0")
        + codes[:16].ljust(16, b"\0")
        + b",".join(names)[:64].ljust(64, b"\0")
    )


def _with_special(rng: Rng, record: bytes, formats: dict[int, str]) -> bytes:
    codes = formats.get(record[2]) if len(record) > 2 else None
    if codes is None:
        return bytes_spoiled(rng, record)
    singles = _split(codes)
    k = int(rng.integers(len(singles)))
    at = 3 + struct.calcsize("<" + "".join(singles[:k]))
    if singles[k].endswith("s"):
        new = rng.bytes(int(singles[k][:-1]))
    elif singles[k] == "e":
        new = np.float16(pick(rng, (np.nan, np.inf, -1.0))).tobytes()
    else:
        new = packed_special(rng, "<" + singles[k])
    return record[:at] + new + record[at + len(new) :]


def _split(codes: str) -> list[str]:
    found, count = [], ""
    for c in codes:
        if c.isdigit():
            count += c
        else:
            found.append(count + c)
            count = ""
    return found


# telemetry


@cache
def _tlogs() -> tuple[tuple[tuple[float, bytes], ...], ...]:
    """Records (time, packet) of sound logs."""
    logs = (
        dive(duration=2.2, rates=(20.0, 10.0, 20.0)),
        dive(duration=2.2, rates=(20.0, 10.0, 20.0), version=1, horizontal=False),
    )
    return tuple(tuple(sorted(log.records, key=lambda r: r[0])) for log in logs)


def _spoil_tlog(rng: Rng, folder: Path) -> Path:
    records = [(struct.pack(">Q", round(t * 1e6)), packet) for t, packet in pick(rng, _tlogs())]
    for _ in range(int(rng.integers(1, 4))):
        _spoil_packets(rng, records)
    return _written(rng, b"".join(a + b for a, b in records), folder / "fuzz.tlog")


def _spoil_packets(rng: Rng, records: list[tuple[bytes, bytes]]) -> None:
    if not records:
        return
    kind = _message(pick(rng, records)[1])
    alike = [i for i, (_, packet) in enumerate(records) if _message(packet) == kind]
    match int(rng.integers(8)):
        case 0 | 1 | 2:  # numbers, with a checksum that is right
            cls = dialect.mavlink_map.get(kind)
            if cls is not None:
                field = int(rng.integers(len(cls.ordered_fieldnames)))
                for i in alike[part(rng, len(alike))]:
                    records[i] = records[i][0], _resealed(rng, records[i][1], cls, field)
        case 3:
            for i in reversed(alike[part(rng, len(alike))]):
                del records[i]
        case 4:
            block = part(rng, len(records))
            records[block] = records[block] * 2
        case 5:
            block = part(rng, len(records))
            records[block] = records[block][::-1]
        case 6:
            for i in range(len(records))[part(rng, len(records))]:
                records[i] = packed_special(rng, ">Q"), records[i][1]
        case _:
            t, _ = pick(rng, records)
            name = pick(rng, _PARAMETERS).encode()[:16]
            said = dialect.MAVLink_param_value_message(name, pick(rng, FLOATS[:7]), 9, 1000, 1)
            records.append((t, said.pack(dialect.MAVLink(None, 1, 1))))


def _message(packet: bytes) -> int:
    if packet[0] == 0xFD:
        return packet[7] | packet[8] << 8 | packet[9] << 16
    return packet[5]


def _resealed(rng: Rng, packet: bytes, cls: type, field: int) -> bytes:
    """A packet with one field that readers seldom meet, and the checksum that goes with it."""
    head = 10 if packet[0] == 0xFD else 6
    codes = _split(cls.unpacker.format.lstrip("<"))
    size = struct.calcsize(cls.unpacker.format)
    payload = packet[head : head + packet[1]].ljust(size, b"\0")
    at = struct.calcsize("<" + "".join(codes[:field]))
    code = codes[field]
    count = int(code[:-1] or 1)
    if code.endswith("s"):
        new = rng.bytes(count)
    else:
        code = {"b": "b", "B": "B", "c": "B"}.get(code[-1], code[-1])
        new = b"".join(packed_special(rng, "<" + code) for _ in range(count))
    if packet[0] == 0xFE and at + len(new) > packet[1]:
        return packet
    payload = payload[:at] + new + payload[at + len(new) :]
    if packet[0] == 0xFE:
        payload = payload[: packet[1]]
    start = packet[:1] + bytes([len(payload)]) + packet[2:head]
    crc = x25crc(start[1:] + payload)
    crc.accumulate(bytes([cls.crc_extra]))
    return start + payload + struct.pack("<H", crc.crc)


BIN = Kind("bin", _spoil_bin, _read)
TLOG = Kind("tlog", _spoil_tlog, _read)
