"""Scenarios flown in real time on a simulated vehicle, which another process serves."""

import json
import os
import re
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.models.files.owned import run_folder
from spinndrift.models.recordings.checks.examine import examine
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.run import flight
from spinndrift.sims.run.collection import COLLECTION, collect, maneuver_scenario
from spinndrift.sims.run.dead_man import dead_man_key
from spinndrift.sims.run.flight import fly
from spinndrift.sims.run.flight_log import AGES
from spinndrift.sims.run.folder import telemetry_log, write_files
from spinndrift.sims.run.live import LivePage
from spinndrift.sims.scenarios.maneuvers import Maneuvers
from spinndrift.sims.scenarios.scenario import Scenario, load_scenario, overridden
from spinndrift.systems.controllers.maneuvers import Steadiness
from spinndrift.systems.logs.load import LogOptions, import_log
from spinndrift.systems.mavlink import telemetry
from spinndrift.systems.mavlink.link import Link
from spinndrift.systems.mavlink.parameters import Parameters
from spinndrift.systems.mavlink.transport import Connection

pytestmark = pytest.mark.whole

# a loaded machine is late and loses its estimate for a while, which has tests of its own
PATIENT = (
    "late: 20, lost: 20, silence: 5, stale: 5, stale_aid: 20, dead_reckoning: 20, outputs: 20, "
    "plan_age: 20"
)


