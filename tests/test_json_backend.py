"""The physics of an ArduSub against a peer that reads and writes as ArduPilot's SIM_JSON does."""

import re
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise

import numpy as np
import pytest
from measured_mixer import MEASURED
from scipy.spatial.transform import Rotation

from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.store import Recording
from spinndrift.sims.cli import main
from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.sims.vehicle.json_backend import JsonBackend, lock_step, open_physics
from spinndrift.sims.vehicle.json_protocol import Frames, servos
from spinndrift.sims.vehicle.physics import Physics
from spinndrift.systems.mavlink.transport import Datagrams

pytestmark = pytest.mark.whole

LIMIT = 30.0  # s of wall time for an answer, on a busy machine
DT = 1 / 400
NEUTRAL = [1500] * 8
SCENARIO = load_scenario(
    "station_keeping_calm",
    "station: {disturbance_set: still, start: {position: [1, 2, -5], rpy_deg: [6, -11, 30]}}",
)


def packet(frame: int, us: list[int], rate: int = 400, channels: int = 16) -> bytes:
    magic = {16: 18458, 32: 29569}[channels]
    return struct.pack(f"<HHI{channels}H", magic, rate, frame, *(us + [0] * channels)[:channels])


NUMBER = r"(-?[\d.]+(?:e[-+]?\d+)?)"


class State:
    """A line as ArduPilot's parser takes it apart: by the place of keys in the text."""

    def __init__(self, line: bytes):
        text = line.decode("ascii")
        # its parser needs the line feed before the first line, and takes the last line alone
        assert text.startswith("\n")
        assert text.endswith("\n")
        assert text.count("\n") == 2
        self.t = self._number(text, "timestamp")
        section = text[text.index("imu") :]
        self.gyro, self.accel = self._list(section, "gyro"), self._list(section, "accel_body")
        self.position, self.velocity = self._list(text, "position"), self._list(text, "velocity")
        q = self._list(text, "quaternion")
        self.R = Rotation.from_quat(q, scalar_first=True)
        self.volts = self._number(text[text.index("battery") :], "voltage")

    @staticmethod
    def _number(text: str, key: str) -> float:
        found = re.match(NUMBER, text[text.index(key) + len(key) + 2 :].lstrip())
        assert found is not None
        return float(found[1])

    @staticmethod
    def _list(text: str, key: str) -> np.ndarray:
        inside = text[text.index(key) :].split("[", 1)[1].split("]", 1)[0]
        return np.array([float(v) for v in inside.split(",")])


class Autopilot:
    """A peer over UDP: sends a packet, waits for the state."""

    def __init__(self, port: int):
        self.socket = socket.socket(type=socket.SOCK_DGRAM)
        self.socket.settimeout(LIMIT)
        self.socket.connect(("127.0.0.1", port))
        self.frame = 0

    def step(self, us: list[int] = NEUTRAL) -> State:
        state = self.ask(packet(self.frame, us))
        self.frame += 1
        return state

    def ask(self, data: bytes) -> State:
        self.socket.send(data)
        return State(self.socket.recv(65536))


@pytest.fixture(scope="module")
def backend() -> Iterator[JsonBackend]:
    datagrams = open_physics("udpin:127.0.0.1:0")
    backend = JsonBackend(SCENARIO, datagrams)
    stop = threading.Event()
    thread = threading.Thread(target=backend.run, args=(stop,), daemon=True)
    thread.start()
    yield backend
    stop.set()
    thread.join(LIMIT)
    datagrams.close()


@pytest.fixture
def autopilot(backend: JsonBackend) -> Iterator[Autopilot]:
    autopilot = Autopilot(port_of(backend))
    yield autopilot
    autopilot.socket.close()


def port_of(backend: JsonBackend) -> int:
    datagrams: Datagrams = backend._datagrams
    return datagrams.port


def test_the_first_state_is_the_start_in_north_east_down(autopilot: Autopilot):
    state = autopilot.step()
    assert state.t == pytest.approx(DT)
    np.testing.assert_allclose(state.position, [2, 1, 5], atol=1e-3)
    np.testing.assert_allclose(state.velocity, 0, atol=0.02)
    # about forward, right, down: roll keeps its sign, pitch changes it, yaw counts from north
    roll, pitch, yaw = state.R.as_euler("ZYX")[::-1]
    np.testing.assert_allclose([roll, pitch, yaw], np.deg2rad([6, 11, 60]), atol=1e-3)
    assert 12 < state.volts < 17


