"""The vehicle's MAVLink ports in virtual time: a client's bytes in, the vehicle's bytes out."""

import random
from collections import Counter

import numpy as np
import pytest
from fuzz.mavlink_frames import framed

from spinndrift.sims.vehicle.autopilot.navigation import Motion
from spinndrift.sims.vehicle.endpoint import dvl_messages
from spinndrift.sims.vehicle.link_faults import FaultyLink, LinkFaults
from spinndrift.sims.vehicle.ports import Ports
from spinndrift.sims.vehicle.vehicle import Vehicle
from spinndrift.systems.mavlink import codec
from spinndrift.systems.mavlink.dialect import Message, Parser, mavlink

pytestmark = pytest.mark.whole

TICK = 0.01


class Client:
    """A ground station at each port of a vehicle."""

    def __init__(
        self,
        ports: int = 1,
        motion: Motion | None = None,
        clock: float = 0.0,
        tick: float = TICK,
        **values,
    ):
        self.vehicle = Vehicle(values, clock)
        self.ports = Ports(self.vehicle, ports)
        self.motion = motion or Motion()
        self.sender = Parser(255, 190)
        self._readers = [Parser(255, 190) for _ in range(ports)]
        self.heard: list[list[Message]] = [[] for _ in range(ports)]
        self.ticks, self.tick = 0, tick
        self.run(2.0)

    def send(self, message: Message, port: int = 0) -> None:
        self.ports.receive(port, self.sender.packed(message))

    def run(self, duration: float) -> None:
        for _ in range(round(duration / self.tick)):
            self.ticks += 1
            self.vehicle.step(self.ticks * self.tick, self.motion)
            for port, packets in enumerate(self.ports.step()):
                for packet in packets:
                    self.heard[port] += self._readers[port].messages(packet)

    def of(self, kind: str, port: int = 0) -> list:
        return [m for m in self.heard[port] if m.get_type() == kind]

    def forget(self) -> None:
        for heard in self.heard:
            heard.clear()

    def command(self, number: int, *params: float) -> int:
        """Send COMMAND_LONG; the result of its acknowledgement."""
        self.forget()
        filled = [*params, *[0.0] * 7][:7]
        self.send(mavlink.MAVLink_command_long_message(1, 1, number, 0, *filled))
        self.run(self.tick)
        ack = self.of("COMMAND_ACK")[-1]
        assert ack.command == number
        assert (ack.target_system, ack.target_component) == (255, 190)
        return ack.result


def test_heartbeat_says_what_a_submarine_of_ardupilot_says():
    client = Client()
    client.forget()
    client.run(3.0)
    beats = client.of("HEARTBEAT")
    assert len(beats) == 3
    assert (beats[0].type, beats[0].autopilot, beats[0].base_mode) == (12, 3, 81)
    assert beats[0].custom_mode == 19
    assert client.command(400, 1) == 0
    client.run(1.1)
    assert client.of("HEARTBEAT")[-1].base_mode == 209


def test_default_rates_are_those_of_a_vehicle():
    client = Client()
    client.forget()
    client.run(10.0)
    counts = Counter(m.get_type() for m in client.heard[0])
    for kind, rate in {
        "RAW_IMU": 2,
        "SYS_STATUS": 2,
        "SERVO_OUTPUT_RAW": 2,
        "GLOBAL_POSITION_INT": 3,
        "ATTITUDE": 10,
        "VFR_HUD": 10,
        "EKF_STATUS_REPORT": 3,
    }.items():
        assert abs(counts[kind] - 10 * rate) <= 1, kind
    assert "ATTITUDE_QUATERNION" not in counts
    assert "LOCAL_POSITION_NED" not in counts  # there is no horizontal aid


@pytest.mark.parametrize(
    ("asked", "given"), [(20, 20), (50, 50), (100, 100), (200, 200), (400, 333)]
)
def test_six_messages_together_hold_the_rate_that_was_asked_for(asked: int, given: int):
    client = Client(tick=0.0025)
    ids = {27: "RAW_IMU", 31: "ATTITUDE_QUATERNION", 36: "SERVO_OUTPUT_RAW", 30: "ATTITUDE"}
    ids |= {116: "SCALED_IMU2", 137: "SCALED_PRESSURE2"}
    for message in ids:
        assert client.command(511, message, 1e6 / asked) == 0
    client.forget()
    client.run(2.0)
    for kind in ids.values():
        assert abs(len(client.of(kind)) - 2 * given) <= 2


