"""Streams of DVLs: Water Linked's JSON lines and Nortek's packets."""

import json
import math
import struct
import threading
import time

import numpy as np
import pytest

from spinndrift.systems.dvl.config import NucleusDvl
from spinndrift.systems.dvl.nucleus import Nucleus, checksum
from spinndrift.systems.dvl.reading import DvlReading
from spinndrift.systems.dvl.stream import DvlStream
from spinndrift.systems.dvl.water_linked import WaterLinked
from spinndrift.systems.mavlink.transport import Connection

SEEN = 1_700_000_000.25  # s since 1970


def report(**changes) -> bytes:
    """A velocity report as an A50 with software 2.4 sends it."""
    fields = {
        "time": 120.5,
        "vx": 0.41,
        "vy": -0.07,
        "vz": 0.02,
        "fom": 0.004,
        "covariance": [[1e-5, 0, 0], [0, 1e-5, 0], [0, 0, 1e-6]],
        "altitude": 2.35,
        "transducers": [{"id": 0, "velocity": 0.2, "distance": 2.6, "beam_valid": True}],
        "velocity_valid": True,
        "status": 0,
        "format": "json_v3.1",
        "type": "velocity",
        "time_of_validity": round(SEEN * 1e6),
        "time_of_transmission": round((SEEN + 0.132) * 1e6),
    }
    fields.update(changes)
    return json.dumps({k: v for k, v in fields.items() if v is not None}).encode() + b"\r\n"


def bottom_track(
    velocity=(0.41, -0.07, 0.02), status: int = 0x7FFF, distances=(2.2, 2.4, 2.6), merit=0.003
) -> bytes:
    """A bottom-track packet: the header, then 128 bytes of data."""
    data = bytearray(128)
    seconds = int(SEEN)
    struct.pack_into("<BBBBIII", data, 0, 1, 128, 1, 0, seconds, 250_000, status)
    struct.pack_into("<3f", data, 48, *distances)
    struct.pack_into("<3f", data, 96, *velocity)
    struct.pack_into("<3f", data, 108, merit, merit, merit)
    struct.pack_into("<2f", data, 120, 0.0, 0.05)  # velocity half a ping after the trigger
    return packet(0xB4, bytes(data))


def packet(number: int, data: bytes) -> bytes:
    head = struct.pack("<BBBBHH", 0xA5, 10, number, 0x20, len(data), checksum(data))
    return head + struct.pack("<H", checksum(head)) + data


def test_checksum_by_hand():
    assert checksum(b"") == 0xB58C
    assert checksum(b"\x01\x02") == 0xB58C + 0x0201
    assert checksum(b"\x01\x02\x03") == 0xB58C + 0x0201 + 0x0300
    assert checksum(b"\xff\xff" * 3) == (0xB58C + 3 * 0xFFFF) & 0xFFFF


def in_pieces(decoder, data: bytes, size: int) -> list[DvlReading]:
    return [r for k in range(0, len(data), size) for r in decoder.readings(data[k : k + size])]


@pytest.mark.parametrize("size", [1, 7, 100, 10_000])
def test_a_water_linked_report(size: int):
    decoder = WaterLinked()
    found = in_pieces(decoder, report() + report(velocity_valid=False), size)
    good, bad = found
    np.testing.assert_allclose(good.velocity, [0.41, -0.07, 0.02])
    assert (good.valid, good.altitude, good.figure_of_merit) == (True, 2.35, 0.004)
    assert good.stamp == pytest.approx(SEEN)
    assert good.latency == pytest.approx(0.132)
    assert not bad.valid
    assert np.all(bad.velocity == 0)
    assert decoder.damaged == 0


def test_reports_that_are_no_velocity_over_the_bed_are_skipped():
    others = b"".join(
        [
            json.dumps({"type": "position_local", "x": 1.0, "ts": 3.0}).encode() + b"\n",
            json.dumps({"response_to": "get_config", "type": "response"}).encode() + b"\n",
            report(type="velocity_water"),
            report(tracking_mode="water"),
            b"\n[]\n",
        ]
    )
    decoder = WaterLinked()
    assert list(decoder.readings(others)) == []
    assert decoder.damaged == 0


