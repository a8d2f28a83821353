"""The driver against the simulated vehicle behind its MAVLink server."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
from served_vehicle import Served

from spinndrift.models.config.errors import UserError
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.vehicle.telemetry import messages
from spinndrift.systems.mavlink import commands, guard_process, telemetry
from spinndrift.systems.mavlink.config import Mavlink
from spinndrift.systems.mavlink.driver import Acted, Driver
from spinndrift.systems.mavlink.link import Link
from spinndrift.systems.mavlink.parameters import Borrowed, Parameters, borrowed_file
from spinndrift.systems.mavlink.transport import Connection

pytestmark = pytest.mark.whole

WAYS = ("manual_control", "rc_override", "thruster_passthrough")
WRENCHES = np.diag([20.0, 20.0, 20.0, 2.0, 2.0, 4.0])
HERE = np.array([0.0, 0.0, -1.5])


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    served = Served("tcpin:127.0.0.1:0")
    yield served
    served.close()


@pytest.fixture
def port(served: Served) -> int:
    return served.ports[0]


@pytest.fixture(autouse=True)
def _state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


def connect(port: int, **settings) -> Driver:
    config = Mavlink(f"tcp:127.0.0.1:{port}", **settings)
    return Driver(config, load_vehicle("bluerov2_heavy").thrusters())


def fly(driver: Driver, F: np.ndarray, seconds: float, **more) -> Acted:
    end, acted, start = time.monotonic() + seconds, None, time.monotonic()
    while acted is None or time.monotonic() < end:
        acted = driver.act(time.monotonic() - start, F, HERE, **more)
        time.sleep(0.02)
    return acted


def until(true: Callable[[], bool], seconds: float = 10.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if true():
            return True
        time.sleep(0.02)
    return False


def pilot_disarms(port: int) -> None:
    """What a pilot does who has been left an armed vehicle."""
    with Link(Connection.parse(f"tcp:127.0.0.1:{port}")) as link:
        link.find_vehicle(15.0)
        commands.disarm(link)
        commands.set_mode(link, "MANUAL")


@pytest.mark.parametrize(
    "way", [WAYS[0], *(pytest.param(way, marks=pytest.mark.slow) for way in WAYS[1:])]
)
def test_every_axis_gets_the_outputs_that_are_foreseen(port: int, way):
    with connect(port, actuation=way) as driver:
        assert until(lambda: all(found.passed for found in driver.preflight()), 30.0)
        driver.prepare()
        fly(driver, np.zeros(6), 1.0)  # the verticals spool up for half a second
        for F in WRENCHES:
            acted = fly(driver, F, 0.7)
            assert (acted.order, acted.reason) == ("fly", "")
            np.testing.assert_allclose(acted.F_Bo_B, F, atol=1e-9)
            shown = driver.sense().outputs
            assert shown is not None
            np.testing.assert_allclose(shown.value, acted.expected, atol=4.0)
            assert np.abs(acted.expected - 1500).max() > 50
    check_at_rest(port)


def check_at_rest(port: int, rounding: float = 0.0) -> None:
    """Disarmed, neutral (but for `rounding`, µs), with the motors' functions."""
    with Link(Connection.parse(f"tcp:127.0.0.1:{port}")) as link:
        link.find_vehicle(15.0)
        parameters = Parameters(link)
        for n in range(1, 9):
            assert parameters.read(f"SERVO{n}_FUNCTION") == 32 + n
        assert parameters.read("FS_PILOT_TIMEOUT") == 3.0
        assert link.wait_for("SERVO_OUTPUT_RAW", 5.0) is not None
        shown = telemetry.outputs(link, 8)
        assert shown is not None
        np.testing.assert_allclose(shown.value, 1500.0, rtol=0, atol=rounding)
        status = telemetry.status(link, time.monotonic())
        assert status is not None
        assert not status.armed


def test_readings_are_those_of_the_vehicle(served: Served):
    with connect(served.ports[0]) as driver:
        assert until(lambda: None not in (s := driver.sense())[:4] and s.outputs is not None)
        sensed, (X_WB, _) = driver.sense(), served.simulation.plant.truth()
        assert sensed.imu is not None
        assert sensed.depth is not None
        assert sensed.attitude is not None
        assert sensed.imu.value[2] > 8.0  # specific force at rest points up
        assert 0 < time.monotonic() - sensed.imu.taken < 2.0
        assert sensed.depth.value[0] == pytest.approx(-X_WB[6], abs=0.5)
        assert abs(sensed.attitude.value @ X_WB[:4]) > 0.99
        assert 12 < sensed.voltage < 17


