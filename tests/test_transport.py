"""Byte streams on loopback, and MAVLink packets in them."""

import os
import pty
import re
import socket
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.systems.mavlink.dialect import Parser, mavlink
from spinndrift.systems.mavlink.transport import Connection, Lost, Transport


def heartbeat() -> mavlink.MAVLink_message:
    return mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)


def read_until(transport: Transport, size: int, seconds: float = 5.0) -> bytes:
    data, end = b"", time.monotonic() + seconds
    while len(data) < size and time.monotonic() < end:
        data += transport.read(0.05)
    return data


def lost(transport: Transport) -> bool:
    try:
        for _ in range(100):
            transport.read(0.05)
    except Lost:
        return True
    return False


def pair(kind: str) -> tuple[Transport, Transport]:
    """A listening side and a connected one."""
    server = Connection.parse(f"{kind}in:127.0.0.1:0").open()
    client = Connection.parse(
        f"{'udpout' if kind == 'udp' else kind}:127.0.0.1:{server.port}"
    ).open()
    return server, client


@pytest.mark.parametrize("kind", ["tcp", "udp"])
def test_both_sides_hear_each_other(kind: str):
    server, client = pair(kind)
    client.write(b"to the vehicle")
    assert read_until(server, 14) == b"to the vehicle"
    server.write(b"and back")
    assert read_until(client, 8) == b"and back"
    client.close()
    server.close()
    assert lost(client)
    assert lost(server)


def test_a_lost_peer_is_told_and_a_listener_takes_the_next_client():
    server, client = pair("tcp")
    server.read(1.0)  # accepts
    client.close()
    assert server.read(1.0) == b""
    again = Connection.parse(f"tcp:127.0.0.1:{server.port}").open()
    again.write(b"next")
    assert read_until(server, 4) == b"next"
    server.close()
    assert lost(again)
    again.close()


def test_udp_survives_a_peer_that_does_not_listen():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    client = Connection.parse(f"udpout:127.0.0.1:{port}").open()
    for _ in range(5):
        client.write(b"x")
        assert client.read(0.01) == b""
    client.close()


def test_packets_stay_whole_when_the_reader_is_slow():
    server, client = pair("tcp")
    server.read(1.0)
    sender, receiver = Parser(1, 1), Parser(255, 190)
    sent = 0
    for _ in range(30_000):  # more than the buffers hold
        server.write(sender.packed(mavlink.MAVLink_param_value_message(b"NAME", 1.0, 9, 9, 9)))
        sent += 1
    data = b"".join(iter(lambda: client.read(0.05), b""))
    server.write(sender.packed(heartbeat()))  # completes what was left in part
    data += b"".join(iter(lambda: client.read(0.05), b""))
    found = list(receiver.messages(data))
    assert receiver.damaged == 0
    assert 0 < len(found) < sent  # what did not fit was dropped …
    # … and the sequence numbers tell; a gap of more than half of them looks like a new beginning
    gaps = (np.diff([message.get_seq() for message in found]) - 1) % 256
    assert receiver.lost == gaps[gaps <= 127].sum()
    server.close()
    client.close()


def test_a_pseudo_terminal_is_a_serial_line():
    ours, theirs = pty.openpty()
    line = Connection.parse(f"serial:{os.ttyname(theirs)}:115200").open()
    line.write(b"ping\n")
    assert b"ping" in os.read(ours, 100)
    os.write(ours, b"pong\n")
    assert read_until(line, 4).startswith(b"pong")
    line.close()
    with pytest.raises(Lost):
        line.read(0.0)
    os.close(ours)
    os.close(theirs)


@pytest.mark.parametrize(
    "text",
    ["", "tcp", "tcp:host", "tcp::5760", "udp:1.2.3.4:1", "tcp:h:x", "tcp:h:70000", "udpout:h:0"],
)
def test_what_is_no_connection_is_refused(text: str):
    with pytest.raises(UserError, match=r"vehicle_link\.connection"):
        Connection.parse(text, "vehicle_link.connection")


def test_connections_are_written_as_they_are_read():
    for text in ("tcp:127.0.0.1:5760", "serial:/dev/ttyACM0:115200", "udpin:0.0.0.0:14550"):
        assert str(Connection.parse(text)) == text


