"""Ground stations that others wrote find the simulated vehicle and fly it."""

import importlib.util
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from served_vehicle import LIMIT, Served

pytestmark = pytest.mark.whole

MAVPROXY = Path(sys.executable).parent / "mavproxy.py"

MAVSDK = """
import json, sys, time
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.action.action import Action
from mavsdk.plugins.manual_control.manual_control import ManualControl
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkDirect, MavlinkMessage
from mavsdk.plugins.param.param import Param

client = Mavsdk(Configuration.create_manual(255, 190, True))
client.add_any_connection(sys.argv[1])
system = client.first_autopilot(30)
listed = Param(system).get_all_params()
print(len(listed.int_params) + len(listed.float_params), flush=True)
sticks = ManualControl(system)


def hold(x, duration):
    # without sticks the pilot's failsafe disarms, soon after the boot
    end = time.monotonic() + duration
    while time.monotonic() < end:
        sticks.set_manual_control_input(x, 0.0, 0.5, 0.0)
        time.sleep(0.05)


hold(0.0, 1.0)
Action(system).arm()
for mode in (2, 19):
    fields = {"target_system": 1, "base_mode": 1, "custom_mode": mode}
    message = MavlinkMessage("SET_MODE", 255, 190, 1, 1, json.dumps(fields))
    MavlinkDirect(system).send_message(message)
    hold(0.0, 1.0)
hold(1.0, 3.0)
Action(system).disarm()
client.destroy()
"""


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    served = Served("tcpin:127.0.0.1:0", "tcpin:127.0.0.1:0")
    yield served
    served.close()


class Watch:
    """What the vehicle was seen to be while a client ran."""

    def __init__(self, served: Served):
        self._autopilot = served.simulation.vehicle.autopilot
        self.armed: list[bool] = [self._autopilot.armed]
        self.modes: list[int] = [self._autopilot.mode]
        self.most = 1500

    def until(self, done: Callable[[], bool]) -> None:
        end = time.monotonic() + LIMIT
        while not done():
            assert time.monotonic() < end, f"{self.armed}, {self.modes}, {self.most}"
            if self._autopilot.armed != self.armed[-1]:
                self.armed.append(self._autopilot.armed)
            if self._autopilot.mode != self.modes[-1]:
                self.modes.append(self._autopilot.mode)
            self.most = max(self.most, self._autopilot.outputs.us[2])
            time.sleep(0.01)


@pytest.mark.skipif(importlib.util.find_spec("mavsdk") is None, reason="MAVSDK is not installed")
def test_mavsdk_lists_parameters_arms_changes_mode_drives_and_disarms(served: Served):
    watch = Watch(served)
    command = [sys.executable, "-c", MAVSDK, f"tcpout://127.0.0.1:{served.ports[0]}"]
    client = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        watch.until(lambda: client.poll() is not None)
        said = client.communicate()[0]
        assert client.returncode == 0, said
        assert str(len(served.simulation.vehicle.parameters)) in said.split()
        assert watch.armed == [False, True, False]
        assert watch.modes == [19, 2, 19]
        assert watch.most == 1700  # full stick at the default gain
    finally:
        client.kill()
        client.wait()


@pytest.mark.skipif(not MAVPROXY.exists(), reason="MAVProxy is not installed")
def test_mavproxy_lists_parameters_arms_changes_mode_drives_and_disarms(served: Served, tmp_path):
    watch, autopilot = Watch(served), served.simulation.vehicle.autopilot
    command = [sys.executable, str(MAVPROXY), f"--master=tcp:127.0.0.1:{served.ports[1]}"]
    command += ["--source-system=255", f"--state-basedir={tmp_path}", "--nowait"]
    command += [f"--logfile={tmp_path / 'mav.tlog'}", "--default-modules=rc,param,mode,arm"]
    log = tmp_path / "said.txt"
    with log.open("w") as out:
        client = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=out, stderr=subprocess.STDOUT, text=True
        )
        assert client.stdin is not None

        def say(line: str) -> None:
            client.stdin.write(line + "\n")  # pyright: ignore[reportOptionalMemberAccess]
            client.stdin.flush()  # pyright: ignore[reportOptionalMemberAccess]

        try:
            listed = f"Received {len(served.simulation.vehicle.parameters)} parameters"
            watch.until(lambda: listed in log.read_text())
            say("arm throttle")
            watch.until(lambda: autopilot.armed)
            say("mode ALT_HOLD")
            watch.until(lambda: autopilot.mode == 2)
            say("mode MANUAL")
            watch.until(lambda: autopilot.mode == 19)
            say("rc 5 1600")
            watch.until(lambda: autopilot.outputs.us[2] == 1600)
            say("disarm")
            watch.until(lambda: not autopilot.armed)
        finally:
            client.kill()
            client.communicate()
