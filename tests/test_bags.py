"""ROS bags give the recording that the same data give as a log, in any frames and clocks."""

import json
import sqlite3
import sys

import numpy as np
import pytest
from bag_writers import EPOCH_NS, KINDS, Messages, as_mavros
from log_writers import dive, outputs, truth

from helpers import ROOT
from spinndrift.models import frames
from spinndrift.models.config import typed_yaml
from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.resample import hold, rotations
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.cli import main
from spinndrift.sims.log_check import find_logs
from spinndrift.systems.logs.bags.bag import open_bag
from spinndrift.systems.logs.bags.propose import propose, written
from spinndrift.systems.logs.bags.topics import TopicMap
from spinndrift.systems.logs.load import LogOptions, import_log, load_data
from spinndrift.systems.logs.log_bytes import read_log_bytes
from spinndrift.systems.logs.packets import message_id, scan

pytestmark = pytest.mark.whole

DEMO = ROOT / "sims" / "data" / "sitl_dive.tlog.xz"
START, DURATION = 100.0, 6.0
_STAMP_S = 2e-9
"""Stamps of ROS are whole ns."""


def ns(t):
    return EPOCH_NS + round(t * 1e9)


@pytest.fixture(scope="session")
def cut_dive():
    """A quarter of a minute of both stretches of the packaged dive, and all its parameters."""
    raw = read_log_bytes(DEMO).data
    packets = scan(raw)
    t = packets.stamps(raw)
    t = t - t[0]
    always = ("PARAM_VALUE", "SYSTEM_TIME", "VISION_POSITION_DELTA")
    keep = np.isin(packets.message, [message_id(name) for name in always])
    for first in (60.0, 160.0):
        keep |= (t > first) & (t < first + 8.0)
    return b"".join(raw[packets.record[i] : packets.end[i]] for i in np.flatnonzero(keep))


def largest_step(x):
    """Of a variable (scenario, trajectory, time, …), from one reading to the next."""
    series = np.moveaxis(x, 2, -1).reshape(-1, x.shape[2])
    return max(np.abs(np.diff(row[np.isfinite(row)])).max(initial=0.0) for row in series)


@pytest.mark.parametrize("kind", KINDS)
def test_the_packaged_dive_as_a_bag_is_the_same_recording(kind, cut_dive, tmp_path):
    (tmp_path / "dive.tlog").write_bytes(cut_dive)
    log, _ = import_log(tmp_path / "dive.tlog")
    messages = Messages(kind)
    bag, report = import_log(messages.write(tmp_path / "dive", as_mavros(messages, cut_dive)))
    assert bag.scenarios == log.scenarios == ("01_MANUAL", "02_MANUAL_passthrough")
    assert set(bag.dataset) == set(log.dataset)
    assert bag.vehicle == log.vehicle
    assert bag.command_period == pytest.approx(log.command_period, rel=1e-6)
    np.testing.assert_array_equal(bag.mask, log.mask)
    for name in set(log.dataset.data_vars) - {"mask", "start_time"}:
        ours, theirs = bag.dataset[name].to_numpy(), log.dataset[name].to_numpy()
        steepest = largest_step(theirs) / 0.01 + np.nanmax(np.abs(theirs))
        single = np.finfo(np.float32).eps * np.nanmax(np.abs(theirs)) * (name == "voltage")
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=_STAMP_S * steepest + single)
    started = (log.dataset["start_time"] - bag.dataset["start_time"]).to_numpy()
    assert np.ptp(started) < 1e-6  # the same times, from another origin
    assert "INS_GYRO_FILTER" in str(report)


# a vehicle with known motion


def times(rate, offset=0.0):
    return START + offset + np.arange(0, DURATION, 1 / rate)


def commands(messages, topic="/pwm", rate=50.0, of=outputs):
    """Rows of a command array; it has no header."""
    return [(ns(t), topic, messages.array("UInt16", of(t))) for t in times(rate, 0.002)]


def odometry(messages, down_world=False, down_body=False, names=("odom", "base_link")):
    t = times(50.0)
    X, V, _ = truth(t)
    q = rotations(X[:4])
    P = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    Q = np.diag([1, -1, -1])
    R = np.einsum(
        "ij,njk,kl->nil",
        P if down_world else np.eye(3),
        q.as_matrix(),
        Q if down_body else np.eye(3),
    )
    x, y, z, w = type(q).from_matrix(R).as_quat().T
    p = frames.ned_to_enu(X[4:]) if down_world else X[4:]
    V = frames.twist_frd_to_flu(V) if down_body else V
    turned = np.stack([w, x, y, z])
    parts = zip(t, turned.T, p.T, V[:3].T, V[3:].T, strict=True)
    return [(ns(s), "/odom", messages.odometry(ns(s), *rest, *names)) for s, *rest in parts]