def test_where_no_one_listens_is_one_sentence():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(UserError, match=f"tcp:127.0.0.1:{port}: Connection refused; check"):
        Connection.parse(f"tcp:127.0.0.1:{port}").open()
    with pytest.raises(UserError, match=r"serial:/dev/no_such:57600: .*check the device"):
        Connection.parse("serial:/dev/no_such:57600").open()


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
@pytest.mark.parametrize("host", ["192.0.2.1", "a..b"])  # of documentation; no name
def test_where_this_computer_can_t_listen_is_told_what_to_give(kind: str, host: str):
    words = f"{host} is no address of this computer; give {kind}:0.0.0.0:14550"
    with pytest.raises(UserError, match=re.escape(words)):
        Connection.parse(f"{kind}:{host}:14550").open()


def test_the_field_of_a_connection_is_named_once():
    for text, field in (
        ("connection: 10.0.0.1", "vehicle_link: Mavlink.connection: `10.0.0.1` is no"),
        (
            'connection: "udpin:0.0.0.0:14550", dvl: !WaterLinkedDvl {connection: x}',
            "vehicle_link.dvl: WaterLinkedDvl.connection: `x` is no",
        ),
    ):
        with pytest.raises(UserError, match=re.escape(f"--scenario-text: {field} connection")):
            load_scenario("station_keeping_calm", f"vehicle_link: !Mavlink {{{text}}}")


def test_close_from_another_thread_ends_a_read():
    server, client = pair("tcp")
    server.read(1.0)
    ended: list[float] = []

    def wait() -> None:
        try:
            while True:
                client.read(0.1)
        except Lost:
            ended.append(time.monotonic())

    reader = threading.Thread(target=wait)
    reader.start()
    client.close()
    reader.join(5.0)
    assert not reader.is_alive()
    assert ended
    server.close()


def counted(order: Callable[[list[bytes]], list[bytes]], n: int = 600) -> Parser:
    sender, receiver = Parser(1, 1), Parser(255, 190)
    packets = [sender.packed(heartbeat()) for _ in range(n)]
    list(receiver.messages(b"".join(order(packets))))
    return receiver


def test_losses_are_counted_by_sequence_numbers():
    assert counted(lambda p: p).lost == 0
    assert counted(lambda p: p[:100] + p[107:]).lost == 7
    assert counted(lambda p: [*p[:99], p[100], p[99], *p[101:]]).lost == 0  # late, not lost
    assert counted(lambda p: [*p[:100], p[99], *p[100:]]).lost == 0  # twice
    assert counted(lambda p: [*p[:100], p[90], *p[100:]]).lost == 0  # twice, and late
    assert counted(lambda p: [*p[:10], p[0], *p[10:]]).lost == 0
    assert counted(lambda p: p[:110] + p[:50]).lost == 0  # the sender began anew
    assert counted(lambda p: p[:60] + p[10:50]).lost == 0  # also a little before


def test_damaged_packets_are_skipped_and_the_next_are_read():
    sender, receiver = Parser(1, 1), Parser(255, 190)
    rng = np.random.default_rng(0)
    packets = [sender.packed(heartbeat()) for _ in range(200)]
    broken = [bytearray(packet) for packet in packets]
    for packet in broken[50:100]:
        packet[rng.integers(1, len(packet))] ^= 1 << rng.integers(8)
    data, found = b"".join(bytes(p) for p in broken), []
    for k in range(0, len(data), 7):  # in pieces
        found += receiver.messages(data[k : k + 7])
    assert {m.get_type() for m in found} == {"HEARTBEAT"}
    assert len(found) >= 148  # a wrong length may take a neighbour along
    assert receiver.damaged > 0


def test_a_serial_line_that_no_one_reads_holds_nothing_up():
    """Its buffer is full after some kilobytes; packets are lost then, as on a radio."""
    ours, theirs = pty.openpty()
    transport = Connection.parse(f"serial:{os.ttyname(theirs)}:115200").open()
    try:
        began = time.monotonic()
        for _ in range(40):
            transport.write(bytes(1000))
        assert time.monotonic() - began < 10.0
        assert os.read(ours, 100) == bytes(100)
    finally:
        transport.close()
        os.close(ours)
        os.close(theirs)
