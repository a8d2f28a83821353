"""Logs with one stream wrong: its unit or sign, readings that stand still, a clock that jumps."""

import struct

import log_writers
import numpy as np
import pytest
from log_writers import PARAMETERS, dataflash, dialect, dive, ned, outputs, truth

from spinndrift.models.config.errors import UserError
from spinndrift.models.frames import frd_to_flu
from spinndrift.models.recordings.checks.finding import findings_of
from spinndrift.models.recordings.outputs import outputs_of
from spinndrift.models.recordings.resample import rotations
from spinndrift.systems.logs.clock import epochs
from spinndrift.systems.logs.load import import_log
from spinndrift.systems.logs.packets import repeated, scan
from spinndrift.systems.mavlink import codec

DURATION = 20.0


def imported(folder, log, name="dive.tlog", **options):
    path = folder / name
    path.write_bytes(log.bytes())
    recording, report = import_log(path, **options)
    return recording, {f.word: f for f in findings_of(recording.dataset)}, report


def remade(log, kind, change):
    """The log with the messages of a kind changed in place by `change(time, message)`."""
    reader = dialect.MAVLink(None)
    number = dialect.MAVLINK_MSG_ID_HEARTBEAT if kind == "HEARTBEAT" else _number(kind)
    for i, (t, packed) in enumerate(log.records):
        if int.from_bytes(packed[7:10], "little") == number:
            message = reader.decode(bytearray(packed))
            change(t, message)
            log.records[i] = (t, bytes(message.pack(dialect.MAVLink(None, 1, 1))))
    return log


def _number(kind):
    return getattr(dialect, f"MAVLINK_MSG_ID_{kind}")


def scaled(factor, *fields):
    def change(_, message):
        for field in fields:
            setattr(message, field, getattr(message, field) * factor)

    return change


def without(log, *kinds):
    numbers = {_number(kind) for kind in kinds}
    log.records = [r for r in log.records if int.from_bytes(r[1][7:10], "little") not in numbers]
    return log


@pytest.mark.parametrize(
    ("kind", "change", "said"),
    [
        (
            "ATTITUDE_QUATERNION",
            scaled(57.29578, "rollspeed", "pitchspeed", "yawspeed"),
            "p,q,r look like deg/s",
        ),
        ("LOCAL_POSITION_NED", scaled(1 / 0.514444, "vx", "vy", "vz"), "u,v,w look like knots"),
        ("LOCAL_POSITION_NED", scaled(-1.0, "vy"), "along the world's x has the wrong sign"),
        ("LOCAL_POSITION_NED", scaled(-1.0, "z", "vz"), "the pressure falls where the height does"),
    ],
)
def test_streams_that_fit_in_another_unit_or_sign_only_are_refused(tmp_path, kind, change, said):
    log = remade(dive(duration=DURATION), kind, change)
    with pytest.raises(UserError, match=f"{said}.*--accept motion-contradiction"):
        imported(tmp_path, log)
    _, found, _ = imported(tmp_path, log, accept=["motion-contradiction"])
    assert said in found["motion-contradiction"].text


def exchanged(*pairs):
    def change(_, message):
        for a, b in pairs:
            x, y = getattr(message, a), getattr(message, b)
            setattr(message, a, y)
            setattr(message, b, x)

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (exchanged(("x", "y"), ("vx", "vy")), "RAW_IMU feels only otherwise: north and east"),
        (scaled(-1.0, "y", "vy"), "only otherwise: the velocity to the east has the other sign"),
        (scaled(1 / 0.3048, "x", "y", "vx", "vy"), "only otherwise: it looks like ft/s"),
        (exchanged(("x", "y")), "x and y look exchanged"),
        (scaled(1 / 0.3048, "z", "vz"), "height of LOCAL_POSITION_NED looks like feet"),
        (scaled(1000.0, "z"), "height of LOCAL_POSITION_NED looks like mm"),
    ],
)
def test_axes_and_units_that_only_other_sensors_tell(tmp_path, change, said):
    """Position and velocity may be wrong alike: accelerometer and pressure tell."""
    log = with_imu(remade(dive(duration=DURATION), "LOCAL_POSITION_NED", change), accelerated)
    with pytest.raises(UserError, match=f"{said}.*--accept motion-contradiction"):
        imported(tmp_path, log)