@contextmanager
def vehicle(out: Path) -> Iterator[tuple[int, subprocess.Popen]]:
    """A served vehicle: its port, and its process; at its end the truth is in `out`."""
    command = ["-m", "spinndrift", "vehicle", "station_keeping_calm", "--out", str(out)]
    served = subprocess.Popen(
        [sys.executable, *command, "--connection", "tcpin:127.0.0.1:0"],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert served.stderr is not None
    found = re.search(r"tcpin:127.0.0.1:(\d+)", served.stderr.readline())
    assert found is not None
    yield int(found[1]), served
    served.terminate()  # a shell in the background has its children ignore SIGINT
    served.wait(30.0)
    served.stderr.close()


@pytest.fixture(scope="module")
def port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """That of a served vehicle, which ends at a signal and leaves the truth."""
    out = tmp_path_factory.mktemp("served") / "out"
    with vehicle(out) as (port, served):
        yield port
    assert served.returncode == 0
    assert Recording.load(out / "truth.nc").dataset.sizes["time"] > 1
    assert (out / "scenario.yaml").exists()


@pytest.fixture(autouse=True)
def _state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


def scenario(port: int, duration: float, more: str = "") -> Scenario:
    link = f'!Mavlink {{connection: "tcp:127.0.0.1:{port}", safety: {{{PATIENT}}}{more}}}'
    text = f"vehicle_link: {link}\nduration: {duration}"
    return load_scenario("station_keeping_calm", text)


def test_a_flight_holds_its_pose_and_leaves_the_vehicle_as_it_was(port: int, tmp_path: Path):
    said: list[str] = []
    wanted = scenario(port, 6.0, ", actuation: thruster_passthrough")
    run = fly(wanted, arm=True, record=tmp_path / "telemetry.tlog", say=said.append)
    assert (run.outcome.reason, run.outcome.time) == ("duration", pytest.approx(6.0, abs=0.1))
    assert "arming" in said
    assert sum(check[1] for check in run.checks) == len(run.checks) > 20
    X, F = run.log["X_WB"], run.log["F_Bo_B"]
    assert np.isfinite(X).all()
    assert np.linalg.norm(X[:, 4:6], axis=1).max() < 1.5  # W begins at the vehicle's place
    assert np.abs(F).max() > 1.0
    assert np.ptp(run.log["pwm"], axis=0).max() > 10  # the outputs moved
    assert set(run.log["guard_order"].ravel()) == {0}
    assert run.numbers["loop"]["command_p99_ms"] > 0
    assert run.scenario.station.sensing.imu.rate in (20, 40, 100)
    values = write_files(run, tmp_path, report=True)
    assert values["link"]["damaged"] == 0
    telemetry_log = tmp_path / "telemetry.tlog"
    imported, _ = import_log(telemetry_log, options=LogOptions(1.0, align=tmp_path))
    stretches = list(imported.trajectories())
    (flown,) = run.log.recording.trajectories()
    for told in stretches:  # one, but for gaps of a busy computer, at the start also
        first = round((told.start - flown.start) / run.log.dt)
        apart = told.X_WB - flown.X_WB[first : first + len(told)]
        # one dive, one clock, one W; single samples come late on a loaded machine
        assert np.median(np.abs(apart[:, :4]).max(axis=1)) < 0.02
    assert sum(len(told) for told in stretches) > 0.5 * len(flown)
    with Link(Connection.parse(f"tcp:127.0.0.1:{port}")) as link:
        link.find_vehicle(15.0)
        parameters = Parameters(link)
        assert [parameters.read(f"SERVO{n}_FUNCTION") for n in range(1, 9)] == [*range(33, 41)]
        status = telemetry.status(link, time.monotonic())
        assert status is not None
        assert not status.armed


@pytest.mark.slow
def test_a_guard_ends_a_collection_and_voids_the_trajectory_it_was_in(
    port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    pressed = [0.0]

    @contextmanager
    def key() -> Iterator[Callable[[], float]]:
        yield lambda: pressed[0]

    def let_go(fraction: float, words: str) -> None:
        if "2 of 2" in words and "open loop" in words:
            pressed[0] = 9.0

    monkeypatch.setattr(flight, "dead_man_key", key)
    settings = Maneuvers(
        ("surge-forward",), 2, duration=2.0, steady=Steadiness(0.3, 12.0, 0.2, 0.2)
    )
    base = scenario(port, 1.0, ", imu_rate: 20.0")
    assert base.vehicle_link is not None
    safety = replace(base.vehicle_link.safety, dead_man=1.0, end="disarm")
    link = replace(base.vehicle_link, safety=safety)
    wanted = maneuver_scenario(replace(base, vehicle_link=link), settings)
    with run_folder(tmp_path / "out", COLLECTION) as folder:
        found = collect(wanted, folder, arm=True, report=False, progress=let_go)
    assert found.outcome is not None
    assert found.outcome.reason == "guard"
    assert "the dead-man key was not pressed" in found.outcome.sentence
    assert (found.added, found.there, found.wanted) == (1, 1, 2)
    recording = Recording.load(folder / "recording.nc")
    (run,) = recording.trajectories()
    assert (run.scenario, run.sensors["repeat"][0]) == ("surge-forward", 1)
    assert len(run) == 10 + 41
    assert np.ptp(run.commands["F_Bo_B"][20:, 0]) < 1.0, "a constant wrench, after its ramp"
    assert run.commands["F_Bo_B"][20:, 0].mean() > 20
    assert run.V_WB_B[-1, 0] > run.V_WB_B[0, 0] + 0.2, "it moved as it was pushed"
    assert (folder / "dive-1" / "telemetry.tlog").stat().st_size > 10_000


@pytest.mark.slow
def test_without_a_dvl_depth_is_held_and_what_is_collected_can_be_learned_from(
    port: int, tmp_path: Path
):
    base = overridden(scenario(port, 8.0), "station: {sensing: {dvl: null}}")
    run = fly(base, arm=True)
    assert run.outcome.reason == "duration"
    X, late = run.log["X_WB"], run.log.time > 6.0
    assert np.isnan(X[:, 4:6]).all()
    assert np.isnan(run.log["V_WB_B"][:, :2]).all()
    assert np.abs(X[late, 6] + 1.5).max() < 0.3, run.numbers["loop"]
    assert np.abs(run.log["F_Bo_B"][:, :2]).max() < 5.0
    (tmp_path / "run").mkdir()
    values = write_files(run, tmp_path / "run", report=True)
    assert "the place is not known" in values["outcome"]["words"]

    settings = Maneuvers(("heave-down", "yaw-left"), 1, duration=2.0)
    with run_folder(tmp_path / "out", COLLECTION) as folder:
        found = collect(maneuver_scenario(base, settings), folder, arm=True, report=False)
    assert (found.added, found.wanted) == (2, 2)
    recording = Recording.load(folder / "recording.nc")
    heave, yaw = recording.trajectories()
    assert heave.X_WB[-1, 6] < heave.X_WB[0, 6] - 0.1
    assert yaw.V_WB_B[-1, 5] > 0.2
    assert examine(recording, load_vehicle("bluerov2_heavy"), "recording", ()).duration > 4


@pytest.mark.slow
def test_nothing_is_armed_without_being_asked(port: int):
    with pytest.raises(UserError, match="add --arm to fly, or --dry-run"):
        fly(scenario(port, 1.0))


@pytest.mark.slow
def test_a_vehicle_that_is_gone_for_good_leaves_a_log_that_says_so(tmp_path: Path):
    with vehicle(tmp_path / "served") as (port, served):
        base = scenario(port, 20.0)
        assert base.vehicle_link is not None
        safety = replace(base.vehicle_link.safety, silence=1.0, hold=2.0)
        wanted = replace(base, vehicle_link=replace(base.vehicle_link, safety=safety))

        def leave(fraction: float, words: str) -> None:
            if words.startswith("2 s"):
                served.kill()

        run = fly(wanted, arm=True, record=tmp_path / "telemetry.tlog", progress=leave)
    assert run.outcome.reason == "guard"
    assert "the vehicle was not heard" in run.outcome.sentence
    assert "could not be stopped in order" in run.outcome.sentence
    values = write_files(run, tmp_path, report=True)
    assert values["link"]["received"] > 100
    assert len(run.log.time) > 2 / run.log.dt


@pytest.mark.slow
def test_a_dry_run_commands_nothing_and_its_page_shows_the_log(port: int):
    wanted, seen = scenario(port, 2.0, ", estimate: autopilot"), []
    over = threading.Event()

    def watch() -> None:
        while not over.wait(0.1):
            with urllib.request.urlopen(page.address + "state.json", timeout=10.0) as answer:
                seen.append(json.load(answer))

    with LivePage("0") as page:
        page.begin(wanted)
        browser = threading.Thread(target=watch)
        browser.start()
        run = fly(wanted, dry_run=True, live=page)
        over.set()
        browser.join()
    states = {state["t"]: state for state in seen if "X_WB" in state}
    assert len(states) >= 3
    for t, state in states.items():
        n = round(t / run.log.dt)
        if abs(t - n * run.log.dt) < 1e-9 and 0 < n < len(run.log.time):
            np.testing.assert_array_equal(state["X_WB"], run.log["X_WB"][n])
            np.testing.assert_array_equal(state["pwm"], run.log["pwm"][n])
            heard = next(g["value"] for g in state["guards"] if g["name"] == "silence")
            assert heard == run.log["guard_ages"][n, AGES.index("vehicle")]
    guards = {guard["name"]: guard for guard in seen[-1]["guards"]}
    assert {"silence", "attitude", "depth", "loop", "depth_limits", "battery"} <= set(guards)
    assert all(0 <= guard["share"] < 1 for guard in guards.values())
    ages = run.log["guard_ages"]
    assert np.isfinite(ages[:, AGES.index("vehicle")]).all()
    assert np.isnan(ages[:, AGES.index("dead_man")]).all(), "there is none"
    assert run.outcome.reason == "duration"
    assert np.abs(run.log["F_Bo_B"]).max() > 0.1  # computed
    np.testing.assert_array_equal(run.log["pwm"], 1500.0)  # not sent
    assert "error_std" not in run.log  # an autopilot tells no covariance


CONTROLLER = """
import numpy as np
from pydrake.systems.framework import LeafSystem

class Failing(LeafSystem):
    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("X_WB", 7)
        self.DeclareVectorInputPort("V_WB_B", 6)
        self.DeclareStateOutputPort("F_Bo_B", self.DeclareDiscreteState(6))
        self.DeclarePeriodicDiscreteUpdateEvent(0.02, 0.0, self.update)

    def update(self, context, state):
        if context.get_time() > 3.5:  # beyond the run without commands
            raise RuntimeError("a fault of the controller")
        state.set_value(0, np.array([15.0, 0, 0, 0, 0, 0]))
"""


@pytest.mark.slow
def test_an_exception_in_the_diagram_leaves_no_thruster_running(port: int, tmp_path: Path):
    (tmp_path / "failing.py").write_text(CONTROLLER)
    own = f"controller: !Own {{system: {tmp_path}/failing.py:Failing}}"
    goal = "success: !ReachGoal {goal: [50, 0, -1], progress_time: 99}"
    base = scenario(port, 30.0)
    with pytest.raises(RuntimeError, match="a fault of the controller"):
        fly(overridden(base, f"{own}\n{goal}"), arm=True)
    with Link(Connection.parse(f"tcp:127.0.0.1:{port}")) as link:
        link.find_vehicle(15.0)
        assert link.wait_for("SERVO_OUTPUT_RAW", 5.0) is not None
        shown, status = telemetry.outputs(link, 8), telemetry.status(link, time.monotonic())
        assert shown is not None
        assert status is not None
        np.testing.assert_array_equal(shown.value, 1500.0)
        assert not status.armed


def test_a_dead_man_key_needs_a_terminal_and_counts_from_the_last_press(
    monkeypatch: pytest.MonkeyPatch,
):
    with open(os.devnull) as nothing, monkeypatch.context() as patched:
        patched.setattr(sys, "stdin", nothing)
        with pytest.raises(UserError, match="dead_man: there is no terminal"), dead_man_key():
            pass
    ours, theirs = os.openpty()
    with os.fdopen(theirs) as terminal, monkeypatch.context() as patched:
        patched.setattr(sys, "stdin", terminal)
        with dead_man_key() as age:
            time.sleep(0.3)
            assert age() >= 0.3
            os.write(ours, b" ")
            end = time.monotonic() + 10.0
            while age() > 0.25 and time.monotonic() < end:
                time.sleep(0.01)
            assert age() <= 0.25
    os.close(ours)


def test_a_vehicle_with_another_frame_is_refused(port: int):
    text = f'vehicle_link: !Mavlink {{connection: "tcp:127.0.0.1:{port}"}}'
    with pytest.raises(UserError, match="has 8 thrusters and the scenario's vehicle 6"):
        fly(load_scenario("station_keeping_calm", f"station: {{vehicle: bluerov2}}\n{text}"))


@pytest.mark.parametrize("collecting", [False, True])
def test_an_unarmed_command_offers_what_it_has(collecting: bool, monkeypatch: pytest.MonkeyPatch):
    for name in ("Driver", "Cockpit", "preflight"):
        monkeypatch.setattr(flight, name, MagicMock())
    monkeypatch.setattr(flight, "as_granted", lambda scenario, *_: scenario)
    with pytest.raises(UserError, match="nothing was armed: add --arm to fly") as told:
        fly(scenario(1, 1.0), keep=MagicMock() if collecting else None)
    assert ("--dry-run" in str(told.value)) is not collecting


def test_a_scenario_without_a_vehicle_says_what_to_add():
    with pytest.raises(UserError, match="has no vehicle_link: add vehicle_link: !Mavlink"):
        fly(load_scenario("station_keeping_calm"), arm=True)


def test_an_attempt_that_never_flew_leaves_no_telemetry_and_a_flight_keeps_its_own(tmp_path: Path):
    def failing() -> None:
        with telemetry_log(tmp_path) as record:
            record.write_bytes(b"heard")
            raise UserError("nobody there")

    with pytest.raises(UserError, match="nobody there"):
        failing()
    assert not list(tmp_path.iterdir())
    with telemetry_log(tmp_path) as record:
        record.write_bytes(b"flown")
    with pytest.raises(UserError, match="ended early; name another folder"):
        telemetry_log(tmp_path).__enter__()
    assert record.read_bytes() == b"flown"
