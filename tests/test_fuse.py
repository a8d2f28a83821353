"""Readings of sensors on the grid of a recording: where there was a sample, and nowhere else."""

import numpy as np
import pytest
from log_writers import dialect, dive

from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.logs.load import import_log, own_rate
from spinndrift.systems.logs.signals import Series, Signals
from spinndrift.training.diagnosis.data.arrays import make_data
from spinndrift.training.smoothing.complete import complete

START, DURATION = 100.0, 20.0


def felt(t):
    """Forward specific force (mg) of these logs: fast against a slow stream."""
    return np.round(500 * np.sin(9.0 * t))


def with_imu(times, **options):
    """A dive with RAW_IMU at some times."""
    log = dive(duration=DURATION, **options)
    for t in times:
        fields = (round(t * 1e6), int(felt(t)), 0, -1000, 0, 0, 0, 0, 0, 0)
        log.send(t, dialect.MAVLink_raw_imu_message(*fields))
    return log


def imported(folder, log, **options):
    path = folder / "dive.tlog"
    path.write_bytes(log.bytes())
    recording, report = import_log(path, **options)
    (run,) = recording.trajectories()
    t = run.start + recording.dt * np.arange(len(run))
    return recording, run, t, report


def read(run) -> np.ndarray:
    """Samples at which the accelerometer has a reading."""
    return np.asarray(np.isfinite(run.sensors["imu_specific_force"]).all(axis=1))


def test_a_slow_accelerometer_is_read_where_it_has_samples(tmp_path):
    """At 2 Hz: one of ten samples of 20 Hz, and the value there is its own."""
    times = START + 0.013 + np.arange(0, DURATION, 0.5)
    _, run, t, report = imported(tmp_path, with_imu(times))
    force = run.sensors["imu_specific_force"]
    there = read(run)
    nearest = np.abs(t[:, None] - times).min(axis=1)
    assert np.count_nonzero(there) == np.sum((times > t[0] - 0.025) & (times < t[-1] + 0.025))
    assert nearest[there].max() <= 0.025 + 1e-9
    whole = felt(times)  # mg, of what was truncated towards zero
    given = np.interp(t[there], times, whole + np.sign(whole) / 2) * 9.80665e-3
    np.testing.assert_allclose(force[there, 0], given, atol=1e-9)
    assert any("RAW_IMU at 2.0 Hz is slower than the recording" in line for line in report.lacks)


def test_a_sensor_that_begins_late_or_stops_has_no_readings_elsewhere(tmp_path):
    times = START + np.arange(4.0, 8.0, 0.02)
    log = with_imu(times)
    pressure = dialect.MAVLINK_MSG_ID_SCALED_PRESSURE2
    number = lambda packed: int.from_bytes(packed[7:10], "little")  # noqa: E731
    log.records = [r for r in log.records if number(r[1]) != pressure or r[0] < START + 8]
    _, run, t, report = imported(tmp_path, log)
    there = read(run)
    inside = (t > times[0]) & (t < times[-1])
    assert there[inside].all()
    assert not there[(t < times[0] - 0.025) | (t > times[-1] + 0.025)].any()
    assert not np.isfinite(run.sensors["pressure_depth"][t > START + 8.05]).any()
    for name in ("RAW_IMU", "SCALED_PRESSURE2"):
        assert any(f"{name} is silent for" in line for line in report.lacks)


def test_single_lost_messages_of_a_fast_sensor_are_bridged(tmp_path):
    times = START + np.arange(0.0, DURATION, 0.05)
    kept = np.delete(times, [100, 200, 201, 202])
    _, run, t, report = imported(tmp_path, with_imu(kept))
    there = read(run)
    lost = t[1:-1][~there[1:-1]]
    np.testing.assert_allclose(lost, times[[200, 201, 202]], atol=0.026)
    assert not any("RAW_IMU" in line for line in report.lacks)


@pytest.mark.parametrize(
    ("step", "lost", "there"), [(0.05, [100, 200, 201, 202], True), (0.5, [], False)]
)
def test_a_diagnosis_takes_an_accelerometer_that_was_read_nearly_always(
    tmp_path, step, lost, there
):
    times = np.delete(START + np.arange(0.0, DURATION, step), lost)
    recording, *_ = imported(tmp_path, with_imu(times, horizontal=False))
    data = make_data(recording, load_vehicle("bluerov2_heavy"))
    assert (data.specific_force is not None) == there
    assert data.specific_force is None or np.isfinite(data.specific_force).all()


def test_a_pause_of_the_accelerometer_is_too_long_for_a_diagnosis(tmp_path):
    times = START + np.arange(0.0, DURATION, 0.05)
    log = with_imu(times[(times < 105.0) | (times > 106.0)], horizontal=False)
    recording, *_ = imported(tmp_path, log)
    assert make_data(recording, load_vehicle("bluerov2_heavy")).specific_force is None


@pytest.mark.slow
def test_the_smoother_gives_forces_where_there_were_readings(tmp_path):
    times = START + np.arange(0.0, DURATION, 0.5)
    recording, run, *_ = imported(tmp_path, with_imu(times, horizontal=False))
    short = recording.cut(0.0, 4.0)
    assert isinstance(short, Recording)
    vehicle = load_vehicle("bluerov2_heavy")
    found = complete(short, vehicle, vehicle.dynamics(), rounds=1)
    size = int(short.lengths[0, 0])
    there = np.isfinite(run.sensors["imu_specific_force"][:size])
    np.testing.assert_array_equal(np.isfinite(found.force[0, 0, :size]), there)


def test_the_accelerometer_counts_for_the_rate_where_nothing_else_tells_of_surge():
    def rate(accelerometer, horizontal):
        fast = Series(np.arange(0, 10, 0.02), np.zeros((3, 500)), "")
        force = Series(np.arange(0, 10, 1 / accelerometer), np.zeros(1), "")
        v = fast.x + (0.0 if horizontal else np.array([[np.nan], [np.nan], [0.0]]))
        velocity = Series(fast.t, v, "")
        given = {"position": velocity, "velocity": velocity, "specific_force": force}
        return own_rate(Signals(attitude=fast, rates=fast, outputs=fast, **given))

    assert rate(25, horizontal=True) == 50
    assert rate(25, horizontal=False) == 25
    assert rate(2, horizontal=False) == 50
    assert rate(12.5, horizontal=False) == 12.5
    assert rate(9.9, horizontal=False) == 10
    assert rate(12.5, horizontal=True) == 50


def test_the_rate_of_a_stream_is_that_without_gaps_however_many_there_are():
    def rate(steps):
        t = np.cumsum(steps)
        return Series(t, np.zeros((1, t.size)), "").rate

    assert rate([0.05] * 40) == pytest.approx(20.0)
    assert rate([0.05] * 40 + [30.0] * 3) == pytest.approx(20.0)
    assert rate([0.05] * 40 + [1e5] * 60) == pytest.approx(20.0)  # stamps of a damaged log
    assert rate([1e5] * 60) == 0.0
