"""The served vehicle with its plant: it goes where it is told, in each way of telling."""

from typing import Any

import numpy as np
import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.store import Recording
from spinndrift.sims.cli import main
from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.sims.vehicle.simulation import TICK, Simulation
from spinndrift.sims.vehicle.write import write_vehicle
from spinndrift.systems.mavlink import codec
from spinndrift.systems.mavlink.dialect import Message, Parser, mavlink

pytestmark = pytest.mark.whole

AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")
SCENARIO = load_scenario(
    "station_keeping_calm",
    "station: {disturbance_set: still, start: {position: [0, 0, -5]}, sensing: {ekf: {}}}",
)


class Pilot:
    """A ground station in virtual time."""

    def __init__(self):
        self.simulation = Simulation(SCENARIO, 1)
        self.sender, self.reader = Parser(255, 190), Parser(255, 190)
        self.heard: dict[str, Message] = {}
        self.run(2.0)

    def send(self, message: Message) -> None:
        self.simulation.receive(0, self.sender.packed(message))

    def run(self, duration: float, say=None) -> None:
        for tick in range(round(duration / TICK)):
            if tick % 20 == 0:
                self.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))
                if say is not None:
                    self.send(say)
            for packet in self.simulation.step()[0]:
                for message in self.reader.messages(packet):
                    self.heard[message.get_type()] = message

    def command(self, number: int, *params: float) -> int:
        filled = [*params, *[0.0] * 7][:7]
        self.send(mavlink.MAVLink_command_long_message(1, 1, number, 0, *filled))
        self.run(TICK)
        return self.heard["COMMAND_ACK"].result  # pyright: ignore[reportAttributeAccessIssue]

    def pass_through(self, on: bool) -> None:
        for n in range(1, 9):
            name = f"SERVO{n}_FUNCTION".encode()
            self.send(mavlink.MAVLink_param_set_message(1, 1, name, (50 if on else 32) + n, 9))
        self.run(1.1, NEUTRAL["rc_override"])

    def moved(self, say: Message) -> np.ndarray:
        """Change of the twist by a third of a second of a command."""
        before = self.simulation.plant.truth()[1]
        self.run(0.3, say)
        return self.simulation.plant.truth()[1] - before


def manual(**demands: float) -> Message:
    fields = codec.manual_control_fields(**demands)
    z = {name: fields[name] for name in ("x", "y", "z", "r")}
    return mavlink.MAVLink_manual_control_message(
        1, **z, buttons=0, s=fields["s"], t=fields["t"], enabled_extensions=3
    )


def override(us: list[int]) -> Message:
    return mavlink.MAVLink_rc_channels_override_message(1, 1, *us)


def stick_override(**demands: float) -> Message:
    """Channels pitch, roll, throttle, yaw, forward, lateral from demands about B."""
    d = {axis: demands.get(axis, 0.0) for axis in AXES}
    signed = (-d["pitch"], d["roll"], d["heave"], -d["yaw"], d["surge"], -d["sway"])
    return override([*(round(1500 + 400 * v) for v in signed), 1500, 1500])


def thruster_override(**demands: float) -> Message:
    """Pulse widths of the thrusters whose forces add up to the axis asked for."""
    plant = SCENARIO.station.load_vehicle().thrusters()
    wrench = np.array([demands.get(axis, 0.0) for axis in AXES])
    share = np.linalg.pinv(np.asarray(plant.allocation)) @ wrench
    return override([round(v) for v in 1500 + 200 * share / np.abs(share).max(initial=1e-9)])


WAYS = {
    "manual_control": manual,
    "rc_override": stick_override,
    "thruster_passthrough": thruster_override,
}
NEUTRAL = {"rc_override": override([1500] * 8)}


@pytest.fixture(scope="module")
def pilot() -> Pilot:
    pilot = Pilot()
    assert pilot.command(400, 1) == 0
    pilot.run(1.5, manual())
    return pilot


@pytest.mark.slow  # tests/test_driver.py drives the axes in all three ways
@pytest.mark.parametrize("way", WAYS)
def test_six_axes_move_as_they_are_told(pilot: Pilot, way: str):
    pilot.pass_through(way == "thruster_passthrough")
    for axis, name in enumerate(AXES):
        for sign in (1.0, -1.0):
            pilot.run(0.4, NEUTRAL["rc_override"])
            change = pilot.moved(WAYS[way](**{name: 0.5 * sign}))
            # thrusters above or below the centre of mass also pitch and roll
            half = slice(0, 3) if axis < 3 else slice(3, 6)
            assert np.argmax(np.abs(change[half])) == axis % 3, (name, sign, change)
            assert np.sign(change[axis]) == sign, (name, sign, change)
    pilot.pass_through(False)


