"""Logs with one thing wrong: what the import finds, and what it makes of it."""

import lzma

import numpy as np
import pytest
from log_writers import PARAMETERS, dataflash, dialect, dive, heartbeat, outputs, parameter
from recordings_changed import changed

from helpers import ROOT, shared_data
from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.checks.examine import examine
from spinndrift.models.recordings.checks.finding import findings_of
from spinndrift.models.recordings.outputs import outputs_of
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.logs.frame import settled
from spinndrift.systems.logs.load import import_log


def imported(folder, data, name="dive.tlog", **options):
    path = folder / name
    path.write_bytes(data)
    recording, report = import_log(path, **options)
    return recording, [(f.word, f.place) for f in findings_of(recording.dataset)], report


def pwm(recording):
    run = next(iter(recording.trajectories()))
    t = run.start + recording.dt * (np.arange(len(run)) + 0.5)
    return run.commands["pwm"].T, outputs(t)


@pytest.mark.parametrize(
    ("kind", "autopilot", "said"),
    [(2, 3, "a quadrotor"), (10, 3, "a rover"), (1, 3, "aeroplane"), (12, 12, "PX4")],
)
def test_logs_of_other_vehicles_are_refused(tmp_path, kind, autopilot, said):
    log = dive(duration=8.0)
    log.records = [r for r in log.records if r[1][7:10] != b"\0\0\0"]  # without heartbeats
    for t in np.arange(100.0, 108.0):
        log.send(t, heartbeat(kind=kind, autopilot=autopilot))
    with pytest.raises(UserError, match=f"not ArduSub's: .*{said}.*--accept not-a-submarine"):
        imported(tmp_path, log.bytes())
    _, found, _ = imported(tmp_path, log.bytes(), accept=["not-a-submarine"])
    assert found == [("not-a-submarine", "HEARTBEAT")]


def test_frames_that_contradict_the_outputs_or_have_no_preset_are_refused(tmp_path):
    eight = PARAMETERS | {"FRAME_CONFIG": 0.0}
    with pytest.raises(UserError, match="BLUEROV1 has 6 thrusters, and outputs 7, 8 drive more"):
        imported(tmp_path, dive(duration=8.0, parameters=eight).bytes())
    six = {f"SERVO{n}_FUNCTION": 32.0 + n for n in range(1, 7)} | {"FRAME_CONFIG": 0.0}
    with pytest.raises(UserError, match="no preset has the thrusters of frame BLUEROV1"):
        imported(tmp_path, dive(duration=8.0, parameters=six).bytes())
    _, found, _ = imported(tmp_path, dive(duration=8.0, parameters=six).bytes(), vehicle="bluerov2")
    assert found == []


def named_frame(name: bytes, parameters: dict[str, float]):
    """A dive before which the autopilot named its frame."""
    log = dive(duration=8.0, parameters=parameters)
    log.send(100.0, dialect.MAVLink_statustext_message(6, b"Frame: " + name))
    return log.bytes()


def test_the_frame_that_the_autopilot_names_counts_where_the_parameter_is_missing(tmp_path):
    recording, found, report = imported(tmp_path, named_frame(b"VECTORED", {}))
    assert (recording.vehicle, found) == ("bluerov2", [])
    assert any("Frame: VECTORED: 6 thrusters" in line for line in report.done)
    other = named_frame(b"SOMETHING_NEW", {})
    assert imported(tmp_path, other)[0].vehicle == "bluerov2_heavy"
    with pytest.raises(UserError, match="Frame: VECTORED is that of a vehicle with 6 thrusters"):
        imported(tmp_path, named_frame(b"VECTORED", {}), vehicle="bluerov2_heavy")


def test_a_frame_that_was_changed_without_a_start_is_refused_unless_outputs_have_it(tmp_path):
    """The motors of FRAME_CONFIG were not in force, or the functions of all outputs say so too."""
    changed = named_frame(b"VECTORED_6DOF", {"FRAME_CONFIG": 1.0})
    with pytest.raises(UserError, match=r"FRAME_CONFIG 1.*VECTORED, and the autopilot started as"):
        imported(tmp_path, changed)
    outputs_too = {f"SERVO{n}_FUNCTION": 32.0 + n for n in range(1, 7)}
    outputs_too |= {"FRAME_CONFIG": 1.0, "SERVO7_FUNCTION": 0.0, "SERVO8_FUNCTION": 0.0}
    recording, found, report = imported(tmp_path, named_frame(b"VECTORED_6DOF", outputs_too))
    assert (recording.vehicle, found) == ("bluerov2", [])
    assert any("started as Frame: VECTORED_6DOF" in line for line in report.done)
    same = named_frame(b"VECTORED", {"FRAME_CONFIG": 1.0})
    assert imported(tmp_path, same)[1] == []


