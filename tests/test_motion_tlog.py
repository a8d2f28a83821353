"""Height and climb of telemetry beside, and in place of, its local position."""

from typing import Any

import numpy as np
import pytest
from log_writers import dialect, dive, truth

from spinndrift.systems.logs.load import LogOptions, import_log
from spinndrift.systems.logs.motion_tlog import upright
from spinndrift.systems.logs.signals import Series

LOCAL, GLOBAL = dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 33


def number(packed):
    return int.from_bytes(packed[7:10], "little")


def imported(folder, log, **options):
    path = folder / "dive.tlog"
    path.write_bytes(log.bytes())
    return import_log(path, **options)


def partly(silent, glob=True, duration=36.0, **settings):
    """A dive whose local positions are silent at some times; the global ones are not."""
    log = dive(duration=duration, **settings)
    other = dive(duration=duration, horizontal=False, **settings)
    log.records = [r for r in log.records if number(r[1]) != LOCAL or not silent(r[0])]
    log.records += [r for r in other.records if number(r[1]) == GLOBAL and glob]
    return log


SPANS = [
    (lambda t: t < 112.0, [True, False]),
    (lambda t: t > 112.0, [False, True]),
    (lambda t: 112.0 < t < 124.0, [False, True, False]),
]


@pytest.mark.parametrize(("silent", "unknown"), SPANS)
def test_height_and_climb_where_the_local_position_is_silent(tmp_path, silent, unknown):
    recording, report = imported(tmp_path, partly(silent))
    runs = list(recording.trajectories())
    assert sum(len(run) for run in runs) * recording.dt > 34.0
    assert [bool(np.isnan(run.X_WB[:, 4:6]).all()) for run in runs] == unknown
    for run, lacks in zip(runs, unknown, strict=True):
        t = run.start + recording.dt * np.arange(len(run))
        X, V, v_W = truth(t)
        assert np.abs(run.X_WB[:, 6] - X[6]).max() < 2e-3
        assert np.abs(run.sensors["vertical_velocity"] - v_W[2]).max() < 0.01
        if lacks:
            assert np.isnan(run.V_WB_B[:, :2]).all()
        else:
            assert np.abs(run.V_WB_B.T - V).max() < 2e-3
            assert np.abs(run.X_WB[:, 4:].T - X[4:]).max() < 1e-3
    assert "LOCAL_POSITION_NED is silent for" in str(report)


def test_positions_slower_than_the_climb_of_the_display_are_read_to_their_last(tmp_path):
    log = partly(lambda t: t > 112.0, rates=(50.0, 3.0, 50.0), hud=10.0)
    recording, _ = imported(tmp_path, log)
    runs = list(recording.trajectories())
    assert sum(len(run) for run in runs) * recording.dt > 30.0
    assert not np.isnan(runs[0].X_WB).any()


STATUS = dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT


@pytest.mark.parametrize(
    ("reported", "flags", "lasts"),
    [
        # the heartbeats end after 35 s
        (lambda t: t < 104.0, 831, [35.0]),
        (lambda t: t > 120.0, 831, [35.0]),
        (lambda t: not 108.0 < t < 124.0, 831, [35.0]),
        (lambda t: t < 104.0, 1 | 128, [3.0, 32.0]),  # without a horizontal estimate until 103 s
    ],
)
def test_reports_of_the_filter_that_stop_leave_the_rest_to_the_position(
    tmp_path, reported, flags, lasts
):
    log = dive(duration=36.0)
    log.records = [r for r in log.records if number(r[1]) != STATUS or reported(r[0])]
    if flags != 831:
        log.records = [r for r in log.records if number(r[1]) != STATUS]
        for t in np.arange(100.0, 104.0):
            log.send(t, dialect.MAVLink_ekf_status_report_message(flags, 0, 0, 0, 0, 0))
    recording, _ = imported(tmp_path, log, options=LogOptions(minimum=2.0))
    runs = [len(run) * recording.dt for run in recording.trajectories()]
    assert runs == pytest.approx(lasts, abs=0.3)
    unknown = [np.isnan(run.V_WB_B[:, 0]).all() for run in recording.trajectories()]
    assert unknown == [False] if len(lasts) == 1 else [True, False]


def test_short_pauses_of_the_local_position_stay_gaps(tmp_path):
    recording, report = imported(tmp_path, partly(lambda t: 112.0 < t < 113.5))
    assert recording.missing == {}
    assert "Cut at 1 gap of up to 1." in str(report)


@pytest.mark.parametrize(
    ("silent", "said"),
    [
        (SPANS[0][0], "late start of LOCAL_POSITION_NED (12.0 s)"),
        (SPANS[1][0], "early end of LOCAL_POSITION_NED (23.0 s)"),
    ],
)
def test_time_without_a_position_is_said(tmp_path, silent, said):
    """Nothing tells of the height there: the time is lost."""
    recording, report = imported(tmp_path, partly(silent, glob=False))
    assert recording.missing == {}
    assert said in str(report)


def turned(log):
    """The same log, with vz positive upwards."""
    records, decoder = [], dialect.MAVLink(None)
    for t, packed in log.records:
        if number(packed) == GLOBAL:
            m: Any = decoder.decode(bytearray(packed))
            fields = (m.time_boot_ms, 0, 0, 0, m.relative_alt, 0, 0, -m.vz, 0)
            message = dialect.MAVLink_global_position_int_message(*fields)
            packed = bytes(message.pack(dialect.MAVLink(None, 1, 1)))
        records.append((t, packed))
    log.records = records
    return log


@pytest.mark.parametrize("rate", [25.0, 3.0])
def test_a_climb_that_is_positive_upwards_is_turned(tmp_path, rate):
    rates = (50.0, rate, 50.0)
    given, plain = imported(tmp_path, dive(horizontal=False, rates=rates))
    former, report = imported(tmp_path, turned(dive(horizontal=False, rates=rates)))
    for name in ("V_WB_B", "vertical_velocity"):
        np.testing.assert_array_equal(former.dataset[name], given.dataset[name])
    assert "its vz is positive upwards" in str(report)
    assert "positive upwards" not in str(plain)


def test_the_climb_of_a_noisy_height_is_left(tmp_path):
    """A barometer's noise of 0.2 m hides the climb: nothing tells that it is turned."""

    t = np.arange(0, 60, 0.25)
    noise = 0.2 * np.random.default_rng(1).standard_normal(t.size)
    lacking = np.full(t.size, np.nan)
    z, climb = 0.5 * np.sin(0.3 * t), 0.15 * np.cos(0.3 * t)
    velocity = Series(t, np.stack([lacking, lacking, climb]), "")
    for sign in (1, -1):
        noisy = Series(t, np.stack([lacking, lacking, sign * z + noise]), "")
        assert upright(noisy, velocity) == (velocity, [])
