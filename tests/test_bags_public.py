"""Bags as simulators, drivers and vehicles of many makers publish them."""

import gzip
import sqlite3
from types import SimpleNamespace

import numpy as np
import pytest
from bag_writers import EPOCH_NS, Messages
from log_writers import outputs, truth
from scipy.spatial.transform import Rotation

from spinndrift.models.config import typed_yaml
from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.resample import rotations
from spinndrift.systems.logs.bags.bag import open_bag
from spinndrift.systems.logs.bags.propose import propose, written
from spinndrift.systems.logs.bags.signals import read_bag
from spinndrift.systems.logs.bags.topics import TopicMap

START, DURATION, RATE = 100.0, 6.0, 40.0
_INTERPOLATION = (1 / RATE) ** 2 / 8 * 5
"""Of a linear interpolation between samples where the second derivative is below 5."""
_DIFFERENCES = 0.05**2 / 6 * 8 + _INTERPOLATION
"""h²/6 times the third derivative, of central differences over ±50 ms."""
T = START + np.arange(0, DURATION, 1 / RATE)
X, V, V_W = truth(T)
R_WB = rotations(X[:4])
IDENTITY = Rotation.identity()
NED = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))


def ns(t):
    return EPOCH_NS + round(t * 1e9)


def quaternions(R):
    return R.as_quat(scalar_first=True)


def row(i, topic, message):
    return ns(T[i]), topic, message


def each(topic, make):
    """Rows of one message at each instant; `make` takes its number and header time."""
    return [row(i, topic, make(i, ns(T[i]))) for i in range(T.size)]


def odometry(m, topic="/odom", frame="map", child="base_link", R=R_WB, p=X[4:], v=V[:3], w=V[3:]):
    q = quaternions(R)
    return each(topic, lambda i, t: m.odometry(t, q[i], p[:, i], v[:, i], w[:, i], frame, child))


def pwm(m, topic="/pwm"):
    """Commands at a fifth of the rate."""
    return each(topic, lambda i, t: m.array("UInt16", outputs(T[i])))[::5]


def number(m, value, topic, kind="std_msgs/msg/Float64"):
    return each(topic, lambda i, t: m.make(kind, data=float(value[i])))


def pressure(m, value, topic="/pressure", frame=""):
    kind = "sensor_msgs/msg/FluidPressure"
    return each(topic, lambda i, t: m.make(kind, header=(t, frame), fluid_pressure=float(value[i])))


def twist(m, v, topic, frame):
    """Linear velocities alone."""
    kind = "geometry_msgs/msg/TwistStamped"
    return each(
        topic, lambda i, t: m.make(kind, header=(t, frame), twist=m.twist(v[:, i], (0, 0, 0)))
    )


def imu(m, frame="base_link", q=None, w=None, a=None, topic="/imu"):
    at = [None if x is None else np.asarray(x).T for x in (q, w, a)]
    return each(
        topic, lambda i, t: m.imu(t, *[None if x is None else x[i] for x in at], frame=frame)
    )


def read(folder, m, rows, **given):
    return read_bag(m.write(folder / "bag", rows), **given)


def said(signals):
    return " ".join([*signals.notes, *map(str, signals.findings)])


def close(series, expected, atol=_INTERPOLATION):
    """A series is the truth at its times; `expected` are (k, n) at T."""
    wanted = np.stack([np.interp(series.t + START, T, x) for x in np.atleast_2d(expected)])
    inside = slice(5, -5)
    known = np.isfinite(series.x).all(axis=-1) if series.x.ndim > 1 else slice(None)
    assert np.any(known)
    found = np.atleast_2d(series.x)[known] if series.x.ndim > 1 else series.x[None]
    kept = wanted[known] if series.x.ndim > 1 and wanted.shape[0] > 1 else wanted
    np.testing.assert_allclose(found[:, inside], kept[:, inside], rtol=0, atol=atol)


def same_attitude(series):
    turn = (
        rotations(series.x)
        * Rotation.from_quat(
            quaternions(R_WB)[np.searchsorted(T - START, series.t - 1e-6)], scalar_first=True
        ).inv()
    )
    assert turn.magnitude().max() < 1e-6


def cross(w, p):
    return np.cross(w, p, axisa=0).T


# mountings


