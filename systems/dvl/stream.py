"""A thread that reads a DVL's stream and keeps the newest reading, on the local clock."""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from ...models.config.errors import UserError
from ..mavlink.clock import VehicleClock
from ..mavlink.transport import Connection, Lost, Transport
from .reading import Decoder, DvlReading

_WAIT, _RETRY = 0.1, 1.0  # s


class Timed(NamedTuple):
    """A reading with local times (monotonic, s)."""

    reading: DvlReading
    arrival: float
    validity: float
    """When the velocity was valid; a few milliseconds late, as the network's delay is unknown."""


class DvlStream:
    """The newest reading of a DVL; connects again when the stream ends."""

    def __init__(
        self,
        connection: Connection,
        decoder: Decoder,
        login: Callable[[Transport], None] = lambda transport: None,
    ):
        """Connect, `login` on each connection, and read from then on.

        Raises:
            UserError: the DVL can't be reached.
        """
        self.connection, self._decoder, self._login = connection, decoder, login
        self.reconnections = 0
        self._clock = VehicleClock()
        self._newest: Timed | None = None
        self._closing = threading.Event()
        self._transport: Transport | None = self._open()
        self._thread = threading.Thread(target=self._run, name="dvl", daemon=True)
        self._thread.start()

    @property
    def newest(self) -> Timed | None:
        """The newest reading, valid or not."""
        return self._newest

    @property
    def damaged(self) -> int:
        """Packets or lines that could not be read."""
        return self._decoder.damaged

    def age(self) -> float:
        """Time since the newest reading arrived (s), infinite before the first."""
        newest = self._newest
        return float("inf") if newest is None else time.monotonic() - newest.arrival

    def close(self) -> None:
        """End the thread and close the connection; may be called twice."""
        self._closing.set()
        self._thread.join()
        if self._transport is not None:
            self._transport.close()

    def _open(self) -> Transport:
        opened = self.connection.open()
        with suppress(Lost):
            self._login(opened)
        return opened

    def _run(self) -> None:
        while not self._closing.is_set():
            if self._transport is None:
                try:
                    self._transport = self._open()
                    self.reconnections += 1
                except UserError:
                    self._closing.wait(_RETRY)
                continue
            try:
                data = self._transport.read(_WAIT)
            except Lost:
                self._transport.close()
                self._transport = None
                continue
            arrival = time.monotonic()
            for reading in self._decoder.readings(data):
                self._newest = Timed(reading, arrival, self._validity(reading, arrival))

    def _validity(self, reading: DvlReading, arrival: float) -> float:
        if reading.latency is not None:
            return arrival - reading.latency
        if reading.stamp != reading.stamp:  # the instrument has no clock
            return arrival
        self._clock.arrived(reading.stamp, arrival)
        local = self._clock.local(reading.stamp)
        return arrival if local is None else local