def test_the_right_axes_and_units_have_no_finding(tmp_path):
    _, found, _ = imported(tmp_path, with_imu(dive(duration=DURATION), accelerated))
    assert found == {}


def test_angles_in_degrees_are_named(tmp_path):
    log = dive(duration=DURATION)
    for t, (q, _, _, w) in zip(
        times := 100 + np.arange(0, DURATION, 0.02), ned(times), strict=True
    ):
        roll, pitch, yaw = codec.euler_from_attitude(np.asarray(q)[:, None])
        angles = np.rad2deg([roll[0], pitch[0], yaw[0]])
        fields = (round(t * 1e3), *angles, *w)
        log.send(t, dialect.MAVLink_attitude_message(*fields))
    with pytest.raises(UserError, match=r"ATTITUDE: roll, pitch and yaw reach .* degrees"):
        imported(tmp_path, without(log, "ATTITUDE_QUATERNION"))


@pytest.mark.parametrize("jitter", ["normal", "late"])
def test_jittering_stamps_of_a_steady_stream_are_steadied(tmp_path, jitter):
    """The attitude is that of the right times but for a common latency, and the finding says so."""
    rng = np.random.default_rng(0)
    draw = rng.normal if jitter == "normal" else rng.exponential

    def change(_, message):
        message.time_boot_ms += round(20 * float(draw()))

    recording, found, _ = imported(
        tmp_path, remade(dive(duration=DURATION), "ATTITUDE_QUATERNION", change)
    )
    assert "about steady 50 Hz" in found["clock-jitter"].text
    run = next(recording.trajectories())
    t = run.start + recording.dt * np.arange(len(run))
    late = np.log(2) * 0.02 if jitter == "late" else 0.0  # the median latency
    off = rotations(truth(t - late)[0][:4]).inv() * rotations(run.X_WB[:, :4].T)
    assert np.quantile(off.magnitude(), 0.95) < 0.01  # rad: 10 ms at 1 rad/s


def test_a_stream_whose_stamps_drift_is_put_on_the_clock_of_the_others(tmp_path):
    def change(t, message):
        message.time_boot_ms += round(5.0 * (t - 100.0))  # 0.5 %, 0.3 s in all

    log = remade(dive(duration=60.0, rates=(25.0, 10.0, 25.0)), "LOCAL_POSITION_NED", change)
    recording, found, _ = imported(tmp_path, log)
    assert "drift by 0.3 s" in found["clock-rate"].text
    run = next(recording.trajectories())
    t = run.start + recording.dt * np.arange(len(run))
    inner = slice(20, -20)
    assert np.abs(run.X_WB[inner, 4:] - truth(t)[0][4:, inner].T).max() < 0.05


def test_a_message_that_is_stamped_late_is_no_step_of_the_clock():
    raw = np.arange(0.0, 10.0, 0.05)
    raw[[50, 100, 150]] += 0.6
    assert epochs(raw)[1] == ()


def test_a_climb_against_the_height_is_refused(tmp_path):
    """Without a horizontal estimate and pressure nothing else tells."""
    slow = dive(duration=30.0, horizontal=False, rates=(50.0, 5.0, 50.0), hud=10.0)
    log = without(slow, "SCALED_PRESSURE2")
    log = remade(log, "VFR_HUD", scaled(-1.0, "climb"))
    with pytest.raises(UserError, match="climb of VFR_HUD has the other sign than the height"):
        imported(tmp_path, log)


def with_imu(log, change=lambda t, f: f):
    """RAW_IMU at 25 Hz of a vehicle that gravity alone acts on, as `change` of its fields (mg)."""
    times = np.arange(100.0, 100.0 + DURATION, 0.04)
    for t, (q, _, _, w) in zip(times, ned(times), strict=True):
        a, b, c, d = q
        down = np.array([2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d])
        fields = [round(x) for x in (*change(t, -1000.0 * down), *(1000.0 * w))]
        log.send(t, dialect.MAVLink_raw_imu_message(round(t * 1e6), *fields, 0, 0, 0))
    return log


