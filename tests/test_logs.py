"""Importing logs: known numbers come back, clocks and cuts are right, damage is survived."""

import gzip
import lzma
import re

import log_writers
import numpy as np
import pytest
import scipy.signal
from log_writers import (
    EPOCH_US,
    PARAMETERS,
    DataFlash,
    Tlog,
    dataflash,
    dive,
    heartbeat,
    outputs,
    truth,
)
from pymavlink import DFReader, mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers import ROOT, shared_data
from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.kinematics import agreement
from spinndrift.models.recordings.resample import (
    continuous,
    linear,
    rotations,
    slerp,
)
from spinndrift.sims.cli import main
from spinndrift.systems.logs.cut_tlog import cut_tlog
from spinndrift.systems.logs.dataflash import read_bin
from spinndrift.systems.logs.load import LogOptions, import_log, load_data, own_rate
from spinndrift.systems.logs.log_bytes import read_log_bytes
from spinndrift.systems.logs.packets import scan
from spinndrift.systems.logs.signals import Series, Signals
from spinndrift.systems.logs.tlog import read_tlog
from spinndrift.systems.mavlink import codec

pytestmark = pytest.mark.whole

DEMO = ROOT / "sims" / "data" / "sitl_dive.tlog.xz"


def imported(tmp_path, data, name="dive.tlog", rate=20.0, vehicle="bluerov2_heavy", **options):
    path = tmp_path / name
    path.write_bytes(data)
    return import_log(path, rate=rate, vehicle=vehicle, options=LogOptions(**options))


def errors(run, dt):
    """Rotation (rad), position (m), velocity (m/s), rates (rad/s) of a run against the truth."""
    t = run.start + dt * np.arange(len(run))
    X, V, _ = truth(t)
    turn = (rotations(X[:4]).inv() * rotations(run.X_WB[:, :4].T)).as_rotvec().T
    return [
        np.abs(e).max()
        for e in (
            turn,
            run.X_WB[:, 4:].T - X[4:],
            run.V_WB_B[:, :3].T - V[:3],
            run.V_WB_B[:, 3:].T - V[3:],
        )
    ]


def check_truth(recording, velocity_step=0.04, rotation_step=0.02):
    """Within what linear interpolation between samples can give, h²/8 · max|ẍ|, and rounding."""
    for run in recording.trajectories():
        turn, position, velocity, rate = errors(run, recording.dt)
        assert turn < rotation_step**2 / 8 * 2 + 1e-6
        assert position < 1e-4
        assert velocity < velocity_step**2 / 8 * 3 + 1e-5
        assert rate < rotation_step**2 / 8 * 5 + 1e-5
        t = run.start + recording.dt * np.arange(len(run))
        middle = outputs(t + recording.dt / 2)
        assert np.abs(run.commands["pwm"].T - middle).max() < 2.0  # µs: rounding, curvature


# telemetry


@pytest.mark.parametrize("version", [1, 2])
def test_telemetry_gives_back_the_motion(tmp_path, version):
    recording, report = imported(tmp_path, dive(version=version).bytes())
    assert recording.scenarios == ("01_MANUAL",)
    assert recording.vehicle == "bluerov2_heavy"
    assert recording.missing == {}
    assert recording.duration > 18
    check_truth(recording)
    (run,) = recording.trajectories()
    t = run.start + recording.dt * np.arange(len(run))
    np.testing.assert_allclose(run.sensors["voltage"], 16.0 - 0.01 * (t - 100), atol=0.011)
    depth = run.sensors["pressure_depth"]  # at 10 Hz: every other sample
    assert abs(np.isfinite(depth).mean() - 0.5) < 0.01
    np.testing.assert_allclose(
        np.where(np.isfinite(depth), depth + truth(t)[0][6], 0), 0, atol=0.01
    )
    assert any("ATTITUDE_QUATERNION at 50 Hz" in line for line in report.has)
    assert any("No DVL" in line for line in report.lacks)
    assert "01_MANUAL: " in report.text()
    assert recording.notes == report.notes()


def test_a_wrapping_microsecond_counter_and_a_jumping_logger_change_nothing(tmp_path):
    start = 4285.0  # the 32-bit µs counter wraps at 4294.967 s
    log = dive(start=start)
    plain, _ = imported(tmp_path, log.bytes())
    assert len(plain.scenarios) == 1
    check_truth(plain)
    jumped, report = imported(tmp_path, log.bytes(lambda t: t + (3600.0 if t > start + 8 else 0.0)))
    np.testing.assert_array_equal(jumped.dataset["pwm"].to_numpy(), plain.dataset["pwm"].to_numpy())
    assert any("clock or link jumped" in line for line in report.done)