def test_rates_are_the_derivatives_of_the_states(autopilot: Autopilot):
    turn = [1300, 1700, 1600, 1400, 1600, 1400, 1550, 1650]
    states = [autopilot.step(turn) for _ in range(200)]
    down = np.array([0.0, 0.0, 9.80665])
    for a, b in pairwise(states[100:]):
        assert b.t - a.t == pytest.approx(DT)
        change = (b.velocity - a.velocity) / DT
        np.testing.assert_allclose(b.R.apply(b.accel) + down, change, atol=1e-9)
        # a step's mean rate lies between the rates at its ends; a velocity held in the body turns
        # by ω DT in the world meanwhile
        moved = (b.position - a.position) / DT
        turning = float(np.linalg.norm(a.gyro) * np.linalg.norm(a.velocity)) * DT
        assert_between(moved, a.velocity, b.velocity, turning)
        turned = (a.R.inv() * b.R).as_rotvec() / DT
        assert_between(turned, a.gyro, b.gyro, 1e-6)


def assert_between(value: np.ndarray, a: np.ndarray, b: np.ndarray, margin: float) -> None:
    assert np.all(value >= np.minimum(a, b) - margin)
    assert np.all(value <= np.maximum(a, b) + margin)


@pytest.mark.parametrize("axis", range(6), ids=["surge", "sway", "down", "roll", "pitch", "yaw"])
@pytest.mark.parametrize("sign", [1, -1])
def test_outputs_of_the_mixer_move_the_axis_that_they_are_for(
    autopilot: Autopilot, axis: int, sign: int
):
    us = [1500 + int(150 * sign * v) for v in MEASURED[:, axis]]

    def twist(state: State) -> np.ndarray:
        return np.concatenate([state.R.inv().apply(state.velocity), state.gyro])

    before = [autopilot.step() for _ in range(200)][-1]
    after = [autopilot.step(us) for _ in range(100)][-1]
    change = twist(after) - twist(before)
    half = slice(0, 3) if axis < 3 else slice(3, 6)
    assert np.argmax(np.abs(change[half])) == axis % 3
    assert np.sign(change[axis]) == sign


def test_a_packet_without_an_answer_is_repeated_and_no_time_passes(
    backend: JsonBackend, autopilot: Autopilot
):
    autopilot.step()
    last = autopilot.step()
    repeated = backend.repeated
    again = autopilot.ask(packet(autopilot.frame - 1, [1900] * 8))
    assert again.t == last.t
    np.testing.assert_array_equal(again.position, last.position)
    assert backend.repeated == repeated + 1
    assert autopilot.step().t == pytest.approx(last.t + DT)


def test_of_packets_that_waited_the_newest_alone_is_answered(backend: JsonBackend):
    autopilot = Autopilot(port_of(backend))
    last = autopilot.step()
    # as many as a socket's buffer takes, while the physics is busy with the first of them
    for _ in range(50):
        autopilot.socket.send(packet(autopilot.frame, NEUTRAL))
    answers = [State(autopilot.socket.recv(65536))]
    autopilot.socket.settimeout(0.5)
    with suppress(TimeoutError):
        while True:
            answers.append(State(autopilot.socket.recv(65536)))
    assert len(answers) < 50
    assert all(a.t == pytest.approx(last.t + DT) for a in answers)
    autopilot.socket.close()


def test_a_gap_is_one_step_and_is_counted(backend: JsonBackend, autopilot: Autopilot):
    last = autopilot.step()
    missed = backend.frames.missed
    autopilot.frame += 3
    assert autopilot.step().t == pytest.approx(last.t + DT)
    assert backend.frames.missed == missed + 3


def test_an_autopilot_that_boots_anew_finds_the_vehicle_where_it_was(
    backend: JsonBackend, autopilot: Autopilot
):
    last = [autopilot.step() for _ in range(10)][-1]
    boots = backend.restarts
    again = Autopilot(port_of(backend))
    state = again.step()
    assert state.t == pytest.approx(DT)
    np.testing.assert_allclose(state.position, last.position, atol=0.01)
    assert backend.restarts == boots + 1
    again.socket.close()


def test_other_datagrams_are_ignored_and_counted(backend: JsonBackend, autopilot: Autopilot):
    foreign = backend.foreign
    good = packet(0, NEUTRAL)
    for data in (
        b"",
        b"x",
        good[:-1],
        good + b"\0",
        b"\0\0" + good[2:],
        packet(0, [], 400, 32)[:-2],
    ):
        autopilot.socket.send(data)
    last = autopilot.step()
    assert backend.foreign == foreign + 6
    rng = np.random.default_rng(0)
    for _ in range(1000):
        spoiled = bytearray(good)
        spoiled[rng.integers(len(good))] = rng.integers(256)
        servos(bytes(spoiled))
        assert servos(rng.bytes(int(rng.integers(80)))) is None
    state = autopilot.ask(packet(autopilot.frame, NEUTRAL, channels=32))
    assert state.t == pytest.approx(last.t + DT)