MOUNTS = SimpleNamespace(
    imu=Rotation.from_euler("xyz", [np.pi, 0.0, 0.4]),
    dvl=Rotation.from_euler("xyz", [0.1, -0.2, np.pi / 4]),
    place=np.array([0.3, -0.1, -0.25]),
    deck=np.array([0.1, 0.2, 0.05]),
)


def mounted_rows(m, imu_frame="imu_link"):
    """A vehicle with a rolled IMU, and a turned DVL and a barometer away from Bo."""
    R, place = MOUNTS, MOUNTS.place
    up = R_WB.inv().apply([0.0, 0.0, 9.81]).T
    v_S = V[:3] + cross(V[3:], place)
    z_S = X[6] + R_WB.apply(place)[:, 2]
    q = quaternions(R_WB * R.imu).T
    rows = imu(m, imu_frame, q, R.imu.inv().apply(V[3:].T).T, R.imu.inv().apply(up.T).T)
    rows += twist(m, R.dvl.inv().apply(v_S.T).T, "/dvl", "dvl_link")
    rows += pressure(m, 101325.0 - 9800.0 * z_S, frame="dvl_link")
    return rows + pwm(m)


def static(m):
    """The chain to the DVL has a link between; of the IMU the parent comes from another message."""
    deck_turn = Rotation.from_euler("z", 0.7)
    to_dvl = deck_turn.inv() * MOUNTS.dvl
    place = deck_turn.inv().apply(MOUNTS.place - MOUNTS.deck)
    deck = m.transforms(
        ("map", "base_link", (9.0, 9.0, 9.0), IDENTITY),
        ("base_link", "deck", MOUNTS.deck, deck_turn),
        ("deck", "dvl_link", place, to_dvl),
    )
    other = m.transforms(("base_link", "imu_link", (0.0, 0.0, 0.0), MOUNTS.imu))
    return [(ns(START), "/tf_static", deck), (ns(START), "/tf_static", other)]


def is_the_body(signals):
    same_attitude(signals.attitude)
    close(signals.rates, V[3:])
    close(signals.specific_force, R_WB.inv().apply([0.0, 0.0, 9.81]).T)
    close(signals.velocity, V_W)
    close(signals.pressure_depth, -X[6])


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_mountings_of_tf_are_those_of_the_sensors(kind, tmp_path):
    m = Messages(kind)
    signals = read(tmp_path, m, mounted_rows(m) + static(m))
    is_the_body(signals)
    assert "imu_link is mounted at xyz (0, 0, 0) m, rpy (3.14, 0, 0.4) rad (tf)" in said(signals)


def test_mountings_are_written_into_the_proposal_and_may_be_corrected(tmp_path):
    m = Messages("mcap")
    path = m.write(tmp_path / "bag", mounted_rows(m) + static(m))
    with open_bag(path) as bag:
        text = written(bag, propose(bag))
    assert typed_yaml.loads(TopicMap, text)
    assert "/tf_static: tf2_msgs/msg/TFMessage, 2 messages, the mountings" in text
    (tmp_path / "map.yaml").write_text(text)
    (bare := tmp_path / "bare").mkdir()
    without = m.write(bare / "bag", mounted_rows(m))
    is_the_body(read_bag(without, tmp_path / "map.yaml"))
    assert "no tf leads from base_link to imu_link" in said(read_bag(without))
    short = "topics:\n- {topic: /imu, gives: [attitude, rates]%s}\n- {topic: /pwm, gives: [pwm]}\n"
    (tmp_path / "short.yaml").write_text(short % "")
    same_attitude(read_bag(path, tmp_path / "short.yaml").attitude)
    (tmp_path / "none.yaml").write_text(short % ", rpy: [0, 0, 0]")
    bare_attitude = rotations(read_bag(path, tmp_path / "none.yaml").attitude.x)
    turned = (R_WB.inv() * bare_attitude).as_matrix()
    np.testing.assert_allclose(turned, np.tile(MOUNTS.imu.as_matrix(), (T.size, 1, 1)), atol=1e-6)


def test_a_joint_that_moves_mounts_nothing(tmp_path):
    m = Messages("mcap")
    rows = odometry(m) + pwm(m) + imu(m, "gimbal", None, V[3:], np.full((3, T.size), 5.7))
    rows += each(
        "/tf",
        lambda i, t: m.transforms(
            ("base_link", "gimbal", np.zeros(3), Rotation.from_euler("z", 0.01 * i))
        ),
    )
    assert "no tf leads from base_link to gimbal" in said(read(tmp_path, m, rows))


