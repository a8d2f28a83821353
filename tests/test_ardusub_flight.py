"""Scenarios flown on a real ArduSub in its own simulator; skipped without SPINNDRIFT_ARDUSUB.

A second client, at another port of the autopilot, watches the outputs. The estimate is the
autopilot's, from a simulated GPS. Bounded in time, on loopback, on free ports.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from ardusub_binary import BINARY, free_instance

from spinndrift.models.config.errors import UserError
from spinndrift.systems.mavlink import commands
from spinndrift.systems.mavlink.link import Link
from spinndrift.systems.mavlink.parameters import Parameters
from spinndrift.systems.mavlink.transport import Connection

pytestmark = pytest.mark.skipif(not BINARY, reason="SPINNDRIFT_ARDUSUB names no binary")
LIMIT = 120.0  # s of wall time for anything
STOPS = 2.5  # s until the thrusters are still: that of docs/field.md, and the streams' own time
PATIENT = "late: 5, plan_age: 10, lost: 5, silence: 5, stale: 5, stale_aid: 10, outputs: 10"
"""Guards that a loaded machine trips; those of the vehicle and of the place stay."""
_OFFSETS = {"X": 5, "Y": 13, "Z": -18}
PARAMETERS = {
    "FRAME_CONFIG": 2,
    "FS_PILOT_INPUT": 2,
    "FS_GCS_ENABLE": 2,
    "BATT_MONITOR": 4,
    "SIM_BATT_VOLTAGE": 16,
    **{f"INS_ACC{n}OFFS_{axis}": 0.001 for n in ("", 2) for axis in "XYZ"},
    **{f"INS_ACC{n}SCAL_{axis}": 1.001 for n in ("", 2) for axis in "XYZ"},
    **{f"COMPASS_OFS{n}_{axis}": v for n in ("", 2, 3) for axis, v in _OFFSETS.items()},
}
"""Calibrations are those of the simulated sensors (ArduPilot's own tests), the rest a Heavy's."""


@contextmanager
def autopilot(folder: Path) -> Iterator[int]:
    """A served ArduSub that has a position; its instance."""
    instance = free_instance()
    (folder / "sub.parm").write_text("".join(f"{k} {v}\n" for k, v in PARAMETERS.items()))
    command = [BINARY, "--model", "vectored_6dof", "--speedup", "1", "-I", str(instance)]
    command += ["--home", "51.48,0,0,0", "--defaults", "sub.parm"]
    with (folder / "ardusub.log").open("w") as log:
        process = subprocess.Popen(command, cwd=folder, stdout=log, stderr=log)
    try:
        with linked(instance, 0) as link:  # it boots when its first port is connected
            commands.request_rates(link, {"LOCAL_POSITION_NED": 5.0})
            assert link.wait_for("LOCAL_POSITION_NED", LIMIT) is not None
        yield instance
    finally:
        process.kill()
        process.wait()


@contextmanager
def linked(instance: int, port: int, system: int = 250) -> Iterator[Link]:
    """A client at one of the autopilot's ports."""
    connection = Connection.parse(f"tcp:127.0.0.1:{5760 + 10 * instance + port}")
    end = time.monotonic() + 10.0
    while True:
        try:
            link = Link(connection, system=system)
            break
        except UserError:
            assert time.monotonic() < end, "it does not listen"
            time.sleep(0.1)
    with link:
        link.find_vehicle(LIMIT)
        yield link


@pytest.fixture(scope="module")
def instance(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    with autopilot(tmp_path_factory.mktemp("ardusub")) as instance:
        yield instance


@contextmanager
def flight(instance: int, folder: Path, actuation: str, goal: bool) -> Iterator[subprocess.Popen]:
    """`spinndrift run` in a process of its own; without a `goal` it goes on for 40 s."""
    end = "" if goal else "duration: 40, success: !ReachGoal {radius: 0.01, near_radius: 0.02}, "
    safety = f"max_depth: 8.0, fence: [9.0, 8.0], end: disarm, {PATIENT}"
    link = (
        f'!Mavlink {{connection: "tcp:127.0.0.1:{5760 + 10 * instance}", actuation: {actuation}, '
        f"estimate: autopilot, safety: {{{safety}}}}}"
    )
    text = f"{{{end}station: {{sensing: {{dvl: null}}}}, vehicle_link: {link}}}"
    command = [sys.executable, "-m", "spinndrift", "run", "pylon_crossing_vehicle", "--arm"]
    command += ["--scenario-text", text, "--out", str(folder / "flight")]
    surroundings = os.environ | {"XDG_STATE_HOME": str(folder)}
    surroundings.pop("XLA_FLAGS", None)  # those of the tests compile fast, for a slow planner
    with (folder / "run.txt").open("w") as log:
        process = subprocess.Popen(command, env=surroundings, stdout=log, stderr=log)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def outputs(link: Link) -> list[int]:
    found = link.latest("SERVO_OUTPUT_RAW")
    assert found is not None
    return [getattr(found.message, f"servo{n}_raw") for n in range(1, 9)]


def until(true: Callable[[], bool], limit: float) -> float:
    """Time until it is true (s)."""
    started = time.monotonic()
    while not true():
        assert time.monotonic() < started + limit
        time.sleep(0.02)
    return time.monotonic() - started


def is_armed(link: Link) -> bool:
    found = link.latest("HEARTBEAT")
    return found is not None and commands.is_armed(found.message)


def as_it_was(link: Link) -> bool:
    parameters = Parameters(link)
    functions = [parameters.read(f"SERVO{n}_FUNCTION") for n in range(1, 9)]
    return functions == [*range(33, 41)] and parameters.read("FS_PILOT_TIMEOUT") == 3


@pytest.mark.parametrize("actuation", ["manual_control", "rc_override", "thruster_passthrough"])
def test_the_pylon_crossing_reaches_its_goal(instance: int, actuation: str, tmp_path: Path):
    with flight(instance, tmp_path, actuation, goal=True) as process:
        assert process.wait(LIMIT) == 0
    assert "reached the goal" in (tmp_path / "run.txt").read_text()
    with linked(instance, 2) as link:
        assert not is_armed(link)
        assert as_it_was(link)


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("actuation", ["manual_control", "thruster_passthrough"])
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL, signal.SIGSTOP])
def test_however_it_ends_the_thrusters_stop(
    instance: int, actuation: str, end: signal.Signals, tmp_path: Path
):
    with linked(instance, 2) as link:
        commands.request_rates(link, {"SERVO_OUTPUT_RAW": 50.0, "HEARTBEAT": 10.0})
        with flight(instance, tmp_path, actuation, goal=False) as process:
            until(lambda: is_armed(link) and max(outputs(link)) > 1540, LIMIT)
            time.sleep(2.0)
            process.send_signal(end)
            still = until(lambda: all(abs(v - 1500) <= 1 for v in outputs(link)), 10.0)
            assert still < STOPS
            until(lambda: not is_armed(link), 5.0)
            until(lambda: as_it_was(link), 5.0)
            assert all(abs(v - 1500) <= 1 for v in outputs(link))
