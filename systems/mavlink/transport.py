"""Byte streams to and from a vehicle: TCP, UDP, serial. The only sockets of this package.

A connection is written as in other MAVLink software: `tcp:HOST:PORT` connects, `tcpin:HOST:PORT`
waits for one client at a time, `udpin:HOST:PORT` listens and answers whoever sends, and
`udpout:HOST:PORT` sends first; `serial:DEVICE:BAUD`. Port 0 of a listening connection takes a free
one.
"""

import select
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from ...models.config.errors import UserError
from .refusals import LISTENING, refusal

FORMS = "tcp:HOST:PORT, tcpin:HOST:PORT, udpin:HOST:PORT, udpout:HOST:PORT or serial:DEVICE:BAUD"

_CHUNK = 65536  # bytes read at once: more than the largest datagram
_FULL_S = 0.02  # for which a serial line may take nothing; with 0 pyserial tries for ever
_WAITING = 32768  # bytes that may wait to be sent: behind them a command would be late
_SILENT = 10.0  # s after which a UDP peer that sends nothing gets nothing


@dataclass(frozen=True)
class Connection:
    """Where a vehicle, or a ground station, is.

    Attributes:
        kind: tcp, tcpin, udpin, udpout or serial.
        address: host name, or device.
        number: port, or baud rate.
    """

    kind: str
    address: str
    number: int

    @classmethod
    def parse(cls, text: str, field: str = "connection") -> "Connection":
        """Read `kind:address:number`.

        Raises:
            UserError: the text has another form.
        """
        kind, _, rest = text.partition(":")
        address, _, number = rest.rpartition(":")
        known = kind in _KINDS and bool(address) and number.isascii() and number.isdigit()
        if not known or not (kind == "serial" or int(number) < 65536):
            raise UserError(f"{field}: `{text}` is no connection; give {FORMS}")
        lowest = 0 if kind in LISTENING else 1
        if int(number) < lowest:
            raise UserError(f"{field}: `{text}` needs a port, or a baud rate, above 0")
        return cls(kind, address, int(number))

    def __str__(self) -> str:
        """As it is written."""
        return f"{self.kind}:{self.address}:{self.number}"

    def open(self, timeout: float = 5.0) -> "Transport":
        """Open it; `timeout` (s) bounds the time to connect.

        Raises:
            UserError: host, port or device can't be opened; the sentence says why.
        """
        with self._refusing():
            return _KINDS[self.kind](self, timeout)

    def open_datagrams(self) -> "Datagrams":
        """Open a UDP connection whose datagrams keep their bounds.

        Raises:
            UserError: it is none, or host or port can't be opened; the sentence says why.
        """
        if not self.kind.startswith("udp"):
            raise UserError(
                f"connection {self}: datagrams need udpin:HOST:PORT or udpout:HOST:PORT"
            )
        with self._refusing():
            return Datagrams(self)

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError) as error:
            words = refusal(self.kind, self.address, self.number, error)
            raise UserError(f"connection {self}: {words}") from error


class Lost(OSError):
    """The other side closed the connection, or the device is gone."""


@runtime_checkable
class Transport(Protocol):
    """A stream of bytes in both directions."""

    port: int
    """The local port of a listening connection; 0 for others."""

    def read(self, timeout: float) -> bytes:
        """What has arrived; waits up to `timeout` (s) for the first byte; empty if there is none.

        Raises:
            Lost: the connection has ended.
        """
        ...

    def write(self, data: bytes) -> None:
        """Send; what can't be sent at once is dropped, as commands must not be late.

        Raises:
            Lost: the connection has ended.
        """
        ...

    def close(self) -> None:
        """Close; further calls raise `Lost`."""
        ...


class _Tcp:
    """One TCP connection."""

    port = 0

    def __init__(self, connection: Connection, timeout: float):
        address = (connection.address, connection.number)
        self._socket = socket.create_connection(address, timeout)
        _prepare(self._socket)
        self._sender = _Sender()

    def read(self, timeout: float) -> bytes:
        data = _received(self._socket, timeout)
        if data == b"":
            raise Lost("the other side closed the connection")
        return data or b""

    def write(self, data: bytes) -> None:
        self._sender.send(self._socket, data)

    def close(self) -> None:
        _shut(self._socket)


class _TcpListener:
    """Serves one TCP client at a time; the next is accepted when it has left."""

    def __init__(self, connection: Connection, timeout: float):
        del timeout
        self._listener = socket.create_server((connection.address, connection.number), backlog=1)
        self._listener.setblocking(False)
        self.port = self._listener.getsockname()[1]
        self._client: socket.socket | None = None
        self._sender = _Sender()

    def read(self, timeout: float) -> bytes:
        if self._client is None:
            if not _readable(self._listener, timeout):
                return b""
            with suppress(BlockingIOError, ConnectionAbortedError):
                self._client = self._listener.accept()[0]
                _prepare(self._client)
            return b""
        try:
            data = _received(self._client, timeout)
        except Lost:
            data = b""
        if data == b"":
            self._leave()
        return data or b""

    def write(self, data: bytes) -> None:
        if self._client is None:
            if self._listener.fileno() < 0:
                raise Lost("the connection is closed")
            return
        try:
            self._sender.send(self._client, data)
        except Lost:
            self._leave()

    def _leave(self) -> None:
        if self._client is not None:
            _shut(self._client)
        self._client, self._sender = None, _Sender()

    def close(self) -> None:
        self._leave()
        _shut(self._listener)