def imported(path, **options):
    return import_log(path, rate=20.0, options=LogOptions(**options))


def against_truth(recording, dt=0.02):
    """Largest errors of attitude, position, velocity and rates, where they are there."""
    (run,) = recording.trajectories()
    X, V, _ = truth(START + run.start + recording.dt * np.arange(len(run)))
    turn = (rotations(X[:4]).inv() * rotations(run.X_WB[:, :4].T)).magnitude()
    p, v, w = run.X_WB[:, 4:].T, run.V_WB_B[:, :3].T, run.V_WB_B[:, 3:].T
    return [np.abs(e).max() for e in (turn, p - X[4:], v - V[:3], w - V[3:])]


_INTERPOLATION = 0.02**2 / 8 * 5
"""Of a linear interpolation over 20 ms where the second derivative is below 5."""


@pytest.mark.parametrize(
    ("world", "body", "names"),
    [
        (False, False, ("odom", "base_link")),
        (True, True, ("odom_ned", "base_link_frd")),
        (True, True, ("map_ned", "base_link_ned")),
        (True, False, ("map_ned", "base_link")),
        (False, True, ("map", "base_link_frd")),
    ],
)
def test_frames_by_their_names(world, body, names, tmp_path):
    messages = Messages("mcap")
    rows = odometry(messages, world, body, names) + commands(messages)
    recording, _ = imported(messages.write(tmp_path / "bag", rows))
    assert max(against_truth(recording)) < _INTERPOLATION


def test_frames_by_the_map(tmp_path):
    messages = Messages("mcap")
    rows = odometry(messages, True, True) + commands(messages)
    path = messages.write(tmp_path / "bag", rows)
    with open_bag(path) as bag:
        text = written(bag, propose(bag))
    assert "frame: ENU/FLU" in text
    assert typed_yaml.loads(TopicMap, text)
    (tmp_path / "bag.topics.yaml").write_text(text.replace("ENU/FLU", "NED/FRD"))
    recording, report = imported(path)  # the map beside it
    assert max(against_truth(recording)) < _INTERPOLATION
    assert "bag.topics.yaml" in str(report)


@pytest.mark.parametrize("frame", ["base_link", "base_link_frd", "map", "map_ned"])
def test_twists_in_body_and_world(frame, tmp_path):
    messages = Messages("ros1")
    rows = commands(messages)
    for t in times(50.0):
        X, V, v_W = truth(t)
        w_W = rotations(X[:4, None]).apply(V[3:])[0]
        v, w = (v_W, w_W) if frame.startswith("map") else (V[:3], V[3:])
        if frame.endswith("_ned"):
            v, w = frames.ned_to_enu(v), frames.ned_to_enu(w)
        if frame.endswith("_frd"):
            v, w = frames.frd_to_flu(v), frames.frd_to_flu(w)
        pose = messages.make(
            "geometry_msgs/msg/PoseStamped", header=(ns(t), "map"), pose=messages.pose(X[:4], X[4:])
        )
        twist = messages.make(
            "geometry_msgs/msg/TwistStamped", header=(ns(t), frame), twist=messages.twist(v, w)
        )
        order = messages.make("geometry_msgs/msg/Twist", linear=messages.xyz("Vector3", (9, 9, 9)))
        rows += [(ns(t), "/pose", pose), (ns(t), "/dvl", twist), (ns(t), "/cmd_vel", order)]
    recording, _ = imported(messages.write(tmp_path / "bag", rows))
    assert max(against_truth(recording)) < _INTERPOLATION


def test_a_pose_alone_is_differentiated(tmp_path):
    messages = Messages("sqlite3")
    rows = commands(messages)
    for t in times(100.0):
        X, _, _ = truth(t)
        rows.append((ns(t), "/mocap", messages.pose(X[:4], X[4:])))
    recording, report = imported(messages.write(tmp_path / "bag", rows))
    turn, position, velocity, rate = against_truth(recording)
    assert max(turn, position) < _INTERPOLATION
    assert max(velocity, rate) < 0.05**2 / 6 * 8  # h²/6 times the third derivative
    assert "differences" in str(report)


