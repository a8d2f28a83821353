"""Which messages a link gets, and how often."""

from ..autopilot.parameters import Parameters

ACCEPTED, DENIED = 0, 2

GROUPS: dict[int, tuple[str, tuple[int, ...]]] = {
    1: ("RAW_SENS", (27, 116, 129, 29, 137, 143)),
    2: ("EXT_STAT", (1, 125, 152, 42, 24, 62)),
    3: ("RC_CHAN", (36, 65)),
    6: ("POSITION", (33, 32)),
    10: ("EXTRA1", (30, 178)),
    11: ("EXTRA2", (74,)),
    12: ("EXTRA3", (163, 2, 241, 147, 193, 251)),
}
"""MAV_DATA_STREAM: the rate's parameter SR0_… and the messages."""

_ALL = 0  # the stream of REQUEST_DATA_STREAM that means every group
_HEARTBEAT = 0
_LONGEST = 60_000  # ms
_SLOWEST_CATCH_UP = 0.25  # s behind which a stream begins anew


class Streams:
    """The intervals of one link.

    An interval is a whole number of milliseconds and at least 1.25 loops of the autopilot; a
    request for less gets that.
    """

    def __init__(self, parameters: Parameters, known: frozenset[int]):
        """Begin with the default rates; `known` are the messages that can be asked for."""
        self._parameters = parameters
        self._known = known
        self._interval: dict[int, float] = {}
        self._due: dict[int, float] = {}
        self._next = 0.0
        for message in known:
            self._set(message, self.default(message))

    def default(self, message: int) -> int:
        """Interval (ms) of a message that nobody asked for, 0 if it is not sent."""
        if message == _HEARTBEAT:
            return 1000
        for name, members in GROUPS.values():
            if message in members:
                rate = self._parameters.integer(f"SR0_{name}")
                return round(1000 / rate) if rate > 0 else 0
        return 0

    def interval(self, message: int) -> int:
        """Interval in force (µs), -1 if it is not sent, 0 for an unknown message."""
        if message not in self._known:
            return 0
        return round(1e6 * self._interval[message]) if message in self._interval else -1

    def request(self, message: int, interval_us: float) -> int:
        """Take SET_MESSAGE_INTERVAL: 0 for the default, -1 for none; returns the ack's result."""
        if message not in self._known or (interval_us < 0 and interval_us != -1):
            return DENIED
        if interval_us == 0:
            self._set(message, self.default(message))
        elif interval_us == -1:
            self._set(message, 0)
        else:
            loop_ms = 1000 / max(self._parameters["SCHED_LOOP_RATE"], 1.0)
            self._set(message, max(int(interval_us / 1000), int(1.25 * loop_ms), 1))
        return ACCEPTED

    def request_group(self, stream: int, rate: int) -> None:
        """Take REQUEST_DATA_STREAM: a rate (Hz) for all messages of a group, 0 for none."""
        wanted = GROUPS.values() if stream == _ALL else [GROUPS[stream]] if stream in GROUPS else []
        for _, members in wanted:
            for message in members:
                if message in self._known:
                    self._set(message, max(1, round(1000 / rate)) if rate > 0 else 0)

    def due(self, t: float) -> list[int]:
        """Messages to send at time t (s)."""
        if t < self._next:
            return []
        now = [message for message, at in self._due.items() if at <= t + 1e-9]
        for message in now:
            at = self._due[message] + self._interval[message]
            late = t - at > _SLOWEST_CATCH_UP
            self._due[message] = t + self._interval[message] if late else at
        self._next = min(self._due.values(), default=t + 1.0)
        return now

    def _set(self, message: int, interval_ms: int) -> None:
        self._interval.pop(message, None)
        self._due.pop(message, None)
        if interval_ms > 0:
            self._interval[message] = min(interval_ms, _LONGEST) / 1000
            self._due[message] = 0.0
        self._next = 0.0
