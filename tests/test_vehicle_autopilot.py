"""The simulated autopilot against what a real ArduSub 4.5.6 was measured to do."""

import numpy as np
import pytest
from measured_mixer import MEASURED

from spinndrift.models.config.errors import UserError
from spinndrift.sims.vehicle.autopilot.autopilot import FORCE_ARM, Autopilot
from spinndrift.sims.vehicle.autopilot.channels import Channels
from spinndrift.sims.vehicle.autopilot.mixer import FRAMES, Demands, mix
from spinndrift.sims.vehicle.autopilot.navigation import Motion
from spinndrift.sims.vehicle.autopilot.parameters import Parameters
from spinndrift.sims.vehicle.autopilot.pilot import Sticks
from spinndrift.systems.mavlink import codec

GCS = 255
DT = 0.01
NEUTRAL = [1500] * 8
IGNORED = [65535] * 8
PASS_THROUGH = {f"SERVO{n}_FUNCTION": 50 + n for n in range(1, 9)}


class Dive:
    """An autopilot in virtual time, with a ground station that sends what `say` says."""

    def __init__(self, motion: Motion | None = None, **values: float | int):
        self.parameters = Parameters(values)
        self.autopilot = Autopilot(self.parameters)
        self.motion = motion or Motion()
        self.texts: list[str] = []
        self.t = 0.0

    def run(self, duration: float, say=None, heartbeats: bool = True) -> list[int]:
        """Advance; `say` is called ten times a second."""
        for _ in range(round(duration / DT)):
            if round(self.t / DT) % 10 == 0:
                if heartbeats:
                    self.autopilot.heard(GCS)
                if say is not None:
                    say(self.autopilot)
            self.t = round(self.t + DT, 9)
            self.autopilot.step(self.t, self.motion)
            self.texts += [text.text for text in self.autopilot.texts]
            self.autopilot.texts.clear()
        return list(self.autopilot.outputs.us[:8])


def sticks(**fields: int):
    return lambda autopilot: autopilot.manual_control(GCS, 1, Sticks(**fields))


def override(*values: int):
    return lambda autopilot: autopilot.override(GCS, [*values, *IGNORED][:8] + [0] * 8)


def armed(motion: Motion | None = None, **values: float | int) -> Dive:
    dive = Dive(motion, **values)
    dive.run(2.0, sticks())
    assert dive.autopilot.arm()
    dive.run(1.5, sticks())
    return dive


def test_mixer_has_the_signs_that_were_measured_on_each_thruster():
    measured = MEASURED[:, [3, 4, 5, 2, 0, 1]] * [1, 1, 1, -1, 1, 1]  # the mixer's throttle is up
    np.testing.assert_array_equal(np.array(FRAMES[2].factors), measured)


@pytest.mark.parametrize("frame", [1, 2])
def test_each_demand_moves_the_vehicle_along_its_own_axis_alone(frame: int):
    parameters = Parameters({"FRAME_CONFIG": frame})
    factors = np.array(FRAMES[frame].factors)
    # BlueROV2 in the autopilot's frame: the sum of effects u · factor is the effect on each axis
    for axis, name in enumerate(Demands._fields):
        if frame == 1 and name == "pitch":
            assert not factors[:, axis].any()  # six thrusters don't pitch
            continue
        widths = mix(parameters, frame, Demands(**{name: 0.5}), 1.0)
        effect = (np.array(widths) - 1500) @ factors
        assert effect[axis] > 0
        np.testing.assert_array_equal(np.delete(effect, axis), 0)


def test_the_groups_saturate_each_by_their_own_maximum():
    parameters = Parameters()
    demands = Demands(yaw=0.5, forward=1.0, lateral=0.5, throttle=0.3)
    widths = mix(parameters, 2, demands, 1.0)
    # horizontals: sums 0, -2, 1, 1 divided by 2; verticals keep theirs
    assert widths == [1500, 1100, 1700, 1700, 1380, 1380, 1380, 1380]