def test_a_vehicle_that_booted_anew_is_read_again_before_a_flight(served: Served):
    vehicle = served.simulation.vehicle
    with connect(served.ports[0]) as driver:
        assert vehicle.parameters.set("JS_GAIN_DEFAULT", 0.75)
        assert until(lambda: vehicle.autopilot.t > 8.0, 60.0)  # a clock that runs back shows it
        vehicle.reboot()
        assert until(lambda: driver.link.statistics().reboots == 1, 30.0)
        found = {finding.name: finding for finding in driver.preflight()}
        assert driver.parameters["JS_GAIN_DEFAULT"] == 0.75
        assert found  # its streams came back unasked: nothing here waits for ever
        assert until(
            lambda: driver.link.statistics().rates.get("ATTITUDE_QUATERNION", 0) > 15, 30.0
        )
    assert vehicle.parameters.set("JS_GAIN_DEFAULT", 0.5)


def test_a_dry_run_commands_nothing(port: int):
    with connect(port, actuation="rc_override") as driver:
        driver._dry = True
        driver.prepare()
        acted = fly(driver, WRENCHES[0], 0.5)
        assert acted.order == "fly"
        shown = driver.sense().outputs
        assert shown is not None
        np.testing.assert_array_equal(shown.value, 1500.0)
    check_at_rest(port)


def test_a_guard_holds_depth_with_neutral_sticks(port: int):
    with connect(port) as driver:
        driver.prepare()
        fly(driver, WRENCHES[0], 1.0)
        acted = fly(driver, WRENCHES[0], 2.0, ages={"plan": 9.0})
        assert acted.order == "hold_depth"
        assert "planner" in acted.reason
        status = telemetry.status(driver.link, time.monotonic())
        assert status is not None
        assert (status.mode, status.armed) == ("ALT_HOLD", True)
        shown = driver.sense().outputs
        assert shown is not None
        np.testing.assert_allclose(shown.value[:2], 1500.0, atol=60)  # no more surge
    check_at_rest(port)


@pytest.mark.parametrize(
    "way", [pytest.param("manual_control", marks=pytest.mark.slow), "thruster_passthrough"]
)
def test_directions_are_the_vehicles_and_outputs_are_told_with_the_scenarios(port: int, way):
    thrusters, F = load_vehicle("bluerov2_heavy").thrusters(), WRENCHES[0]
    with Link(Connection.parse(f"tcp:127.0.0.1:{port}")) as link:
        link.find_vehicle(15.0)
        parameters = Parameters(link)
        parameters.write("MOT_3_DIRECTION", -1.0)
        parameters.write("JS_THR_GAIN", 0.8)
    try:
        with connect(port, actuation=way) as driver:
            driver.prepare()
            fly(driver, np.zeros(6), 1.0)
            acted = fly(driver, F + WRENCHES[2] / 2, 0.7)
            shown = driver.sense().outputs
            assert shown is not None
            np.testing.assert_allclose(shown.value, acted.expected, atol=4.0)
            told, volts = driver.as_described(acted.expected), driver.sense().voltage
        given = thrusters.wrench(thrusters.force(jnp.asarray(told), volts))
        np.testing.assert_allclose(given, F + WRENCHES[2] / 2, atol=1.0)
        mirrored = np.flatnonzero(told != acted.expected)
        assert mirrored.tolist() == [2]
    finally:
        with Link(Connection.parse(f"tcp:127.0.0.1:{port}")) as link:
            link.find_vehicle(15.0)
            parameters = Parameters(link)
            parameters.write("MOT_3_DIRECTION", 1.0)
            parameters.write("JS_THR_GAIN", 1.0)
    check_at_rest(port, rounding=1.0)  # outputs are cut to whole µs: a mirrored zero may be 1499


