"""Faults of sensors: each against its definition, alone, in the suite and in a scenario."""

import math
from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

from spinndrift.models import se3
from spinndrift.models.config import typed_yaml
from spinndrift.models.config.errors import UserError
from spinndrift.models.sensors import SHIPPED, DepthSensor, Dvl, SensorFault
from spinndrift.models.sensors.faults import FaultySensor
from spinndrift.systems.closed_loop import Signal, logged, seeded
from spinndrift.systems.compiled.simulator import CompiledSimulator
from spinndrift.systems.plant.sensor_suite import SensorSuite
from spinndrift.systems.station.config import Sensing, StationConfig
from spinndrift.systems.station.simulated import add_noise

RATE = 10.0  # of the depth gauge and the compass


def see(faults: Sequence[SensorFault], readings: np.ndarray, seed: int = 0) -> np.ndarray:
    """Readings [values, valid, stamp] (time, size) as they are shown."""
    faulty = FaultySensor(SHIPPED[faults[0].sensor], tuple(faults))
    memory = jnp.zeros(faulty.memory_size)
    noise = np.random.default_rng(seed).standard_normal((len(readings), faulty.noise_size))
    rows = []
    for reading, w in zip(readings, noise, strict=True):
        now = jnp.asarray(reading)
        memory, row = faulty.show(memory, now, now[-1], jnp.asarray(w))
        rows.append(row)
    return np.stack(rows)


def readings(sensor: str, count: int, seed: int = 1) -> np.ndarray:
    """Valid readings of random values at a sensor's rate."""
    values = np.random.default_rng(seed).uniform(-1, 1, (count, SHIPPED[sensor].value_size))
    time = np.arange(count) / SHIPPED[sensor].rate
    return np.column_stack([values, np.ones(count), time])


def test_values_are_changed_in_their_time_and_components_alone():
    """Depth at 10 Hz from 1 s for 0.5 s is readings 10 to 14; the imu at 100 Hz 100 to 149."""
    for sensor, first in (("depth", 10), ("imu", 100)):
        end, chosen = first + first // 2, [0] if sensor == "depth" else [2, 4]
        raw = readings(sensor, end + 3)
        late = raw[first:end, -1:] - 1.0
        values = raw[first:end, chosen]
        expected = {
            "nan": np.full_like(values, np.nan),
            "infinite": np.full_like(values, np.inf),
            "constant": np.full_like(values, 3.0),
            "offset": values + 3.0,
            "drift": values + 3.0 * late,
            "scale": 3.0 * values,
        }
        for fault, wanted in expected.items():
            size = None if fault in ("nan", "infinite") else 3.0
            own = () if sensor == "depth" else tuple(chosen)
            shown = see([SensorFault(sensor, fault, 1.0, 0.5, own, size)], raw)
            truth = raw.copy()
            truth[first:end, chosen] = wanted
            np.testing.assert_allclose(shown, truth, rtol=1e-15, err_msg=fault)
            np.testing.assert_array_equal(shown[:first], raw[:first])
            np.testing.assert_array_equal(shown[end:], raw[end:])


def test_a_fault_of_no_duration_hits_one_reading_and_one_without_stays():
    raw = readings("imu", 40)
    for start in (0.1, 0.1 + 1e-12, 0.0951, 0.1 - 1e-12):  # the first reading from then on
        spike = see([SensorFault("imu", "offset", start, 0.0, (0,), 1000.0)], raw) - raw
        assert np.flatnonzero(spike[:, 0]).tolist() == [10]
        np.testing.assert_allclose(spike[10], [1000.0, *np.zeros(7)])
    stays = see([SensorFault("imu", "constant", 0.1, size=0.0)], raw)
    assert np.all(stays[10:, :6] == 0)


def test_what_is_frozen_repeats_bit_for_bit_while_stamps_go_on():
    raw = readings("dvl", 12)
    raw[4, :4] = 0.0  # a drop-out just before: the value before it stays
    raw[7, :4] = 0.0  # and one in the fault's time
    shown = see([SensorFault("dvl", "frozen", 1.0, 1.0)], raw)
    np.testing.assert_array_equal(shown[5:10, :4], np.tile(raw[3, :4], (5, 1)))
    np.testing.assert_array_equal(shown[:, 4], raw[:, 4])
    np.testing.assert_array_equal(shown[10:], raw[10:])
    one = see([SensorFault("dvl", "frozen", 1.0, 1.0, (1,))], raw)
    np.testing.assert_array_equal(one[5:10, 1], np.full(5, raw[3, 1]))
    np.testing.assert_array_equal(one[:, [0, 2, 3, 4]], raw[:, [0, 2, 3, 4]])