def test_dvl_imu_and_pressure_without_a_position(tmp_path):
    messages = Messages("mcap")
    rows = commands(messages)
    for t in times(50.0):
        X, V, _ = truth(t)
        a = rotations(X[:4, None]).inv().apply([0.0, 0.0, 9.81])[0]
        pascal = 101325.0 - 9800.0 * X[6]
        rows += [
            (ns(t), "/imu", messages.imu(ns(t), X[:4], V[3:], a)),
            (ns(t), "/dvl", messages.make(
                "geometry_msgs/msg/TwistStamped", header=(ns(t), "dvl_link"),
                twist=messages.twist(V[:3], np.zeros(3)),
            )),
            (ns(t), "/pressure", messages.make(
                "sensor_msgs/msg/FluidPressure", header=(ns(t), ""), fluid_pressure=pascal
            )),
        ]  # fmt: skip
    recording, report = imported(messages.write(tmp_path / "bag", rows))
    (run,) = recording.trajectories()
    X, V, _ = truth(START + run.start + recording.dt * np.arange(len(run)))
    assert np.isnan(run.X_WB[:, 4:6]).all()
    np.testing.assert_allclose(run.X_WB[:, 6], X[6], atol=_INTERPOLATION)
    np.testing.assert_allclose(run.V_WB_B.T, V, atol=_INTERPOLATION)
    np.testing.assert_allclose(run.sensors["pressure_depth"], -X[6], atol=_INTERPOLATION)
    assert set(run.sensors) >= {"imu_specific_force", "pressure_depth", "vertical_velocity"}
    assert "Velocity from /dvl" in str(report)


@pytest.mark.parametrize(
    ("name", "variable", "size"), [("forces", "thruster_force", 8), ("wrench", "F_Bo_B", 6)]
)
def test_other_commands_are_held(name, variable, size, tmp_path):
    """A command acts until the next message, on the recorder's clock: the mean over a step."""
    messages = Messages("mcap")
    t = times(7.0)
    given = 10 * np.sin(np.multiply.outer(1 + np.arange(size), t))
    rows = odometry(messages)
    for i, s in enumerate(t):
        if name == "forces":
            message, topic = messages.array("Float64", given[:, i]), "/thruster_forces"
        else:
            parts = {
                "force": messages.xyz("Vector3", given[:3, i]),
                "torque": messages.xyz("Vector3", given[3:, i]),
            }
            wrench = messages.make("geometry_msgs/msg/Wrench", **parts)
            topic = "/wrench_setpoint"
            message = messages.make(
                "geometry_msgs/msg/WrenchStamped", header=(ns(s), "base_link"), wrench=wrench
            )
        rows.append((ns(s), topic, message))
    recording, _ = imported(messages.write(tmp_path / "bag", rows))
    (run,) = recording.trajectories()
    grid = START + run.start + recording.dt * np.arange(len(run))
    expected = hold(grid, t, given, recording.dt).T
    np.testing.assert_allclose(run.commands[variable], expected, atol=1e-6)
    assert list(run.commands) == [variable]


def test_six_values_are_the_six_thruster_vehicle(tmp_path):
    messages = Messages("ros1")
    rows = odometry(messages) + commands(messages, of=lambda t: outputs(t)[:6])
    recording, _ = imported(messages.write(tmp_path / "bag", rows))
    assert recording.vehicle == "bluerov2"
    five = odometry(messages) + commands(messages, of=lambda t: outputs(t)[:5])
    with pytest.raises(UserError, match="drives 5 thrusters"):
        imported(messages.write(tmp_path / "five", five))


def test_channels_directions_scale_and_delay_of_the_map(tmp_path):
    messages = Messages("mcap")
    order = [3, 1, 2, 4, 8, 7, 6, 5]

    def normal(t):
        return (outputs(t)[np.argsort(order)] - 1500) / 400

    rows = odometry(messages) + [
        (ns(t + 0.1), "/motors", messages.array("Float64", normal(t))) for t in times(50.0, 0.002)
    ]
    path = messages.write(tmp_path / "bag", rows)
    with pytest.raises(UserError, match="what the thrusters did"):  # parts of full thrust, not N
        imported(path)
    signs = load_vehicle("bluerov2_heavy")
    mirrored = [1 if mount.motor > 0 else -1 for mount in signs.propulsion.mounts]
    made = tmp_path / "map.yaml"
    made.write_text(
        "topics:\n"
        "- {topic: /odom, gives: [attitude, position, velocity, rates]}\n"
        "- {topic: /motors, gives: [pwm], delay: 0.1, scale: 400, offset: 1500,\n"
        f"   channels: {order}, directions: {mirrored}}}\n"
    )
    recording, _ = imported(path, topics=made)
    (run,) = recording.trajectories()
    t = times(50.0, 0.002)
    grid = START + run.start + recording.dt * np.arange(len(run))
    expected = hold(grid, t, outputs(t), recording.dt).T
    np.testing.assert_allclose(run.commands["pwm"][2:-2], expected[2:-2], atol=1e-6)