def test_a_slower_rate_takes_longer_steps_up_to_what_the_autopilot_accepts(autopilot: Autopilot):
    t = autopilot.step().t
    for rate, length in ((400, DT), (1200, DT), (200, 2 * DT), (50, 8 * DT), (0, DT), (1, 39 * DT)):
        state = autopilot.ask(packet(autopilot.frame, NEUTRAL, rate))
        autopilot.frame += 1
        assert state.t - t == pytest.approx(length)
        t = state.t


def test_counts_go_on_where_they_wrap():
    frames = Frames()
    counts = (2**32 - 1, 0, 0, 1, 5, 0)
    turns = [frames.turn(frame) for frame in counts]
    assert turns == ["first", "next", "repeated", "next", "next", "restarted"]
    assert frames.missed == 3


def test_the_plant_is_stepped_at_the_rate_of_the_main_loop_or_faster():
    for period, steps in ((0.01, 4), (0.02, 8), (0.0025, 1), (0.003, 2), (0.001, 1)):
        text = f"station: {{period: {period}, substeps: 3}}, log: {{rate: {0.5 / period}}}"
        station = load_scenario("station_keeping_calm", f"{{{text}}}").station
        assert lock_step(station).period == pytest.approx(period / steps)


def test_a_vehicle_that_shoots_up_falls_back_to_the_surface():
    start = "start: {position: [0, 0, -0.1]}, start_twist: [0, 0, 1, 0, 0, 0]"
    physics = Physics(load_scenario("station_keeping_calm", f"station: {{{start}}}").station)
    heights = []
    for _ in range(150):
        physics.step(NEUTRAL)
        heights.append(physics.truth()[0][6])
    # in air it would slow down by its weight alone: 1 m/s against 132 N on 13.5 kg and added mass
    assert 0 < max(heights) < 0.3
    assert heights[-1] < max(heights) - 0.02


def test_the_command_flies_and_leaves_the_truth(tmp_path):
    out = tmp_path / "flown"
    command = [sys.executable, "-m", "spinndrift", "vehicle", "station_keeping_calm", "--backend"]
    command += ["ardupilot-json", "--connection", "udpin:127.0.0.1:0", "--duration", "0.2"]
    process = subprocess.Popen([*command, "--out", str(out)], stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        line = process.stderr.readline()
        assert line.startswith("serving udpin:127.0.0.1:")
        autopilot = Autopilot(int(line.rsplit(":", 1)[1]))
        for _ in range(80):
            autopilot.step([1500, 1500, 1600, 1600, 1500, 1500, 1500, 0])
        autopilot.socket.close()
        assert process.wait(LIMIT) == 0
        told = process.stderr.read()
        process.stderr.close()
    finally:
        process.kill()
        process.wait()
    assert "FRAME_CONFIG 2, MOT_1_DIRECTION 1" in told
    assert "0.2 s simulated" in told
    assert f"--defaults {out / 'vehicle.parm'}" in told
    assert "FRAME_CONFIG 2\nMOT_1_DIRECTION 1\n" in (out / "vehicle.parm").read_text()
    data = Recording.load(out / "truth.nc").dataset
    pwm = data["pwm"].to_numpy()[0, 0]
    np.testing.assert_array_equal(pwm[0], [1500, 1500, 1600, 1600, 1500, 1500, 1500, 1500])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--speed", "2"], "--speedup"),
        (["--connection", "tcpin:127.0.0.1:0"], "give udpin:HOST:PORT"),
        (["--connection", "udpin:127.0.0.1:0", "udpin:127.0.0.1:0"], "one autopilot"),
    ],
)
def test_the_command_refuses_in_one_sentence(arguments: list[str], said: str, capsys):
    with pytest.raises(SystemExit) as end:
        main(["vehicle", "station_keeping_calm", "--backend", "ardupilot-json", *arguments])
    assert end.value.code == 2
    told = capsys.readouterr().err.strip()
    assert said in told
    assert len(told.splitlines()) == 1


def test_a_port_in_use_is_refused():
    first = open_physics("udpin:127.0.0.1:0")
    with pytest.raises(UserError, match="another program may use the port"):
        open_physics(f"udpin:127.0.0.1:{first.port}")
    first.close()