def test_a_reversed_motor_is_mirrored_in_the_mixer_and_nowhere_else():
    dive = armed(MOT_3_DIRECTION=-1)
    forward = dive.run(0.2, sticks(x=1000))
    assert forward == [1300, 1300, 1300, 1700, 1500, 1500, 1500, 1500]
    raw = Dive(MOT_3_DIRECTION=-1, **PASS_THROUGH)
    assert raw.run(2.0, override(1500, 1500, 1600))[2] == 1600
    tested = armed(MOT_3_DIRECTION=-1)
    assert tested.autopilot.test_motor((2, 1, 1600, 0, 0, 2, 0))
    assert tested.autopilot.outputs.us[:8] == [1500, 1500, 1600, *[1500] * 5]


@pytest.mark.parametrize(
    ("fields", "channel", "us"),
    [
        ({}, 3, 1500),
        ({"x": 1000}, 5, 1700),
        ({"y": -1000}, 6, 1300),
        ({"r": 500}, 4, 1600),
        ({"z": 1000}, 3, 1700),
        ({"z": 0}, 3, 1300),  # the field's default dives
        ({"s": 400}, 1, 1900),  # without the gain
        ({"t": -100}, 2, 1400),
        ({"x": 32767}, 5, 1900),  # "not used" is full
        ({"z": 32767}, 3, 1900),
        ({"s": -32768}, 1, 1100),
    ],
)
def test_manual_control_scales_by_the_gain_what_it_scaled(fields: dict, channel: int, us: int):
    dive = Dive()
    dive.run(0.5, sticks(**fields))
    expected = [1500] * 8
    expected[channel - 1] = us
    assert dive.autopilot.channels.us[:8] == expected


@pytest.mark.parametrize("gain", [0.25, 0.5, 1.0])
def test_fields_of_the_codec_ask_for_the_wrench_that_the_mixer_then_gives(gain: float):
    wanted = np.array([0.2, -0.1, 0.15, 0.1, -0.05, 0.12])  # surge … yaw about B
    fields = codec.manual_control_fields(*wanted.tolist(), gain=gain)
    dive = armed(JS_GAIN_DEFAULT=gain)
    u = (np.array(dive.run(0.2, sticks(**fields))) - 1500) / 400
    got = u @ (MEASURED * [1, -1, -1, 1, -1, -1]) / 4  # four thrusters share each demand
    # 1 µs of each width, and a field's step of up to 1000 gain / 500
    np.testing.assert_allclose(got, wanted, atol=1 / 400 + gain / 500)


def test_only_the_ground_station_commands_and_only_this_vehicle():
    dive = Dive()
    for system, target in ((254, 1), (GCS, 0), (GCS, 2)):
        dive.run(0.2, lambda a, s=system, to=target: a.manual_control(s, to, Sticks(x=1000)))
        assert dive.autopilot.channels.us[4] == 1500
    dive.run(0.2, lambda a: a.override(254, [1600] * 16))
    assert dive.autopilot.channels.us[:8] == NEUTRAL
    other = Dive(SYSID_MYGCS=254)
    other.run(0.2, lambda a: a.override(254, [1600] * 16))
    assert other.autopilot.channels.us[:8] == [1600] * 8


def test_buttons_disarm_arm_and_step_the_gain_once_a_press():
    dive = Dive()
    dive.run(0.2, sticks(buttons=1 << 6))
    assert dive.autopilot.armed
    dive.run(0.2, sticks())
    dive.run(0.5, sticks(buttons=1 << 11))  # held
    assert dive.autopilot.pilot.gain == pytest.approx(0.75)
    assert dive.texts.count("#Gain is 75%") == 1
    dive.run(0.2, sticks(buttons=1 << 4))
    assert not dive.autopilot.armed


