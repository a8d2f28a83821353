"""A real ArduSub flies our plant. SPINNDRIFT_ARDUSUB names its binary; skipped without.

Bounded in time, on loopback, on free ports.
"""

import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from ardusub_binary import BINARY, ArduSub

from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.systems.mavlink import codec, commands, telemetry
from spinndrift.systems.mavlink.actuation import Command, as_wired, make_actuation
from spinndrift.systems.mavlink.dialect import mavlink
from spinndrift.systems.mavlink.parameters import Parameters

pytestmark = pytest.mark.skipif(not BINARY, reason="SPINNDRIFT_ARDUSUB names no binary")
AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")
LIMIT = 60.0  # s of wall time for anything
ALIGNED = 1 | 4  # EKF_STATUS_REPORT: attitude and vertical velocity
SCENARIO = load_scenario(
    "station_keeping_calm",
    "station: {disturbance_set: still, start: {position: [0, 0, -5]}}",
)


class Flown(ArduSub):
    """An ArduSub with a pilot."""

    def simulated(self, seconds: float, say: Callable[[], object] = lambda: None) -> None:
        """Let the plant's time pass; `say` is called all the while."""
        end, wall = self.backend.physics.time + seconds, time.monotonic() + LIMIT
        while self.backend.physics.time < end:
            assert time.monotonic() < wall, "the plant's time stands still"
            say()
            time.sleep(0.02)

    def command(self, **demands: float) -> Callable[[], object]:
        fields = codec.manual_control_fields(**demands)
        sticks = {name: fields[name] for name in ("x", "y", "z", "r", "s", "t")}
        message = mavlink.MAVLink_manual_control_message(
            1, **sticks, buttons=0, enabled_extensions=3
        )
        return lambda: self.link.send(message)

    def aligned(self) -> None:
        """Wait until the attitude's estimate has converged."""
        self.link.find_vehicle(LIMIT)
        assert not commands.request_rates(self.link, RATES)
        found = self.link.wait_for(
            "EKF_STATUS_REPORT", LIMIT, lambda m: m.flags & ALIGNED == ALIGNED
        )
        assert found is not None


RATES = {
    "EKF_STATUS_REPORT": 5.0,
    "ATTITUDE_QUATERNION": 20.0,
    "RAW_IMU": 20.0,
    "SCALED_PRESSURE": 10.0,
    "SERVO_OUTPUT_RAW": 20.0,
}


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flown]:
    flown = Flown(SCENARIO, tmp_path_factory.mktemp("ardusub"), "FS_PILOT_INPUT 2\n")
    try:
        flown.aligned()
        neutral = flown.command()
        flown.simulated(0.5, neutral)
        commands.arm(flown.link)
        flown.simulated(1.0, neutral)
        yield flown
    finally:
        flown.close()


def test_its_estimate_agrees_with_the_truth(flown: Flown):
    flown.simulated(1.0, flown.command())
    attitude = flown.link.latest("ATTITUDE_QUATERNION")
    pressure, imu = flown.link.latest("SCALED_PRESSURE"), flown.link.latest("RAW_IMU")
    X, V = flown.backend.physics.truth()
    assert attitude is not None
    assert pressure is not None
    assert imu is not None
    m = attitude.message
    q = codec.attitude(m.q1, m.q2, m.q3, m.q4)
    angle = 2 * np.arccos(min(1.0, abs(float(q @ X[:4]))))
    assert angle < np.deg2rad(5)
    # the density of ArduPilot's sea water, and the motion between two samples
    gradient = codec.pascal_per_metre(density=1024.5)
    depth = codec.depth_from_pressure(pressure.message.press_abs, gradient=gradient)
    assert float(depth) == pytest.approx(-X[6], abs=0.1)
    f = codec.imu_specific_force(imu.message.xacc, imu.message.yacc, imu.message.zacc)
    assert np.linalg.norm(f) == pytest.approx(9.8, abs=0.3 + float(np.abs(V).max()))


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_each_axis_moves_as_it_is_told(flown: Flown, axis: str, sign: float):
    flown.simulated(0.8, flown.command())
    before = flown.backend.physics.truth()[1]
    flown.simulated(0.5, flown.command(**{axis: 0.4 * sign}))
    change = flown.backend.physics.truth()[1] - before
    number = AXES.index(axis)
    # thrusters above or below the centre of mass also pitch and roll
    half = slice(0, 3) if number < 3 else slice(3, 6)
    assert np.argmax(np.abs(change[half])) == number % 3
    assert np.sign(change[number]) == sign