def test_intervals_are_reset_switched_off_and_told():
    client = Client()
    assert client.command(511, 30, 10_000) == 0
    assert client.command(510, 30) == 0
    assert client.of("MESSAGE_INTERVAL")[-1].interval_us == 10_000
    assert client.command(511, 30, -1) == 0
    client.forget()
    client.run(1.0)
    assert not client.of("ATTITUDE")
    assert client.command(511, 30, 0) == 0
    client.forget()
    client.run(1.0)
    assert len(client.of("ATTITUDE")) in (9, 10, 11)
    client.send(mavlink.MAVLink_request_data_stream_message(1, 1, 10, 50, 1))
    client.forget()
    client.run(1.0)
    assert len(client.of("ATTITUDE")) in (49, 50, 51)


@pytest.mark.parametrize("message", [105, 331, 230, 64, 141, 11038, 375, 111])
def test_messages_that_ardusub_lacks_are_denied_and_say_so(message: int):
    client = Client()
    assert client.command(511, message, 10_000) == 2
    assert client.of("STATUSTEXT")[-1].text == f"No ap_message for mavlink id ({message})"


def test_commands_that_are_not_known_are_unsupported():
    client = Client()
    assert client.command(31000) == 3
    assert client.command(519, 1) == 3
    assert client.command(520, 1) == 0
    assert client.of("AUTOPILOT_VERSION")
    assert client.command(512, 148) == 0


def test_modes_are_set_and_refused_with_a_reason():
    client = Client()
    assert client.command(176, 1, 2) == 0
    client.run(1.0)
    assert client.of("HEARTBEAT")[-1].custom_mode == 2
    assert client.command(176, 1, 16) == 4
    assert client.of("STATUSTEXT")[-1].text == "Mode change failed: POSHOLD requires position"
    client.send(mavlink.MAVLink_set_mode_message(1, 1, 19))
    client.run(1.1)
    assert client.of("HEARTBEAT")[-1].custom_mode == 19


def test_parameters_list_read_and_set():
    client = Client()
    client.forget()
    client.send(mavlink.MAVLink_param_request_list_message(1, 1))
    client.run(3.0)
    listed = client.of("PARAM_VALUE")
    names = client.vehicle.parameters.names
    assert [m.param_id for m in listed] == list(names)
    assert [m.param_index for m in listed] == list(range(len(names)))
    assert {m.param_count for m in listed} == {len(names)}
    client.forget()
    client.send(mavlink.MAVLink_param_set_message(1, 1, b"SERVO7_FUNCTION", 57.0, 9))
    client.send(mavlink.MAVLink_param_request_read_message(1, 1, b"SERVO7_FUNCTION", -1))
    client.run(TICK)
    assert [m.param_value for m in client.of("PARAM_VALUE")] == [57.0, 57.0]
    client.forget()
    client.send(mavlink.MAVLink_param_set_message(1, 1, b"SERVO7_FUNCTION", float("nan"), 9))
    client.send(mavlink.MAVLink_param_request_read_message(1, 1, b"NOT_THERE", -1))
    client.run(TICK)
    assert not client.of("PARAM_VALUE")


def test_forced_arming_has_its_own_number():
    client = Client(BATT_ARM_VOLT=20)
    assert client.command(400, 1) == 4
    assert client.of("STATUSTEXT")[-1].text == "Arm: Battery 1 below minimum arming voltage"
    assert client.command(400, 1, 21196) == 4
    assert client.command(400, 1, 2989) == 0
    assert client.command(400, 1) == 0
    assert client.command(400, 0, 21196) == 0


def test_timesync_is_answered_and_missions_are_empty():
    client = Client()
    client.forget()
    client.send(mavlink.MAVLink_timesync_message(0, 12345))
    client.send(mavlink.MAVLink_mission_request_list_message(1, 1))
    client.run(TICK)
    answer = client.of("TIMESYNC")[0]
    assert answer.ts1 == 12345
    assert answer.tc1 == pytest.approx(2e9, rel=1e-3)
    assert client.of("MISSION_COUNT")[0].count == 0