def accelerated(t, f):
    """The specific force (mg) with that of the motion, in the autopilot's axes."""
    h = 1e-3
    change = (truth(t + h)[2] - truth(t - h)[2]) / (2 * h)
    in_body = rotations(truth(np.atleast_1d(t))[0][:4]).inv().apply(change)[0]
    return f + frd_to_flu(in_body) / codec.G * 1000.0


def test_an_accelerometer_that_feels_no_gravity_is_left_out(tmp_path):
    recording, found, _ = imported(tmp_path, with_imu(dive(duration=DURATION)))
    assert "imu_specific_force" in recording.dataset
    assert found == {}
    for change, said in (
        (
            lambda t, f: f / 9.8,
            "its specific force is 1.01 m/s²",
        ),  # 102.04 mg as 102, that is 102.5
        (lambda t, f: -f, "does not point up in the world"),
    ):
        recording, found, _ = imported(tmp_path, with_imu(dive(duration=DURATION), change))
        assert "imu_specific_force" not in recording.dataset
        assert said in found["sensor-left-out"].text


def test_an_accelerometer_that_stands_still_has_no_readings_there(tmp_path):
    held = with_imu(dive(duration=DURATION), lambda t, f: f if t < 110 else np.full(3, -577.0))
    recording, found, _ = imported(tmp_path, held)
    assert "stand still at one value for 10.0 s" in found["sensor-left-out"].text
    run = next(recording.trajectories())
    read = np.isfinite(run.sensors["imu_specific_force"][:, 0])
    t = run.start + recording.dt * np.arange(len(run))
    assert read[t < 109.9].all()
    assert not read[t > 110.2].any()


def test_velocities_that_are_repeated_between_updates_are_samples_of_the_updates(tmp_path):
    """Sent at 25 Hz, new at 5 Hz: the recording is that of a stream at 5 Hz."""
    kept = {}

    def hold(t, message):
        step = round(t * 25) // 5
        fields = ("x", "y", "z", "vx", "vy", "vz")
        if step not in kept:
            kept.clear()
            kept[step] = [getattr(message, f) for f in fields]
        for field, value in zip(fields, kept[step], strict=True):
            setattr(message, field, value)

    log = remade(dive(duration=DURATION), "LOCAL_POSITION_NED", hold)
    recording, _, report = imported(tmp_path, log)
    assert recording.scenarios == ("01_MANUAL",)
    assert "LOCAL_POSITION_NED: its values change at 5.0 Hz" in str(report)
    run = next(recording.trajectories())
    V = truth(run.start + recording.dt * np.arange(len(run)))[1]
    assert np.abs(run.V_WB_B[:, :3] - V[:3].T).max() < 0.05


def pressures(log, kind, change):
    message = getattr(dialect, f"MAVLink_{kind}_message")
    for t, (_, p, _, _) in zip(times := 100 + np.arange(0, DURATION, 0.1), ned(times), strict=True):
        log.send(t, message(round(t * 1e3), change(1013.25 + 98.0 * p[2]), 0.0, 1200))
    return log


def test_a_pressure_in_another_unit_is_named_and_left_out(tmp_path):
    for factor, unit in ((0.1, "kPa"), (0.001, "bar"), (0.0145038, "psi")):
        log = without(dive(duration=DURATION), "SCALED_PRESSURE2")
        recording, found, _ = imported(
            tmp_path, pressures(log, "scaled_pressure2", lambda p, k=factor: k * p)
        )
        assert "pressure_depth" not in recording.dataset
        assert f"looks like {unit}, not hPa" in found["sensor-left-out"].text
    log = without(dive(duration=DURATION), "SCALED_PRESSURE2")
    gauge = pressures(log, "scaled_pressure2", lambda p: p - 700.0)
    assert "less than the surface's" in imported(tmp_path, gauge)[1]["sensor-left-out"].text