def test_overrides_ignore_65535_keep_on_release_and_have_no_limit():
    channels, parameters = Channels(), Parameters()
    channels.override_all([1600, 65535, 0, 2200, 900, 65534, 65535, 1700] + [0] * 8, 1.0)
    assert channels.update(1.0, parameters)
    assert channels.us[:8] == [1600, 1500, 1500, 2200, 900, 65534, 1500, 1700]
    channels.override_all([0] * 8 + [1800, 65534] + [0] * 6, 1.1)
    assert channels.update(1.1, parameters)
    assert channels.us[:10] == [1600, 1500, 1500, 2200, 900, 65534, 1500, 1700, 1800, 0]
    assert not channels.update(1.2, parameters)


def test_vertical_thrust_ramps_up_after_arming_as_it_was_recorded():
    # ../shared/data/sitl_log: z = 0 held while arming; seconds after "Arming motors"
    recorded = {0.47: 1500, 0.541: 1529, 0.564: 1545, 0.612: 1585, 0.66: 1700}
    dive = Dive()
    dive.run(3.0, sticks(z=0))
    assert dive.autopilot.arm()
    for t, us in recorded.items():
        out = dive.run(t - (dive.t - 3.0), sticks(z=0))
        assert out[:4] == NEUTRAL[:4]
        # a step of this test is 0.01 s of the ramp, 8 µs; the log was read 0.01 s late at most
        assert abs(out[4] - us) <= 16, t


# -------------------------------------------------------------------------------- failsafes

FORWARD = (1500, 1500, 1500, 1500, 1600)
DRIVEN = [1400, 1400, 1600, 1600, 1500, 1500, 1500, 1500]


def test_overrides_stop_while_heartbeats_go_on_disarm():
    dive = armed()
    assert dive.run(1.0, override(*FORWARD)) == DRIVEN
    assert dive.run(2.85) == DRIVEN
    assert dive.run(0.2) == NEUTRAL
    assert not dive.autopilot.armed
    assert dive.texts[-2:] == ["Lost manual control", "Disarming motors"]
    assert dive.autopilot.status == 5


def test_overrides_stop_neutral_only():
    dive = armed(FS_PILOT_INPUT=1)
    dive.run(1.0, override(*FORWARD))
    assert dive.run(2.85) == DRIVEN
    assert dive.run(0.2) == NEUTRAL
    assert dive.autopilot.armed


def test_overrides_stop_without_the_failsafe_and_the_last_is_held():
    dive = armed(FS_PILOT_INPUT=0)
    dive.run(1.0, override(*FORWARD))
    assert dive.run(7.0) == DRIVEN
    assert dive.autopilot.armed


@pytest.mark.parametrize("way", [1, 2])
def test_pass_through_goes_on_with_seven_and_eight(way: int):
    dive = Dive(FS_PILOT_INPUT=way, **PASS_THROUGH)
    dive.run(1.5, override(*[1600] * 8))
    assert not dive.autopilot.armed  # it runs without
    assert dive.run(2.6) == [1600] * 8
    assert dive.run(7.0) == [1500] * 6 + [1600] * 2


def test_pass_through_without_the_failsafe_goes_on_for_ever():
    dive = Dive(FS_PILOT_INPUT=0, **PASS_THROUGH)
    dive.run(1.5, override(*[1600] * 8))
    assert dive.run(7.0) == [1600] * 8


def test_silence_disarms_after_two_and_a_half_seconds():
    dive = armed(FS_PILOT_INPUT=0)
    dive.run(1.0, override(*FORWARD))
    assert dive.run(2.3, heartbeats=False) == DRIVEN
    assert dive.run(0.5, heartbeats=False) == NEUTRAL
    assert not dive.autopilot.armed
    assert "MYGCS: heartbeat lost" in dive.texts


def test_silence_in_pass_through_disarms_and_the_thrusters_go_on():
    dive = armed(FS_PILOT_INPUT=0, **PASS_THROUGH)
    dive.run(1.0, override(*[1600] * 8))
    assert dive.run(7.0, heartbeats=False) == [1600] * 8
    assert not dive.autopilot.armed


def test_silence_holds_depth_and_keeps_the_forward_command():
    dive = armed(FS_PILOT_INPUT=0, FS_GCS_ENABLE=3)
    dive.run(1.0, override(*FORWARD))
    assert dive.run(4.0, heartbeats=False)[:4] == DRIVEN[:4]
    assert dive.autopilot.mode == 2
    assert dive.autopilot.armed


