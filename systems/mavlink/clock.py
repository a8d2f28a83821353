"""The vehicle's boot clock, and where its times are on the local monotonic clock.

Messages carry the time since boot in milliseconds or microseconds, some in 32 bits: that of
SERVO_OUTPUT_RAW begins anew every 71.6 minutes. TIMESYNC, where the vehicle answers it, gives the
offset between the clocks to half a round trip (the principle of NTP; Mills 1991, section 4).
Without it the smallest delay of a message bounds the offset from above.
"""

from collections import deque
from typing import NamedTuple

_WINDOW = 10.0  # s of observations that are kept: clocks drift by less than 1 ms in it
_REBOOT = 2.0  # s by which the boot clock runs back when the vehicle boots again
_FRESH = 5.0  # s for which an answer to TIMESYNC is preferred to the delay of messages
_APART = 60.0  # s: longest delay of a message; a clock that is farther off began anew


class Exchange(NamedTuple):
    """One answered TIMESYNC, in local time (s)."""

    at: float
    offset: float
    """Local time of the vehicle's boot, taking the middle of the round trip (s)."""
    round_trip: float


class VehicleClock:
    """Offset of the boot clock, from what the link observes. Times are in seconds.

    `offset` is the local time of the vehicle's boot: local = boot + offset. `reboots` counts how
    often the boot clock began anew. One thread may observe while others read.
    """

    def __init__(self):
        self.reboots = 0
        self.offset: float | None = None
        """Local time of the vehicle's boot (s), None before the first observation."""
        self.uncertainty: float | None = None
        """Half the round trip of the exchange in use (s); None without TIMESYNC."""
        self._exchanges: deque[Exchange] = deque()
        self._delays: deque[tuple[float, float]] = deque()  # (arrival, arrival - boot)
        self._newest = -float("inf")
        self._newest_at = 0.0

    def exchanged(self, sent: float, vehicle: float, received: float) -> None:
        """Take in an answer to TIMESYNC: local times of request and answer, vehicle's in between.

        `vehicle` is the answer's time on the boot clock.
        """
        self._begin_again(vehicle, received)
        middle, trip = (sent + received) / 2, received - sent
        self._exchanges.append(Exchange(received, middle - vehicle, trip))
        while self._exchanges[0].at < received - _WINDOW:
            self._exchanges.popleft()
        self._settle()

    def arrived(self, boot: float, arrival: float) -> None:
        """Take in a message: its time on the boot clock and the local time of its arrival."""
        self._begin_again(boot, arrival)
        delay = arrival - boot
        while self._delays and self._delays[-1][1] >= delay:  # keeps a falling minimum at the front
            self._delays.pop()
        self._delays.append((arrival, delay))
        while self._delays[0][0] < arrival - _WINDOW:
            self._delays.popleft()
        self._settle()

    def local(self, boot: float) -> float | None:
        """Local time of a time on the boot clock, None before the first observation."""
        offset = self.offset
        return None if offset is None else boot + offset

    def _settle(self) -> None:
        best = self._best()
        if best is not None:
            self.offset, self.uncertainty = best.offset, best.round_trip / 2
        else:
            self.offset = self._delays[0][1] if self._delays else None
            self.uncertainty = None

    def _best(self) -> Exchange | None:
        """The exchange of the shortest round trip; None if all are old and messages go on."""
        if not self._exchanges:
            return None
        newest = max(self._exchanges[-1].at, self._delays[-1][0] if self._delays else 0.0)
        if self._delays and self._exchanges[-1].at < newest - _FRESH:
            return None
        return min(self._exchanges, key=lambda exchange: exchange.round_trip)

    def continued(self, value: float, span: float, arrival: float) -> float:
        """Time on the boot clock of a counter that returns to zero at `span` (s).

        It is the one nearest to where the clock should be on arrival. If none is near, the clock
        began anew, and the counter with it.
        """
        expected = self._newest + arrival - self._newest_at
        if expected == -float("inf"):
            return value
        found = value + span * round((expected - value) / span)
        return found if abs(found - expected) < _APART else value

    def _begin_again(self, boot: float, arrival: float) -> None:
        if boot < self._newest - _REBOOT:
            self.reboots += 1
            self._exchanges.clear()
            self._delays.clear()
            self._newest = -float("inf")
        if boot > self._newest:
            self._newest, self._newest_at = boot, arrival


MILLISECONDS_32 = 2**32 / 1e3
"""Span (s) of time_boot_ms: 49.7 days."""
MICROSECONDS_32 = 2**32 / 1e6
"""Span (s) of a time in µs and 32 bits: 71.6 minutes."""