def moved_to_port_1(log):
    """The same log with the pulses in messages of port 1."""
    servo = dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW
    kept = [r for r in log.records if int.from_bytes(r[1][7:10], "little") != servo]
    times = [r[0] for r in log.records if int.from_bytes(r[1][7:10], "little") == servo]
    log.records = kept
    for t in times:
        pulses = [int(us) for us in outputs(t - 0.004)] + [0] * 8
        fields = (round((t - 0.004) * 1e6) % 2**32, 1, *pulses)
        log.send(t - 0.004, dialect.MAVLink_servo_output_raw_message(*fields))
    return log


@pytest.mark.parametrize("first", [9, 17])
def test_thrusters_of_the_second_port_are_read_by_function(tmp_path, first):
    """Outputs 9 to 16, or 17 to 24, as the functions say."""
    own = {k: v for k, v in PARAMETERS.items() if "FUNCTION" not in k}
    own |= {f"SERVO{first + n}_FUNCTION": 33.0 + n for n in range(8)}
    log = moved_to_port_1(dive(duration=8.0, parameters=own))
    recording, found, _ = imported(tmp_path, log.bytes())
    read, written = pwm(recording)
    assert np.abs(read - written).max() < 2.0
    assert found == []


def test_a_direction_that_changes_in_the_log_cuts_there(tmp_path):
    log = dive(duration=20.0, changes=[(110.0, "MOT_3_DIRECTION", -1.0)])
    recording, found, report = imported(tmp_path, log.bytes())
    assert [word for word, _ in found] == ["output-direction"]
    assert recording.scenarios == ("01_MANUAL", "02_MANUAL")
    for run, sign in zip(recording.trajectories(), (1, -1), strict=True):
        t = run.start + recording.dt * (np.arange(len(run)) + 0.5)
        expected = 1500 + sign * (outputs(t)[2] - 1500)
        assert np.abs(run.commands["pwm"][:, 2] - expected).max() < 2.0
    assert any("change of a thruster's direction" in line for line in report.dropped)


def test_outputs_that_exchange_motors_in_the_log_cut_there(tmp_path):
    """The first report of a parameter holds before it, and a new function within 1.3 s."""
    changes = [(110.0, "SERVO3_FUNCTION", 37.0), (110.2, "SERVO5_FUNCTION", 35.0)]
    recording, found, _ = imported(tmp_path, dive(duration=20.0, changes=changes).bytes())
    assert {word for word, _ in found} == {"output-direction"}
    assert outputs_of(recording.dataset) == ()
    runs, columns = list(recording.trajectories()), ([2, 4], [4, 2])
    for run, own in zip(runs, columns, strict=True):
        t = run.start + recording.dt * (np.arange(len(run)) + 0.5)
        assert np.abs(run.commands["pwm"][:, [2, 4]].T - outputs(t)[own]).max() < 2.0
    assert 111.3 < runs[1].start < 112.0


def test_an_output_that_is_reversed_in_the_log_is_so_from_then_on(tmp_path):
    """Nothing moves in these logs as thrusters say, so the parameter decides."""
    log = dive(duration=20.0, changes=[(110.0, "SERVO4_REVERSED", 1.0)])
    log.send(100.3, parameter("SERVO4_REVERSED", 0.0))
    recording, found, _ = imported(tmp_path, log.bytes())
    assert [word for word, _ in found] == ["output-direction", "output-reversed"]
    for run, sign in zip(recording.trajectories(), (1, -1), strict=True):
        t = run.start + recording.dt * (np.arange(len(run)) + 0.5)
        expected = 1500 + sign * (outputs(t)[3] - 1500)
        assert np.abs(run.commands["pwm"][:, 3] - expected).max() < 2.0


def test_a_recording_keeps_the_outputs_of_the_thrusters(tmp_path):
    swapped = PARAMETERS | {"SERVO3_FUNCTION": 37.0, "SERVO5_FUNCTION": 35.0}
    recording, _, report = imported(tmp_path, dive(duration=8.0, parameters=swapped).bytes())
    assert outputs_of(recording.dataset) == (1, 2, 5, 4, 3, 6, 7, 8)
    assert "Thrusters by output: 1 (output 1), 2 (output 2), 3 (output 5)" in str(report)


def test_a_silent_aid_is_set_apart_as_dead_reckoning(tmp_path):
    log = dive(duration=30.0)
    for t in np.arange(100.0, 130.0, 0.1):
        if not 110.0 < t < 120.0:
            delta = dialect.MAVLink_vision_position_delta_message(
                round(t * 1e6), 100000, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 90.0
            )
            log.send(t, delta, system=255, component=190)
    recording, found, _ = imported(tmp_path, log.bytes())
    assert [word for word, _ in found] == ["dead-reckoning"]
    assert recording.scenarios == ("01_MANUAL", "02_MANUAL_dead-reckoning", "03_MANUAL")
    starts = recording.dataset["start_time"].to_numpy()[:, 0]
    np.testing.assert_allclose(starts[1:], [110.0, 120.0], atol=0.2)