def test_silence_with_surface_disarms_without_a_position():
    dive = armed(FS_PILOT_INPUT=0, FS_GCS_ENABLE=4)
    dive.run(1.0, override(*FORWARD))
    assert dive.run(4.0, heartbeats=False) == NEUTRAL
    assert not dive.autopilot.armed
    assert "Mode change failed: SURFACE requires position" in dive.texts


@pytest.mark.parametrize("way", [0, 1])
def test_silence_without_an_action_goes_on_for_ever(way: int):
    dive = armed(FS_PILOT_INPUT=0, FS_GCS_ENABLE=way)
    dive.run(1.0, override(*FORWARD))
    assert dive.run(7.0, heartbeats=False) == DRIVEN


def test_overrides_count_as_heartbeats():
    dive = armed()
    assert dive.run(7.0, override(*FORWARD), heartbeats=False) == DRIVEN


def test_the_pilots_failsafe_acts_once():
    dive = Dive()
    dive.run(4.0)
    assert dive.texts.count("Lost manual control") == 1
    assert dive.autopilot.arm()
    dive.run(7.0)
    assert dive.autopilot.armed


def test_a_leak_is_told_and_is_critical():
    dive = armed(motion=Motion(leak=True))
    assert "Leak Detected" in dive.texts
    assert dive.autopilot.status == 5


# ------------------------------------------------------------------------- arming and modes


def test_arming_is_refused_below_the_least_voltage_and_forced_by_its_number_alone():
    assert FORCE_ARM == 2989
    dive = Dive(BATT_ARM_VOLT=20)
    dive.run(0.5)
    assert not dive.autopilot.arm()
    dive.run(0.1)
    assert "Arm: Battery 1 below minimum arming voltage" in dive.texts
    assert dive.autopilot.arm(force=True)
    assert dive.autopilot.arm()  # twice is accepted


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"RC2_MIN": 1400}, "Arm: Roll radio min too high"),
        ({"RC4_MAX": 1600}, "Arm: Yaw radio max too low"),
        ({"BATT_LOW_VOLT": 17}, "Arm: Battery 1 low voltage failsafe"),
        (
            {"BTN4_FUNCTION": 0},
            "Arm: Must assign a disarm or arm_toggle button or disarm aux function",
        ),
    ],
)
def test_refusals_to_arm_say_why(values: dict, told: str):
    dive = Dive(**values)
    assert not dive.autopilot.arm()
    dive.run(0.05)
    assert told in dive.texts


def test_modes_that_need_a_position_are_refused_without_one():
    dive = Dive()
    dive.run(2.0)
    assert dive.autopilot.mode == 19
    for mode in (3, 4, 7, 9, 16):
        assert not dive.autopilot.set_mode(mode)
    for mode in (0, 1, 2, 21, 19):
        assert dive.autopilot.set_mode(mode)
        assert dive.autopilot.mode == mode
    assert not dive.autopilot.set_mode(77)
    dive.run(0.05)
    assert "Mode change failed: POSHOLD requires position" in dive.texts
    assert "No such mode 77" in dive.texts


def test_displacements_aid_once_biases_have_settled_and_positions_at_once():
    moved = np.array([0.1, 0.0, 0.0])

    def dvl(autopilot: Autopilot) -> None:
        autopilot.aid.displaced(autopilot.t, 0.1, moved, 90.0, autopilot.motion)

    dive = Dive()
    dive.run(30.0, dvl)
    assert "EKF3 IMU0 fusing odometry" in dive.texts
    assert not dive.autopilot.aid.valid(dive.t)
    dive.run(10.0, dvl)
    assert dive.autopilot.aid.valid(dive.t)
    assert dive.autopilot.set_mode(16)
    np.testing.assert_allclose(dive.autopilot.aid.v_W, [1.0, 0.0])
    dive.run(2.0)
    assert not dive.autopilot.aid.valid(dive.t)
    placed = Dive()
    placed.run(5.0, lambda a: a.aid.placed(a.t, np.array([3.0, 4.0, -1.0]), np.zeros(3)))
    assert placed.autopilot.aid.valid(placed.t)
    nan = Dive()
    nan.run(5.0, lambda a: a.aid.placed(a.t, np.full(3, np.nan), np.zeros(3)))
    assert not nan.autopilot.aid.valid(nan.t)


