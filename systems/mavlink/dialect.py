"""The MAVLink dialect in use: ArduPilot's, in version 2 of the protocol.

pymavlink's `mavutil` chooses dialect and version by environment variables that are read when it is
first imported. This module imports the version 2 dialect itself, so neither the environment nor the
order of imports matters. `mavutil` is not used.
"""

from collections.abc import Iterable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

__all__ = ["Message", "Parser", "mavlink"]

Message = Any
"""A pymavlink message. Its fields are attributes, which its class does not declare."""

_LAST = 255  # sequence numbers count from 0 to this
_LATE = 64  # places by which a packet can be late: 50 ms at a full rate and in a burst


class Parser:
    """Messages from bytes, bytes from messages, and counts of what was lost.

    Bytes that are not a sound packet of a known message are skipped and counted in `damaged`. Gaps
    in the sequence numbers of a sender are counted in `lost`; a packet that arrives late is not.
    """

    def __init__(self, system: int, component: int):
        """Pack as the sender `system`, `component`."""
        self._mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self._mav.robust_parsing = True
        self._sequence: dict[tuple[int, int], int] = {}
        self.received = self.damaged = self.lost = 0

    def messages(self, data: bytes) -> Iterable[Message]:
        """The messages that end within `data`, which continues what was given before."""
        for message in self._mav.parse_buffer(data) or ():
            if message.get_msgId() < 0:  # BAD_DATA, or a message that the dialect lacks
                self.damaged += message.get_type() == "BAD_DATA"
                continue
            self.received += 1
            self._count(message.get_srcSystem(), message.get_srcComponent(), message.get_seq())
            yield message

    def _count(self, system: int, component: int, number: int) -> None:
        sender = (system, component)
        gap = (number - self._sequence.get(sender, number - 1) - 1) % (_LAST + 1)
        late = gap >= _LAST - _LATE
        if late:
            self.lost -= gap < _LAST  # it was counted as lost; a gap of 255 is a repetition
        elif gap <= _LAST // 2:  # beyond, the sender began anew
            self.lost += gap
        if not late:
            self._sequence[sender] = number

    def restart(self, counts: bool = False) -> None:
        """Begin a new stream: what was sent in between is not counted as lost.

        `counts` is whether the counts begin anew as well.
        """
        self._sequence.clear()
        if counts:
            self.received = self.damaged = self.lost = 0

    def packed(self, message: Message) -> bytes:
        """The packet of a message, with the next sequence number."""
        data = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % (_LAST + 1)
        return data