def test_only_the_vehicle_is_heard(tmp_path):
    log = dive()
    for t in 100.0 + np.arange(0, 20, 0.01):  # others say other things, at the same times
        ms = round(t * 1e3)
        wrong = dialect.MAVLink_attitude_quaternion_message(ms, 1, 0, 0, 0, 9, 9, 9)
        log.send(t, wrong, 255, 190)
        log.send(t, wrong, 1, 100)
    for t in 100.0 + np.arange(0, 20):
        log.send(t, heartbeat(kind=6, autopilot=8), 255, 190)
        log.send(t, heartbeat(mode=0, kind=30, autopilot=8), 1, 100)
    recording, _ = imported(tmp_path, log.bytes())
    check_truth(recording)
    two = dive()
    for t in 100.0 + np.arange(0, 20):
        two.send(t, heartbeat(mode=4, kind=2), 7, 1)
    recording, report = imported(tmp_path, two.bytes())
    check_truth(recording)
    assert any("Several autopilots" in line for line in report.done)
    with pytest.raises(UserError, match=r"--system 9: not an autopilot of this log; give one of 1"):
        imported(tmp_path, two.bytes(), system=9)


def test_attitudes_that_were_never_filled_in_are_none(tmp_path, monkeypatch):
    ned = log_writers.ned
    monkeypatch.setattr(log_writers, "ned", lambda t: [(0 * q, *rest) for q, *rest in ned(t)])
    with pytest.raises(UserError, match="no ATTITUDE in this log"):
        imported(tmp_path, dive().bytes())


def test_cuts_at_modes_arming_and_gaps(tmp_path):
    def state(t):
        mode = 19 if t < 110 else 0
        return t < 120, mode

    log = dive(duration=40, state=state, silent=lambda t: 114 <= t < 115)
    recording, report = imported(tmp_path, log.bytes(), minimum=3.0)
    assert recording.scenarios == ("01_MANUAL", "02_STABILIZE", "03_STABILIZE")
    bounds = [
        (run.start, run.start + recording.dt * (len(run) - 1)) for run in recording.trajectories()
    ]
    for (start, stop), (low, high) in zip(
        bounds, [(100, 109.1), (110, 114), (115, 119.1)], strict=True
    ):
        assert low <= start < low + 0.2
        assert high - 0.2 < stop <= high
    check_truth(recording)
    assert any("disarmed" in line for line in report.dropped)
    assert any("1 gap of up to" in line for line in report.dropped)
    everything, _ = imported(tmp_path, log.bytes(), disarmed=True)
    assert everything.scenarios[-1].endswith("STABILIZE_disarmed")


def test_very_long_stretches_are_cut_into_equal_parts(tmp_path):
    log = dive(duration=620.0, rates=(5.0, 5.0, 5.0))
    recording, report = imported(tmp_path, log.bytes(), gap=1.0)
    assert recording.scenarios == ("01_MANUAL", "02_MANUAL", "03_MANUAL")
    assert np.ptp(recording.lengths) <= 1
    assert recording.duration > 615
    assert any("equal parts" in line for line in report.dropped)


def test_resets_of_the_estimator_cut(tmp_path):
    recording, report = imported(tmp_path, dive(jump=110.0).bytes())
    assert len(recording.scenarios) == 2
    assert any("position reset" in line for line in report.dropped)
    first, second = recording.trajectories()
    assert first.start + recording.dt * len(first) < 110 < second.start
    assert errors(first, recording.dt)[1] < 1e-4
    assert errors(second, recording.dt)[1] == pytest.approx(2.0, abs=1e-3)


def test_a_reboot_starts_a_new_run(tmp_path):
    log = dive(start=500.0, duration=12.0)
    again = dive(start=100.0, duration=12.0)
    later = Tlog()
    later.records = [(t + 430.0, packed) for t, packed in again.records]
    joined = Tlog()
    joined.records = log.records + later.records
    recording, report = imported(tmp_path, joined.bytes())
    assert len(recording.scenarios) == 2
    assert any("booted 1 more time" in line for line in report.done)
    second = list(recording.trajectories())[1]
    assert np.abs(second.V_WB_B[5] - truth(100.0 + 5.0)[1]).max() < 2.0  # exists, is finite


def test_pass_through_is_a_run_of_its_own_and_keeps_the_wiring(tmp_path):
    swapped = PARAMETERS | {"SERVO1_FUNCTION": 34.0, "SERVO2_FUNCTION": 33.0}
    changes = [(110.0, f"SERVO{n}_FUNCTION", 50.0 + n) for n in range(1, 9)]
    recording, _ = imported(tmp_path, dive(parameters=swapped, changes=changes).bytes())
    assert recording.scenarios == ("01_MANUAL", "02_MANUAL_passthrough")
    for run in recording.trajectories():
        t = run.start + recording.dt * (np.arange(len(run)) + 0.5)
        expected = outputs(t)[[1, 0, 2, 3, 4, 5, 6, 7]]
        assert np.abs(run.commands["pwm"].T - expected).max() < 2.0