# --------------------------------------------------------------------- thrusters one by one


def motor(number: int, us: int):
    return lambda a: a.test_motor((number, 1, us, 0, 0, 2, 0))


def test_the_motor_test_moves_one_motor_and_times_out():
    dive = armed()
    assert dive.run(0.5, motor(6, 2200)) == [1500] * 6 + [2200, 1500]
    dive.run(0.3, motor(0, 900))
    assert dive.autopilot.outputs.us[:8] == [900, *[1500] * 5, 2200, 1500]
    assert dive.run(0.7, sticks()) == NEUTRAL
    assert "Motor test timed out!" in dive.texts
    assert not dive.autopilot.armed
    dive.autopilot.arm()
    assert not dive.autopilot.test_motor((0, 1, 1600, 0, 0, 2, 0))
    dive.run(0.05)
    assert "10 second cooldown required after motor test" in dive.texts


def test_a_disarm_in_the_motor_test_holds_the_thrusters_while_commands_go_on():
    dive = armed()
    dive.run(0.5, motor(6, 1700))
    dive.autopilot.disarm()
    assert dive.run(3.0, motor(6, 1600)) == [1500] * 6 + [1700, 1500]
    assert not dive.autopilot.test_motor((6, 1, 1600, 0, 0, 2, 0))
    assert dive.run(0.7) == NEUTRAL


def test_set_servo_needs_an_output_without_an_owner_and_never_stops():
    dive = Dive(SERVO1_FUNCTION=0)
    dive.run(1.5)
    assert not dive.autopilot.set_servo(2, 1600)
    assert dive.autopilot.set_servo(1, 1600)
    assert dive.run(5.0, heartbeats=False)[0] == 1600


def test_a_changed_function_acts_within_a_second_and_outlives_a_reboot():
    dive = armed()
    dive.run(0.5, override(*[1600] * 8))
    dive.parameters.set("SERVO8_FUNCTION", 58)
    assert dive.run(1.2, override(*[1600] * 8))[7] == 1600
    rebooted = Autopilot(dive.parameters)
    rebooted.override(GCS, [1600] * 16)
    for t in (0.01, 0.02, 0.03):
        rebooted.step(t, Motion())
    assert rebooted.outputs.us[:8] == [1500] * 7 + [1600]


def test_depth_hold_pushes_back_towards_its_depth():
    def verticals(depth_now: float) -> float:
        dive = armed(motion=Motion(height=-2.0))
        dive.autopilot.set_mode(2)
        dive.run(0.2, sticks())
        dive.motion = Motion(height=-depth_now)
        return float(np.mean(dive.run(0.2, sticks())[4:]))

    assert verticals(2.0) == 1500
    assert verticals(2.3) < 1450  # too deep: up
    assert verticals(1.7) > 1550


# ------------------------------------------------------------------------------- parameters


def test_parameters_are_stored_in_their_types():
    parameters = Parameters()
    assert parameters.set("FS_PILOT_INPUT", 1.6)
    assert parameters["FS_PILOT_INPUT"] == 2
    assert parameters.set("FS_PILOT_INPUT", 1e9)
    assert parameters["FS_PILOT_INPUT"] == 127
    assert parameters.set("JS_GAIN_DEFAULT", 0.3)
    assert parameters["JS_GAIN_DEFAULT"] == np.float32(0.3)
    assert not parameters.set("JS_GAIN_DEFAULT", float("nan"))
    assert not parameters.set("NOT_THERE", 1)
    with pytest.raises(UserError, match="NOT_THERE"):
        Parameters({"NOT_THERE": 1})
