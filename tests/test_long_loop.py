"""A long dive's loop leaks neither memory nor threads nor files: link, sockets, served vehicle.

The vehicle's time is stepped as fast as it goes, a command and a look at all telemetry for each
20 ms of it; the link has its own thread and real sockets. `make slow` flies an hour.
"""

import gc
import os
import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.sims.vehicle.server import Server, open_all
from spinndrift.sims.vehicle.simulation import Simulation
from spinndrift.systems.mavlink import telemetry
from spinndrift.systems.mavlink.dialect import mavlink
from spinndrift.systems.mavlink.link import Link
from spinndrift.systems.mavlink.transport import Connection

PERIOD = 0.02  # s of the vehicle's time
MEGABYTES = 10.0  # that an hour may take: a day takes less than a small computer has to spare
FEW = 100  # messages: the newest of each kind, and those on their way


class Used(NamedTuple):
    """What this process holds."""

    threads: int
    files: int
    messages: int
    megabytes: float


def used() -> Used:
    gc.collect()
    resident = int(Path("/proc/self/statm").read_text().split()[1])
    return Used(
        threading.active_count(),
        len(os.listdir("/proc/self/fd")),
        sum(isinstance(each, mavlink.MAVLink_message) for each in gc.get_objects()),
        resident * os.sysconf("SC_PAGE_SIZE") / 1e6,
    )


def looped(seconds: float, samples: int) -> list[Used]:
    """Fly for so long; what was in use at equal times in the later three quarters."""
    transports = open_all(["udpin:127.0.0.1:0"])
    scenario = load_scenario("station_keeping_calm")
    server = Server(Simulation(scenario, 1, record=False), transports)
    found: list[Used] = []
    turns = round(seconds / PERIOD)
    looks = np.linspace(turns / 4, turns - 1, samples).astype(int)
    with Link(Connection.parse(f"udpout:127.0.0.1:{transports[0].port}")) as link:
        for turn in range(turns):
            server.advance(PERIOD)
            link.send(mavlink.MAVLink_manual_control_message(1, turn % 200, 0, 500, 0, 0))
            for read in (telemetry.attitude, telemetry.imu, telemetry.position, telemetry.battery):
                read(link)
            telemetry.status(link, time.monotonic())
            link.statistics()
            time.sleep(0.0)  # the link's thread has its turn
            if turn in looks:
                found.append(used())
        assert link.statistics().received > 10 * seconds
    server.close()
    return found


@pytest.mark.slow
def test_ten_seconds_hold_what_their_beginning_held():
    before = used()
    found = looped(10.0, 2)
    assert {each[:2] for each in found} == {(before.threads + 1, before.files + 2)}
    assert max(each.messages for each in found) < FEW
    assert used()[:2] == before[:2]


@pytest.mark.slow
def test_an_hour_leaks_nothing():
    found = looped(float(os.environ.get("SPINNDRIFT_LOOP", "3600")), 12)
    assert len({each[:2] for each in found}) == 1
    assert max(each.messages for each in found) < FEW
    hours = np.linspace(0.25, 1.0, len(found))
    grown = np.polyfit(hours, [each.megabytes for each in found], 1)[0]
    assert grown < MEGABYTES, found