def test_a_hulls_pressure_is_no_depth_where_no_height_tells(tmp_path):
    log = without(dive(duration=DURATION), "SCALED_PRESSURE2", "LOCAL_POSITION_NED")
    hull = pressures(log, "scaled_pressure", lambda p: 1040.0)
    recording, found, _ = imported(tmp_path, hull)
    assert "pressure_depth" not in recording.dataset
    assert "log SCALED_PRESSURE2, or a height" in found["sensor-left-out"].remedy
    log = without(dive(duration=DURATION), "SCALED_PRESSURE2", "LOCAL_POSITION_NED")
    deep = pressures(log, "scaled_pressure", lambda p: p + 1000.0)  # no hull holds so much
    recording, found, _ = imported(tmp_path, deep)
    assert "pressure_depth" in recording.dataset
    assert found == {}


def test_a_new_surface_pressure_holds_from_its_report_on(tmp_path):
    log = without(dive(duration=DURATION), "SCALED_PRESSURE2")
    log = pressures(log, "scaled_pressure2", lambda p: p)
    plain, _, _ = imported(tmp_path, log)
    log = dive(duration=DURATION, changes=[(110.0, "BARO2_GND_PRESS", 91325.0)])
    changed, _, _ = imported(
        tmp_path, pressures(without(log, "SCALED_PRESSURE2"), "scaled_pressure2", lambda p: p)
    )
    deeper = (changed.dataset["pressure_depth"] - plain.dataset["pressure_depth"]).to_numpy()[0, 0]
    t = changed.dataset["time"].to_numpy() + float(changed.dataset["start_time"][0, 0])
    known = np.isfinite(deeper)
    np.testing.assert_allclose(deeper[known & (t < 109.8)], 0.0, atol=1e-6)
    np.testing.assert_allclose(deeper[known & (t > 110.2)], 10000 / 9800, atol=1e-6)


def battery(log, number, millivolts, start=100.0):
    for t in np.arange(start, start + DURATION, 0.5):
        cells = [millivolts, *[65535] * 9]
        fields = (number, 0, 0, 32767, cells, 0, 0, 0, 50)
        log.send(t, dialect.MAVLink_battery_status_message(*fields))
    return log


def test_the_second_monitor_counts_where_the_first_is_unknown(tmp_path):
    log = battery(without(dive(duration=DURATION), "BATTERY_STATUS"), 0, 65535)
    recording, found, _ = imported(tmp_path, battery(log, 1, 15200))
    assert found == {}
    np.testing.assert_allclose(next(recording.trajectories()).sensors["voltage"], 15.2)


def test_a_voltage_that_no_thruster_runs_at_is_left_out(tmp_path):
    log = battery(without(dive(duration=DURATION), "BATTERY_STATUS"), 0, 152)
    recording, found, _ = imported(tmp_path, log)
    assert "0.152 V are no voltage of a vehicle with" in found["sensor-left-out"].text
    assert "voltage" not in recording.dataset


@pytest.mark.parametrize("back", [1.0, 3.0])
def test_a_clock_that_steps_back_makes_two_parts(tmp_path, back):
    """Both parts are whole, and no sample of one lies in the other."""
    log, second = dive(duration=DURATION), dive(start=120.0 - back, duration=DURATION)
    log.records += [(t + back, packed) for t, packed in second.records]
    recording, _, report = imported(tmp_path, log)
    assert recording.scenarios == ("01_MANUAL", "02_MANUAL")
    assert "clock stepped back 1 time without a reboot" in str(report)
    for run in recording.trajectories():
        assert len(run) > 18.0 / recording.dt
        t = recording.dt * np.arange(len(run)) + run.start
        t = t if run.scenario == "01_MANUAL" else t - 10.0 - back
        assert np.abs(run.X_WB[:, 4:] - truth(t)[0][4:].T).max() < 0.05


def test_a_message_that_comes_late_is_no_step_of_the_clock():
    raw = np.arange(0.0, 10.0, 0.05)
    raw[100:103] -= 1.0
    shift, starts, _ = epochs(raw)
    assert starts == ()
    np.testing.assert_array_equal(shift, 0.0)
    raw[100:] -= 1.0
    _, starts, steps = epochs(raw)
    assert (len(starts), steps) == (1, 1)