def test_a_pilot_s_station_is_obeyed_again_after_the_dive(served: Served, port: int):
    values = served.simulation.vehicle.parameters
    assert values["SYSID_MYGCS"] == 255
    with connect(port, system=254) as driver:
        assert until(lambda: all(found.passed for found in driver.preflight()), 30.0)
        driver.prepare()
        assert values["SYSID_MYGCS"] == 254
        fly(driver, np.zeros(6), 1.0)
        acted = fly(driver, WRENCHES[0], 0.7)
        shown = driver.sense().outputs
        assert shown is not None
        np.testing.assert_allclose(shown.value, acted.expected, atol=4.0)
        driver._ask(176, 1.0, 0.0)  # another station changes the mode
        assert fly(driver, WRENCHES[0], 1.0).order == "yield"
    assert values["SYSID_MYGCS"] == 255
    assert values["FS_PILOT_TIMEOUT"] == 3.0
    pilot_disarms(port)


def test_a_depth_sensor_that_fails_ends_the_dive(served: Served, port: int, monkeypatch):
    with connect(port) as driver:
        driver.prepare()
        assert fly(driver, np.zeros(6), 0.5).order == "fly"
        monkeypatch.setattr(messages, "_SENSORS_HEALTHY", messages._SENSORS_HEALTHY & ~8)
        monkeypatch.setattr(messages, "_SENSORS_ALIGNED", messages._SENSORS_ALIGNED & ~8)
        acted = fly(driver, np.zeros(6), 2.0)
        assert "depth sensor is not healthy" in acted.reason


def test_a_pilot_who_changes_the_mode_is_left_alone(port: int):
    with connect(port) as driver:
        driver.prepare()
        fly(driver, WRENCHES[0], 0.5)
        driver._ask(176, 1.0, 0.0)  # DO_SET_MODE STABILIZE, as another station would
        acted = fly(driver, WRENCHES[0], 2.0)
        assert acted.order == "yield"
        assert "STABILIZE" in acted.reason
    pilot_disarms(port)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ((176, 1.0, 2.0), "the mode was changed to ALT_HOLD meanwhile"),
        pytest.param(
            (400, 1.0, 2989.0),
            "somebody else has armed the vehicle meanwhile",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_vehicle_that_a_pilot_takes_before_arming_is_left_alone(
    served: Served, port: int, monkeypatch: pytest.MonkeyPatch, command, words: str
):
    autopilot = served.simulation.vehicle.autopilot
    with connect(port) as driver:
        borrow = driver._borrowed.borrow

        def taken(*given) -> None:
            borrow(*given)
            before = autopilot.mode, autopilot.armed
            driver._ask(*command)
            assert until(lambda: (autopilot.mode, autopilot.armed) != before)
            assert until(lambda: (s := driver._seen()).armed or s.mode != "MANUAL")

        monkeypatch.setattr(driver._borrowed, "borrow", taken)
        with pytest.raises(commands.VehicleRefused, match=words):
            driver.prepare()
    assert autopilot.armed == (command[0] == 400)
    assert served.simulation.vehicle.parameters["FS_PILOT_TIMEOUT"] == 3.0, "given back"
    pilot_disarms(port)


@pytest.mark.slow
def test_a_vehicle_that_boots_before_arming_is_not_armed(
    served: Served, port: int, monkeypatch: pytest.MonkeyPatch
):
    """It has lost its mode, its rates and what it knew of its own state."""
    with connect(port) as driver:
        borrow = driver._borrowed.borrow

        def booting(*given) -> None:
            borrow(*given)
            driver._ask(246, 1.0)
            assert until(lambda: driver.link.clock.reboots > 0)
            commands.set_mode(driver.link, "MANUAL")

        monkeypatch.setattr(driver._borrowed, "borrow", booting)
        with pytest.raises(commands.VehicleRefused, match="booted anew since its checks"):
            driver.prepare()
    assert not served.simulation.vehicle.autopilot.armed
    assert served.simulation.vehicle.parameters["FS_PILOT_TIMEOUT"] == 3.0, "given back"
    with connect(port) as driver:
        assert until(lambda: all(found.passed for found in driver.preflight()), 30.0)
        driver.prepare()
        assert fly(driver, WRENCHES[0], 0.5).order == "fly"
    check_at_rest(port)


@pytest.mark.slow
def test_an_armed_vehicle_keeps_what_a_former_run_has_left(served: Served, port: int):
    """Its thrusters run: nobody changes what their outputs do."""
    with Link(Connection.parse(f"tcp:127.0.0.1:{port}")) as link:
        number = commands.identity(link).serial_number
        file = borrowed_file(Connection.parse(f"tcp:127.0.0.1:{port}"), number)
        Borrowed(Parameters(link), file).borrow({"FS_PILOT_TIMEOUT": 60.0})
        commands.arm(link)
    values = served.simulation.vehicle.parameters
    with connect(port) as driver:
        found = {finding.name: finding for finding in driver.preflight()}
        assert not found["disarmed"].passed
        assert not found["outputs"].passed
        assert values["FS_PILOT_TIMEOUT"] == 60.0
        commands.disarm(driver.link)
        found = {finding.name: finding for finding in driver.preflight()}
        assert found["disarmed"].passed
        assert values["FS_PILOT_TIMEOUT"] == 3.0


KILLED = """
import sys, time
import numpy as np
import jax
jax.config.update("jax_enable_x64", True)
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.mavlink.config import Mavlink
from spinndrift.systems.mavlink.driver import Driver
config = Mavlink(sys.argv[1], actuation="thruster_passthrough")
with Driver(config, load_vehicle("bluerov2_heavy").thrusters()) as driver:
    driver.prepare()
    start = time.monotonic()
    while True:
        driver.act(time.monotonic() - start, np.array([20.0, 0, 10, 0, 0, 0]), np.zeros(3))
        print("flying", flush=True)
        time.sleep(0.02)
"""


@pytest.mark.parametrize(
    "how", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.slow)]
)
def test_a_killed_or_hung_process_leaves_no_thruster_running(port: int, how: signal.Signals):
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, f"tcp:127.0.0.1:{port}"],
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )
    assert process.stdout is not None
    for _ in range(50):
        assert b"flying" in process.stdout.readline()
    process.send_signal(how)
    time.sleep(4.0)  # the guard: a second without a beat, a second of neutral, parameters
    process.wait(5.0)  # the guard has killed a process that hangs
    process.stdout.close()
    check_at_rest(port)


