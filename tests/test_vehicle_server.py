"""The server over sockets on loopback: real clients find a vehicle and command it."""

import os
import pty
import select
import socket
import time
from collections.abc import Callable, Iterator

import pytest
from served_vehicle import LIMIT, Served

from spinndrift.systems.mavlink.dialect import Message, Parser, mavlink
from spinndrift.systems.mavlink.link import Link
from spinndrift.systems.mavlink.transport import Connection, Transport

pytestmark = pytest.mark.whole


@pytest.fixture(scope="module")
def router() -> Iterator[Link]:
    """A link that waits for its vehicle."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with Link(Connection.parse(f"tcpin:127.0.0.1:{port}")) as link:
        yield link


@pytest.fixture(scope="module")
def line() -> Iterator[tuple[int, str]]:
    """A serial line: our end, and the name of the other."""
    ours, theirs = pty.openpty()
    yield ours, os.ttyname(theirs)
    os.close(ours)
    os.close(theirs)


@pytest.fixture(scope="module")
def served(router: Link, line: tuple[int, str]) -> Iterator[Served]:
    listening = ("tcpin:127.0.0.1:0", "udpin:127.0.0.1:0", "tcpin:127.0.0.1:0")
    router_port = router.connection.number
    served = Served(*listening, f"tcp:127.0.0.1:{router_port}", f"serial:{line[1]}:115200")
    yield served
    served.close()


def test_it_connects_to_a_router_that_listens(served: Served, router: Link):
    del served
    assert router.find_vehicle(LIMIT) == (1, 1)


def test_it_serves_a_serial_line(served: Served, line: tuple[int, str]):
    del served
    parser, heard, end = Parser(255, 190), set[str](), time.monotonic() + LIMIT
    while "HEARTBEAT" not in heard and time.monotonic() < end:
        if select.select([line[0]], [], [], 0.1)[0]:
            heard |= {m.get_type() for m in parser.messages(os.read(line[0], 4096))}
    assert "HEARTBEAT" in heard


class Client:
    """A ground station over a transport."""

    def __init__(self, transport: Transport):
        self.transport = transport
        self.parser = Parser(255, 190)
        self._beat = 0.0

    def send(self, message: Message) -> None:
        self.transport.write(self.parser.packed(message))

    def until(self, wanted: Callable[[Message], bool], say: Message | None = None) -> Message:
        """The first message that is wanted; heartbeats, and `say`, go out meanwhile."""
        end = time.monotonic() + LIMIT
        while time.monotonic() < end:
            if time.monotonic() - self._beat > 0.2:
                self._beat = time.monotonic()
                self.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))
                if say is not None:
                    self.send(say)
            for message in self.parser.messages(self.transport.read(0.05)):
                if wanted(message):
                    return message
        raise TimeoutError(f"nothing wanted within {LIMIT} s")

    def command(self, number: int, *params: float) -> int:
        filled = [*params, *[0.0] * 7][:7]
        command = mavlink.MAVLink_command_long_message(1, 1, number, 0, *filled)
        ack = self.until(lambda m: m.get_type() == "COMMAND_ACK", command)
        return ack.result  # pyright: ignore[reportAttributeAccessIssue]


def armed(message) -> bool:
    return message.get_type() == "HEARTBEAT" and bool(message.base_mode & 128)


def disarmed(message) -> bool:
    return message.get_type() == "HEARTBEAT" and not message.base_mode & 128


@pytest.mark.parametrize("kind", ["tcp", "udp"])
def test_a_client_arms_drives_and_disarms(served: Served, kind: str):
    port = served.ports[0 if kind == "tcp" else 1]
    name = "tcp" if kind == "tcp" else "udpout"
    transport = Connection.parse(f"{name}:127.0.0.1:{port}").open()
    client = Client(transport)
    try:
        client.until(lambda m: m.get_type() == "HEARTBEAT")
        assert client.command(511, 36, 50_000) == 0
        assert client.command(400, 1) == 0
        forward = mavlink.MAVLink_manual_control_message(1, 1000, 0, 500, 0, 0)
        client.until(armed, forward)

        def driven(m) -> bool:
            return m.get_type() == "SERVO_OUTPUT_RAW" and m.servo3_raw == 1700

        client.until(driven, forward)
        assert client.command(400, 0) == 0
        client.until(disarmed)

        def still(m) -> bool:
            return m.get_type() == "SERVO_OUTPUT_RAW" and m.servo3_raw == 1500

        client.until(still)
    finally:
        transport.close()


def test_a_second_tcp_client_waits_and_takes_over(served: Served):
    connection = Connection.parse(f"tcp:127.0.0.1:{served.ports[0]}")
    first, second = connection.open(), connection.open()
    try:
        Client(first).until(lambda m: m.get_type() == "HEARTBEAT")
        assert second.read(1.5) == b""
        first.close()
        Client(second).until(lambda m: m.get_type() == "HEARTBEAT")
    finally:
        first.close()
        second.close()