def test_messages_of_two_links_are_read_once(tmp_path):
    one, _, _ = imported(tmp_path, dive(duration=DURATION, horizontal=False, hud=10.0))
    log = dive(duration=DURATION, horizontal=False, hud=10.0)
    log.records += [(t + 0.3, packed) for t, packed in log.records]
    twice, _, report = imported(tmp_path, log)
    assert "messages came twice" in str(report)
    n = min(one.mask.shape[2], twice.mask.shape[2])
    for name in ("X_WB", "V_WB_B", "pwm"):
        np.testing.assert_array_equal(
            one.dataset[name].to_numpy()[:, :, :n], twice.dataset[name].to_numpy()[:, :, :n]
        )


def test_a_clock_that_runs_fast_against_the_loggers_is_told(tmp_path):
    path = tmp_path / "dive.tlog"
    path.write_bytes(dive(duration=80.0, rates=(25.0, 10.0, 25.0)).bytes(clock=lambda t: t / 1.2))
    found = {f.word: f for f in findings_of(import_log(path)[0].dataset)}
    assert "runs 20 % faster than the logger's" in found["clock-rate"].text


def test_outputs_beyond_the_fourteenth_are_in_a_record_of_their_own(tmp_path, monkeypatch):
    own = PARAMETERS | {"SERVO8_FUNCTION": 0.0, "SERVO15_FUNCTION": 40.0}
    monkeypatch.setattr(log_writers, "PARAMETERS", own)
    columns = "TimeUS,C15,C16,C17,C18"
    monkeypatch.setitem(log_writers._FORMATS, "RCO2", (140, "QHHHH", columns))
    real = log_writers.DataFlash.write

    def write(log, name, *values):
        real(log, name, *values)
        if name == "RCOU":
            real(log, "RCO2", values[0], values[8], 0, 0, 0)

    monkeypatch.setattr(log_writers.DataFlash, "write", write)
    log = dataflash(duration=DURATION)
    recording, _, _ = imported(tmp_path, log, "dive.BIN")
    assert outputs_of(recording.dataset) == (1, 2, 3, 4, 5, 6, 7, 15)
    run = next(recording.trajectories())
    t = run.start + recording.dt * (np.arange(len(run)) + 0.5)
    assert np.abs(run.commands["pwm"][:, 7] - outputs(t)[7]).max() < 5.0


def test_a_dataflash_clock_that_steps_back_makes_two_parts(tmp_path):
    log, second = dataflash(duration=DURATION), dataflash(start=118.0, duration=DURATION)
    log.parts += [part for part in second.parts if part[2] != 128]  # without FMT
    recording, _, report = imported(tmp_path, log, "dive.BIN")
    assert recording.scenarios == ("01_MANUAL", "02_MANUAL")
    assert "clock stepped back 1 time" in str(report)


@pytest.mark.parametrize("rate", [20, 300])
def test_equal_packets_whose_numbers_came_round_are_no_copies(rate):
    """At 300 packets a second the numbers recur within the two seconds that a copy may be late."""
    one = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    data = b""
    for k in range(700):
        stamp = struct.pack(">Q", round(1e15 + 1e6 * k / rate))
        one.seq = k % 256
        data += stamp + dialect.MAVLink_heartbeat_message(12, 3, 0, 0, 4, 3).pack(one)
    packets = scan(data)
    every = np.ones(packets.record.size, bool)
    assert packets.record.size == 700
    assert not repeated(data, packets, every).any()
    copied = repeated(data + data[-20 * 29 :], scan(data + data[-20 * 29 :]), np.ones(720, bool))
    assert np.flatnonzero(copied).tolist() == [*range(700, 720)]


@pytest.mark.parametrize(("jump", "said"), [(103.0, False), (112.0, True)])
def test_a_reset_of_the_estimator_before_arming_is_none_of_the_data(tmp_path, jump, said):
    log = dive(duration=DURATION, state=lambda t: (t > 106.0, 19), jump=jump)
    _, _, report = imported(tmp_path, log)
    assert ("position reset of the estimator" in str(report)) == said
