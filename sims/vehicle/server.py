"""Serves a simulated vehicle over MAVLink, in real time or a multiple of it."""

import threading
import time
from collections.abc import Sequence
from contextlib import suppress

from ...models.config.errors import UserError
from ...systems.mavlink.transport import FORMS, Connection, Lost, Transport
from .link_faults import FaultyLink, Packets
from .simulation import TICK, Simulation

_MOST_TICKS = 40  # between looks at the sockets
_BEHIND = 0.5  # s of wall time beyond which the clock is stopped instead of catching up


def open_all(connections: Sequence[str]) -> list[Transport]:
    """Open every connection, or none.

    Raises:
        UserError: one can't be read or opened.
    """
    if not connections:
        raise UserError(f"--connection: give at least one; {FORMS}")
    wanted = [Connection.parse(text, "--connection") for text in connections]
    opened: list[Transport] = []
    try:
        for connection in wanted:
            opened.append(connection.open())
    except BaseException:
        for transport in opened:
            transport.close()
        raise
    return opened


class Server:
    """Steps a simulation by the wall clock and carries bytes between it and its transports."""

    def __init__(
        self,
        simulation: Simulation,
        transports: Sequence[Transport],
        seed: int = 0,
        speed: float = 1.0,
    ):
        """Serve at `speed` times real time; `seed` is that of the links' faults."""
        self.simulation = simulation
        self.behind = 0.0
        self._transports = dict(enumerate(transports))
        self._speed = speed
        faults = simulation.settings.faults
        n = len(transports)
        self._inward = [FaultyLink(faults, seed + 2 * i) for i in range(n)]
        self._packets = [Packets() for _ in range(n)] if faults.any else []
        self._outward = [FaultyLink(faults, seed + 2 * i + 1) for i in range(n)]

    def run(self, stop: threading.Event, duration: float | None = None) -> None:
        """Serve until `stop` is set, or the simulation's time reaches `duration` (s)."""
        simulation = self.simulation
        began = time.monotonic() - simulation.time / self._speed
        while not stop.is_set() and (duration is None or simulation.time < duration - 1e-9):
            wall = time.monotonic() - began
            late = wall - simulation.time / self._speed
            if late > _BEHIND:
                began += late
                self.behind += late
                wall -= late
            for _ in range(_MOST_TICKS):
                if simulation.time + TICK > wall * self._speed:
                    break
                self._tick()
            due = began + (simulation.time + TICK) / self._speed - time.monotonic()
            self._read(max(0.0, min(due, 0.05)))

    def advance(self, seconds: float) -> None:
        """Step by simulated seconds without waiting, and take what has arrived."""
        for _ in range(round(seconds / TICK)):
            self._tick()
        self._read(0.0)

    def close(self) -> None:
        """Close all transports."""
        for transport in self._transports.values():
            with suppress(OSError):
                transport.close()

    def _tick(self) -> None:
        simulation = self.simulation
        for port, link in enumerate(self._inward):
            for data in link.due(simulation.time):
                simulation.receive(port, data)
        boots = simulation.vehicle.boots
        packets = simulation.step()
        if simulation.vehicle.boots != boots:
            for link in (*self._inward, *self._outward):
                link.clear()
        for port, link in enumerate(self._outward):
            for packet in packets[port]:
                link.send(simulation.time, packet)
            for packet in link.due(simulation.time):
                self._write(port, packet)

    def _read(self, wait: float) -> None:
        """Read what has arrived everywhere; waits for the first transport up to `wait` (s)."""
        if not self._transports:
            time.sleep(wait)
        for port, transport in list(self._transports.items()):
            try:
                data = transport.read(wait)
            except Lost:
                self._drop(port)
                continue
            wait = 0.0
            if data:
                for packet in self._packets[port].split(data) if self._packets else [data]:
                    self._inward[port].send(self.simulation.time, packet)

    def _write(self, port: int, packet: bytes) -> None:
        transport = self._transports.get(port)
        if transport is not None:
            try:
                transport.write(packet)
            except Lost:
                self._drop(port)

    def _drop(self, port: int) -> None:
        with suppress(OSError):
            self._transports.pop(port).close()