def test_an_old_report_has_no_times():
    old = report(time_of_validity=None, time_of_transmission=None, format="json_v2")
    (found,) = WaterLinked().readings(old)
    assert math.isnan(found.stamp)
    assert found.latency is None


@pytest.mark.parametrize("size", [1, 13, 10_000])
def test_a_nucleus_packet_among_text_and_other_packets(size: int):
    decoder = Nucleus()
    data = b"OK\r\n" + packet(0x82, b"\x01" * 40) + bottom_track() + b"\xa5OK\r\n"
    data += bottom_track(status=0x7FFF & ~(1 << 10))  # y is not valid
    good, bad = in_pieces(decoder, data, size)
    np.testing.assert_allclose(good.velocity, [0.41, -0.07, 0.02], atol=1e-7)
    assert good.valid
    assert good.altitude == pytest.approx(2.4)
    assert good.figure_of_merit == pytest.approx(0.003)
    assert good.stamp == pytest.approx(SEEN + 0.05)
    assert not bad.valid
    assert decoder.damaged == 0


@pytest.mark.parametrize("kind", [WaterLinked, Nucleus])
def test_damaged_streams_raise_nothing_and_recover(kind):
    make = report if kind is WaterLinked else bottom_track
    rng, decoder = np.random.default_rng(0), kind()
    for _ in range(3000):
        data = bytearray(make())
        for _ in range(rng.integers(1, 5)):
            where, what = rng.integers(len(data)), rng.integers(3)
            if what == 0:
                data[where] = rng.integers(256)
            elif what == 1:
                del data[where : where + rng.integers(1, 9)]
            else:
                data[where:where] = rng.bytes(rng.integers(1, 9))
        for found in decoder.readings(bytes(data)):
            assert np.isfinite(found.velocity).all()
    assert decoder.damaged > 0
    assert len(list(decoder.readings(b"\n" + make() * 60))) >= 10


def hello(transport):
    transport.write(b"hello\n")


@pytest.mark.parametrize("asks", [True, False], ids=["password", "none"])
def test_a_nucleus_is_logged_in_before_it_is_started(asks):
    server = Connection.parse("tcpin:127.0.0.1:0").open()
    heard: list[bytes] = []

    def instrument():
        words = b""
        server.read(5.0)  # accepts
        if asks:
            server.write(b"Please enter password:\r\n")
        while not words.endswith(b"START\r\n") and len(words) < 50:
            words += server.read(1.0)
            if asks and words == b"secret\r\n":
                server.write(b"Welcome to Nortek Nucleus\r\n")
        heard.append(words)
        server.write(bottom_track())

    thread = threading.Thread(target=instrument, daemon=True)
    thread.start()
    stream = NucleusDvl(f"tcp:127.0.0.1:{server.port}", "secret").open()
    assert _until(lambda: stream.newest is not None)
    thread.join(5.0)
    assert heard == [b"secret\r\nSTART\r\n" if asks else b"START\r\n"]
    stream.close()
    server.close()


def test_a_stream_gives_the_time_of_validity_and_connects_again():
    server = Connection.parse("tcpin:127.0.0.1:0").open()
    port = server.port
    stream = DvlStream(Connection.parse(f"tcp:127.0.0.1:{port}"), WaterLinked(), hello)
    assert stream.newest is None
    heard = b""
    end = time.monotonic() + 5
    while b"hello" not in heard and time.monotonic() < end:
        heard += server.read(0.05)
    assert heard == b"hello\n"
    before = time.monotonic()
    server.write(report())
    assert _until(lambda: stream.newest is not None)
    newest = stream.newest
    assert newest is not None
    assert newest.arrival >= before
    assert newest.arrival - newest.validity == pytest.approx(0.132)
    server.close()
    server = Connection.parse(f"tcpin:127.0.0.1:{port}").open()
    assert _until(lambda: server.read(0.05) == b"hello\n")
    assert stream.reconnections >= 1  # a closing listener may still accept one
    server.write(report(vx=0.5))
    assert _until(lambda: (now := stream.newest) is not None and now.reading.velocity[0] == 0.5)
    assert stream.age() < 1.0
    stream.close()
    server.close()


def _until(true, seconds: float = 10.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if true():
            return True
        time.sleep(0.01)
    return False