def test_telemetry_returns_through_the_codec_what_went_in():
    q_WB = codec.attitude_from_euler(0.1, -0.2, 0.7)
    motion = Motion(
        q_WB=q_WB,
        omega_B=np.array([0.1, -0.2, 0.3]),
        f_B=np.array([0.5, -0.4, 9.7]),
        height=-3.2,
        climb=0.1,
        pressure=3.2 * codec.ARDUSUB_PASCAL_PER_METRE,
        voltage=15.5,
    )
    client = Client(motion=motion)
    for message in (27, 31, 137, 33, 147):
        assert client.command(511, message, 20_000) == 0
    client.run(0.1)
    last = {m.get_type(): m for m in client.heard[0]}
    q = last["ATTITUDE_QUATERNION"]
    np.testing.assert_allclose(codec.attitude(q.q1, q.q2, q.q3, q.q4), q_WB, atol=1e-6)
    imu = last["RAW_IMU"]
    gyro = codec.imu_angular_rate(imu.xgyro, imu.ygyro, imu.zgyro)
    np.testing.assert_allclose(gyro, motion.omega_B, atol=0.5e-3)  # whole mrad/s
    force = codec.imu_specific_force(imu.xacc, imu.yacc, imu.zacc)
    np.testing.assert_allclose(force, motion.f_B, atol=0.5e-3 * codec.G)
    depth = codec.depth_from_pressure(last["SCALED_PRESSURE2"].press_abs)
    assert depth == pytest.approx(3.2, abs=1e-4)  # a float's step at 1300 hPa
    position = last["GLOBAL_POSITION_INT"]
    assert codec.height_from_relative_alt(position.relative_alt) == pytest.approx(-3.2)
    assert codec.climb_from_vz(position.vz) == pytest.approx(0.1)
    assert position.alt == 0  # frozen
    assert codec.pack_voltage(np.array(last["BATTERY_STATUS"].voltages, float)) == pytest.approx(
        15.5
    )


def test_a_dvl_gives_a_local_position_after_its_settling_and_reaches_every_port():
    client = Client(ports=2)
    client.run(36.0)
    for _ in range(10):
        moved = np.array([0.05, 0.0, 0.0])  # forward, east
        client.ports.dvl(dvl_messages(client.vehicle.boot_us, 0.1, moved, np.zeros(3), 90.0, 3.0))
        client.run(0.1)
    client.forget()
    client.ports.dvl(dvl_messages(client.vehicle.boot_us, 0.1, np.zeros(3), np.zeros(3), 90.0, 3.0))
    client.run(0.5)
    position = client.of("LOCAL_POSITION_NED")[-1]
    np.testing.assert_allclose([position.x, position.y], [0.0, 0.5], atol=1e-6)
    for port in (0, 1):
        delta = client.of("VISION_POSITION_DELTA", port)[0]
        assert (delta.get_srcSystem(), delta.get_srcComponent()) == (1, 197)
        assert client.of("DISTANCE_SENSOR", port)[0].current_distance == 300


def test_odometry_in_its_own_frame_aids_and_in_another_is_ignored():
    def odometry(frame: int) -> Message:
        q, none = [np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)], [0.0] * 21
        return mavlink.MAVLink_odometry_message(
            0, frame, 12, 2.0, 3.0, 1.0, q, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, none, none
        )

    client = Client()
    client.run(2.0)
    client.send(odometry(1))
    client.forget()
    client.run(0.5)
    assert not client.of("LOCAL_POSITION_NED")
    client.send(odometry(20))
    client.run(0.5)
    position = client.of("LOCAL_POSITION_NED")[-1]
    got = [position.x, position.y, position.vx, position.vy]
    # forward at a heading of 90° is east
    np.testing.assert_allclose(got, [2.0, 3.0, 0.0, 0.5], atol=1e-6)


def test_ports_have_rates_of_their_own_and_route_for_each_other():
    client = Client(ports=2)
    client.forget()
    client.send(
        mavlink.MAVLink_command_long_message(1, 1, 511, 0, 30, 10_000, 0, 0, 0, 0, 0), port=1
    )
    client.send(mavlink.MAVLink_vision_position_delta_message(0, 100, [0.0] * 3, [0.0] * 3, 50.0))
    client.run(1.0)
    assert len(client.of("ATTITUDE", 0)) in (9, 10, 11)
    assert len(client.of("ATTITUDE", 1)) in (99, 100, 101)
    assert not client.of("COMMAND_ACK", 0)
    assert len(client.of("VISION_POSITION_DELTA", 1)) == 1
    assert not client.of("VISION_POSITION_DELTA", 0)