def test_frozen_from_the_first_reading_on():
    raw = readings("dvl", 6)
    raw[0, :4] = 0.0  # not valid: there is nothing yet that could stay
    shown = see([SensorFault("dvl", "frozen")], raw)
    np.testing.assert_array_equal(shown[1:, :4], np.tile(raw[1, :4], (5, 1)))


def test_marks_and_stamps():
    raw = readings("depth", 8)
    lost = see([SensorFault("depth", "dropout", 0.2, 0.3)], raw)
    np.testing.assert_array_equal(lost[2:5, :2], np.zeros((3, 2)))
    np.testing.assert_array_equal(lost[:, 2], raw[:, 2])
    stuck = see([SensorFault("depth", "frozen_stamp", 0.2, 0.3)], raw)
    np.testing.assert_array_equal(stuck[2:5, 2], np.full(3, raw[1, 2]))
    np.testing.assert_array_equal(stuck[:, :2], raw[:, :2])
    ahead = see([SensorFault("depth", "stamp_offset", 0.2, 0.3, size=0.15)], raw)
    np.testing.assert_allclose(ahead[2:5, 2], raw[2:5, 2] + 0.15)
    raw = readings("dvl", 6)
    raw[3, :4] = 0.0
    for size in (0.0, -32.768):  # lock loss and a sentinel, marked as valid
        shown = see([SensorFault("dvl", "constant", 0.4, 0.6, size=size)], raw)
        np.testing.assert_array_equal(shown[2:5, :4], np.tile([size] * 3 + [1.0], (3, 1)))


def test_hidden_latency_shows_the_value_of_then_with_the_stamp_of_now():
    raw = readings("imu", 100)
    shown = see([SensorFault("imu", "latency", 0.5, size=0.3)], raw)
    np.testing.assert_array_equal(shown[50:, :6], raw[20:70, :6])
    np.testing.assert_array_equal(shown[:, 7], raw[:, 7])
    raw = readings("dvl", 12)
    shown = see([SensorFault("dvl", "latency", 1.0, size=0.5)], raw)  # 2.5 periods
    np.testing.assert_allclose(shown[5:, :3], (raw[2:9, :3] + raw[3:10, :3]) / 2, rtol=1e-12)
    angle = np.linspace(3.0, 4.1, 12)  # a compass that turns through π at a steady rate
    raw = np.column_stack([np.asarray(_wrapped(angle)), np.ones(12), np.arange(12) / RATE])
    shown = see([SensorFault("compass", "latency", 0.5, size=0.25)], raw)
    expected = _wrapped(angle - 2.5 * (angle[1] - angle[0]))
    np.testing.assert_allclose(shown[5:, 0], expected[5:], atol=1e-12)


def test_a_turned_compass_stays_in_its_range():
    raw = readings("compass", 30)
    shown = see([SensorFault("compass", "offset", 1.0, size=3.0)], raw)
    np.testing.assert_allclose(shown[10:, 0], _wrapped(raw[10:, 0] + 3.0), atol=1e-12)
    assert np.any(shown[10:, 0] < 0)
    np.testing.assert_array_equal(shown[:10], raw[:10])


@pytest.mark.parametrize("share", [0.0, 0.2, 0.9])
def test_the_share_that_is_hit(share):
    """Counts of independent hits lie within four standard deviations of n·share."""
    n = 2000
    shown = _many(SensorFault("depth", "offset", size=1.0, share=share), n)
    hits = np.count_nonzero(shown > 0.5)
    assert abs(hits - n * share) <= 4 * math.sqrt(n * share * (1 - share))
    assert set(np.round(shown, 9)) <= {0.0, 1.0}


def test_noise_is_multiplied():
    """Added white noise of std σ√(k² − 1): with the sensor's own σ it is k σ."""
    n, k = 4000, 5.0
    added = _many(SensorFault("depth", "noise", size=k), n)
    std = DepthSensor().noise * math.sqrt(k**2 - 1)
    assert abs(added.std() / std - 1) < 4 / math.sqrt(2 * n)


