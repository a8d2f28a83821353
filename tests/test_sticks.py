"""Outputs between slow samples, from the sticks that commanded them."""

import numpy as np
import pytest
from log_writers import dialect, dive

from spinndrift.models.recordings.origin import states_estimated
from spinndrift.systems.logs.load import import_log
from spinndrift.systems.logs.signals import Series, Spans
from spinndrift.systems.logs.sticks import by_controllers, by_sticks
from spinndrift.systems.logs.table import Table

MIXER = 400 * np.random.default_rng(3).uniform(-0.7, 0.7, (6, 6))  # µs: outputs by demands
LATE = 0.03
END = 120.0


class Flight:
    """A pilot's sticks, and the outputs they make with those of an autopilot beside them."""

    def __init__(self, jitter=0.0, gain=lambda t: np.full(np.shape(t), 0.5), late=LATE):
        rng = np.random.default_rng(1)
        self.t = np.arange(0.0, END, 0.05) + rng.uniform(0, jitter or 1e-9, round(END / 0.05))
        changes = np.sort(rng.uniform(0, END, (6, 60)), axis=1)
        values = rng.integers(-700, 700, (6, 61))
        self.values = np.stack(
            [v[np.searchsorted(c, self.t)] for v, c in zip(values, changes, strict=True)]
        )
        self.values[4:] //= 4  # s and t are µs
        self.gain, self.late = gain, late

    def table(self):
        x, y, z, r, s, roll = self.values.astype(float)
        columns = {"x": x, "y": y, "z": 500 + z / 2, "r": r, "s": s, "roll": roll}
        return Table("MANUAL_CONTROL", {"t": self.t, **columns})

    def reports(self):
        t = np.arange(0.0, END, 0.5)
        name = np.array([b"PilotGain\0", b"Lights1\0\0\0"])[np.arange(t.size) % 2]
        return Table("NAMED_VALUE_FLOAT", {"t": t, "name": name, "value": self.gain(t)})

    def outputs(self, t, beside=0.0):
        last = np.clip(np.searchsorted(self.t, t - self.late, side="right") - 1, 0, None)
        x, y, z, r, s, roll = self.values[:, last].astype(float)
        k = self.gain(self.t)[last] / 1000
        demand = np.stack([k * x, -k * y, k * z, roll / 400, -s / 400, -k * r])
        return 1500 + MIXER @ demand + beside

    def logged(self, rate, beside=lambda t: 0.0, start=0.013):
        t = np.arange(start, END, 1 / rate)
        return Series(t, self.outputs(t, beside(t)), "SERVO_OUTPUT_RAW")


def modes(*parts):
    starts, stops, labels = zip(*parts, strict=True)
    return [Spans(np.array(starts), np.array(stops), labels)]


MANUAL = modes((0.0, END, "MANUAL"))


def misses(flight, series, beside=lambda t: 0.0, within=(1.0, END - 1.0)):
    """Root mean square errors of a series, 20 ms and more from instants at which sticks come.

    The lag is found to 10 ms, and the series has steps of 10 ms.
    """
    t = np.arange(*within, 0.01) + 0.0033
    after = np.searchsorted(flight.t, t - flight.late)
    t = t[(np.abs(t - flight.late - flight.t[[after - 1, after]]) > 0.02).all(axis=0)]
    found = np.stack([np.interp(t, series.t, u) for u in series.x])
    return np.sqrt(np.mean((found - flight.outputs(t, beside(t))) ** 2))


@pytest.mark.parametrize("rate", [1.9, 9.7])
def test_a_pilots_outputs_are_known_between_samples(rate):
    flight = Flight(jitter=0.01)
    slow = flight.logged(rate)
    found, told = by_sticks(slow, {"MANUAL_CONTROL": flight.table()}, MANUAL)
    assert misses(flight, slow) > 10
    assert misses(flight, found) < 1e-6
    assert len(told) == 1
    assert "follow MANUAL_CONTROL at 20 Hz" in told[0]


def test_what_an_autopilot_adds_is_interpolated():
    flight = Flight()

    def beside(t):
        return 60 * np.sin(0.9 * np.asarray(t) + np.arange(6.0)[:, None])

    slow = flight.logged(1.9, beside)
    found, _ = by_sticks(slow, {"MANUAL_CONTROL": flight.table()}, MANUAL)
    # lines miss the sine by (ωh)²/8 of 60 µs at most, and its changes blur the map
    assert misses(flight, found, beside) < 2 * 60 * (0.9 / 1.9) ** 2 / 8
    assert misses(flight, slow, beside) > 20


