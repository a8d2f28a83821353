"""Bags of mavros of a vehicle without a DVL: what its topics are not."""

import numpy as np
import pytest
from bag_writers import EPOCH_NS, Messages
from log_writers import outputs, truth

from spinndrift.models.config.errors import UserError
from spinndrift.systems.logs.load import LogOptions, import_log

START, DURATION = 100.0, 24.0
HULL = "/mavros/imu/static_pressure"


def ns(t):
    return EPOCH_NS + round(t * 1e9)


def times(rate):
    return START + np.arange(0, DURATION, 1 / rate)


def rows_of(messages, *, height=True, pascal=lambda z: 103000.0, pwm=outputs, pressure=HULL):
    """What mavros publishes of a plain vehicle."""
    rows = []
    for t in times(50.0):
        X, V, _ = truth(t)
        rows.append((ns(t), "/mavros/imu/data", messages.imu(ns(t), X[:4], V[3:])))
    for t in times(20.0):
        X, _, v_W = truth(t)
        head = {"header": (ns(t), "")}
        water = messages.make("sensor_msgs/msg/FluidPressure", **head, fluid_pressure=pascal(X[6]))
        still, climb = (0.0, 0.0, float(X[6])), (0.0, 0.0, -round(float(v_W[2]), 2))
        place = messages.odometry(ns(t), X[:4], still, climb, np.zeros(3), "map", "base_link")
        channels = np.array([*pwm(t), *[0] * 8], np.uint16)
        rows += [
            (ns(t), pressure, water),
            (
                ns(t),
                "/mavros/rc/out",
                messages.make("mavros_msgs/msg/RCOut", **head, channels=channels),
            ),
        ]
        if height:
            z = messages.make("std_msgs/msg/Float64", data=float(X[6]))
            rows += [
                (ns(t), "/mavros/global_position/rel_alt", z),
                (ns(t), "/mavros/global_position/local", place),
            ]
    for t in times(1.0):
        state = messages.make(
            "mavros_msgs/msg/State", header=(ns(t), ""), armed=True, mode="MANUAL"
        )
        rows.append((ns(t), "/mavros/state", state))
    return rows


def imported(folder, messages, rows, **options):
    path = messages.write(folder / "bag", rows)
    recording, report = import_log(path, **options)
    run = next(recording.trajectories())
    return recording, run, truth(START + run.start + recording.dt * np.arange(len(run)))[0], report


def test_the_place_of_a_gps_that_is_not_there_is_no_position(tmp_path):
    messages = Messages("ros1")
    recording, run, X, report = imported(tmp_path, messages, rows_of(messages))
    assert recording.missing == {"X_WB": ("x", "y"), "V_WB_B": ("u", "v")}
    np.testing.assert_allclose(run.X_WB[:, 6], X[6], atol=2e-3)
    assert "Height and climb from /mavros/global_position/rel_alt" in str(report)
    assert "pressure_depth" not in run.sensors
    assert f"{HULL} changes by 0 % of the estimated height's change" in str(report)


def test_a_first_barometer_in_the_water_is_the_depth_where_the_height_tells(tmp_path):
    messages = Messages("ros1")
    rows = rows_of(messages, pascal=lambda z: 101325.0 - 9800.0 * float(z))
    _, run, X, _ = imported(tmp_path, messages, rows)
    depth = run.sensors["pressure_depth"]
    assert np.isfinite(depth).mean() > 0.9
    np.testing.assert_allclose(depth[np.isfinite(depth)], -X[6][np.isfinite(depth)], atol=0.01)


@pytest.mark.parametrize("mapped", [False, True])
def test_no_height_is_derived_from_a_first_barometer_unless_a_map_names_it(tmp_path, mapped):
    messages = Messages("ros1")
    topics = tmp_path / "map.yaml"
    topics.write_text(
        "topics:\n"
        "- {topic: /mavros/imu/data, gives: [attitude, rates]}\n"
        "- {topic: /mavros/rc/out, gives: [pwm]}\n"
        f"- {{topic: {HULL}, gives: [depth]}}\n"
    )
    rows = rows_of(messages, height=False, pascal=lambda z: 101325.0 - 9800.0 * float(z))
    options = LogOptions(topics=topics if mapped else None)
    recording, run, X, report = imported(tmp_path, messages, rows, options=options)
    assert ("z" in recording.missing["X_WB"]) != mapped
    assert ("may be of the barometer in the hull, and no height tells" in str(report)) != mapped
    if mapped:
        np.testing.assert_allclose(run.X_WB[:, 6], X[6], atol=2e-3)


def test_another_pressure_is_taken_before_a_first_barometer(tmp_path):
    messages = Messages("ros1")
    rows = rows_of(messages, height=False, pascal=lambda z: 180000.0)
    water = lambda z: 101325.0 - 9800.0 * float(z)  # noqa: E731
    rows += [
        row
        for row in rows_of(messages, height=False, pascal=water, pressure="/depth/pressure")
        if row[1] == "/depth/pressure"
    ]
    _, run, X, report = imported(tmp_path, messages, rows)
    np.testing.assert_allclose(run.X_WB[:, 6], X[6], atol=2e-3)
    assert "Height and climb from /depth/pressure" in str(report)


def test_frames_that_contradict_the_outputs_are_refused(tmp_path):
    """As in telemetry."""
    messages = Messages("ros1")
    parameters = {f"SERVO{n}_FUNCTION": 32.0 + n for n in range(1, 9)} | {"FRAME_CONFIG": 0.0}
    rows = rows_of(messages)
    for name, value in parameters.items():
        kept = messages.make("mavros_msgs/msg/ParamValue", real=value)
        head = {"header": (ns(START), ""), "param_id": name}
        param = messages.make("mavros_msgs/msg/Param", **head, value=kept)
        rows.append((ns(START), "/mavros/param/param_value", param))
    with pytest.raises(UserError, match="BLUEROV1 has 6 thrusters, and outputs 7, 8 drive more"):
        imported(tmp_path, messages, rows)