def test_armed_and_mode_are_those_of_mavros(tmp_path):
    messages = Messages("ros1")
    rows = odometry(messages) + commands(messages)
    for t in times(4.0, 0.1):
        state = {"armed": START + 1 < t < START + 5, "mode": "ALT_HOLD"}
        message = messages.make("mavros_msgs/msg/State", header=(ns(t), ""), **state)
        rows.append((ns(t), "/mavros/state", message))
    recording, _ = imported(messages.write(tmp_path / "bag", rows), minimum=2.0)
    assert recording.scenarios == ("01_ALT_HOLD",)
    (run,) = recording.trajectories()
    assert run.start == pytest.approx(1.1, abs=0.26)
    assert len(run) * recording.dt == pytest.approx(3.75, abs=0.3)


def test_headers_on_a_clock_of_their_own(tmp_path):
    """An IMU that counts from its boot, and simulated time at half the recorder's pace."""
    messages = Messages("mcap")
    rows = [(ns(START + 2 * (r / 1e9 - ns(START) / 1e9)), *rest) for r, *rest in odometry(messages)]
    rows += [
        (ns(START + 2 * (t - START)), "/pwm", messages.array("UInt16", outputs(t)))
        for t in times(50.0)
    ]
    for t in times(100.0):
        _, V, _ = truth(t)
        message = messages.imu(round((t - 90) * 1e9), None, None, V[:3] + np.array([0, 0, 9.8]))
        rows.append((ns(START + 2 * (t - START)), "/imu", message))
    recording, report = imported(messages.write(tmp_path / "bag", rows))
    assert max(against_truth(recording)) < _INTERPOLATION
    (run,) = recording.trajectories()
    _, V, _ = truth(START + run.start + recording.dt * np.arange(len(run)))
    felt = run.sensors["imu_specific_force"] - [0, 0, 9.8]
    np.testing.assert_allclose(felt, V[:3].T, atol=2e-3)
    t = times(50.0)
    grid = START + run.start + recording.dt * np.arange(len(run))
    expected = hold(grid, t, outputs(t), recording.dt).T
    np.testing.assert_allclose(run.commands["pwm"][:-2], expected[:-2], atol=0.5)
    assert "a clock of their own" in str(report)


def test_older_files_without_definitions(tmp_path, cut_dive):
    messages = Messages("sqlite3")
    path = messages.write(tmp_path / "bag", as_mavros(messages, cut_dive)[::1])
    whole, _ = import_log(path)
    with sqlite3.connect(path / "bag.db3") as base:
        base.execute("delete from message_definitions")
    bare, _ = import_log(path / "bag.db3")
    assert bare.dataset.drop_attrs().identical(whole.dataset.drop_attrs())


# use and refusals


def test_every_command_reads_a_bag_and_its_folder(tmp_path):
    messages = Messages("sqlite3")
    path = messages.write(tmp_path / "bag", odometry(messages) + commands(messages))
    assert load_data(path).duration == load_data(path / "bag.db3").duration > 5
    assert [found for _, found in find_logs([tmp_path])] == [path / "bag.db3"]