# DVLs


_BEAM = "float64 range"
_DVLS = {
    "uuv_sensor_ros_plugins_msgs/msg/DVL": "std_msgs/Header header\n"
    "geometry_msgs/Vector3 velocity\nfloat64[9] velocity_covariance\nfloat64 altitude\n"
    "uuv_sensor_ros_plugins_msgs/DVLBeam[] beams",
    "waterlinked_a50_ros_driver/msg/DVL": "std_msgs/Header header\nfloat64 time\n"
    "geometry_msgs/Vector3 velocity\nfloat64 fom\nfloat64 altitude\n"
    "waterlinked_a50_ros_driver/DVLBeam[] beams\nbool velocity_valid\nint64 status\nstring form",
    "marine_acoustic_msgs/msg/Dvl": "std_msgs/Header header\nuint8 velocity_mode\n"
    "geometry_msgs/Vector3 velocity\nfloat64[9] velocity_covar\nfloat64 altitude\n"
    "bool beam_velocities_valid",
    "nortek_dvl/msg/Dvl": "std_msgs/Header header\ngeometry_msgs/Vector3 velocity\n"
    "float32 figureOfMerit\nfloat32[4] beamDistance",
}


_NAVIGATION = {
    "cola2_msgs/msg/NED": "float64 north\nfloat64 east\nfloat64 depth",
    "cola2_msgs/msg/RPY": "float64 roll\nfloat64 pitch\nfloat64 yaw",
    "cola2_msgs/msg/NavSts": "std_msgs/Header header\ncola2_msgs/NED position\n"
    "geometry_msgs/Point body_velocity\ncola2_msgs/RPY orientation\n"
    "cola2_msgs/RPY orientation_rate",
}


def dvl_rows(m, kind, v, frame="dvl_link"):
    """Every seventh ping fails, in the manner of the maker."""
    package = kind.split("/")[0]
    m.define(f"{package}/msg/DVLBeam", _BEAM)
    m.define(kind, _DVLS[kind])

    def ping(i, t):
        lost = i % 7 == 3
        more = {}
        velocity = np.zeros(3) if lost else v[:, i]
        if package.startswith("uuv") and lost:
            more["velocity_covariance"] = np.full(9, -1.0)
        if package.startswith("water"):
            more["velocity_valid"] = not lost
        if package.startswith("marine"):
            more |= {"velocity_mode": 2 if lost and i % 2 else 1}
            more |= {"beam_velocities_valid": not lost or bool(i % 2)}
        if package.startswith("nortek") and lost:
            velocity = np.full(3, -32.768)
        fields = {"header": (t, frame), "velocity": m.xyz("Vector3", velocity)}
        return m.make(kind, **fields, **more)

    return each("/dvl/data", ping)


@pytest.mark.parametrize("kind", _DVLS)
def test_dvls_are_read_by_the_names_of_their_fields(kind, tmp_path):
    m = Messages("mcap")
    down = kind.startswith(("water", "marine"))
    v = FRD.apply(V[:3].T).T if down else V[:3]
    rows = dvl_rows(m, kind, v) + pwm(m) + imu(m, "base_link", X[:4], V[3:])
    signals = read(tmp_path, m, rows + pressure(m, 101325.0 - 9800.0 * X[6]))
    assert signals.velocity is not None
    assert signals.velocity.source == "/dvl/data"
    assert signals.velocity.left_out == len(range(3, T.size, 7))
    close(signals.velocity, V_W, 4 * _INTERPOLATION)


def test_the_climb_tells_that_an_instrument_has_z_down(tmp_path):
    m = Messages("mcap")
    v = FRD.apply(V[:3].T).T
    rows = twist(m, v, "/dvl/twist", "dvl") + pwm(m) + imu(m, "base_link", X[:4], V[3:])
    signals = read(tmp_path, m, rows + pressure(m, 101325.0 - 9800.0 * X[6]))
    close(signals.velocity, V_W)
    assert "/dvl/twist: its velocities are taken in ENU/FRD" in said(signals)


