"""The link to a vehicle: one thread that receives, sends heartbeats and connects again.

Everybody else reads the newest message of each kind and calls `send`; neither waits.
"""

import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

from ...models.config.errors import UserError
from . import heartbeat
from .clock import MICROSECONDS_32, MILLISECONDS_32, VehicleClock
from .config import GROUND_STATION
from .dialect import Message, Parser, mavlink
from .transport import Connection, Lost, Transport
from .urgent import urgent

_HEARTBEAT, _TIMESYNC, _RETRY = 0.5, 0.5, 1.0  # s between heartbeats, TIMESYNC requests, attempts
_WAIT = 0.05  # s: longest wait for data
_TELLINGS, _RECENT = 5, 2.0  # calls, a second apart, after a boot; s over which rates are counted
_BY_FIELD = {"NAMED_VALUE_FLOAT": "name", "BATTERY_STATUS": "id"}  # kept by that field as well
_AIDS = ("VISION_POSITION_DELTA", "ODOMETRY", "DISTANCE_SENSOR")
"""What a companion computer sends to the autopilot about the motion, under any system id."""
_STEERING = ("MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE")
_BOOT_CLOCKS = {"SERVO_OUTPUT_RAW": MICROSECONDS_32}  # others' time_usec has 64 bits
_OF_A_FIX = ("GPS_RAW_INT", "GPS2_RAW")  # time of the last fix: it stands still under water


class Received(NamedTuple):
    """A message with its times."""

    message: Message
    arrival: float
    """Local monotonic time (s)."""
    boot: float | None
    """Time on the vehicle's boot clock (s), if the message has one; a 32-bit field is continued."""


class Peer(NamedTuple):
    """A sender by its ids."""

    system: int
    component: int


@dataclass
class Statistics:
    """What came through the link.

    Attributes:
        received: messages since the vehicle's last boot, of all senders.
        lost: gaps in sequence numbers since then.
        damaged: packets with a wrong checksum, and bytes in between, since then.
        reconnections: how often a lost connection was opened again.
        silence: time since the vehicle was last heard (s).
        rates: messages per second of each kind, over the last two seconds.
        round_trip: shortest recent round trip of TIMESYNC (s), None if it is not answered.
        reboots: of the vehicle.
    """

    received: int = 0
    lost: int = 0
    damaged: int = 0
    reconnections: int = 0
    silence: float = float("inf")
    rates: dict[str, float] = field(default_factory=dict)
    round_trip: float | None = None
    reboots: int = 0


