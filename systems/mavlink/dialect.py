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


class _Sender:
    """Sequence numbers of a sender.

    Attributes:
        last: the last one.
        skipped: those that were skipped shortly before.
        behind: the last one that lay behind and had not been skipped, if it came just now.
    """

    def __init__(self, last: int):
        self.last, self.skipped = last, set[int]()
        self.behind: int | None = None

    def take(self, number: int) -> int:
        """Packets that are lost more than before: those skipped, or -1 for one that was late."""
        gap = (number - self.last - 1) % (_LAST + 1)
        if gap >= _LAST - _LATE:
            if number in self.skipped:
                self.skipped.remove(number)
                return -1
            before, self.behind = self.behind, number
            if before is not None and gap < _LAST and number == (before + 1) % (_LAST + 1):
                self._begin(number)  # two in a row are no repetitions
            return 0
        if gap > _LAST // 2:
            self._begin(number)
            return 0
        near = {n for n in self.skipped if (number - n) % (_LAST + 1) <= _LATE}
        self.skipped = near | {(number - k) % (_LAST + 1) for k in range(1, gap + 1)}
        self.last, self.behind = number, None
        return gap

    def _begin(self, number: int) -> None:
        """The sender began anew, or so much was lost that it looks like that."""
        self.last, self.behind = number, None
        self.skipped.clear()


class Parser:
    """Messages from bytes, bytes from messages, and counts of what was lost.

    Bytes that are not a sound packet of a known message are skipped and counted in `damaged`. Gaps
    in the sequence numbers of a sender are counted in `lost`; a packet that arrives late is not.
    """

    def __init__(self, system: int, component: int):
        """Pack as the sender `system`, `component`."""
        self._mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self._mav.robust_parsing = True
        self._senders: dict[tuple[int, int], _Sender] = {}
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
        sender = self._senders.setdefault((system, component), _Sender(number - 1))
        self.lost += sender.take(number)

    def restart(self, counts: bool = False) -> None:
        """Begin a new stream: what was sent in between is not counted as lost.

        `counts` is whether the counts begin anew as well.
        """
        self._senders.clear()
        if counts:
            self.received = self.damaged = self.lost = 0

    def packed(self, message: Message) -> bytes:
        """The packet of a message, with the next sequence number."""
        data = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % (_LAST + 1)
        return data
