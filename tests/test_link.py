"""The link's thread against a peer on loopback that speaks MAVLink packets."""

import io
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.systems.logs.packets import message_name, scan
from spinndrift.systems.mavlink.dialect import Message, Parser, mavlink
from spinndrift.systems.mavlink.link import Link, Peer
from spinndrift.systems.mavlink.transport import Connection, Lost, Transport

BOOTED = 40.0  # s on the vehicle's clock when the peer starts


class Vehicle:
    """A peer that sends an attitude at 50 Hz and a heartbeat at 5 Hz, and answers TIMESYNC."""

    def __init__(self, transport: Transport):
        self.transport, self.parser = transport, Parser(1, 1)
        self.heard: list[Message] = []
        self.silent = False
        self._start = time.monotonic()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def boot(self) -> float:
        return BOOTED + time.monotonic() - self._start

    def send(self, message: Message) -> None:
        self.transport.write(self.parser.packed(message))

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self.transport.close()

    def _run(self) -> None:
        k = 0
        while not self._ended.wait(0.02):
            k += 1
            try:
                for message in self.parser.messages(self.transport.read(0.0)):
                    self.heard.append(message)
                    if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                        now = int(self.boot * 1e9)
                        self.send(mavlink.MAVLink_timesync_message(now, message.ts1))
                if self.silent:
                    continue
                if k % 10 == 1:
                    self.send(mavlink.MAVLink_heartbeat_message(12, 3, 81, 19, 3, 3))
                ms = int(self.boot * 1e3)
                self.send(mavlink.MAVLink_attitude_message(ms, 0.1, 0, 0, 0, 0, k))
            except Lost:
                return


def within(seconds: float, true: Callable[[], bool]) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if true():
            return True
        time.sleep(0.01)
    return true()


@pytest.fixture(params=["tcp", "udp"])
def flying(request: pytest.FixtureRequest, tmp_path: Path):
    kind = request.param
    server = Connection.parse(f"{kind}in:127.0.0.1:0").open()
    vehicle = Vehicle(server)
    out = "udpout" if kind == "udp" else "tcp"
    with Link(
        Connection.parse(f"{out}:127.0.0.1:{server.port}"), record=tmp_path / "dive.tlog"
    ) as link:
        yield link, vehicle, tmp_path / "dive.tlog"
    vehicle.close()


def test_it_finds_the_vehicle_and_keeps_the_newest_messages(flying):
    link, vehicle, _ = flying
    assert link.find_vehicle(5.0) == Peer(1, 1)
    first = link.wait_for("ATTITUDE", 5.0)
    assert first is not None
    assert first.boot == pytest.approx(vehicle.boot, abs=0.3)
    later = link.wait_for("ATTITUDE", 5.0, lambda m: m.yawspeed > first.message.yawspeed + 20)
    assert later is not None
    assert link.age("ATTITUDE") < 0.5
    assert link.age("RAW_IMU") == float("inf")
    assert link.wait_for("RAW_IMU", 0.05) is None
    assert within(5.0, lambda: link.statistics().round_trip is not None)
    statistics = link.statistics()
    assert statistics.damaged == statistics.lost == 0
    assert statistics.rates["ATTITUDE"] > 5
    offset = link.clock.offset
    assert offset is not None
    assert link.clock.uncertainty is not None
    # the true offset, within half a round trip and the stamp's nanoseconds
    assert abs(vehicle._start - BOOTED - offset) <= link.clock.uncertainty + 1e-3
    heard = {m.get_type() for m in vehicle.heard}
    assert {"HEARTBEAT", "TIMESYNC"} <= heard


def test_the_telemetry_log_holds_both_directions(flying):
    link, vehicle, path = flying
    link.find_vehicle(5.0)
    assert link.wait_for("ATTITUDE", 5.0) is not None
    vehicle.silent = True
    link.send(mavlink.MAVLink_manual_control_message(1, 10, 20, 500, 0, 0))
    assert within(5.0, lambda: any(m.get_type() == "MANUAL_CONTROL" for m in vehicle.heard))
    link.close()
    found = scan(path.read_bytes())  # as an importer reads it
    senders = {
        (int(s), message_name(int(m))) for s, m in zip(found.system, found.message, strict=True)
    }
    assert {(1, "ATTITUDE"), (255, "MANUAL_CONTROL"), (255, "HEARTBEAT")} <= senders
    assert found.skipped == 0
    stamps = found.stamps(path.read_bytes())
    assert abs(stamps[-1] - time.time()) < 60
    assert np.all(np.diff(stamps) >= 0)