def test_the_command_prints_a_map_and_takes_it(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    messages = Messages("ros1")
    messages.write(tmp_path / "dive", odometry(messages) + commands(messages))
    main(["import", "dive.bag", "--topics"])
    text = capsys.readouterr().out
    assert [one.topic for one in typed_yaml.loads(TopicMap, text).topics] == ["/odom", "/pwm"]
    assert not list(tmp_path.glob("*.nc"))
    (tmp_path / "map.yaml").write_text(text)
    main(["import", "dive.bag", "--topics", "map.yaml", "--out", "dive.nc"])
    assert load_data("dive.nc").duration > 5


def _sound(tmp_path, kind):
    messages = Messages(kind)
    path = messages.write(tmp_path / "bag", odometry(messages) + commands(messages))
    return path if path.is_file() else next(path.glob(f"*.{'db3' if kind == 'sqlite3' else kind}"))


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_that_is_cut_off(kind, tmp_path):
    path = _sound(tmp_path, kind)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(UserError, match=r"repair it with|damaged") as refused:
        import_log(path)
    assert str(path) in str(refused.value)


def _fails(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        main(["import", *map(str, arguments)])
    assert end.value.code == 2
    return " ".join(capsys.readouterr().err.split())


def test_refusals_name_the_remedy(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    messages = Messages("mcap")
    moved, driven = odometry(messages), commands(messages)
    bare = messages.write(tmp_path / "bare", driven)
    assert "no topic tells the attitude (/pwm std_msgs/msg/UInt16MultiArray ×300)" in _fails(
        capsys, bare
    )
    idle = messages.write(tmp_path / "idle", moved)
    assert "record mavros_msgs/RCOut" in _fails(capsys, idle)
    foreign = messages.write(
        tmp_path / "foreign",
        [
            (
                1,
                "/clock",
                messages.make(
                    "rosgraph_msgs/msg/Clock", clock=messages.make("builtin_interfaces/msg/Time")
                ),
            )
        ],
    )
    assert "no topic with messages of a type that is read" in _fails(capsys, foreign)
    base = sqlite3.connect(tmp_path / "own.db3")
    base.execute("create table a (b)")
    base.close()
    assert "not closed after recording" in _fails(capsys, tmp_path / "own.db3")
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "metadata.yaml").write_text("a: 1\n")
    assert "damaged" in _fails(capsys, empty)
    (idle / "metadata.yaml").unlink()
    assert "has no metadata.yaml, so the bag was not closed" in _fails(capsys, idle)
    tlog = tmp_path / "dive.tlog"
    tlog.write_bytes(dive(duration=1.0).bytes())
    assert "--topics is for ROS bags" in _fails(capsys, tlog, "--topics", "map.yaml")
    assert "no ROS bag" in _fails(capsys, tlog, "--topics")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("{topic: /odo, gives: [attitude]}", "/odo is no topic of"),
        ("{topic: /pwm, gives: [attitude]}", "gives no attitude; it may give pwm"),
        ("{topic: /odom, gives: [altitude]}", "altitude"),
        ("{topic: /odom, gives: [attitude], type: sensor_msgs/msg/Imu}", "not sensor_msgs/msg/Imu"),
        ("{topic: /odom, gives: [attitude], frame: NWU}", "NED/FRD"),
        ("{topic: /odom, gives: [attitude], delay: 100}", "at most 10"),
        ("{topic: /odom, gives: []}", "name what the topic tells"),
        ("{topic: /odom, gives: [position]}", "no topic tells the attitude"),
    ],
)
def test_a_wrong_map_is_refused(line, said, tmp_path, capsys):
    path = _sound(tmp_path, "mcap")
    (tmp_path / "map.yaml").write_text(f"topics:\n- {line}\n- {{topic: /pwm, gives: [pwm]}}\n")
    told = _fails(capsys, path, "--topics", tmp_path / "map.yaml")
    assert said in told
    assert "map.yaml" in told or "mcap" in told


def test_other_mcap_files_are_no_bags(tmp_path):
    from mcap.writer import Writer

    with (tmp_path / "plot.mcap").open("wb") as handle:
        writer = Writer(handle)
        writer.start()
        channel = writer.register_channel(
            "/a", "json", writer.register_schema("a", "jsonschema", b"{}")
        )
        writer.add_message(channel, 1, json.dumps({"x": 1}).encode(), 1)
        writer.finish()
    with pytest.raises(UserError, match="another encoding than ROS's"):
        import_log(tmp_path / "plot.mcap")