def test_reversed_thrusters_are_mirrored_unless_the_vehicle_has_them_so(tmp_path):
    reversed_ = PARAMETERS | {"MOT_3_DIRECTION": -1.0}
    plain, _ = imported(tmp_path, dive().bytes())
    mirrored, report = imported(tmp_path, dive(parameters=reversed_).bytes())
    a, b = plain.dataset["pwm"].to_numpy()[0, 0].T, mirrored.dataset["pwm"].to_numpy()[0, 0].T
    np.testing.assert_allclose(b[2], 3000 - a[2], atol=1e-6)
    np.testing.assert_allclose(np.delete(b, 2, 0), np.delete(a, 2, 0), atol=1e-6)
    assert any("Thrusters 3 run the other way" in line for line in report.done)


SIX = {f"SERVO{n}_FUNCTION": 32.0 + n for n in range(1, 7)}
LIGHTS = {"SERVO7_FUNCTION": 0.0, "SERVO8_FUNCTION": 7.0}  # nothing, camera tilt


@pytest.mark.parametrize(
    ("parameters", "vehicle", "count"),
    [
        (SIX | {"FRAME_CONFIG": 1.0}, "bluerov2", 6),
        (SIX | LIGHTS, "bluerov2", 6),
        (SIX | LIGHTS | {"FRAME_CONFIG": 2.0}, "bluerov2_heavy", 8),
        (SIX, "bluerov2_heavy", 8),  # what 7 and 8 do is not in the log
        ({"FRAME_CONFIG": 1.0}, "bluerov2", 6),
        ({}, "bluerov2_heavy", 8),
    ],
)
def test_thrusters_are_those_of_the_frame_and_of_the_outputs(tmp_path, parameters, vehicle, count):
    recording, report = imported(tmp_path, dive(parameters=parameters).bytes(), vehicle=None)
    assert recording.vehicle == vehicle
    (run,) = recording.trajectories()
    t = run.start + recording.dt * (np.arange(len(run)) + 0.5)
    expected = outputs(t)[:count]
    stopped = [6, 7] if parameters.get("SERVO8_FUNCTION") == 7 and count == 8 else []
    expected[stopped] = 1500
    assert np.abs(run.commands["pwm"].T - expected).max() < 2.0
    told = [line for line in report.done if "thrusters, read as those of bluerov2" in line]
    assert len(told) == (count == 6)
    assert any("thrusters 7, 8; they are taken as stopped" in line for line in report.done) == (
        stopped != []
    )


def test_a_frame_that_contradicts_the_vehicle_is_refused(tmp_path, capsys):
    (tmp_path / "dive.tlog").write_bytes(dive(parameters={"FRAME_CONFIG": 1.0}).bytes())
    given = ["import", str(tmp_path / "dive.tlog"), "--vehicle", "bluerov2_heavy"]
    with pytest.raises(SystemExit) as stop:
        main([*given, "--out", str(tmp_path / "dive.nc")])
    assert stop.value.code == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "FRAME_CONFIG 1 is that of a vehicle with 6 thrusters, and bluerov2_heavy has 8" in told
    assert "--vehicle bluerov2" in told
    assert not (tmp_path / "dive.nc").exists()


@pytest.mark.parametrize("name", ["dive.tlog.xz", "dive.BIN.xz"])
def test_the_six_thruster_dive_has_six(name):
    """Motors 1 … 6 of a frame VECTORED; output 8 is a camera's."""
    recording, report = import_log(shared_data("data", "sitl_six_plain", name))
    assert recording.vehicle == "bluerov2"
    assert {run.commands["pwm"].shape[1] for run in recording.trajectories()} == {6}
    assert any("FRAME_CONFIG 1: 6 thrusters" in line for line in report.done)
    assert not any("No output is assigned" in line for line in report.done)
    spread = np.concatenate([run.commands["pwm"] for run in recording.trajectories()]).std(axis=0)
    assert spread.min() > 10  # µs: each was driven


def test_without_a_horizontal_estimate_only_the_vertical_is_kept(tmp_path):
    recording, report = imported(tmp_path, dive(horizontal=False).bytes())
    assert recording.missing == {"X_WB": ("x", "y"), "V_WB_B": ("u", "v")}
    (run,) = recording.trajectories()
    t = run.start + recording.dt * np.arange(len(run))
    X, V, v_W = truth(t)
    assert np.abs(run.X_WB[:, 6] - X[6]).max() < 2e-3  # mm in the message, cm/s in its slope
    assert np.abs(run.sensors["vertical_velocity"] - v_W[2]).max() < 0.01
    assert np.abs(run.V_WB_B[:, 3:].T - V[3:]).max() < 1e-3
    assert any("No horizontal estimate: surge and sway" in line for line in report.lacks)