PUSHES = np.diag([25.0, 25.0, 25.0, 3.0, 3.0, 5.0])
"""A wrench along each axis (N, N·m)."""


@pytest.fixture(scope="module", params=["manual_control", "rc_override", "thruster_passthrough"])
def commanded(flown: Flown, request: pytest.FixtureRequest) -> Iterator[Callable[..., Command]]:
    """Commands of an actuation in our own driver's form, for an armed vehicle."""
    parameters = Parameters(flown.link)
    thrusters, _ = as_wired(SCENARIO.station.load_vehicle().thrusters(), parameters.read_all())
    actuation = make_actuation(request.param, thrusters, parameters.read_all())
    former = {name: parameters.read(name) for name in actuation.borrowed}
    vehicle = flown.link.find_vehicle()

    def command(F: np.ndarray) -> Command:
        volts = flown.backend.physics.battery()[0]
        return actuation.command(vehicle, F, volts, telemetry.pilot_gain(flown.link, {}))

    commands.set_mode(flown.link, "MANUAL")
    flown.simulated(0.5, lambda: flown.link.send(actuation.neutral(vehicle)))
    for name, value in actuation.borrowed.items():
        parameters.write(name, value)
        flown.link.send(actuation.neutral(vehicle))
    heartbeat = flown.link.latest("HEARTBEAT")
    if heartbeat is None or not commands.is_armed(heartbeat.message):
        commands.arm(flown.link)
    yield command
    flown.simulated(0.5, lambda: flown.link.send(actuation.neutral(vehicle)))
    for name, value in former.items():
        assert value is not None
        parameters.write(name, value)


@pytest.mark.parametrize("axis", range(6), ids=AXES)
def test_every_actuation_gives_the_outputs_and_the_push_that_it_foresees(
    flown: Flown, commanded: Callable[..., Command], axis: int
):
    still, F = np.zeros(6), PUSHES[axis]
    flown.simulated(1.0, lambda: flown.link.send(commanded(still).message))
    before = flown.backend.physics.truth()[1]
    sent: list[Command] = []

    def push() -> None:
        sent.append(commanded(F))
        flown.link.send(sent[-1].message)

    flown.simulated(0.6, push)
    change = flown.backend.physics.truth()[1] - before
    shown = telemetry.outputs(flown.link, 8)
    assert shown is not None
    # whole numbers on the way, and the battery's voltage of the last commands
    assert min(np.abs(c.pwm - shown.value).max() for c in sent[-10:]) < 6.0
    np.testing.assert_allclose(sent[-1].F_Bo_B, F, atol=1e-6)
    half = slice(0, 3) if axis < 3 else slice(3, 6)
    assert np.argmax(np.abs(change[half])) == axis % 3
    assert change[axis] > 0


def test_it_holds_its_depth(flown: Flown):
    flown.simulated(2.0, flown.command(heave=-0.3))
    commands.set_mode(flown.link, "ALT_HOLD")
    flown.simulated(4.0, flown.command())
    start = flown.backend.physics.truth()[0][6]
    flown.simulated(4.0, flown.command())
    assert flown.backend.physics.truth()[0][6] == pytest.approx(start, abs=0.3)


def test_booted_anew_it_finds_the_vehicle_where_it_was(flown: Flown):
    before = flown.backend.physics.truth()[0]
    flown.stop()
    flown.start()
    flown.aligned()
    assert flown.backend.restarts == 1
    heartbeat = flown.link.latest("HEARTBEAT")
    assert heartbeat is not None
    assert not commands.is_armed(heartbeat.message)
    # adrift meanwhile, by no more than its net buoyancy drives it
    assert np.linalg.norm(flown.backend.physics.truth()[0][4:] - before[4:]) < 3.0