def test_losses_and_a_second_ground_station_show(flying):
    link, vehicle, _ = flying
    link.find_vehicle(5.0)
    vehicle.parser.packed(mavlink.MAVLink_heartbeat_message(12, 3, 81, 19, 3, 3))  # never sent
    assert within(5.0, lambda: link.statistics().lost == 1)
    assert link.others() == []
    other = Parser(255, 190)
    heartbeat = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    vehicle.transport.write(other.packed(heartbeat))
    assert within(5.0, lambda: link.others() == [Peer(255, 190)])


def test_silence_is_a_number(flying):
    link, vehicle, _ = flying
    link.find_vehicle(5.0)
    vehicle.silent = True
    assert within(5.0, lambda: link.age("ATTITUDE") > 0.4)


def test_it_connects_again_and_ends_its_thread():
    server = Connection.parse("tcpin:127.0.0.1:0").open()
    port, vehicle = server.port, Vehicle(server)
    before = threading.active_count()
    with Link(Connection.parse(f"tcp:127.0.0.1:{port}")) as link:
        link.find_vehicle(5.0)
        vehicle.close()
        assert within(5.0, lambda: not link.connected)
        assert not link.send(mavlink.MAVLink_manual_control_message(1, 0, 0, 500, 0, 0))
        vehicle = Vehicle(Connection.parse(f"tcpin:127.0.0.1:{port}").open())
        assert within(10.0, lambda: link.connected and link.age("ATTITUDE") < 0.5)
        assert link.statistics().reconnections >= 1  # one more if the closing listener answered
        assert link.statistics().lost == 0
        vehicle.close()
    assert threading.active_count() <= before


def test_without_a_vehicle_the_sentence_says_what_was_heard():
    server = Connection.parse("udpin:127.0.0.1:0").open()
    link = Link(Connection.parse(f"udpout:127.0.0.1:{server.port}"))
    with pytest.raises(UserError, match=r"no autopilot's heartbeat in 0\.2 s \(heard nothing\)"):
        link.find_vehicle(0.2)
    link.close()
    server.close()


def test_clocks_of_others_and_times_of_fixes_are_no_boot(flying):
    link, vehicle, _ = flying
    link.find_vehicle(5.0)
    other = Parser(1, 191)
    for _ in range(20):
        vehicle.send(mavlink.MAVLink_gps_raw_int_message(3_000_000, 1, 0, 0, 0, 0, 0, 0, 0, 0))
        since_1970 = mavlink.MAVLink_timesync_message(time.time_ns(), time.monotonic_ns())
        vehicle.transport.write(other.packed(since_1970))
        vehicle.send(mavlink.MAVLink_timesync_message(5_000_000_000, 17))  # not asked for
        time.sleep(0.03)
    assert link.wait_for("GPS_RAW_INT", 5.0, since=0.0) is not None
    assert link.statistics().reboots == 0
    assert within(5.0, lambda: link.statistics().round_trip is not None)
    local = link.clock.local(vehicle.boot)
    assert local == pytest.approx(time.monotonic(), abs=0.1)


def test_commands_go_on_where_the_record_cannot_be_written(flying):
    link, vehicle, path = flying
    link.find_vehicle(5.0)

    class Full(io.BytesIO):
        name = str(path)

        def write(self, data):
            raise OSError(28, "No space left on device")

    with link._sending:  # its thread writes too
        link._record.close()
        link._record = Full()
    count = len(vehicle.heard)
    assert link.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))
    assert within(5.0, lambda: len(vehicle.heard) > count + 3)  # its own heartbeats go on, too
    assert any("No space left" in text for _, _, text in link.texts())


def test_mutated_frames_raise_nothing():
    rng = np.random.default_rng(0)
    sender, receiver = Parser(1, 1), Parser(255, 190)
    kinds = [
        mavlink.MAVLink_heartbeat_message(12, 3, 81, 19, 3, 3),
        mavlink.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_statustext_message(4, b"Lost manual control"),
        mavlink.MAVLink_param_value_message(b"FS_PILOT_INPUT", 2.0, 9, 1300, 4),
        mavlink.MAVLink_timesync_message(1, 2),
    ]
    for _ in range(20_000):
        packet = bytearray(sender.packed(kinds[rng.integers(len(kinds))]))
        for _ in range(rng.integers(1, 4)):
            what, where = rng.integers(3), rng.integers(len(packet)) if packet else 0
            if what == 0 and packet:
                packet[where] = rng.integers(256)
            elif what == 1:
                del packet[where : where + rng.integers(1, 5)]
            else:
                packet[where:where] = rng.bytes(rng.integers(1, 5))
        for message in receiver.messages(bytes(packet)):
            assert message.get_type() in mavlink.mavlink_map[message.get_msgId()].msgname
    good = sender.packed(kinds[0])
    assert [m.get_type() for m in receiver.messages(good * 20)].count("HEARTBEAT") >= 10