def test_the_climb_is_that_of_the_faster_message(tmp_path):
    """VFR_HUD repeats the estimate of GLOBAL_POSITION_INT more often, and not rounded to 1 cm/s."""
    slow = (50.0, 5.0, 50.0)
    worst = []
    for hud in (None, 2.0, 10.0):
        recording, report = imported(tmp_path, dive(horizontal=False, rates=slow, hud=hud).bytes())
        (run,) = recording.trajectories()
        _, _, v_W = truth(run.start + recording.dt * np.arange(len(run)))
        worst.append(np.abs(run.sensors["vertical_velocity"] - v_W[2]).max())
        assert ("Climb from VFR_HUD at 10 Hz" in str(report)) == (hud == 10.0)
    assert worst[0] == worst[1] > 4 * worst[2]


@pytest.mark.parametrize("rate", [20.0, 25.0])
def test_rates_as_fast_as_the_grid_are_not_interpolated(tmp_path, rate):
    """Between samples a motion faster than them would be smoothed, and look slower than it was."""
    data = dive(rates=(rate, 25.0, 50.0), parameters=PARAMETERS | {"INS_GYRO_FILTER": 20.0}).bytes()
    (tmp_path / "dive.tlog").write_bytes(data)
    recording, _ = import_log(tmp_path / "dive.tlog", rate=rate)
    sampled = read_tlog(data, ("ATTITUDE_QUATERNION",)).tables["ATTITUDE_QUATERNION"]
    (run,) = recording.trajectories()
    after = np.searchsorted(sampled["t"], run.start)
    logged = codec.body_vector(*(sampled[f"{n}speed"] for n in ("roll", "pitch", "yaw")))
    following = logged[:, after : after + len(run)].T
    np.testing.assert_allclose(run.V_WB_B[:, 3:], following, atol=1e-9)


def test_slow_outputs_are_told_to_hide_the_lag(tmp_path):
    recording, report = imported(tmp_path, dive(rates=(50.0, 4.0, 10.0)).bytes())
    assert recording.command_period == pytest.approx(0.1, rel=0.05)
    text = " ".join(report.lacks)
    assert "Thruster outputs at 10.0 Hz: thruster lag" in text
    assert "Position and velocity at 4.0 Hz only" in text


def test_the_gyro_filters_delay_is_taken_off(tmp_path):
    filtered = PARAMETERS | {"INS_GYRO_FILTER": 20.0}
    plain, _ = imported(tmp_path, dive().bytes())
    moved, report = imported(tmp_path, dive(parameters=filtered).bytes())
    rates = [r.dataset["V_WB_B"].to_numpy()[0, 0, :300, 3:] for r in (plain, moved)]
    for r, omega, late in ((plain, rates[0], 0.0), (moved, rates[1], codec.filter_delay(20.0))):
        start = next(iter(r.trajectories())).start
        at, other = (
            truth(start + r.dt * np.arange(300) + delay)[1][3:].T
            for delay in (late, codec.filter_delay(20.0) - late)
        )
        np.testing.assert_allclose(omega, at, atol=1e-3)
        assert np.abs(omega - other).max() > 3e-3
    assert any("moved back by 11 ms" in line for line in report.done)


def test_water_density_corrects_depth(tmp_path):
    data = dive().bytes()
    fresh, _ = imported(tmp_path, data)
    salt, _ = imported(tmp_path, data, water_density=1025.0)
    ratio = 9800 / (1025.0 * codec.G)
    a, b = (r.dataset["pressure_depth"].to_numpy() for r in (fresh, salt))
    np.testing.assert_allclose(b, ratio * a, rtol=1e-9)
    a, b = (r.dataset["X_WB"].to_numpy()[..., 6].mean() for r in (fresh, salt))
    assert b / a == pytest.approx(ratio, abs=2e-3)  # the slow part of it


def test_tables_are_those_of_pymavlink(tmp_path):
    data = dive().bytes()
    path = tmp_path / "dive.tlog"
    path.write_bytes(data)
    reader = mavutil.mavlink_connection(str(path))
    theirs = {"ATTITUDE_QUATERNION": [], "SERVO_OUTPUT_RAW": [], "PARAM_VALUE": []}
    while (message := reader.recv_match()) is not None:
        if message.get_type() in theirs:
            theirs[message.get_type()].append(message)
    reader.close()
    ours = read_tlog(data, theirs.keys())
    for name, messages in theirs.items():
        table = ours.tables[name]
        assert len(messages) == table["t"].size
        for field in messages[0].get_fieldnames():
            values = [getattr(m, field) for m in messages]
            if isinstance(values[0], str):
                values = [v.encode() for v in values]
            assert np.array_equal(table[field], np.array(values, table[field].dtype))
    packets = scan(data)
    assert packets.stamps(data).min() == pytest.approx(EPOCH_US * 1e-6 + 100, abs=0.1)


# DataFlash