def test_a_reboot_forgets_all_but_parameters_and_begins_the_clock_anew():
    client = Client()
    client.send(mavlink.MAVLink_param_set_message(1, 1, b"SERVO8_FUNCTION", 58.0, 9))
    client.command(176, 1, 0)
    client.command(511, 30, 10_000)
    assert client.command(246, 1) == 0
    client.run(1.0)
    client.forget()
    client.run(2.0)
    assert client.of("ATTITUDE")[-1].time_boot_ms < 3100
    assert len(client.of("ATTITUDE")) < 20
    assert client.of("HEARTBEAT")[-1].custom_mode == 19
    assert client.vehicle.parameters["SERVO8_FUNCTION"] == 58


def test_microseconds_overflow_where_their_field_does():
    client = Client(clock=4294.967296 - 3.0)
    client.run(2.0)
    client.forget()
    client.command(511, 36, 20_000)
    client.run(0.2)
    assert client.of("SERVO_OUTPUT_RAW")[-1].time_usec < 2e6
    assert client.vehicle.boot_us > 2**32


# ------------------------------------------------------------------------------ robustness


def test_damaged_and_invented_packets_raise_nothing():
    chance = random.Random(5)
    client = Client()
    kinds = [kind for kind in mavlink.mavlink_map.values() if hasattr(kind, "unpacker")]
    handled = {message.msgname for message in kinds} & HANDLED
    assert handled == HANDLED
    known = [kind for kind in kinds if kind.msgname in HANDLED]
    for n in range(2000):
        kind = chance.choice(known if n % 2 else kinds)
        size = kind.unpacker.size
        payload = bytes(chance.choice((0, 1, 255, chance.randrange(256))) for _ in range(size))
        data = bytearray(framed(kind, payload, n))
        if n % 5 == 0:
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        client.ports.receive(0, bytes(data))
        if n % 10 == 0:
            client.run(TICK)
    client.run(4.0)
    client.forget()
    client.run(2.0)
    assert client.of("HEARTBEAT")


HANDLED = {
    "HEARTBEAT",
    "MANUAL_CONTROL",
    "RC_CHANNELS_OVERRIDE",
    "COMMAND_LONG",
    "COMMAND_INT",
    "PARAM_SET",
    "PARAM_REQUEST_READ",
    "TIMESYNC",
    "VISION_POSITION_DELTA",
    "ODOMETRY",
}


def test_a_faulty_link_loses_delays_damages_and_reorders_the_share_it_is_told():
    faults = LinkFaults(loss=0.2, corruption=0.1, reordering=0.1, delay=0.05, jitter=0.03)
    packets = [n.to_bytes(4, "big") + random.Random(n).randbytes(8) for n in range(5000)]

    def arrivals(seed: int) -> list[tuple[float, bytes]]:
        link, arrived = FaultyLink(faults, seed), []
        for n, packet in enumerate(packets):
            link.send(0.01 * n, packet)
            arrived += [(0.01 * n, p) for p in link.due(0.01 * n)]
        return arrived + [(60.0, p) for p in link.due(60.0)]

    got = arrivals(1)
    assert got == arrivals(1)
    assert got != arrivals(2)
    # four standard deviations of a share of 5000
    assert abs(len(got) / 5000 - 0.8) < 4 * (0.2 * 0.8 / 5000) ** 0.5
    sound = {p: t for t, p in got if p in set(packets)}
    assert abs(1 - len(sound) / len(got) - 0.1) < 4 * (0.1 * 0.9 / 4000) ** 0.5
    numbers = [int.from_bytes(p[:4], "big") for p in sound]
    delays = np.array([t - 0.01 * n for t, n in zip(sound.values(), numbers, strict=True)][:-20])
    assert delays.min() >= 0.05 - 1e-9
    assert delays.max() <= 0.05 + 0.03 + 0.05 + 0.01 + 1e-9
    overtaken = np.mean(np.array(numbers) < np.maximum.accumulate(numbers))
    assert abs(overtaken - 0.1) < 4 * (0.1 * 0.9 / 4000) ** 0.5