def test_the_extra_is_named_where_it_is_missing(tmp_path, monkeypatch):
    path = _sound(tmp_path, "ros1")
    for name in [name for name in sys.modules if name.partition(".")[0] == "rosbags"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(UserError, match=r"install spinndrift\[ros\]"):
        import_log(path)


def test_an_odometry_with_its_twist_in_the_world(tmp_path):
    messages = Messages("mcap")
    rows = commands(messages)
    for t in times(50.0):
        X, V, v_W = truth(t)
        w_W = rotations(X[:4, None]).apply(V[3:])[0]
        rows.append((ns(t), "/pose_gt", messages.odometry(ns(t), X[:4], X[4:], v_W, w_W, "world")))
    path = messages.write(tmp_path / "bag", rows)
    recording, report = imported(path)
    assert max(against_truth(recording)) < _INTERPOLATION
    assert "as the positions tell" in str(report)
    with open_bag(path) as bag:
        (tmp_path / "map.yaml").write_text(written(bag, propose(bag)))
    with pytest.raises(UserError, match="`expressed: world` in the topic map"):
        imported(path, topics=tmp_path / "map.yaml")


def test_axes_that_contradict_the_motion_are_refused(tmp_path):
    """FRD velocities under a name of FLU, and an accelerometer with z down."""
    messages = Messages("mcap")
    rows = commands(messages)
    upside = commands(messages)
    for t in times(50.0):
        X, V, _ = truth(t)
        F = frames.twist_frd_to_flu(V)
        rows.append((ns(t), "/odom", messages.odometry(ns(t), X[:4], X[4:], F[:3], F[3:])))
        a = rotations(X[:4, None]).inv().apply([0.0, 0.0, -9.81])[0]
        upside.append((ns(t), "/odom", messages.odometry(ns(t), X[:4], X[4:], V[:3], V[3:])))
        upside.append((ns(t), "/imu", messages.imu(ns(t), None, V[3:], a)))
    path = messages.write(tmp_path / "bag", rows)
    with pytest.raises(UserError, match=r"wrong-frame|in ENU/FRD, expressed in the body, they fit"):
        imported(path)
    accepted, _ = import_log(path, accept=["wrong-frame"])
    assert accepted.duration > 5
    with pytest.raises(UserError, match="does not point up"):
        imported(messages.write(tmp_path / "upside", upside))


@pytest.mark.parametrize("form", ["bz2", "lz4", "FILE", "MESSAGE", "STORAGE"])
def test_packed_bags(form, tmp_path):
    messages = Messages("ros1" if form.islower() else "mcap" if form == "STORAGE" else "sqlite3")
    rows = odometry(messages) + commands(messages)
    plain, _ = imported(messages.write(tmp_path / "plain", rows))
    packed, _ = imported(messages.write(tmp_path / "packed", rows, packed=form))
    assert packed.dataset.drop_attrs().identical(plain.dataset.drop_attrs())


def test_a_topic_of_each_thruster(tmp_path):
    """As Gazebo has them: numbered from 0, each with its own times."""
    messages = Messages("mcap")
    rows, given = odometry(messages), []
    for k in range(8):
        t = times(10.0 + k, 0.01 * k)
        given.append((t, 5.0 * np.sin(t + k)))
        for s, force in zip(*given[-1], strict=True):
            message = messages.make("std_msgs/msg/Float64", data=float(force))
            rows.append((ns(s), f"/bluerov2/thruster{k}/cmd_thrust", message))
    recording, _ = imported(messages.write(tmp_path / "bag", rows))
    (run,) = recording.trajectories()
    grid = START + run.start + recording.dt * np.arange(len(run))
    expected = np.stack([hold(grid, t, x, recording.dt) for t, x in given], axis=1)
    np.testing.assert_allclose(run.commands["thruster_force"][4:], expected[4:], atol=1e-6)


def test_a_plain_vehicle_without_a_horizontal_estimate(tmp_path):
    messages = Messages("ros1")
    rows = commands(messages)
    for t in times(50.0):
        X, V, _ = truth(t)
        height = messages.make("std_msgs/msg/Float64", data=float(X[6]))
        rows.append((ns(t), "/mavros/imu/data", messages.imu(ns(t), X[:4], V[3:])))
        rows.append((ns(t), "/mavros/global_position/rel_alt", height))
    recording, report = imported(messages.write(tmp_path / "bag", rows))
    (run,) = recording.trajectories()
    X, V, v_W = truth(START + run.start + recording.dt * np.arange(len(run)))
    assert recording.missing == {"X_WB": ("x", "y"), "V_WB_B": ("u", "v")}
    np.testing.assert_allclose(run.X_WB[:, 6], X[6], atol=_INTERPOLATION)
    climb = run.sensors["vertical_velocity"]
    np.testing.assert_allclose(climb, v_W[2], atol=0.05**2 / 6 * 8 + _INTERPOLATION)
    assert "Height and climb from /mavros/global_position/rel_alt" in str(report)
