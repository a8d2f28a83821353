"""Times of an autopilot's own log that jitter, run back, repeat or drift."""

import struct

import log_writers
import numpy as np
import pytest
from log_writers import dataflash

from spinndrift.models.recordings.checks.finding import findings_of
from spinndrift.systems.logs.clock_dataflash import in_order, ordered
from spinndrift.systems.logs.dataflash import read_bin
from spinndrift.systems.logs.load import import_log
from spinndrift.systems.logs.table import Table

START_US = 100_000_000


def restamped(data: bytes, name: str, change) -> bytes:
    """The log with TimeUS of the records of one name, in order, changed."""
    number = log_writers._FORMATS[name][0]
    found, at = bytearray(data), 0
    head, places = b"\xa3\x95" + bytes([number]), []
    lengths = {128: 89}
    while at < len(data):
        kind = data[at + 2]
        if kind == 128:
            lengths[data[at + 3]] = data[at + 4]
        if data[at : at + 3] == head:
            places.append(at + 3)
        at += lengths[kind]
    old = np.array([struct.unpack_from("<Q", data, p)[0] for p in places])
    for place, us in zip(places, np.rint(change(old)).astype(int).tolist(), strict=True):
        struct.pack_into("<Q", found, place, us)
    return bytes(found)


@pytest.fixture(scope="module")
def log() -> bytes:
    return dataflash(duration=12.0).bytes()


def imported(tmp_path, data):
    path = tmp_path / "dive.BIN"
    path.write_bytes(data)
    return import_log(path)[0]


def words(recording):
    return [f.word for f in findings_of(recording.dataset)]


def test_a_good_log_has_no_finding(tmp_path, log):
    assert not {"clock-jitter", "clock-order", "clock-rate"} & set(words(imported(tmp_path, log)))


@pytest.mark.parametrize("off", [-0.3, 0.4])
def test_single_records_at_a_wrong_time_are_left_out(tmp_path, log, off):
    """Pairs of cores share their time; one record of each core is wrong."""

    def change(us):
        us = us.astype(float)
        us[400:402] += off * 1e6
        return us

    expected = imported(tmp_path, log)
    found = imported(tmp_path, restamped(log, "XKQ", change))
    (one,) = (f for f in findings_of(found.dataset) if f.word.startswith("clock"))
    assert (one.word, one.severity) == ("clock-order", "cut")
    assert f"{104 + off:.1f}" in one.place
    # one sample at 50 Hz is interpolated: its curvature is below (1 rad/s)² (0.02 s)² / 8
    X, other = (r.dataset["X_WB"].to_numpy()[0, 0, :, :4] for r in (found, expected))
    np.testing.assert_allclose(X, other, atol=1e-4)


@pytest.mark.parametrize("name", ["XKQ", "XKF1"])
def test_stamps_that_jitter_are_replaced_by_steady_times(tmp_path, log, name):
    """Normal jitter of a quarter of the interval."""
    rng = np.random.default_rng(1)

    def change(us):
        late = np.repeat(rng.normal(0.0, 0.005, us.size // 2), 2)  # two cores a step
        return us + 1e6 * late

    data = restamped(log, name, change)
    found = findings_of(imported(tmp_path, data).dataset)
    told = [f for f in found if f.word.startswith("clock")]
    assert [(f.word, f.place) for f in told] == [("clock-jitter", name)]
    assert "steady 50 Hz" in told[0].text
    expected, given = (read_bin(d, [name]).tables[name] for d in (log, data))
    kept, _ = ordered(given, name)
    flew = expected["C"] == 1  # the other core never turns, so nothing tells of its times
    off = kept["t"][kept["C"] == 1] - expected["t"][flew]
    # a line through 101 normal errors of 5 ms is off by 0.5 ms (1 ms at the ends), the phase less
    assert np.sqrt(np.mean(off**2)) < 1e-3
    assert np.std((given["t"] - expected["t"])[flew]) > 4e-3


def test_the_longest_sequence_of_times_is_kept():
    t = np.array([0.0, 1.0, 5.0, 2.0, 2.0, np.nan, 0.5, 3.0])
    np.testing.assert_array_equal(in_order(t), [1, 1, 0, 1, 1, 1, 0, 1])
    assert in_order(np.arange(5.0)).all()


def test_sensors_of_one_record_have_times_of_their_own():
    t = np.array([0.0, 0.5, 1.0, 0.8, 2.0, 1.7])
    table = Table("ACC", {"t": t, "I": np.array([0.0, 1.0] * 3)})
    kept, found = ordered(table, "ACC")
    assert found == []
    np.testing.assert_array_equal(kept["t"], t)


@pytest.mark.parametrize(("rate", "told"), [(1.0, False), (1.05, True)])
def test_a_clock_that_runs_apart_from_that_of_gps(tmp_path, monkeypatch, rate, told):
    form = (151, "QBBIH", "TimeUS,I,Status,GMS,GWk")
    monkeypatch.setitem(log_writers._FORMATS, "GPS", form)
    log = dataflash(duration=10.0)
    for t in np.arange(0.0, 90.0, 0.2):
        log.write("GPS", START_US + round(1e6 * rate * t), 0, 4, 1000 + round(1e3 * t), 2300)
    found = imported(tmp_path, log.bytes())
    texts = [f.text for f in findings_of(found.dataset) if f.word == "clock-rate"]
    assert bool(texts) is told
    assert not told or "5 % faster than that of GPS" in texts[0]
