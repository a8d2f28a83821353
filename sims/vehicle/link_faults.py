"""Faults of a link: loss, delay, jitter, reordering and damage of packets, from a seed.

A stream of bytes is taken apart into MAVLink packets first: what is lost is a packet, whatever the
chunks that a socket delivers.
"""

import heapq
import random
from dataclasses import dataclass
from typing import Annotated

from ...models.config.checks import Within, check_numbers

_SHARE = Within(0.0, 1.0)
_SECONDS = Within(0.0, 60.0)


@dataclass(frozen=True)
class LinkFaults:
    """Faults of the packets on a link; each is independent of the others.

    Attributes:
        loss: share that is lost.
        corruption: share with one byte changed.
        reordering: share that is overtaken by the packets behind it.
        delay: of every packet (s).
        jitter: largest further delay (s), uniform; packets keep their order.
    """

    loss: Annotated[float, _SHARE] = 0.0
    corruption: Annotated[float, _SHARE] = 0.0
    reordering: Annotated[float, _SHARE] = 0.0
    delay: Annotated[float, _SECONDS] = 0.0
    jitter: Annotated[float, _SECONDS] = 0.0

    @property
    def any(self) -> bool:
        """Whether there is a fault."""
        return self != LinkFaults()

    def __post_init__(self) -> None:
        """Check ranges."""
        check_numbers(self)


class FaultyLink:
    """One direction of a link with faults; equal seeds and packets give equal results.

    A packet that is overtaken arrives 50 ms later than it would.
    """

    def __init__(self, faults: LinkFaults, seed: int):
        self._faults = faults
        self._random = random.Random(seed)
        self._waiting: list[tuple[float, int, bytes]] = []
        self._count = 0
        self._last = 0.0

    def send(self, t: float, packet: bytes) -> None:
        """Put a packet on the way at time t (s)."""
        faults, chance = self._faults, self._random.random
        if chance() < faults.loss:
            return
        if chance() < faults.corruption and packet:
            damaged = bytearray(packet)
            damaged[self._random.randrange(len(damaged))] ^= self._random.randrange(1, 256)
            packet = bytes(damaged)
        at = max(t + faults.delay + faults.jitter * chance(), self._last)
        if chance() < faults.reordering:
            at += _OVERTAKEN
        else:
            self._last = at
        self._count += 1
        heapq.heappush(self._waiting, (at, self._count, packet))

    def due(self, t: float) -> list[bytes]:
        """Packets that arrive by time t."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= t:
            arrived.append(heapq.heappop(self._waiting)[2])
        return arrived

    def clear(self) -> None:
        """Forget what is on the way."""
        self._waiting.clear()


_OVERTAKEN = 0.05  # s
_HEADS = {0xFD: 12, 0xFE: 8}
"""Bytes of a packet besides its payload, by the first: MAVLink 2 and 1."""
_SIGNED, _SIGNATURE = 1, 13


class Packets:
    """The packets in a stream of bytes; bytes between packets are pieces of their own."""

    def __init__(self):
        self._rest = b""

    def split(self, data: bytes) -> list[bytes]:
        """The packets that end within `data`, which continues what was given before."""
        stream, found, start = self._rest + data, [], 0
        while start < len(stream):
            size = _size(stream[start : start + 3])
            if size is None or start + size > len(stream):
                break
            found.append(stream[start : start + size])
            start += size
        self._rest = stream[start:]
        return found


def _size(head: bytes) -> int | None:
    """Length of the packet that begins so, 1 if none does, None if more bytes are needed."""
    if head[0] not in _HEADS:
        return 1
    if len(head) < 3:
        return None
    signed = head[0] == 0xFD and head[2] & _SIGNED
    return _HEADS[head[0]] + head[1] + (_SIGNATURE if signed else 0)