def test_batteries_of_another_number_and_without_voltage(tmp_path):
    def battery(log, number, cells):
        kind = dialect.MAVLINK_MSG_ID_BATTERY_STATUS
        log.records = [r for r in log.records if int.from_bytes(r[1][7:10], "little") != kind]
        for t in np.arange(100.0, 108.0, 0.5):
            fields = (number, 0, 0, 32767, cells, 0, 0, 0, 50)
            log.send(t, dialect.MAVLink_battery_status_message(*fields))
        return log.bytes()

    other, found, _ = imported(tmp_path, battery(dive(duration=8.0), 3, [15000, *[65535] * 9]))
    assert found == []
    np.testing.assert_allclose(next(other.trajectories()).sensors["voltage"], 15.0)
    for empty in (0, 65535):
        without, found, _ = imported(tmp_path, battery(dive(duration=8.0), 0, [empty] * 10))
        assert found == [("no-voltage", "BATTERY_STATUS")]
        assert "voltage" not in without.dataset


def test_records_of_ekf2_are_read_as_those_of_ekf3(tmp_path):
    data = dataflash(duration=8.0).bytes()
    today, _, _ = imported(tmp_path, data, "today.BIN")
    old = data.replace(b"XKF1", b"NKF1").replace(b"XKF4", b"NKF4").replace(b"XKQ\0", b"NKQ\0")
    former, found, _ = imported(tmp_path, old, "old.BIN")
    for name in ("X_WB", "V_WB_B"):
        np.testing.assert_array_equal(
            former.dataset[name].to_numpy(), today.dataset[name].to_numpy()
        )
    assert [word for word, _ in found] == ["armed-unknown"]


def test_a_dataflash_log_without_its_beginning_says_so(tmp_path):
    log = dataflash(duration=8.0)
    formats = [part for part in log.parts if part[2] == 128]
    rest = [part for part in log.parts if part[2] != 128]
    with pytest.raises(UserError, match="the log's beginning is lost, with the FMT records"):
        imported(tmp_path, b"".join(rest), "lost.BIN")
    kept = [part for part in formats if b"BAT\0" not in part]
    recording, _, report = imported(tmp_path, b"".join([*kept, *rest]), "part.BIN")
    assert "voltage" not in recording.dataset
    assert any("layout of 1 kind of records" in line for line in report.dropped + report.done)


def test_the_height_of_a_barometer_is_no_reset(tmp_path):
    """A plain six-thruster dive without a horizontal aid: one stretch a mode."""
    path = shared_data("data", "sitl_six_plain", "dive.tlog.xz")
    recording, report = import_log(path)
    assert recording.scenarios == ("01_MANUAL", "02_STABILIZE", "03_ALT_HOLD")
    assert recording.duration > 215
    assert not any("position reset" in line for line in report.dropped)


def test_the_motion_decides_whether_a_reversed_output_is_mirrored():
    """The packaged dive: its third output is not reversed, whatever a parameter says."""
    recorded, _ = import_log(ROOT / "sims/data/sitl_dive.tlog.xz")
    recorded = recorded.cut(0.0, 20.0)
    turn = np.where(np.arange(8) == 2, -1, 1)
    mirrored = changed(recorded, "pwm", lambda pwm: 1500 + turn * (pwm - 1500))
    restored, (finding,) = settled(mirrored, (3,))
    assert "the motion says that it is not" in finding.text
    np.testing.assert_allclose(
        restored.dataset["pwm"].to_numpy(), recorded.dataset["pwm"].to_numpy()
    )
    kept, (finding,) = settled(recorded, (3,))
    assert "its PWM is mirrored" in finding.text
    assert kept.dataset["pwm"].equals(recorded.dataset["pwm"])


def test_a_dvl_without_lock_is_told_beside_an_accelerometer(tmp_path):
    """The estimate stands still while the vehicle moves: its accelerometer must not fill it.

    From a dive of a real autopilot with its position at 10 Hz, whose accelerometer foretells the
    velocity elsewhere.
    """
    raw = lzma.decompress((ROOT / "sims/data/sitl_dive.tlog.xz").read_bytes())
    out, at, number, place = bytearray(), 0, 0, None
    while at + 8 < len(raw):
        size = raw[at + 9] + 12
        stamp, frame = raw[at : at + 8], raw[at + 8 : at + 8 + size]
        at += 8 + size
        if int.from_bytes(frame[7:10], "little") == dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            number += 1
            if number % 5:
                continue
            if 1500 < number < 2000:
                frame, place = stopped(frame, place)
        out += stamp + frame
    recording, _, _ = imported(tmp_path, bytes(out))
    recording = examine(recording, load_vehicle(recording.vehicle), "dive.tlog", ())
    (told,) = [f.place for f in findings_of(recording.dataset) if f.word == "velocity-held"]
    assert told.endswith("u,v")


def stopped(frame, place):
    """A LOCAL_POSITION_NED that stands still at a place, by default its own; and that place."""
    message = dialect.MAVLink(None).decode(bytearray(frame))
    assert isinstance(message, dialect.MAVLink_local_position_ned_message)
    message.x, message.y = place = place or (message.x, message.y)
    message.vx = message.vy = 0.0
    sender = dialect.MAVLink(None, srcSystem=frame[5], srcComponent=frame[6])
    sender.seq = frame[4]
    return bytes(message.pack(sender)), place