def test_a_pilots_gain_that_changes_is_taken_in():
    flight = Flight(gain=lambda t: np.where(np.asarray(t) < 60.0, 0.5, 0.25))
    slow = flight.logged(1.9)
    tables = {"MANUAL_CONTROL": flight.table(), "NAMED_VALUE_FLOAT": flight.reports()}
    found, _ = by_sticks(slow, tables, MANUAL)
    assert found.measured == 0.0
    slow.x[2] = np.random.default_rng(6).uniform(1300, 1700, slow.t.size)
    assert by_sticks(slow, tables, MANUAL)[0].measured == slow.rate
    assert misses(flight, found, within=(1.0, 58.0)) < 1e-6
    assert misses(flight, found, within=(62.0, END - 1.0)) < 1e-6


def test_each_mode_has_a_map_of_its_own():
    flight = Flight()
    slow = flight.logged(4.7)
    slow.x[:, slow.t > 60.0] = 3000 - slow.x[:, slow.t > 60.0]
    states = modes((0.0, 60.0, "MANUAL"), (60.0, END, "STABILIZE"))
    found, _ = by_sticks(slow, {"MANUAL_CONTROL": flight.table()}, states)
    assert misses(flight, found, within=(1.0, 59.0)) < 1e-6
    turned = Series(found.t, 3000 - found.x, "")
    assert misses(flight, turned, within=(61.0, END - 1.0)) < 1e-6


def test_overrides_are_sticks_as_well():
    flight = Flight()
    x, y, z, r, s, roll = flight.values.astype(float)
    channels = 1500 + np.stack([s, roll, 0.2 * z, 0.2 * r, 0.2 * x, 0.2 * y])
    columns = {f"chan{n}_raw": channels[n - 1] for n in range(1, 7)}
    idle = {f"chan{n}_raw": np.full(flight.t.size, 65535.0) for n in (7, 8)}
    table = Table("RC_CHANNELS_OVERRIDE", {"t": flight.t, **columns, **idle})
    found, told = by_sticks(flight.logged(1.9), {"RC_CHANNELS_OVERRIDE": table}, MANUAL)
    assert misses(flight, found) < 1e-6
    assert "RC_CHANNELS_OVERRIDE" in told[0]


def test_sticks_of_another_flight_change_nothing():
    flight = Flight()
    slow = flight.logged(1.9)
    slow.x[:] = np.random.default_rng(2).uniform(1300, 1700, slow.x.shape)
    found, told = by_sticks(slow, {"MANUAL_CONTROL": flight.table()}, MANUAL)
    assert found is slow
    assert told == []
    assert by_sticks(slow, {}, MANUAL) == (slow, [])


def test_lost_outputs_and_silent_sticks_leave_what_was_there():
    flight = Flight()
    slow = flight.logged(4.7)
    kept = (slow.t < 40.0) | (slow.t > 45.0)
    slow = Series(slow.t[kept], slow.x[:, kept], slow.source)
    silent = (flight.t > 80.0) & (flight.t < 90.0)
    table = flight.table().rows(~silent)
    found, _ = by_sticks(slow, {"MANUAL_CONTROL": table}, MANUAL)
    assert not np.any((found.t > 40.2) & (found.t < 44.8))
    own = slow.t[(slow.t > 80.1) & (slow.t < 90.0)]
    assert set(found.t[(found.t > 80.1) & (found.t < 90.0)]) == set(own)


def controlled(rate=24.7, forward=0.0, until=END):
    """RATE at a rate (Hz), and outputs at some times, of controllers that work at 1 to 2 Hz.

    A pilot's `forward` (µs) is beside them on the first two outputs.
    """
    frequencies = np.array([[1.3], [1.7], [1.1], [0.9]])
    mixer = 400 * np.array([[0.0, 0, 1, 0], [0, 0, -1, 0], [1, -1, 0, -2], [-1, -1, 0, -2]])

    def outputs(t):
        demand = 0.2 * np.sin(2 * np.pi * frequencies * t + frequencies)
        beside = forward * np.sin(2 * np.pi * 1.5 * t) * np.array([[1.0], [1], [0], [0]])
        return 1500 + np.where(t < until, mixer @ demand, 0.0) + beside

    t = np.arange(0.0, END, 1 / rate)
    demand = 0.2 * np.sin(2 * np.pi * frequencies * t + frequencies)
    return Table("RATE", {"t": t, **dict(zip(CONTROLLERS, demand, strict=True))}), outputs


CONTROLLERS = ("ROut", "POut", "YOut", "AOut")
BETWEEN = np.arange(2.0, END - 2.0, 0.0173)


def off(series, outputs, t=BETWEEN):
    """Root mean square error (µs) of each output."""
    found = np.stack([np.interp(t, series.t, x) for x in series.x])
    return np.sqrt(np.mean((found - outputs(t)) ** 2, axis=1))