class Datagrams:
    """A UDP socket whose datagrams keep their bounds and their senders."""

    def __init__(self, connection: Connection):
        """Bind the address of `udpin`; that of `udpout` is `peer`.

        Raises:
            OSError: there is no such address, or it is in use.
        """
        found = socket.getaddrinfo(connection.address, connection.number, type=socket.SOCK_DGRAM)
        family, kind, protocol, _, address = found[0]
        self._socket = socket.socket(family, kind, protocol)
        self.peer: tuple | None = None
        try:
            if connection.kind == "udpin":
                self._socket.bind(address)
            else:
                self.peer = address
            self._socket.setblocking(False)
        except OSError:
            self._socket.close()
            raise
        self.port = self._socket.getsockname()[1] if connection.kind == "udpin" else 0

    def receive(self, timeout: float) -> list[tuple[bytes, tuple]]:
        """Datagrams that have arrived, with their senders; waits up to `timeout` (s) for the first.

        Raises:
            Lost: the socket is closed.
        """
        arrived: list[tuple[bytes, tuple]] = []
        if not _readable(self._socket, timeout):
            return arrived
        while len(arrived) < 64:  # let a flood not starve the caller
            try:
                arrived.append(self._socket.recvfrom(_CHUNK))
            except (BlockingIOError, ConnectionError):  # empty, or no one listens at the peer yet
                break
            except OSError as error:
                raise Lost(str(error)) from error
        return arrived

    def send(self, data: bytes, peer: tuple) -> None:
        """Send a datagram; what can't be sent at once is lost, as UDP packets may be.

        Raises:
            Lost: the socket is closed.
        """
        try:
            self._socket.sendto(data, peer)
        except (BlockingIOError, ConnectionError):
            return
        except OSError as error:  # without a route for the moment it is lost as well
            if self._socket.fileno() < 0:
                raise Lost(str(error)) from error

    def close(self) -> None:
        """Close; further calls raise `Lost`."""
        _shut(self._socket)


class _Udp:
    """UDP datagrams, to a fixed peer or to those that have been heard."""

    def __init__(self, connection: Connection, timeout: float):
        del timeout
        self._datagrams = Datagrams(connection)
        self._peers: dict[tuple, float] = {}
        self.port = self._datagrams.port

    def read(self, timeout: float) -> bytes:
        arrived = self._datagrams.receive(timeout)
        if self._datagrams.peer is None:
            now = time.monotonic()
            self._peers.update((peer, now) for _, peer in arrived)
        return b"".join(data for data, _ in arrived)

    def write(self, data: bytes) -> None:
        now = time.monotonic()
        fixed = self._datagrams.peer
        heard = [peer for peer, last in list(self._peers.items()) if now - last < _SILENT]
        for peer in heard if fixed is None else [fixed]:
            self._datagrams.send(data, peer)

    def close(self) -> None:
        self._datagrams.close()


class _Serial:
    """A serial line."""

    port = 0

    def __init__(self, connection: Connection, timeout: float):
        del timeout
        import serial

        address, baud = connection.address, connection.number
        self._line = serial.Serial(address, baud, timeout=0, write_timeout=_FULL_S)

    def read(self, timeout: float) -> bytes:
        try:
            if not _readable(self._line, timeout):
                return b""
            data = self._line.read(_CHUNK)
        except (OSError, TypeError) as error:  # pyserial: TypeError once it is closed
            raise Lost(str(error)) from error
        if not data:  # ready to read, and nothing there: the device is gone
            raise Lost("the device is gone")
        return data

    def write(self, data: bytes) -> None:
        try:
            self._line.write(data)
        except OSError as error:
            if type(error).__name__ == "SerialTimeoutException":
                return  # the line is full: the packet is lost
            raise Lost(str(error)) from error

    def close(self) -> None:
        with suppress(OSError):
            self._line.close()


def _prepare(channel: socket.socket) -> None:
    channel.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    channel.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _WAITING)
    channel.setblocking(False)


def _readable(channel, timeout: float) -> bool:
    """Whether there is something to read within `timeout` (s).

    Raises:
        Lost: the channel is closed.
    """
    try:
        return bool(select.select([channel], [], [], max(timeout, 0.0))[0])
    except (OSError, ValueError) as error:  # ValueError: its descriptor is -1
        raise Lost("the connection is closed") from error


def _received(channel: socket.socket, timeout: float) -> bytes | None:
    """Bytes, empty at the end of the stream, None if nothing came in time."""
    if not _readable(channel, timeout):
        return None
    try:
        return channel.recv(_CHUNK)
    except BlockingIOError:
        return None
    except OSError as error:
        raise Lost(str(error)) from error


class _Sender:
    """Sends whole packets: one that was sent in part is completed before the next."""

    def __init__(self):
        self._rest = b""

    def send(self, channel: socket.socket, data: bytes) -> None:
        """Send `data`, or drop it while the channel is full.

        Raises:
            Lost: the connection has ended.
        """
        try:
            if self._rest:
                self._rest = self._rest[channel.send(self._rest) :]
            if not self._rest:
                self._rest = data[channel.send(data) :]
        except BlockingIOError:
            return
        except OSError as error:
            raise Lost(str(error)) from error


def _shut(channel: socket.socket) -> None:
    with suppress(OSError):
        channel.shutdown(socket.SHUT_RDWR)
    channel.close()


_KINDS = {
    "tcp": _Tcp,
    "tcpin": _TcpListener,
    "udpin": _Udp,
    "udpout": _Udp,
    "serial": _Serial,
}