@pytest.mark.parametrize(
    ("words", "said"),
    [(b".", ("died", False)), (b"..p.", ("died", True)), (b".w!", ("", False)),
     (b"p?", (guard_process._UNABLE, True))],
)  # fmt: skip
def test_a_guard_knows_whether_a_pilot_steers(monkeypatch, words, said):
    ours, theirs = os.pipe()
    with os.fdopen(ours) as reading, monkeypatch.context() as patched:
        patched.setattr(sys, "stdin", reading)
        os.write(theirs, words)
        os.close(theirs)
        assert guard_process._watch() == said


def test_the_id_that_the_vehicle_obeys_is_set_first_and_given_back_last(tmp_path):
    class Told(Parameters):
        written: ClassVar[list] = []

        def __init__(self):
            pass

        def read(self, name):
            return 1.0

        def write(self, name, value):
            self.written.append((name, value))

    told, calls = Told(), []
    borrowed = Borrowed(told, tmp_path / "borrowed.param")
    borrowed.borrow({"SERVO1_FUNCTION": 51.0, "MAV_GCS_SYSID": 254.0}, lambda: calls.append(1))
    borrowed.give_back()
    names = [name for name, _ in told.written]
    assert names == ["MAV_GCS_SYSID", "SERVO1_FUNCTION", "SERVO1_FUNCTION", "MAV_GCS_SYSID"]
    assert len(calls) == 2


def test_borrowed_parameters_belong_to_a_vehicle_and_not_to_its_address(served: Served):
    """A flight that died is mended through another address, and on no other vehicle."""
    port = served.ports[0]
    died = Connection.parse(f"tcp:localhost:{port}")
    with Link(died) as link:
        number, version = commands.identity(link)
        assert version == (4, 5)
        assert number == served.simulation.vehicle.serial_number.hex() + "0000"
        Borrowed(Parameters(link), borrowed_file(died, number)).borrow({"FS_PILOT_TIMEOUT": 0.5})
    assert borrowed_file(died, "another") != borrowed_file(died, number)
    with connect(port) as driver:
        assert driver.restore() == {"FS_PILOT_TIMEOUT": 3.0}
    assert served.simulation.vehicle.parameters["FS_PILOT_TIMEOUT"] == 3.0


def test_a_frame_that_is_not_the_scenarios_is_refused(port: int):
    with pytest.raises(UserError, match="has 8 thrusters and the scenario's vehicle 6"):
        Driver(Mavlink(f"tcp:127.0.0.1:{port}"), load_vehicle("bluerov2").thrusters())
