"""Nortek Nucleus: binary packets of the TCP stream (port 9000) or a serial line.

Source: Nortek, "Nucleus Integrator's Guide", and the layout in its public driver. A packet has a
header of ten bytes: 0xA5, its length, id, family 0x20, length of the data, checksum of the data,
checksum of the header, all little endian. A checksum is 0xB58C plus the sum of the 16-bit words,
modulo 2¹⁶; an odd last byte is the upper half of a word.
"""

import struct
import time
from collections.abc import Iterable

import numpy as np

from ..mavlink.transport import Transport
from .reading import DvlReading

PORT = 9000
PASSWORD = "nortek"
"""That of a new instrument."""
_START = b"START\r\n"
_PROMPT, _GREETING = b"password", b"Welcome"
_PATIENCE, _WAIT = 2.0, 0.1  # s for the instrument's first words

_SYNC, _FAMILY, _BOTTOM_TRACK = 0xA5, 0x20, 0xB4
_HEADER = struct.Struct("<BBBBHHH")
_COMMON = struct.Struct("<BBBBIII")  # version, offset, flags, -, time (s), µs, status
_BEAMS = struct.Struct("<3f")
_DISTANCE, _VELOCITY, _MERIT, _DELAY, _SIZE = 48, 96, 108, 124, 128
_XYZ_VALID, _MERIT_VALID = 0b111 << 9, 0b111 << 12
_LONGEST = 7000  # bytes of a packet


def start(transport: Transport, password: str) -> None:
    """Log in where the instrument asks for its password, and start the measurement.

    On TCP the first line that it gets is the password. A serial line asks for none.

    Raises:
        Lost: the connection has ended.
    """
    words, end = b"", time.monotonic() + _PATIENCE
    while time.monotonic() < end and _PROMPT not in words and _GREETING not in words:
        words += transport.read(_WAIT)
    if _PROMPT in words:
        transport.write(password.encode() + b"\r\n")
        end = time.monotonic() + _PATIENCE
        while time.monotonic() < end and not transport.read(_WAIT):
            pass
    transport.write(_START)


class Nucleus:
    """Decodes the stream of one connection; packets other than bottom track are skipped."""

    def __init__(self):
        self.damaged = 0
        self._buffer = bytearray()

    def readings(self, data: bytes) -> Iterable[DvlReading]:
        """As `reading.Decoder`."""
        self._buffer += data
        while True:
            start = self._buffer.find(_SYNC)
            if start < 0:
                self._buffer.clear()  # answers to commands are text
                return
            del self._buffer[:start]
            if len(self._buffer) < _HEADER.size:
                return
            _, length, number, family, size, check, own = _HEADER.unpack_from(self._buffer)
            fits = length >= _HEADER.size and family == _FAMILY and length + size <= _LONGEST
            if not fits or checksum(self._buffer[: _HEADER.size - 2]) != own:
                del self._buffer[:1]  # no header: the byte was text or data
                continue
            if len(self._buffer) < length + size:
                return
            content = bytes(self._buffer[length : length + size])
            del self._buffer[: length + size]
            if checksum(content) != check:
                self.damaged += 1
            elif number == _BOTTOM_TRACK and size >= _SIZE:
                yield _reading(content)


def checksum(data: bytes | bytearray) -> int:
    """Nortek's checksum of some bytes."""
    even = len(data) // 2 * 2
    total = 0xB58C + int(np.frombuffer(bytes(data[:even]), "<u2").sum(dtype=np.int64))
    return (total + (data[-1] << 8 if len(data) % 2 else 0)) & 0xFFFF


def _reading(data: bytes) -> DvlReading:
    """The reading of a bottom-track packet's data."""
    _, _, _, _, seconds, micro, status = _COMMON.unpack_from(data)
    velocity = np.array(_BEAMS.unpack_from(data, _VELOCITY), float)
    merit = np.array(_BEAMS.unpack_from(data, _MERIT), float)
    distance = np.array(_BEAMS.unpack_from(data, _DISTANCE), float)
    (delay,) = struct.unpack_from("<f", data, _DELAY)
    valid = status & _XYZ_VALID == _XYZ_VALID and bool(np.isfinite(velocity).all())
    ranged = [d for i, d in enumerate(distance) if status >> (3 + i) & 1 and np.isfinite(d)]
    claimed = status & _MERIT_VALID == _MERIT_VALID and bool(np.isfinite(merit).all())
    return DvlReading(
        velocity if valid else np.zeros(3),
        valid,
        float(np.mean(ranged)) if ranged else float("nan"),
        float(np.sqrt(np.mean(merit**2))) if claimed else float("nan"),
        seconds + micro * 1e-6 + (delay if np.isfinite(delay) else 0.0),
        None,
    )