def test_dataflash_gives_back_the_motion(tmp_path):
    recording, report = imported(tmp_path, dataflash().bytes(), "dive.BIN")
    assert recording.scenarios == ("01_MANUAL",)
    assert recording.duration > 19
    for run in recording.trajectories():
        turn, position, velocity, rate = errors(run, recording.dt)
        assert turn < 0.02**2 / 8 * 2 + 1e-6
        assert position < 1e-4
        assert velocity < 0.02**2 / 8 * 3 + 1e-5
        assert rate < 1e-4  # bias logged in hundredths of a degree per second
        np.testing.assert_allclose(run.sensors["imu_specific_force"][:, 2], codec.G, rtol=1e-6)
    assert any("XKQ at 50 Hz" in line for line in report.has)


def test_dataflash_states(tmp_path):
    recording, report = imported(tmp_path, dataflash(disarm=112.0).bytes(), "dive.bin")
    (run,) = recording.trajectories()
    assert run.start + recording.dt * len(run) == pytest.approx(112.0, abs=0.1)
    (idle,) = (re.match(r"(\S+) s disarmed", line) for line in report.dropped if "armed" in line)
    assert idle is not None
    assert float(idle[1]) == pytest.approx(8.0, abs=0.1)
    unaided, report = imported(tmp_path, dataflash(aided=False).bytes(), "dive.bin")
    assert unaided.missing == {"X_WB": ("x", "y"), "V_WB_B": ("u", "v")}


def test_dataflash_writer_and_reader_agree_with_pymavlink(tmp_path):
    data = dataflash(duration=1.0).bytes()
    path = tmp_path / "dive.bin"
    path.write_bytes(data)
    tables = read_bin(data, ("XKF1", "PARM", "RCOU")).tables
    reader = DFReader.DFReader_binary(str(path), zero_time_base=True)
    seen = dict.fromkeys(tables, 0)
    while (message := reader.recv_match(type=list(tables))) is not None:
        name = message.get_type()
        for column in message.get_fieldnames():
            ours = tables[name][column][seen[name]]
            theirs = getattr(message, column)
            if isinstance(ours, bytes):
                assert ours.decode() == theirs
            else:
                assert ours == pytest.approx(theirs, rel=1e-12)
        seen[name] += 1
    reader.close()
    assert seen == {name: table["t"].size for name, table in tables.items()}


# files that are not what they should be


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.tlog", b"", "the file is empty"),
        ("a.BIN", b"hello, this is no log at all", "neither MAVLink nor DataFlash"),
        ("a.tlog", b"t,x,y\n1,2,3\n" * 9, "neither MAVLink nor DataFlash"),
        ("a.log", b"FMT, 128, 89, FMT, BBnNZ, Type,Length", "a text log"),
        ("a.tlog.xz", lzma.compress(b"x" * 999)[:20], "broken from its start"),
        ("a.BIN.gz", b"\x1f\x8b" + b"\0" * 30, "broken from its start"),
        ("a.BIN", DataFlash().bytes(), "no attitude"),
        ("a.tlog", b"\0" * 8 + b"\xfd" + b"\0" * 60, "no autopilot speaks"),
    ],
)
def test_wrong_files_are_told_in_one_sentence(tmp_path, name, content, sentence):
    with pytest.raises(UserError, match=sentence) as caught:
        imported(tmp_path, content, name)
    assert name in str(caught.value)


def test_missing_files_and_folders_and_options(tmp_path):
    with pytest.raises(UserError, match="no such file"):
        import_log(tmp_path / "none.tlog")
    with pytest.raises(UserError, match="is a folder"):
        import_log(tmp_path)
    for option in ({"rate": 0.0}, {"minimum": -1.0}, {"water_density": 1.0}):
        with pytest.raises(UserError, match="must lie between"):
            imported(tmp_path, b"x", **option)
    with pytest.raises(UserError, match="no stretch of 60 s"):
        imported(tmp_path, dive(duration=8).bytes(), minimum=60.0)


def test_the_command_passes_options_for_logs_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dive.tlog").write_bytes(dive(duration=8).bytes())
    with pytest.raises(SystemExit) as ended:
        main(["import", "dive.tlog", "--minimum", "60"])
    assert ended.value.code == 2
    assert "no stretch of 60 s" in capsys.readouterr().err
    main(["import", "dive.tlog", "--minimum", "2", "--disarmed", "--out", "dive.nc"])
    capsys.readouterr()
    with pytest.raises(UserError, match=r"dive\.nc: --gap is for logs of a vehicle; leave it out"):
        load_data(tmp_path / "dive.nc", options=LogOptions(gap=2.0))


@pytest.mark.parametrize("kind", ["tlog", "bin"])
def test_logs_cut_off_anywhere_give_what_is_there_or_one_sentence(tmp_path, kind):
    data = (dive(duration=9) if kind == "tlog" else dataflash(duration=8)).bytes()
    for part in np.linspace(0.001, 0.999, 17):
        try:
            recording, _ = imported(tmp_path, data[: int(part * len(data))], f"a.{kind}")
        except UserError:
            assert part < 0.95
        else:
            assert recording.duration < 9 * part