def test_a_goal_is_no_dvl_and_a_bare_vector_is_one_by_its_name(tmp_path):
    m = Messages("ros1")
    m.define(
        "own_msgs/msg/Goal",
        "std_msgs/Header header\ngeometry_msgs/Vector3 velocity\n"
        "geometry_msgs/Vector3 acceleration\nfloat64 altitude",
    )

    def goal(i, t):
        return m.make("own_msgs/msg/Goal", header=(t, ""))

    def bare(i, t):
        kind = "geometry_msgs/msg/Vector3Stamped"
        return m.make(kind, header=(t, "base_link"), vector=m.xyz("Vector3", V[:3, i]))

    rows = each("/track", goal) + each("/dvl_velocity", bare) + each("/imu/ang_vel", bare)
    signals = read(tmp_path, m, rows + pwm(m) + imu(m, "base_link", X[:4], V[3:]))
    close(signals.velocity, V_W)
    assert signals.velocity is not None
    assert signals.velocity.source == "/dvl_velocity"


def test_navigation_of_cola2_is_in_ned(tmp_path):
    m = Messages("ros1")
    for name, text in _NAVIGATION.items():
        m.define(name, text)
    roll, pitch, yaw = (NED * R_WB * FRD).as_euler("xyz").T
    p, v = NED.apply(X[4:].T), FRD.apply(V[:3].T)

    def status(i, t):
        place = dict(zip(("north", "east", "depth"), p[i], strict=True))
        turn = {"roll": roll[i], "pitch": pitch[i], "yaw": yaw[i]}
        return m.make(
            "cola2_msgs/msg/NavSts",
            header=(t, "world_ned"),
            position=m.make("cola2_msgs/msg/NED", **place),
            body_velocity=m.xyz("Point", v[i]),
            orientation=m.make("cola2_msgs/msg/RPY", **turn),
        )

    signals = read(tmp_path, m, each("/girona500/navigator/navigation", status) + pwm(m))
    same_attitude(signals.attitude)
    close(signals.position, X[4:])
    close(signals.velocity, V_W)
    close(signals.rates, V[3:], _DIFFERENCES)


# thrusters


_FLOAT = "uuv_gazebo_ros_plugins_msgs/msg/FloatStamped"


def uuv_rows(m, forces, without=()):
    """The topics of the UUV simulator: speeds of rotors, forces, and a wrench of each thruster."""
    m.define(_FLOAT, "std_msgs/Header header\nfloat64 data")
    rows = []
    for k, force in enumerate(forces):
        speed = np.sign(force) * np.sqrt(np.abs(force) / 0.005)
        names = ("input",) if k in without else ("input", "thrust")
        for name in names:
            value = speed if name == "input" else force
            rows += number(m, value, f"/rexrov/thrusters/{k}/{name}", _FLOAT)
    wrench = m.make("geometry_msgs/msg/Wrench", force=m.xyz("Vector3", (1.0, 0.0, 0.0)))
    kind = "geometry_msgs/msg/WrenchStamped"
    return rows + each(
        "/rexrov/thrusters/0/thrust_wrench",
        lambda i, t: m.make(kind, header=(t, ""), wrench=wrench),
    )


def forces_of(count):
    return [20.0 * np.sin(0.7 * T + k) for k in range(count)]


def test_thrusters_of_the_uuv_simulator(tmp_path):
    m = Messages("ros1")
    given = forces_of(6)
    signals = read(tmp_path, m, odometry(m, "/rexrov/pose_gt", "world") + uuv_rows(m, given))
    assert signals.command == "thruster_force"
    assert (signals.voltage, signals.pressure_depth) == (None, None)
    close(signals.outputs, given, 1e-9)


def test_a_thruster_without_messages_keeps_its_number(tmp_path):
    m = Messages("ros1")
    given = forces_of(6)
    rows = odometry(m, "/rexrov/pose_gt", "world") + uuv_rows(m, given, without=(0,))
    silent = ns(START), "/rexrov/thrusters/0/thrust", m.make(_FLOAT, header=(ns(START), ""))
    signals = read(tmp_path, m, [*rows, silent])
    expected = [np.zeros(T.size), *given[1:]]
    close(signals.outputs, expected, 1e-9)


