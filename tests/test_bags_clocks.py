"""Bags whose clocks jitter, drift or step back, and whose frames, mapping or definitions change."""

import sqlite3

import numpy as np
import pytest
from bag_writers import EPOCH_NS, Messages
from log_writers import PARAMETERS, outputs, truth

from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.checks.finding import findings_of
from spinndrift.models.recordings.outputs import outputs_of
from spinndrift.models.recordings.resample import rotations
from spinndrift.systems.logs.load import LogOptions, import_log

START = 100.0


def ns(t):
    return EPOCH_NS + round(t * 1e9)


def times(duration, rate=50.0):
    return START + np.arange(0.0, duration, 1 / rate)


def odometry(messages, t, stamp, frame="map", child="base_link"):
    X, V, _ = truth(t)
    at = 0 if stamp is None else ns(stamp)
    return messages.odometry(at, X[:4], X[4:], V[:3], V[3:], frame, child)


def pulses(messages, duration):
    made = ((t, messages.array("UInt16", outputs(t))) for t in times(duration))
    return [(ns(t), "/pwm", message) for t, message in made]


def imported(path, **options):
    recording, report = import_log(path, options=LogOptions(minimum=4.0, **options))
    return recording, {f.word: f for f in findings_of(recording.dataset)}, report


def off(run, dt, origin=START):
    """Largest errors of a run's attitude (rad) and position (m), a second from its ends."""
    n = round(1.0 / dt)
    X, _, _ = truth(origin + run.start + dt * np.arange(len(run)))
    turn = (rotations(X[:4]).inv() * rotations(run.X_WB[:, :4].T)).magnitude()
    return turn[n:-n].max(), np.abs(run.X_WB[n:-n, 4:].T - X[4:, n:-n]).max()


def test_stamps_of_headers_are_used_whatever_the_latency(tmp_path):
    rng = np.random.default_rng(0)
    messages = Messages("mcap")
    rows = pulses(messages, 7.0)
    for t in times(7.0):
        rows.append((ns(t + 0.05 * rng.exponential()), "/odom", odometry(messages, t, t)))
    recording, found, _ = imported(messages.write(tmp_path / "bag", rows))
    assert not found.keys() & {"clock-jitter", "clock-rate"}
    assert max(off(next(recording.trajectories()), recording.dt)) < 1e-3


def test_arrivals_that_jitter_are_steadied_where_no_header_tells(tmp_path):
    rng = np.random.default_rng(1)
    messages = Messages("mcap")
    rows, last = pulses(messages, 20.0), 0.0
    for t in times(20.0):
        last = max(last + 1e-4, t + 0.02 * rng.exponential())  # in order, as through a socket
        rows.append((ns(last), "/odom", odometry(messages, t, None)))
    recording, found, _ = imported(messages.write(tmp_path / "bag", rows))
    assert "times of arrival jitter" in found["clock-jitter"].text
    assert "about steady 50 Hz" in found["clock-jitter"].text
    assert "header" in found["clock-jitter"].remedy
    origin = min(received for received, topic, _ in rows if topic == "/odom") - EPOCH_NS
    # 5 % of the latencies are below 2 ms, the line through 101 of them is off by 2 σ / √101 at its
    # ends, and the motion has less than 1 rad/s and 1 m/s
    assert max(off(next(recording.trajectories()), recording.dt, 1e-9 * origin)) < 0.01


def test_a_topic_whose_clock_drifts_is_put_on_the_attitudes(tmp_path):
    messages = Messages("mcap")
    rows = pulses(messages, 60.0)
    rng = np.random.default_rng(2)
    for t in times(60.0, 20.0):
        X, V, _ = truth(t)
        rows.append((ns(t + 0.003), "/imu", messages.imu(ns(t), X[:4], V[3:])))
        late = t + 0.005 * (t - START)  # 0.5 %, 0.3 s in all
        pose = messages.make(
            "geometry_msgs/msg/PointStamped",
            header=(ns(late), "map"),
            point=messages.xyz("Point", X[4:]),
        )
        rows.append((ns(t + 0.003 + 0.002 * rng.exponential()), "/position", pose))
    recording, found, _ = imported(messages.write(tmp_path / "bag", rows))
    assert "drift by 0.3 s" in found["clock-rate"].text
    assert found["clock-rate"].place == "/position"
    assert off(next(recording.trajectories()), recording.dt)[1] < 0.02


def test_stamps_that_step_back_begin_a_new_part(tmp_path):
    """The vehicle's computer starts anew after 12 s, with the clock of the beginning."""
    messages = Messages("ros1")
    rows = pulses(messages, 24.0)
    for t in times(24.0):
        stamp = t if t < START + 12 else t - 12
        rows.append((ns(t), "/odom", odometry(messages, t, stamp)))
    recording, _, report = imported(messages.write(tmp_path / "bag", rows))
    one, two = recording.trajectories()
    assert "booted 1 more time" in str(report)
    assert max(off(one, recording.dt)) < 1e-3
    t = START + 12 + recording.dt * np.arange(len(two))
    assert np.abs(two.X_WB[20:-20, 4:].T - truth(t)[0][4:, 20:-20]).max() < 0.05
    assert (
        np.abs(two.commands["pwm"][20:-20].T - outputs(t + recording.dt / 2)[:, 20:-20]).max() < 5
    )