def test_telemetry_is_near_the_truth(pilot: Pilot):
    assert pilot.command(511, 31, 20_000) == 0
    assert pilot.command(511, 137, 20_000) == 0
    pilot.run(1.0, manual())
    X, _ = pilot.simulation.plant.truth()
    quaternion, pressure = pilot.heard["ATTITUDE_QUATERNION"], pilot.heard["SCALED_PRESSURE2"]
    q = codec.attitude(*(getattr(quaternion, f"q{i}") for i in range(1, 5)))
    angle = 2 * np.arccos(min(1.0, abs(float(q @ X[:4]))))
    assert angle < np.deg2rad(5)  # the compass wanders by 1.7° rms
    gradient = codec.pascal_per_metre(density=1025.0)
    depth = codec.depth_from_pressure(pressure.press_abs, gradient=gradient)  # pyright: ignore
    assert abs(depth + X[6]) < 0.1  # an instant's motion, and the sensor's place


def test_gyroscopes_are_late_by_their_low_pass_and_attitude_is_not(pilot: Pilot):
    """As measured on ArduSub: 11 to 12 ms at 20 Hz, by what its import takes off."""
    assert pilot.simulation.vehicle.parameters["INS_GYRO_FILTER"] == 20
    assert pilot.command(511, 27, 10_000) == 0
    assert pilot.command(511, 31, 10_000) == 0
    true, shown, told = [], [], []
    for k in range(400):
        pilot.run(0.01, manual(yaw=0.4 * np.sin(0.05 * k)))
        X, V = pilot.simulation.plant.truth()
        yaw = 2 * np.arctan2(X[3], X[0])
        boot = pilot.simulation.vehicle.boot_us * 1e-6 - pilot.simulation.time
        true.append([boot + pilot.simulation.plant.time, V[5], yaw])
        sample: Any = pilot.heard["RAW_IMU"]
        rate = codec.imu_angular_rate(sample.xgyro, sample.ygyro, sample.zgyro)[2]
        shown.append([sample.time_usec * 1e-6, rate])
        q: Any = pilot.heard["ATTITUDE_QUATERNION"]
        w, _, _, z = codec.attitude(q.q1, q.q2, q.q3, q.q4)
        told.append([q.time_boot_ms * 1e-3, 2 * np.arctan2(z, w)])
    time, rate, yaw = np.array(true).T
    yaw = np.unwrap(yaw)

    def late(at: np.ndarray, values: np.ndarray, known: np.ndarray) -> float:
        """d of values that are those of the known a time d before, but for a constant."""
        slope = np.interp(at, time, np.gradient(known, time))
        apart = np.interp(at, time, known) - values
        return np.linalg.lstsq(np.column_stack([slope, np.ones(400)]), apart, rcond=None)[0][0]

    (at, values), (when, heading) = np.array(shown).T, np.array(told).T
    assert late(at, values, rate) == pytest.approx(codec.filter_delay(20.0), abs=0.002)
    assert late(when, np.unwrap(heading), yaw) == pytest.approx(0.0, abs=0.003)


def test_depth_is_held(pilot: Pilot):
    pilot.pass_through(False)
    assert pilot.command(176, 1, 2) == 0
    pilot.run(2.0, manual())
    start = pilot.simulation.plant.truth()[0][6]
    pilot.run(4.0, manual())
    X, V = pilot.simulation.plant.truth()
    assert abs(X[6] - start) < 0.1
    assert np.abs(V).max() < 0.1
    assert pilot.command(176, 1, 19) == 0


def test_the_truth_is_a_recording(pilot: Pilot, tmp_path):
    write_vehicle(pilot.simulation.truth, SCENARIO, tmp_path)
    recording = Recording.load(tmp_path / "truth.nc")
    data = recording.dataset
    assert data.sizes["time"] == pytest.approx(20 * pilot.simulation.time, abs=2)
    X, _ = pilot.simulation.plant.truth()
    np.testing.assert_allclose(data["X_WB"].to_numpy()[0, 0, -1], X, atol=0.1)
    assert set(np.unique(data["autopilot_state"].to_numpy()[0, 0, :, 1])) == {0.0, 1.0}


def test_an_unknown_parameter_is_refused_before_work():
    scenario = load_scenario("station_keeping_calm", "vehicle_server: {parameters: {NOPE: 1.0}}")
    with pytest.raises(UserError, match="NOPE"):
        Simulation(scenario, 1)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nowhere"], "none of those shipped"),
        (["station_keeping_calm", "--connection", "udp:1"], "is no connection"),
        (["station_keeping_calm", "--speed", "0"], "--speed"),
    ],
)
def test_the_command_refuses_in_one_sentence(arguments: list[str], said: str, capsys):
    with pytest.raises(SystemExit) as end:
        main(["vehicle", *arguments])
    assert end.value.code == 2
    told = capsys.readouterr().err.strip()
    assert said in told
    assert len(told.splitlines()) == 1
