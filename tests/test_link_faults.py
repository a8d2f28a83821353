"""Faults of the link over real sockets, by scenario, and what our link makes of them."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from served_vehicle import LIMIT, Served

from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.sims.vehicle.link_faults import FaultyLink, LinkFaults, Packets
from spinndrift.sims.vehicle.plant import Plant
from spinndrift.systems.mavlink import commands
from spinndrift.systems.mavlink.clock import MICROSECONDS_32
from spinndrift.systems.mavlink.dialect import Parser, mavlink
from spinndrift.systems.mavlink.link import Link
from spinndrift.systems.mavlink.parameters import Parameters
from spinndrift.systems.mavlink.transport import Connection

pytestmark = pytest.mark.whole

KINDS = ["tcp", "udp"]
RATES = {"ATTITUDE_QUATERNION": 100.0, "SERVO_OUTPUT_RAW": 50.0, "RAW_IMU": 100.0}


@pytest.fixture(scope="module")
def plant() -> Plant:
    return Plant(load_scenario("station_keeping_calm").station)


@contextmanager
def linked(kind: str, plant: Plant, settings: str) -> Iterator[tuple[Link, Served]]:
    """A link to a vehicle that is served with these settings."""
    text = f"vehicle_server: {settings}"
    served = Served(f"{kind}in:127.0.0.1:0", text=text, plant=plant)
    way = "udpout" if kind == "udp" else "tcp"
    try:
        with Link(Connection.parse(f"{way}:127.0.0.1:{served.ports[0]}")) as link:
            link.find_vehicle(LIMIT)
            yield link, served
    finally:
        served.close()


def until(true: Callable[[], bool]) -> bool:
    end = time.monotonic() + LIMIT
    while time.monotonic() < end:
        if true():
            return True
        time.sleep(0.02)
    return true()


@pytest.mark.parametrize("kind", KINDS)
def test_commands_get_through_and_the_counts_say_what_was_lost(kind: str, plant: Plant):
    faults = "{loss: 0.1, corruption: 0.05, reordering: 0.1, delay: 0.03, jitter: 0.02}"
    with linked(kind, plant, f"{{faults: {faults}}}") as (link, served):
        assert not commands.request_rates(link, RATES)
        Parameters(link).write("FS_PILOT_INPUT", 1.0)
        assert served.simulation.vehicle.parameters["FS_PILOT_INPUT"] == 1.0
        assert until(lambda: link.statistics().received > 800)
        found = link.statistics()
        sent = found.received + found.lost
        # lost, and damaged beyond use: 0.1 + 0.9 * 0.05; four standard deviations of that share
        share = 0.145
        assert abs(found.lost / sent - share) < 4 * (share * (1 - share) / sent) ** 0.5
        assert found.damaged > 0
        assert found.reboots == found.reconnections == 0
        assert found.round_trip is not None
        commands.arm(link)
        commands.disarm(link)


@pytest.mark.parametrize("kind", ["tcp", pytest.param("udp", marks=pytest.mark.slow)])
def test_a_boot_in_mid_dive_begins_clock_counts_and_rates_anew(kind: str, plant: Plant):
    with linked(kind, plant, "{reboots: [6.0], clock: 2500.0}") as (link, served):
        assert not commands.request_rates(link, RATES)
        Parameters(link).write("JS_GAIN_DEFAULT", 0.75)
        commands.arm(link)
        before = link.wait_for("SERVO_OUTPUT_RAW", LIMIT)
        assert before is not None
        assert before.boot is not None
        assert before.boot > 2500.0
        assert until(lambda: link.statistics().reboots == 1)
        assert served.simulation.vehicle.boots == 2
        # it counts its packets from zero: the link must not take that for a loss
        assert until(lambda: link.statistics().rates.get("ATTITUDE_QUATERNION", 0.0) > 50.0)
        assert until(lambda: link.statistics().rates.get("SERVO_OUTPUT_RAW", 0.0) > 25.0)
        found = link.statistics()
        assert found.lost == found.damaged == 0
        after = link.wait_for("SERVO_OUTPUT_RAW", LIMIT)
        heartbeat = link.wait_for("HEARTBEAT", LIMIT)
        assert after is not None
        assert heartbeat is not None
        assert after.boot is not None
        assert after.boot < 60.0
        taken = link.clock.local(after.boot)
        assert taken is not None
        assert abs(taken - after.arrival) < 1.0
        assert not commands.is_armed(heartbeat.message)
        assert Parameters(link).read("JS_GAIN_DEFAULT") == 0.75
        assert link.statistics().reboots == 1


@pytest.mark.parametrize("kind", [KINDS[0], pytest.param(KINDS[1], marks=pytest.mark.slow)])
def test_a_clock_that_wraps_goes_on(kind: str, plant: Plant):
    start = MICROSECONDS_32 - 4.0
    with linked(kind, plant, f"{{clock: {start}}}") as (link, _):
        assert not commands.request_rates(link, RATES)
        seen: list[float] = []

        def take(received) -> None:
            if received.message.get_type() == "SERVO_OUTPUT_RAW":
                seen.append(received.boot)

        with link.reading(take):
            wrapped = link.wait_for("SERVO_OUTPUT_RAW", LIMIT, lambda m: m.time_usec < 1e6)
            assert wrapped is not None
        assert wrapped.boot is not None
        assert MICROSECONDS_32 <= wrapped.boot < MICROSECONDS_32 + 1.0
        assert seen == sorted(seen)
        assert link.statistics().reboots == 0


def test_packets_arrive_in_order_after_delay_and_jitter_on_the_vehicles_clock():
    link = FaultyLink(LinkFaults(delay=0.03, jitter=0.02), seed=0)
    sent = [k * 0.01 for k in range(500)]
    arrived: list[tuple[float, int]] = []
    for k, t in enumerate(sent):
        link.send(t, k.to_bytes(2))
        arrived += [(t, int.from_bytes(packet)) for packet in link.due(t)]
    assert [k for _, k in arrived] == list(range(len(arrived)))
    late = np.array([t - sent[k] for t, k in arrived])
    assert late.min() >= 0.03 - 1e-9
    assert late.max() <= 0.05 + 0.01  # seen every 10 ms
    assert late.std() > 0.003


@pytest.mark.parametrize("kind", KINDS)
def test_a_stream_is_split_into_packets_whatever_its_chunks(kind: str):
    sender = Parser(1, 1)
    messages = [
        mavlink.MAVLink_heartbeat_message(12, 3, 81, 19, 3, 3),
        mavlink.MAVLink_statustext_message(6, b"\xfd\xfe"),
    ]
    sent = [sender.packed(message) for message in messages * 10]
    noise = [b"x", b"\n"] if kind == "tcp" else []
    stream = b"".join([*noise, *sent])
    for size in (1, 2, 7, 100, len(stream)):
        packets = Packets()
        chunks = [stream[i : i + size] for i in range(0, len(stream), size)]
        found = [piece for chunk in chunks for piece in packets.split(chunk)]
        assert found == [*noise, *sent]