@pytest.mark.parametrize("kind", ["tlog", "bin"])
def test_damaged_logs_lose_only_what_is_damaged(tmp_path, kind):
    data = bytearray((dive() if kind == "tlog" else dataflash()).bytes())
    rng = np.random.default_rng(0)
    for at in rng.integers(2000, len(data) - 100, 12).tolist():
        data[at : at + 40] = rng.integers(0, 256, 40).astype(np.uint8).tobytes()
    recording, report = imported(tmp_path, bytes(data), f"a.{kind}", minimum=2.0)
    assert recording.duration > 12
    if kind == "tlog":  # checksums: nothing wrong gets through
        assert any("skipped" in line or "checksum" in line for line in report.done)
        for run in recording.trajectories():
            assert max(errors(run, recording.dt)) < 0.01


def test_records_whose_time_is_no_number_are_left_out():
    """As a damaged FMT record has it; their length may still be right."""
    log = dataflash(duration=1.0).bytes()
    assert log.count(b"BAT\0QBf\0") == 1
    read = read_bin(log.replace(b"BAT\0QBf\0", b"BAT\0nBf\0"), {"BAT", "RCOU"})
    assert set(read.tables) == {"RCOU"}
    assert read.notes == ("Records of unknown layout were left out: BAT.",)


def test_two_kinds_of_records_of_one_name_are_not_mixed():
    """As a damaged FMT record has it."""
    log = dataflash(duration=1.0).bytes()
    read = read_bin(log, {"BAT", "RCOU"})
    at = log.index(b"BAT\0QBf\0")
    twice = read_bin(log[:at] + b"RCOU" + log[at + 4 :], {"BAT", "RCOU"})
    assert set(twice.tables) == {"RCOU"}
    assert len(twice.tables["RCOU"]["t"]) in {len(t["t"]) for t in read.tables.values()}
    assert twice.notes == ("Records of unknown layout were left out: RCOU.",)