def test_speeds_of_rotors_are_no_forces_but_by_a_map(tmp_path):
    m = Messages("ros1")
    given = forces_of(6)
    rows = odometry(m, "/rexrov/pose_gt", "world") + uuv_rows(m, given, without=range(6))
    with pytest.raises(UserError, match="speeds of rotors `scale` and `squared`"):
        read(tmp_path, m, rows)
    lines = [
        f"- {{topic: /rexrov/thrusters/{k}/input, gives: [forces], thruster: {k + 1}, "
        "scale: 0.005, squared: true}\n"
        for k in range(6)
    ]
    moved = "- {topic: /rexrov/pose_gt, gives: [attitude, position, velocity, rates]}\n"
    (tmp_path / "map.yaml").write_text("topics:\n" + moved + "".join(lines))
    signals = read_bag(tmp_path / "bag.bag", tmp_path / "map.yaml")
    close(signals.outputs, given, 1e-9)


@pytest.mark.parametrize("tail", ["/cmd", "/rpm"])
def test_unnamed_numbers_of_thrusters_are_taken_in_newton_and_said(tail, tmp_path):
    m = Messages("mcap")
    given = forces_of(6)
    rows = odometry(m)
    for k, force in enumerate(given, 1):
        rows += number(m, force, f"/rov/motor_{k}{tail}")
    if tail == "/rpm":
        with pytest.raises(UserError, match="what the thrusters did"):
            read(tmp_path, m, rows)
        return
    signals = read(tmp_path, m, rows)
    close(signals.outputs, given, 1e-9)
    assert "numbers are taken as forces of the thrusters in N" in said(signals)


# depths and heights


def plain(m):
    """Attitude and outputs alone."""
    return imu(m, "base_link", X[:4], V[3:]) + pwm(m)


@pytest.mark.parametrize(("topic", "value"), [("/depth", 5.0 - X[6]), ("/bar30/depth", X[6] - 5.0)])
def test_depths_as_numbers_of_either_sign(topic, value, tmp_path):
    m = Messages("mcap")
    signals = read(tmp_path, m, plain(m) + number(m, value, topic, "std_msgs/msg/Float32"))
    single = 8 * np.finfo(np.float32).eps
    close(signals.pressure_depth, 5.0 - X[6], _INTERPOLATION + single)
    close(signals.position, [X[6] - 5.0], _INTERPOLATION + single)
    assert ("taken as heights" in said(signals)) == (value[0] < 0)


def test_a_depth_with_a_type_of_its_own(tmp_path):
    m = Messages("ros1")
    kind = "mil_msgs/msg/DepthStamped"
    m.define(kind, "std_msgs/Header header\nfloat64 depth")
    rows = each("/depth", lambda i, t: m.make(kind, header=(t, ""), depth=float(-X[6, i])))
    close(read(tmp_path, m, plain(m) + rows).pressure_depth, -X[6])


def test_an_altitude_is_the_distance_to_the_bottom(tmp_path):
    m = Messages("mcap")
    signals = read(tmp_path, m, plain(m) + number(m, 3.0 - X[6], "/altimeter/altitude"))
    assert signals.position is None


@pytest.mark.parametrize("down", [False, True])
def test_a_pose_that_holds_a_depth_alone_is_a_height(down, tmp_path):
    """As estimators that take poses are given it: x, y and the attitude are nobody's."""
    m = Messages("mcap")
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    z = 5.0 - X[6] if down else X[6] - 5.0

    def pose(i, t):
        held = m.pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, z[i]))
        parts = m.make("geometry_msgs/msg/PoseWithCovariance", pose=held)
        return m.make(kind, header=(t, "map"), pose=parts)

    signals = read(tmp_path, m, plain(m) + each("/depth/pose", pose))
    same_attitude(signals.attitude)
    close(signals.position, [X[6] - 5.0])
    assert signals.position is not None
    assert np.isnan(signals.position.x[:2]).all()


@pytest.mark.parametrize(("unit", "name"), [(100.0, "hPa"), (1e3, "kPa")])
def test_pressures_in_other_units(unit, name, tmp_path):
    m = Messages("mcap")
    water = (101325.0 + 9800.0 * (5.0 - X[6])) / unit
    signals = read(tmp_path, m, plain(m) + pressure(m, water))
    close(signals.pressure_depth, 5.0 - X[6])
    assert f"taken as {name}" in said(signals)


def test_the_other_pressures_of_mavros_are_not_the_waters(tmp_path):
    """`diff_pressure` is published beside `static_pressure`, and is zero."""
    m = Messages("mcap")
    rows = plain(m) + pressure(m, np.zeros(T.size), "/mavros/imu/diff_pressure")
    rows += pressure(m, 101325.0 - 9800.0 * X[6], "/mavros/imu/static_pressure")
    signals = read(tmp_path, m, rows + number(m, X[6], "/mavros/global_position/rel_alt"))
    close(signals.pressure_depth, -X[6])