def test_messages_in_another_frame_are_left_out(tmp_path):
    """From 8 s on the same topic is in NED and FRD, by the names of its frames."""
    messages = Messages("mcap")
    rows = pulses(messages, 14.0)
    for t in times(14.0):
        names = ("map", "base_link") if t < START + 8 else ("map_ned", "base_link_frd")
        rows.append((ns(t), "/odom", odometry(messages, t, t, *names)))
    recording, found, _ = imported(messages.write(tmp_path / "bag", rows))
    assert "300 of its messages are in map_ned to base_link_frd" in found["frame-changes"].text
    assert recording.duration < 8.0
    assert max(off(next(recording.trajectories()), recording.dt)) < 1e-3


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_parameters_that_change_the_outputs_in_mid_bag_cut_there(kind, tmp_path):
    messages = Messages(kind)
    told = [(START, name, value) for name, value in PARAMETERS.items()]
    told += [(START + 10, "MOT_3_DIRECTION", -1.0)]
    rows = []
    for t, name, value in told:
        head = {"header": (ns(t), ""), "param_id": name}
        if kind == "ros1":
            kept = messages.make("mavros_msgs/msg/ParamValue", real=value)
            message = messages.make("mavros_msgs/msg/Param", **head, value=kept)
        else:
            kept = messages.make("rcl_interfaces/msg/ParameterValue", type=3, double_value=value)
            message = messages.make("mavros_msgs/msg/ParamEvent", **head, value=kept)
        topic = "param_value" if kind == "ros1" else "event"
        rows.append((ns(t), f"/mavros/param/{topic}", message))
    for t in times(20.0):
        channels = np.zeros(16, np.uint16)
        channels[:8] = outputs(t)
        sent = messages.make("mavros_msgs/msg/RCOut", header=(ns(t), ""), channels=channels)
        rows.append((ns(t), "/mavros/rc/out", sent))
        rows.append((ns(t), "/odom", odometry(messages, t, t)))
    recording, found, _ = imported(messages.write(tmp_path / "bag", rows))
    assert "MOT_3_DIRECTION changed" in found["output-direction"].text
    assert outputs_of(recording.dataset) == tuple(range(1, 9))
    for run, sign in zip(recording.trajectories(), (1, -1), strict=True):
        t = START + run.start + recording.dt * (np.arange(len(run)) + 0.5)
        expected = 1500 + sign * (outputs(t)[2] - 1500)
        assert np.abs(run.commands["pwm"][:, 2] - expected).max() < 2.0


@pytest.mark.slow
def test_parts_with_pauses_are_stretches_of_their_own(tmp_path):
    """Three recordings in one bag, with a minute between."""
    messages, rows = Messages("mcap"), []
    for first in (0.0, 66.0, 133.0):
        for t in times(6.0) + first:
            rows.append((ns(t), "/odom", odometry(messages, t, t)))
            rows.append((ns(t), "/pwm", messages.array("UInt16", outputs(t))))
    recording, _, report = imported(messages.write(tmp_path / "bag", rows))
    runs = list(recording.trajectories())
    assert len(runs) == 3
    assert "2 gaps" in str(report)
    assert max(max(off(run, recording.dt)) for run in runs) < 1e-3


def test_definitions_that_lack_are_assumed_or_named(tmp_path):
    """As ROS 2 before Iron writes: standard types are read, others are named with the remedy."""
    messages = Messages("sqlite3")
    messages.define("own_msgs/msg/Thrust", "float32[] newton")
    rows = []
    for t in times(8.0):
        rows.append((ns(t), "/odom", odometry(messages, t, t)))
        made = messages.make("own_msgs/msg/Thrust", newton=np.zeros(8, np.float32))
        rows.append((ns(t), "/thrust", made))
    path = messages.write(tmp_path / "own", rows)
    with sqlite3.connect(path / "own.db3") as base:
        base.execute("delete from message_definitions")
    with pytest.raises(UserError, match=r"no definition of /thrust own_msgs/msg/Thrust .* as MCAP"):
        imported(path / "own.db3")
    made = tmp_path / "map.yaml"
    made.write_text("topics:\n- {topic: /thrust, gives: [forces]}\n")
    with pytest.raises(UserError, match=r"/thrust can't be taken: no definition of .* as MCAP"):
        imported(path / "own.db3", topics=made)
    standard = [row for row in rows if row[1] == "/odom"] + pulses(messages, 8.0)
    path = messages.write(tmp_path / "bag", standard)
    with sqlite3.connect(path / "bag.db3") as base:
        base.execute("delete from message_definitions")
    _, _, report = imported(path / "bag.db3")
    assert "those of ROS 2 Humble and mavros are assumed" in str(report)