def test_compressed_logs_and_cut_off_ones(tmp_path):
    data = dive().bytes()
    for suffix, compress in ((".xz", lzma.compress), (".gz", gzip.compress)):
        packed = compress(data)
        recording, _ = imported(tmp_path, packed, f"a.tlog{suffix}")
        assert recording.duration > 18
        partly, report = imported(
            tmp_path, packed[: len(packed) * 3 // 4], f"b.tlog{suffix}", minimum=1.0
        )
        assert 0 < partly.duration < recording.duration
        assert any("cut off" in line for line in report.dropped)


def test_messages_without_numbers_are_passed_over(tmp_path):
    log = dive()
    zero, none = [0.0] * 4, [float("nan")] * 4
    for k in range(40):
        ms = 105_007 + 10 * k
        log.send(
            ms * 1e-3,
            dialect.MAVLink_attitude_quaternion_message(ms, *(zero, none)[k % 2], 0, 0, 0),
        )
        log.send(ms * 1e-3, dialect.MAVLink_local_position_ned_message(ms, *none[:3], *none[:3]))
    recording, _ = imported(tmp_path, log.bytes())
    assert len(recording.scenarios) == 1
    for run in recording.trajectories():
        assert errors(run, recording.dt)[1] < 1e-4


def test_progress_runs_from_zero_to_one(tmp_path):
    told = []
    path = tmp_path / "a.tlog.xz"
    path.write_bytes(lzma.compress(dive().bytes()))
    import_log(path, progress=told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_load_data_takes_everything(tmp_path):
    log = tmp_path / "dive.tlog"
    log.write_bytes(dive().bytes())
    recording = load_data(log)
    recording.save(tmp_path / "dive.nc")
    again = load_data(tmp_path / "dive.nc", vehicle="bluerov2_heavy_ng")
    assert again.vehicle == "bluerov2_heavy_ng"
    assert again.scenarios == recording.scenarios
    with pytest.raises(UserError, match="recorded at 20 Hz, not 50"):
        load_data(tmp_path / "dive.nc", rate=50.0)
    (tmp_path / "a.csv").write_text("t\n")
    with pytest.raises(UserError, match="give its folder"):
        load_data(tmp_path / "a.csv")
    with pytest.raises(UserError, match=r"no recording\.yaml"):
        load_data(tmp_path)


# the demo log and real ones


@pytest.fixture(scope="module")
def demo():
    return import_log(DEMO, vehicle="ardusub_sitl")


@pytest.mark.smoke
def test_the_demo_log_has_what_its_readme_says(demo):
    recording, _ = demo
    assert DEMO.stat().st_size <= 1_000_000
    assert recording.scenarios == ("01_MANUAL", "02_MANUAL_passthrough")
    assert np.all(recording.lengths * recording.dt > 85)
    assert recording.missing == {}
    data = read_log_bytes(DEMO).data
    log = read_tlog(data, ("SERVO_OUTPUT_RAW", "PARAM_VALUE"))
    assert not [name for name, _, _ in log.heard if name in ("SIM_STATE", "SIMSTATE")]
    names = set(log.tables["PARAM_VALUE"]["param_id"].tolist())
    assert {b"MOT_1_DIRECTION", b"SERVO8_FUNCTION", b"INS_GYRO_FILTER"} <= names
    for run in recording.trajectories():
        t = recording.dt * np.arange(len(run))
        for part in agreement(t, run.X_WB.T, run.V_WB_B.T):
            assert part.explained > 0.998
            assert part.slope == pytest.approx(1.0, abs=0.01)


def test_a_log_may_keep_the_rate_of_its_slowest_stream():
    assert import_log(DEMO, fine=True)[0].dt == pytest.approx(0.02)
    assert import_log(DEMO)[0].dt == pytest.approx(0.05)

    def rate(*each):
        times = [np.arange(0, 10, 1 / hz) for hz in each]
        one, two, three = (Series(t, np.ones((4, t.size)), "") for t in times)
        rates = Series(two.t, 0 * two.x[:3], "")
        return own_rate(Signals(attitude=one, rates=rates, outputs=three))

    def dropping(every):
        t = np.delete(np.arange(0, 10, 0.02), np.s_[::every])
        one = Series(t, np.ones((4, t.size)), "")
        return own_rate(Signals(attitude=one, rates=Series(t, 0 * one.x[:3], ""), outputs=one))

    assert dropping(30) == dropping(4) == 50
    assert rate(100, 100, 100) == 50
    assert rate(50, 30, 100) == 30
    assert rate(50, 50, 10) == 50  # between outputs it is known what to expect, and how well
    assert rate(30, 50, 50) == 25  # every second sample of the body rates
    assert rate(1000, 1000, 100) == 50
    assert rate(10, 100, 50) == rate(100, 10, 50) == rate(4, 100, 10) == 10
    assert rate(14.3, 14.3, 50) == pytest.approx(14.3)


def test_the_demo_log_is_what_its_command_makes():
    source = shared_data("data", "sitl_log", "dive.tlog").read_bytes()
    assert "--spans 52.8 142.8 148.8 238.8" in (DEMO.parent / "README.md").read_text()
    made = cut_tlog(source, [(52.8, 142.8), (148.8, 238.8)])
    assert made == read_log_bytes(DEMO).data


def test_the_demo_log_obeys_the_simulated_vehicles_laws(demo):
    """Force, drag and restoring by least squares on differences: within 3 % of the known constants.

    The inertia is left out: differences over 50 ms of so light a body are no fit for it.
    """
    recording, _ = demo
    F = recording.wrench().to_numpy()
    masses = []
    for j, run in enumerate(recording.trajectories()):
        n = len(run)
        V, q = run.V_WB_B.T, continuous(run.X_WB[:, :4].T)
        middle = rotations(q[:, 1:] + q[:, :-1]).inv()
        v_W = rotations(q).apply(V[:3].T)
        acceleration = middle.apply(np.diff(v_W, axis=0) / recording.dt).T
        mean = 0.5 * (V[:, 1:] + V[:, :-1])
        up = middle.apply([0.0, 0.0, 1.0]).T
        drag = (48.28, 62.08, 68.98)
        for i in range(3):
            columns = np.stack([F[j, 0, : n - 1, i], -mean[i] * np.abs(mean[i]), up[i]], axis=1)
            c, *_ = np.linalg.lstsq(columns, acceleration[i], rcond=None)
            masses.append(1 / c[0])
            assert c[1] / c[0] == pytest.approx(drag[i], rel=0.03)
        angular = np.diff(V[3:], axis=1) / recording.dt
        for i, lever in ((0, -up[1]), (1, up[0])):
            columns = np.stack(
                [F[j, 0, : n - 1, 3 + i], -mean[3 + i] * np.abs(mean[3 + i]), lever], 1
            )
            c, *_ = np.linalg.lstsq(columns, angular[i], rcond=None)
            assert c[1] / c[0] == pytest.approx(7.076, rel=0.03)
            assert c[2] / c[0] == pytest.approx(6.0, rel=0.03)
    assert masses == pytest.approx([10.5] * 6, rel=0.03)


def test_the_cutter_keeps_whole_packets(tmp_path):
    data = dive(duration=30.0).bytes()
    for t in (100.0,):
        log = dive(duration=30.0)
        for k in range(300):
            log.send(
                t + 0.1 * k,
                dialect.MAVLink_attitude_message(round(1e3 * (t + 0.1 * k)), *[0.0] * 6),
            )
        data = log.bytes()
    cut = cut_tlog(data, [(105.0, 115.0)], {"SERVO_OUTPUT_RAW": 25.0}, always=("HEARTBEAT",))
    packets = scan(cut)
    assert packets.skipped == 0
    assert np.count_nonzero(packets.message == 36) == 250
    assert np.count_nonzero(packets.message == 0) == 30
    for i in range(packets.record.size):
        assert cut[packets.record[i] : packets.end[i]] in data
    with pytest.raises(UserError, match="none of"):
        cut_tlog(data, [(500.0, 600.0)])


def against(recording, t_q, q, t_v, v_W):
    """Median attitude error (°) and rms velocity error (m/s) against a truth in W."""
    turns, misses = [], []
    for run in recording.trajectories():
        t = run.start + recording.dt * np.arange(len(run))
        back = rotations(slerp(t, t_q, continuous(q))).inv()
        turns.append((back * rotations(run.X_WB[:, :4].T)).magnitude())
        misses.append(run.V_WB_B[:, :3] - back.apply(linear(t, t_v, v_W).T))
    angle = np.rad2deg(np.concatenate(turns))
    return float(np.median(angle)), float(np.sqrt(np.mean(np.concatenate(misses) ** 2)))


def test_the_whole_dive_agrees_with_the_simulators_truth():
    path = shared_data("data", "sitl_log", "dive.tlog")
    recording, _ = import_log(path, vehicle="ardusub_sitl")
    assert [name[3:] for name in recording.scenarios] == [
        "MANUAL",
        "MANUAL_passthrough",
        "STABILIZE",
        "ALT_HOLD",
    ]
    truth_ = read_tlog(path.read_bytes(), ("SIM_STATE",)).tables["SIM_STATE"]
    new = np.concatenate([[True], np.diff(truth_["t"]) > 1e-6])
    s = {name: values[new] for name, values in truth_.items()}
    q = codec.attitude(s["q1"], s["q2"], s["q3"], s["q4"])
    angle, miss = against(
        recording, s["t"], q, s["t"], codec.world_vector(s["vn"], s["ve"], s["vd"])
    )
    assert angle < 0.6
    assert miss < 0.012


@pytest.mark.slow
def test_climb_of_the_whole_dive_is_the_simulators_at_every_frequency():
    path = shared_data("data", "sitl_log", "dive.tlog")
    truth_ = read_tlog(path.read_bytes(), ("SIM_STATE",)).tables["SIM_STATE"]
    true_t, new = np.unique(truth_["t"], return_index=True)
    gains = []
    for density in (None, 1023.6):
        options = LogOptions(water_density=density)
        recording, _ = import_log(path, vehicle="ardusub_sitl", rate=50.0, options=options)
        cross, power = np.zeros(2), np.zeros(2)
        for run in recording.trajectories():
            t = run.start + 0.02 * np.arange(len(run))
            found = rotations(run.X_WB[:, :4].T).apply(run.V_WB_B[:, :3])[:, 2]
            true = -linear(t, true_t, truth_["vd"][new])
            if len(run) < 4096:
                continue
            f, both = scipy.signal.csd(true, found, 50.0, nperseg=2048)
            own = scipy.signal.welch(true, 50.0, nperseg=2048)[1]
            for k, (low, high) in enumerate(((0.04, 0.1), (0.3, 1.0))):
                band = (f >= low) & (f < high)
                cross[k] += np.real(both[band]).sum()
                power[k] += own[band].sum()
        gains.append(cross / power)
    assert gains[0][0] > 1.018  # 2.4 % too deep, where it is slow
    np.testing.assert_allclose(gains[0][1], 1.0, atol=0.01)
    np.testing.assert_allclose(gains[1], 1.0, atol=0.01)


def test_the_autopilots_own_log_agrees_with_the_simulators_truth():
    path = shared_data("data", "sitl_log", "dive.BIN.xz")
    recording, report = import_log(path, vehicle="ardusub_sitl")
    assert len(recording.scenarios) == 4
    tables = read_bin(read_log_bytes(path).data, ("SIM", "SIM2")).tables
    a, b = tables["SIM"], tables["SIM2"]
    q = codec.attitude(a["Q1"], a["Q2"], a["Q3"], a["Q4"])
    angle, miss = against(
        recording, a["t"], q, b["t"], codec.world_vector(b["VN"], b["VE"], b["VD"])
    )
    assert angle < 0.6
    assert miss < 0.012
    assert any("Thruster outputs at 10.0 Hz" in line for line in report.lacks)


@pytest.mark.parametrize("name", ["small.tlog", "small.BIN"])
def test_logs_of_a_real_vehicle_on_the_bench(name):
    recording, report = import_log(shared_data("data", "ardusub_logs", name))
    assert recording.scenarios == ("01_MANUAL",)
    assert any("run the other way" in line for line in report.done)
    assert any("Hardly any motion" in line for line in report.lacks)
    if name == "small.BIN":
        assert recording.missing == {"X_WB": ("x", "y"), "V_WB_B": ("u", "v")}