def test_pressures_above_that_of_the_air_begin_at_the_surface(tmp_path):
    m = Messages("ros1")
    below = 0.05 + X[6].max() - X[6]
    signals = read(tmp_path, m, plain(m) + pressure(m, 9800.0 * below))
    close(signals.pressure_depth, below)
    assert "taken as Pa above the air's" in said(signals)


def test_pressures_that_may_be_either_are_left_out_and_said(tmp_path):
    m = Messages("mcap")
    signals = read(tmp_path, m, plain(m) + pressure(m, 9800.0 * (1.0 - X[6])))
    assert signals.pressure_depth is None
    assert "not absolute ones in Pa" in said(signals)


def test_a_height_that_grows_with_the_depth_is_refused(tmp_path):
    m = Messages("mcap")
    deep = 101325.0 + 9800.0 * (20.0 + 3.0 * X[6])
    rows = odometry(m, p=3.0 * X[4:], v=3.0 * V[:3]) + pwm(m) + pressure(m, deep)
    assert "the height grows where the depth does" in said(read(tmp_path, m, rows))


# axes and fields that nobody fills


def test_a_body_in_ned_without_a_name_of_its_own_is_frd(tmp_path):
    m = Messages("ros1")
    turned = {"R": NED * R_WB * FRD, "p": NED.apply(X[4:].T).T}
    moved = {"v": FRD.apply(V[:3].T).T, "w": FRD.apply(V[3:].T).T}
    rows = odometry(m, "/girona/odometry", "world_ned", "girona/base_link", **turned, **moved)
    up = R_WB.inv().apply([0.0, 0.0, 9.81])
    rows += imu(m, "girona/imu", None, None, FRD.apply(up).T)
    signals = read(tmp_path, m, rows + pwm(m))
    same_attitude(signals.attitude)
    close(signals.rates, V[3:])
    close(signals.velocity, V_W)
    close(signals.position, X[4:])
    close(signals.specific_force, up.T)
    assert "is taken as FRD" in said(signals)
    path = tmp_path / "map.yaml"
    path.write_text(
        "topics:\n- {topic: /girona/odometry, gives: [attitude], frame: NED/FLU}\n"
        "- {topic: /pwm, gives: [pwm]}\n"
    )
    assert "upside down most of the time" in said(read_bag(tmp_path / "bag.bag", path))


def test_accelerations_in_g_are_left_out_and_said(tmp_path):
    m = Messages("mcap")
    up = R_WB.inv().apply([0.0, 0.0, 1.0]).T
    signals = read(tmp_path, m, imu(m, "base_link", X[:4], V[3:], up) + pwm(m))
    assert signals.specific_force is None
    assert "accelerations are of 1 m/s²" in said(signals)


@pytest.mark.parametrize(
    ("turned", "remedy"),
    [(FRD.apply(V[3:].T).T, "frame: ENU/FRD"), (np.rad2deg(V[3:]), "scale: 0.0174533")],
)
def test_rates_in_other_axes_or_degrees_are_refused(turned, remedy, tmp_path):
    m = Messages("mcap")
    gyro = imu(m, "imu", None, turned, np.full((3, T.size), 5.7))
    rows = odometry(m, w=np.zeros((3, T.size))) + gyro + pwm(m)
    assert remedy in said(read(tmp_path, m, rows))


def test_a_quaternion_that_nobody_fills_is_no_attitude(tmp_path):
    m = Messages("mcap")
    still = np.tile([[1.0], [0.0], [0.0], [0.0]], (1, T.size))
    blind = imu(m, "base_link", still, V[3:], topic="/a/imu")
    signals = read(tmp_path, m, blind + plain(m))
    assert signals.attitude.source == "/imu"
    (alone := tmp_path / "alone").mkdir()
    with pytest.raises(UserError, match="its quaternion never changes"):
        read(alone, m, blind + pwm(m))


def test_a_twist_that_nobody_fills_is_derived(tmp_path):
    m = Messages("mcap")
    zero = np.zeros((3, T.size))
    signals = read(tmp_path, m, odometry(m, v=zero, w=zero) + pwm(m))
    close(signals.velocity, V_W, _DIFFERENCES)
    close(signals.rates, V[3:], _DIFFERENCES)