def test_faults_act_one_after_the_other():
    raw = readings("depth", 20)
    jump = SensorFault("depth", "offset", 0.5, size=2.0)
    twice = SensorFault("depth", "scale", 1.0, 0.5, size=2.0)
    first, last = see([jump, twice], raw), see([twice, jump], raw)
    np.testing.assert_allclose(first[12, 0], 2 * (raw[12, 0] + 2))
    np.testing.assert_allclose(last[12, 0], 2 * raw[12, 0] + 2)
    stuck = SensorFault("depth", "frozen", 1.0)
    np.testing.assert_allclose(see([jump, stuck], raw)[12, 0], raw[9, 0] + 2)


def _many(fault: SensorFault, n: int) -> np.ndarray:
    """What a fault adds to n readings of zero at one time, as a batch."""
    faulty = FaultySensor(SHIPPED[fault.sensor], (fault,))
    w = np.random.default_rng(3).standard_normal((faulty.noise_size, n))
    reading = jnp.zeros((3, n)).at[1].set(1.0)
    _, shown = faulty.show(jnp.zeros((faulty.memory_size, n)), reading, reading[2], jnp.asarray(w))
    return np.asarray(shown[0])


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return np.angle(np.exp(1j * angle))


# ------------------------------------------------------------------------------------ in a suite

ALL = (
    SensorFault("imu", "frozen", 0.3, 0.2),
    SensorFault("imu", "nan", 0.6, 0.0, (1,)),
    SensorFault("imu", "offset", 0.2, 0.5, (3,), 1000.0, share=0.7),
    SensorFault("dvl", "frozen", 0.9, 0.5, (0,)),
    SensorFault("dvl", "dropout", 0.2, share=0.6),
    SensorFault("depth", "latency", 0.8, size=0.33),
    SensorFault("depth", "noise", 0.2, size=3.0, share=0.8),
    SensorFault("compass", "frozen_stamp", 0.5),
)
PERIODS = dict.fromkeys((f"log_{name}" for name in SHIPPED), 0.01)


def suite(faults: tuple[SensorFault, ...] = ()) -> Diagram:
    """A suite that looks at one motion; its depth gauge keeps no time with the IMU."""
    X = np.asarray(se3.from_position_rpy(jnp.array([1.0, 2, -3]), jnp.array([0.1, -0.2, 0.7])))
    builder = DiagramBuilder()
    sensors = builder.AddNamedSystem(
        "sensors", SensorSuite({**SHIPPED, "depth": DepthSensor(7.0)}, faults)
    )
    for name, value in (("X_WB", X), ("V_WB_B", np.full(6, 0.1)), ("A_WB_B", np.zeros(6))):
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), sensors.GetInputPort(name))
    add_noise(builder, sensors, "noise", 0.01)
    if sensors.HasInputPort("fault_noise"):
        add_noise(builder, sensors, "fault_noise", 0.01)
    for name in SHIPPED:
        log = LogVectorOutput(sensors.GetOutputPort(name), builder, 0.01)
        log.set_name(f"log_{name}")
    return builder.Build()


def record(simulator, diagram: Diagram) -> dict[str, Signal]:
    seeded(diagram, simulator.get_mutable_context(), 4)
    simulator.Initialize()
    simulator.AdvanceTo(1.6)
    return logged(diagram, simulator.get_mutable_context())


def test_a_suite_with_faults_is_the_suite_without_but_for_them():
    """In Drake's events and in the compiled loop alike."""
    bare, faulty = suite(), suite(ALL)
    healthy = record(Simulator(bare), bare)
    drake = record(Simulator(faulty), faulty)
    loop = record(CompiledSimulator(faulty, PERIODS), faulty)
    for name in SHIPPED:
        np.testing.assert_allclose(loop[name].value, drake[name].value, rtol=1e-12, atol=1e-12)
        before = drake[name].time <= 0.2
        np.testing.assert_array_equal(drake[name].value[before], healthy[name].value[before])
    # a reading of t is logged at t + 0.01; times of the faults
    imu, clean = drake["imu"].value[1:], healthy["imu"].value[1:]
    np.testing.assert_array_equal(imu[30:50, :3], np.tile(imu[29, :3], (20, 1)))
    assert np.flatnonzero(np.isnan(imu[:, 1])).tolist() == [60]
    assert np.all(imu[50:60, :3] == clean[50:60, :3])
    far = np.abs(imu[20:70, 3]) > 500
    assert 0.4 < far.mean() < 0.95
    dvl, other = drake["dvl"].value, healthy["dvl"].value
    np.testing.assert_array_equal(dvl[:, 6], other[:, 6])
    kept = (dvl[:, 3] == 1) & (dvl[:, 6] > 0.89) & (dvl[:, 6] < 1.39)
    assert np.unique(dvl[kept, 0]).size <= 1
    compass = drake["compass"].value
    assert compass[-1, 2] == pytest.approx(0.4)
    np.testing.assert_array_equal(compass[:, :2], healthy["compass"].value[:, :2])