class Link:
    """A connection to one vehicle; a context manager that closes it.

    The vehicle is the first sender of a HEARTBEAT with an autopilot's type. Messages of its system
    are kept by their names, the newest of each, and so are those of a DVL's driver.
    """

    def __init__(
        self,
        connection: Connection,
        *,
        system: int = GROUND_STATION,
        component: int = heartbeat.COMPONENT,
        record: Path | None = None,
    ):
        """Open the connection and start the thread; `record` is a telemetry log (.tlog) to write.

        Raises:
            UserError: the connection or the file can't be opened.
        """
        self.connection = connection
        self.clock = VehicleClock()
        self.vehicle: Peer | None = None
        self._me = Peer(system, component)
        self._parser = Parser(*self._me)
        self._newest: dict[str, Received] = {}
        self._times: dict[str, deque[float]] = {}
        self._others: dict[Peer, float] = {}
        self._boots = 0
        self._when_booted: list[Callable[[], object]] = []
        self._booted_calls = 0
        self._asked: deque[int] = deque(maxlen=20)  # times of TIMESYNC requests (ns)
        self._texts: deque[tuple[float, int, str]] = deque(maxlen=200)
        self._readers: list[Callable[[Received], None]] = []
        self._changed = threading.Condition()
        self._sending = threading.Lock()
        self._reconnections = 0
        self._last = -float("inf")
        self._closing = False
        self._transport: Transport | None = connection.open()
        self._record = _open_record(record, self._transport)
        self._thread = threading.Thread(target=self._run, name="mavlink", daemon=True)
        self._thread.start()

    def __enter__(self) -> "Link":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the thread and close the connection; may be called twice."""
        self._closing = True
        self._thread.join()
        if self._transport is not None:
            self._transport.close()
        with self._sending:
            if self._record is not None:
                with suppress(OSError):  # full
                    self._record.close()
                self._record = None

    # ------------------------------------------------------------------------------------- reading

    def latest(self, name: str) -> Received | None:
        """The newest message of that name from the vehicle.

        `NAMED_VALUE_FLOAT/PilotGain` and `BATTERY_STATUS/0` are the newest of that name or number.
        """
        return self._newest.get(name)

    def age(self, name: str) -> float:
        """Time since the newest message of that name arrived (s), infinite if there is none."""
        found = self._newest.get(name)
        return float("inf") if found is None else time.monotonic() - found.arrival

    @property
    def silence(self) -> float:
        """Time since the vehicle was last heard (s), infinite before the first message."""
        return time.monotonic() - self._last

    def texts(self, since: float = 0.0) -> list[tuple[float, int, str]]:
        """Status texts after a local time (s): arrival, severity, text."""
        return [text for text in list(self._texts) if text[0] > since]

    def others(self, within: float = 5.0) -> list[Peer]:
        """Other ground stations with our system id that were heard within some seconds.

        A bridge that uses our id, as for a DVL's messages, is none: it neither says that it is a
        ground station nor steers.
        """
        now = time.monotonic()
        return [peer for peer, last in list(self._others.items()) if now - last < within]

    @contextmanager
    def reading(self, reader: Callable[[Received], None]) -> Iterator[None]:
        """Call `reader` with every message of the vehicle, in the link's thread, in the block."""
        self._readers = [*self._readers, reader]
        try:
            yield
        finally:
            self._readers = [one for one in self._readers if one is not reader]

    def when_booted(self, act: Callable[[], object]) -> None:
        """Call `act` in the link's thread when the vehicle has booted anew; it must not wait.

        It is called five times in as many seconds: the vehicle may not listen yet.
        """
        self._when_booted.append(act)

    def statistics(self, rated: bool = True) -> Statistics:
        """Counts until now, and rates, which take a millisecond or two."""
        now, rates = time.monotonic(), {}
        for name, times in list(self._times.items()) if rated else ():
            count = sum(now - t < _RECENT for t in list(times))
            if count:
                rates[name] = count / _RECENT
        half, parser = self.clock.uncertainty, self._parser
        return Statistics(
            parser.received,
            parser.lost,
            parser.damaged,
            self._reconnections,
            self.silence,
            rates,
            None if half is None else 2 * half,
            self.clock.reboots,
        )

    def wait_for(
        self,
        name: str,
        timeout: float,
        fits: Callable[[Message], bool] = lambda message: True,
        since: float | None = None,
    ) -> Received | None:
        """The first newest message of that name that `fits` and arrived after `since`.

        `since` is by default the time of the call (local, s). None after `timeout` (s).
        """
        end = time.monotonic() + timeout
        since = time.monotonic() if since is None else since
        with self._changed:
            while True:
                found = self._newest.get(name)
                if found is not None and found.arrival >= since and fits(found.message):
                    return found
                left = end - time.monotonic()
                if left <= 0 or not self._changed.wait(left):
                    return None

    # ------------------------------------------------------------------------------------- sending

    @property
    def connected(self) -> bool:
        """Whether the connection is open; UDP is always."""
        return self._transport is not None

    def send(self, message: Message) -> bool:
        """Send at once; false if the connection is lost at the moment."""
        with self._sending:
            transport = self._transport
            if transport is None:
                return False
            data = self._parser.packed(message)
            try:
                transport.write(data)
            except Lost:
                return False  # the thread notices as well, and connects again
            self._keep(data)
        return True

    def find_vehicle(self, timeout: float = 10.0) -> Peer:
        """Wait for the vehicle's first heartbeat.

        Raises:
            UserError: none came.
        """
        end = time.monotonic() + timeout
        with self._changed:
            while self.vehicle is None:
                left = end - time.monotonic()
                if left <= 0 or not self._changed.wait(left):
                    break
        if self.vehicle is None:
            heard = f"{self._parser.received} messages" if self._parser.received else "nothing"
            raise UserError(
                f"connection {self.connection}: no autopilot's heartbeat in {timeout:g} s (heard "
                f"{heard}); check the vehicle's power, its MAVLink endpoint and the address"
            )
        return self.vehicle

    # -------------------------------------------------------------------------------------- thread

    @urgent()
    def _run(self) -> None:
        due = {"heartbeat": 0.0, "timesync": 0.0, "booted": 0.0}
        while not self._closing:
            now = time.monotonic()
            if self._transport is None:
                self._reconnect()
                continue
            if now >= due["heartbeat"]:
                due["heartbeat"] = now + _HEARTBEAT
                self.send(heartbeat.ours())
            if now >= due["timesync"]:
                due["timesync"] = now + _TIMESYNC
                self._asked.append(time.monotonic_ns())
                self.send(mavlink.MAVLink_timesync_message(0, self._asked[-1]))
            if self._booted_calls and now >= due["booted"]:
                due["booted"], self._booted_calls = now + 1.0, self._booted_calls - 1
                for act in self._when_booted:
                    act()
            try:
                data = self._transport.read(_WAIT)
            except Lost:
                self._drop()
                continue
            arrival = time.monotonic()
            for message in self._parser.messages(data):
                self._take_in(message, arrival)

    def _drop(self) -> None:
        with self._sending:
            if self._transport is not None:
                self._transport.close()
            self._transport = None

    def _reconnect(self) -> None:
        started = time.monotonic()
        try:
            opened = self.connection.open(_RETRY)
        except UserError:
            while not self._closing and time.monotonic() - started < _RETRY:
                time.sleep(_WAIT)
            return
        with self._sending:
            self._transport = opened
        self._parser.restart()
        self._reconnections += 1

    def _take_in(self, message: Message, arrival: float) -> None:
        peer, name = Peer(message.get_srcSystem(), message.get_srcComponent()), message.get_type()
        ours, aid = peer.system == self._me.system, name in _AIDS
        if ours and (name in _STEERING or (name == "HEARTBEAT" and heartbeat.is_station(message))):
            self._others[peer] = arrival
        if ours and not aid:
            return
        if name == "HEARTBEAT" and self.vehicle is None and heartbeat.is_autopilot(message):
            self.vehicle = peer
        if self.vehicle is not None and peer.system != self.vehicle.system and not aid:
            return
        if name == "HEARTBEAT" and peer != self.vehicle:
            return  # a camera's, a companion computer's
        with self._sending:
            self._keep(message.get_msgbuf())
        found = Received(message, arrival, boot_time(message, arrival, self.clock))
        if name == "TIMESYNC" and peer == self.vehicle:
            self._exchanged(message, arrival)
        elif found.boot is not None and peer == self.vehicle:  # others may have other clocks
            self.clock.arrived(found.boot, arrival)
        if self.clock.reboots != self._boots:  # its sequence began anew, and its requested rates
            self._boots = self.clock.reboots
            self._parser.restart(counts=True)
            self._booted_calls = _TELLINGS
        if name == "STATUSTEXT":
            self._texts.append((arrival, message.severity, message.text))
        self._times.setdefault(name, deque(maxlen=1000)).append(arrival)
        if not aid:
            self._last = arrival
        with self._changed:
            self._newest[name] = found
            if name in _BY_FIELD:
                self._newest[f"{name}/{getattr(message, _BY_FIELD[name])}"] = found
            self._changed.notify_all()
        for reader in self._readers:
            reader(found)

    def _exchanged(self, message: Message, arrival: float) -> None:
        if message.tc1 > 0 and message.ts1 in self._asked:  # an answer to one of our requests
            self.clock.exchanged(message.ts1 * 1e-9, message.tc1 * 1e-9, arrival)

    def _keep(self, packet: bytes | bytearray) -> None:
        """Append a packet to the telemetry log: time in µs since 1970, then the packet."""
        if self._record is None:
            return
        try:
            self._record.write(struct.pack(">Q", time.time_ns() // 1000) + bytes(packet))
        except OSError as error:  # commands and heartbeats go on without a record
            text = f"{self._record.name} can't be written any more: {error.strerror}"
            with suppress(OSError):
                self._record.close()
            self._record = None
            self._texts.append((time.monotonic(), 4, text))  # a warning


def boot_time(message: Message, arrival: float, clock: VehicleClock) -> float | None:
    """A message's time on the boot clock (s); None if it has none, or a date.

    A `time_usec` of 0 is an unknown time, except where a 32-bit counter has just wrapped.
    """
    if (ms := getattr(message, "time_boot_ms", None)) is not None:
        return clock.continued(ms * 1e-3, MILLISECONDS_32, arrival)
    us = None if message.get_type() in _OF_A_FIX else getattr(message, "time_usec", None)
    if us is None or not 0 <= us < 1e15:
        return None
    span = _BOOT_CLOCKS.get(message.get_type())
    found = us * 1e-6 if span is None else clock.continued(us * 1e-6, span, arrival)
    return found if found > 0 else None


def _open_record(path: Path | None, transport: Transport) -> BinaryIO | None:
    if path is None:
        return None
    try:
        return path.open("xb")
    except OSError as error:
        transport.close()
        raise UserError(f"{path}: can't be written: {error.strerror}; name another file") from error