def test_an_odometry_that_holds_a_twist_alone(tmp_path):
    """As of a DVL; its pose is the identity."""
    m = Messages("mcap")
    none = Rotation.identity(T.size), np.zeros((3, T.size))
    twist_alone = odometry(m, "/dvl/odometry", R=none[0], p=none[1], w=none[1])
    signals = read(tmp_path, m, plain(m) + twist_alone + number(m, -X[6], "/depth"))
    same_attitude(signals.attitude)
    close(signals.velocity, V_W)
    close(signals.position, [X[6]])
    assert "its position never changes" in said(signals)


def test_a_vehicle_that_rests_at_first_is_not_mistaken_for_an_empty_field(tmp_path):
    m = Messages("mcap")
    R, p = quaternions(R_WB), X[4:].copy()
    R[:205], p[:, :205] = R[205], p[:, [205]]
    rows = odometry(m, R=Rotation.from_quat(R, scalar_first=True), p=p) + pwm(m)
    noisy = X[:4] + 1e-4 * np.sin(9 * T)
    signals = read(tmp_path, m, rows + imu(m, "base_link", noisy, V[3:]))
    assert signals.attitude.source == "/odom"


def test_poses_of_markers_and_velocities_of_the_water_are_not_the_vehicles(tmp_path):
    m = Messages("mcap")

    def marker(i, t):
        pose = m.pose(X[:4, 0], (i, 0.1 * i, 1.0))
        return m.make("geometry_msgs/msg/PoseStamped", header=(t, "camera_link"), pose=pose)

    rows = plain(m) + each("/aruco/pose", marker)
    rows += twist(m, np.ones((3, T.size)), "/hydrodynamics/current_velocity", "world")
    signals = read(tmp_path, m, rows)
    assert signals.position is None
    assert signals.velocity is None


# bags


def test_of_several_vehicles_one_is_taken(tmp_path):
    """The second one has the faster topics."""
    m = Messages("mcap")
    rows = odometry(m, "/uuv1/odom", child="uuv1/base_link", p=X[4:] + 50.0)
    slow = odometry(m, "/uuv0/odom", child="uuv0/base_link")[::2]
    rows += slow + pwm(m, "/uuv1/pwm")
    rows += each("/uuv0/pwm", lambda i, t: m.array("UInt16", outputs(T[i]) - 5))
    signals = read(tmp_path, m, rows)
    close(signals.position, X[4:], 4 * _INTERPOLATION)
    close(signals.outputs, outputs(T) - 5, 1e-9)
    assert "several vehicles, and this is uuv0" in said(signals)


def test_stamps_that_were_not_set(tmp_path):
    """The first ones, as before a driver has a clock."""
    m = Messages("ros1")
    rows = odometry(m)
    latency = 3_000_000
    for i in range(4):
        rows[i][2].header.stamp.sec = rows[i][2].header.stamp.nanosec = 0
    rows = [(t + latency, topic, message) for t, topic, message in rows]
    signals = read(tmp_path, m, rows + pwm(m))
    assert signals.attitude.t[-1] == pytest.approx(T[-1] - START, abs=1e-6)
    close(signals.position, X[4:])


def test_a_dvl_without_its_definition_is_said(tmp_path):
    m = Messages("sqlite3")
    kind = "uuv_sensor_ros_plugins_msgs/msg/DVL"
    path = m.write(tmp_path / "bag", dvl_rows(m, kind, V[:3]) + plain(m))
    with sqlite3.connect(path / "bag.db3") as base:
        base.execute("delete from message_definitions")
    signals = read_bag(path)
    assert signals.velocity is None
    assert f"No definition of /dvl/data {kind} is in the bag, so it is not read" in said(signals)


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_a_bag_without_messages(kind, tmp_path):
    m = Messages(kind)
    with pytest.raises(UserError, match="no topic with messages of a type that is read"):
        read(tmp_path, m, [])


def test_a_packed_file_is_named_as_such(tmp_path):
    (packed := tmp_path / "dive.bag.gz").write_bytes(gzip.compress(b"#ROSBAG V2.0\n"))
    with pytest.raises(UserError, match="a packed bag; unpack it"):
        read_bag(packed)