# --------------------------------------------------------------------------------- as settings


def test_a_scenario_names_faults():
    text = "faults: [{sensor: imu, fault: frozen, start: 10, duration: 1}, {sensor: dvl, fault: "
    text += "frozen, start: 5, duration: 20, components: [0]}, {sensor: depth, fault: nan}]"
    found = typed_yaml.loads(StationConfig, f"sensing: {{{text}}}")
    assert found.sensing.faults == (
        SensorFault("imu", "frozen", 10.0, 1.0),
        SensorFault("dvl", "frozen", 5.0, 20.0, (0,)),
        SensorFault("depth", "nan"),
    )
    assert typed_yaml.loads(StationConfig, typed_yaml.dump(found)) == found
    assert Sensing().faults == ()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{sensor: sonar, fault: nan}", "sensor is 'sonar': take one of imu, dvl"),
        ("{sensor: imu, fault: broken}", "fault: .*one of nan, infinite"),
        ("{sensor: imu, fault: dropout}", "fault is 'dropout': the readings of imu have neither"),
        ("{sensor: dvl, fault: nan, components: [3]}", r"components is \(3,\): .*some of 0 to 2"),
        ("{sensor: dvl, fault: nan, components: [0, 0]}", "components .*each once"),
        ("{sensor: depth, fault: nan, components: [-1]}", "components .*0 is the only one"),
        ("{sensor: depth, fault: dropout, components: [0]}", "components .*leave them out"),
        ("{sensor: depth, fault: offset}", "size is None: offset needs one"),
        ("{sensor: depth, fault: frozen, size: 1}", "size is 1.0: frozen has none"),
        ("{sensor: depth, fault: latency, size: 0}", "size is 0.0: give a time"),
        ("{sensor: depth, fault: noise, size: 0.5}", "size is 0.5: give a factor"),
        ("{sensor: depth, fault: nan, share: 1.1}", "share is 1.1"),
        ("{sensor: depth, fault: nan, start: -1}", "start is -1"),
        ("{sensor: depth, fault: nan, duration: -1}", "duration is -1.0: .*leave it out"),
        ("{sensor: compass, fault: offset, size: 40}", "size is 40.0: .*in radians: give -π to π"),
    ],
)
def test_what_makes_no_sense_is_refused_with_a_remedy(text, message):
    with pytest.raises(UserError, match=message):
        typed_yaml.loads(Sensing, f"faults: [{text}]")


def test_a_dvl_may_be_lost_most_of_the_time():
    """The chain's stationary share is enter / (enter + leave): 0.9 of 2000 runs, 4 std errors."""
    dvl = Dvl(dropout_share=0.9, dropout_length=2.0, outlier_share=1.0)
    state, n = dvl.initial(jnp.asarray(np.random.default_rng(0).standard_normal((2, 2000)))), 2000
    X = jnp.tile(se3.identity()[:, None], (1, n))
    zero = jnp.zeros((6, n))
    for k in range(4):
        w = np.random.default_rng(k + 1).standard_normal((dvl.noise_size, n))
        state = dvl.measure(state, X, zero, zero, 0.2 * k, jnp.asarray(w))
    valid = np.asarray(state[6])
    assert abs(valid.mean() - 0.1) < 4 * math.sqrt(0.09 / n)
    with pytest.raises(UserError, match=r"dropout_share is 0.9: .*0.75 at most.*dropout_length"):
        Dvl(dropout_share=0.9)
    with pytest.raises(UserError, match=r"dropout_share is 1.0"):
        replace(dvl, dropout_share=1.0)
    with pytest.raises(UserError, match=r"outlier_share is 1.1"):
        Dvl(outlier_share=1.1)