@pytest.mark.parametrize("forward", [0.0, 20.0])
def test_outputs_of_an_autopilots_log_follow_its_controllers(forward):
    rate, outputs = controlled(forward=forward)
    t = np.arange(0.013, END, 0.1)
    slow = Series(t, outputs(t), "RCOU")
    found, told = by_controllers(slow, rate, MANUAL)
    lines, beside = off(slow, outputs), forward * (np.pi * 1.5 * 0.1) ** 2 / np.sqrt(15)
    assert (off(found, outputs)[2:] < 0.2 * lines[2:]).all()
    assert found.measured == 0.0
    # a forward command that no controller knows is left to lines, and no more than that
    assert (off(found, outputs)[:2] < 0.2 * lines[:2] + 1.5 * beside).all()
    assert "follow RATE at 25 Hz" in told[0]


def test_controllers_that_do_not_act_or_are_slow_change_nothing():
    rate, outputs = controlled(until=0.0, forward=100.0)
    t = np.arange(0.013, END, 0.1)
    slow = Series(t, outputs(t), "RCOU")
    assert by_controllers(slow, rate, MANUAL) == (slow, [])
    rate, outputs = controlled(rate=10.0)
    slow = Series(t, outputs(t), "RCOU")
    assert by_controllers(slow, rate, MANUAL) == (slow, [])
    assert by_controllers(slow, None, MANUAL) == (slow, [])
    assert by_controllers(slow, Table("RATE", {"t": rate["t"]}), MANUAL) == (slow, [])


def test_demands_within_doubt_have_no_part_in_a_map():
    """Noise on an output makes coefficients of all demands, of which one is beyond doubt."""
    rng = np.random.default_rng(5)
    rate, _ = controlled()
    t = np.arange(0.013, END, 0.1)
    yaw = 400 * np.interp(t, rate["t"], rate["YOut"])
    slow = Series(t, 1500 + np.stack([yaw + 10 * rng.normal(size=t.size)]), "RCOU")
    found, _ = by_controllers(slow, rate, MANUAL)
    moved = np.stack([np.interp(found.t, rate["t"], rate[name]) for name in CONTROLLERS])
    rest = found.x[0] - np.interp(found.t, t, slow.x[0])
    lines = np.stack([np.interp(found.t, t, np.interp(t, rate["t"], m)) for m in
                      (rate[name] for name in CONTROLLERS)])  # fmt: skip
    C = np.linalg.lstsq((moved - lines).T, rest, rcond=None)[0]
    assert C[2] == pytest.approx(400, rel=0.1)
    np.testing.assert_allclose(C[[0, 1, 3]], 0.0, atol=1e-6)


@pytest.mark.parametrize("version", [1, 2])
def test_a_log_with_outputs_at_two_hertz_has_those_of_the_sticks(tmp_path, version):
    log = dive(duration=40.0, rates=(50.0, 25.0, 2.0), version=version)
    rng = np.random.default_rng(4)
    t = np.arange(100.0, 140.0, 0.05)
    value = np.repeat(rng.integers(-900, 900, 80), 10)
    for at, x in zip(t, value, strict=True):
        fields = (1, int(x), 0, 500, 0, 0)
        log.send(at - 0.004, dialect.MAVLink_manual_control_message(*fields), system=255)
    number = dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW
    at = slice(5, 6) if version == 1 else slice(7, 10)
    log.records = [r for r in log.records if int.from_bytes(r[1][at], "little") != number]
    for at in np.arange(100.0, 140.0, 0.5) + 0.013:
        pwm = [round(1500 + 0.3 * value[np.searchsorted(t, at, side="right") - 1])] * 8
        fields = (round(at * 1e6) % 2**32, 0, *pwm, *[0] * 8)
        log.send(at, dialect.MAVLink_servo_output_raw_message(*fields))
    path = tmp_path / "dive.tlog"
    path.write_bytes(log.bytes())
    recording, report = import_log(path, rate=20.0, accept=["commands-unrelated"])
    (run,) = recording.trajectories()
    at = run.start + 0.05 * (np.arange(len(run) - 1) + 0.5)
    right = 1500 + 0.3 * value[np.searchsorted(t, at, side="right") - 1]
    steady = right == 1500 + 0.3 * value[np.searchsorted(t, at - 0.07, side="right") - 1]
    steady &= right == 1500 + 0.3 * value[np.searchsorted(t, at + 0.07, side="right") - 1]
    found = run.commands["pwm"][: len(at), 0]
    assert np.abs(found - right)[steady].max() < 1.0  # outputs are whole µs
    assert "follow MANUAL_CONTROL" in str(report)
    assert states_estimated(recording.dataset)
