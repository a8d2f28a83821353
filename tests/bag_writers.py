"""ROS bags: the messages of a telemetry log as mavros publishes them, and bags of any messages."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from spinndrift.models.recordings.resample import rotations, slerp
from spinndrift.systems.logs.bags.mavros import DEFINITIONS
from spinndrift.systems.logs.signals_tlog import WANTED
from spinndrift.systems.logs.tlog import read_tlog
from spinndrift.systems.mavlink import codec

EPOCH_NS = 1_700_000_000_000_000_000
KINDS = ("ros1", "sqlite3", "mcap")
_LATENCY_NS = 3_000_000
_UNKNOWN = (-1.0, *[0.0] * 8)


class Messages:
    """Builds messages of one ROS version and writes bags of them."""

    def __init__(self, kind: str):
        self.kind = kind
        one = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
        for name, text in DEFINITIONS.items():
            if not one or "rcl_interfaces" not in text:
                self.store.register(get_types_from_msg(text, name))

    def define(self, type_: str, text: str) -> None:
        """Add a message of another package; a nested one is named by its own `define`."""
        self.store.register(get_types_from_msg(text, type_))

    def make(self, type_: str, **fields: Any) -> Any:
        """A message; fields that are not given are zero or empty, `header` is (ns, frame)."""
        if "header" in fields:
            stamp, frame = fields["header"]
            time = self.make(
                "builtin_interfaces/msg/Time", sec=int(stamp // 10**9), nanosec=int(stamp % 10**9)
            )
            fields["header"] = self.make("std_msgs/msg/Header", stamp=time, frame_id=frame)
        values = {name: self._zero(desc) for name, desc in self.store.fielddefs[type_][1]}
        unknown = set(fields) - set(values)
        assert not unknown, unknown
        return self.store.types[type_](**(values | fields))

    def _zero(self, description: Any) -> Any:
        node, inner = description
        match int(node):
            case 1:
                name = inner[0]
                return {"string": "", "bool": False}.get(name, 0.0 if "float" in name else 0)
            case 2:
                return self.make(inner)
            case 3:
                (_, (name, _)), size = inner
                return np.zeros(size, name)
            case _:
                (code, element), _ = inner
                return np.zeros(0, element[0]) if int(code) == 1 and element[0] != "string" else []

    def xyz(self, kind: str, v: Iterable[float]) -> Any:
        """A point or vector of geometry_msgs."""
        x, y, z = (float(c) for c in v)
        return self.make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def quaternion(self, q: Iterable[float]) -> Any:
        """A quaternion from w x y z."""
        w, x, y, z = (float(c) for c in q)
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def pose(self, q: Iterable[float], p: Iterable[float]) -> Any:
        """A pose."""
        return self.make(
            "geometry_msgs/msg/Pose", position=self.xyz("Point", p), orientation=self.quaternion(q)
        )

    def twist(self, v: Iterable[float], w: Iterable[float]) -> Any:
        """A twist."""
        return self.make(
            "geometry_msgs/msg/Twist", linear=self.xyz("Vector3", v), angular=self.xyz("Vector3", w)
        )

    def odometry(
        self, t: int, q: Any, p: Any, v: Any, w: Any, frame: str = "map", child: str = "base_link"
    ) -> Any:
        """nav_msgs/Odometry."""
        pose = self.make("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(q, p))
        twist = self.make("geometry_msgs/msg/TwistWithCovariance", twist=self.twist(v, w))
        return self.make(
            "nav_msgs/msg/Odometry",
            header=(t, frame),
            child_frame_id=child,
            pose=pose,
            twist=twist,
        )

    def imu(self, t: int, q: Any = None, w: Any = None, a: Any = None, frame: str = "base_link"):
        """sensor_msgs/Imu; what is None is marked as not measured."""
        parts = {
            "orientation": None if q is None else self.quaternion(q),
            "angular_velocity": None if w is None else self.xyz("Vector3", w),
            "linear_acceleration": None if a is None else self.xyz("Vector3", a),
        }
        absent = {f"{k}_covariance": np.array(_UNKNOWN) for k, v in parts.items() if v is None}
        there = {k: v for k, v in parts.items() if v is not None}
        return self.make("sensor_msgs/msg/Imu", header=(t, frame), **there, **absent)

    def array(self, bits: str, values: Any) -> Any:
        """A std_msgs multi-array of Float32, UInt16, …"""
        name = bits.lower()
        return self.make(f"std_msgs/msg/{bits}MultiArray", data=np.ascontiguousarray(values, name))

    def transforms(self, *known: tuple[str, str, Any, Any]) -> Any:
        """A message of tf: (parent, child, p of the child in the parent, R of it) each."""
        if "tf2_msgs/msg/TFMessage" not in self.store.fielddefs:
            self.define("tf2_msgs/msg/TFMessage", "geometry_msgs/TransformStamped[] transforms")
        found = []
        for parent, child, p, R in known:
            x, y, z, w = R.as_quat()
            transform = self.make(
                "geometry_msgs/msg/Transform",
                translation=self.xyz("Vector3", p),
                rotation=self.quaternion((w, x, y, z)),
            )
            found.append(
                self.make(
                    "geometry_msgs/msg/TransformStamped",
                    header=(EPOCH_NS, parent),
                    child_frame_id=child,
                    transform=transform,
                )
            )
        return self.make("tf2_msgs/msg/TFMessage", transforms=found)

    def write(self, path: Path, rows: Iterable[tuple[int, str, Any]], packed: str = "") -> Path:
        """Write (received in ns, topic, message) as a bag; returns what an import reads.

        `packed` is a compression of ROS 1, or what ROS 2 compresses.
        """
        rows = sorted(rows, key=lambda row: row[0])
        if self.kind == "ros1":
            writer: Any = rosbag1.Writer(path.with_suffix(".bag"))
            into, code = path.with_suffix(".bag"), self.store.serialize_ros1
            if packed:
                writer.set_compression(rosbag1.Writer.CompressionFormat[packed.upper()])
        else:
            storage = rosbag2.StoragePlugin[self.kind.upper()]
            writer = rosbag2.Writer(path, version=9, storage_plugin=storage)
            into, code = path, self.store.serialize_cdr
            if packed:
                mode = rosbag2.CompressionMode[packed]
                writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
        connections: dict[str, Any] = {}
        with writer:
            for received, topic, message in rows:
                type_ = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, type_, typestore=self.store)
                writer.write(connections[topic], received, code(message, type_))
        return into


def as_mavros(messages: Messages, data: bytes) -> list[tuple[int, str, Any]]:
    """The messages of a telemetry log as the topics that mavros makes of them."""
    log = read_tlog(data, WANTED)
    rows: list[tuple[int, str, Any]] = []
    make, tables = messages.make, log.tables

    def ns(t: float) -> int:
        return EPOCH_NS + round(t * 1e9)

    def add(t: float, topic: str, message: Any) -> None:
        rows.append((ns(t) + _LATENCY_NS, f"/mavros/{topic}", message))

    e = tables["ATTITUDE_QUATERNION"]
    q = codec.attitude(e["q1"], e["q2"], e["q3"], e["q4"])
    w = codec.body_vector(e["rollspeed"], e["pitchspeed"], e["yawspeed"])
    for i, t in enumerate(e["t"]):
        add(t, "imu/data", messages.imu(ns(t), q[:, i], w[:, i]))
    raw = tables["RAW_IMU"]
    gyro = codec.imu_angular_rate(raw["xgyro"], raw["ygyro"], raw["zgyro"])
    force = codec.imu_specific_force(raw["xacc"], raw["yacc"], raw["zacc"])
    for i, t in enumerate(raw["t"]):
        add(t, "imu/data_raw", messages.imu(ns(t), None, gyro[:, i], force[:, i]))
    local = tables["LOCAL_POSITION_NED"]
    p = codec.world_vector(local["x"], local["y"], local["z"])
    v = codec.world_vector(local["vx"], local["vy"], local["vz"])
    turned = slerp(local["t"], e["t"], q)
    v_B = rotations(turned).inv().apply(v.T).T
    for i, t in enumerate(local["t"]):
        message = messages.odometry(ns(t), turned[:, i], p[:, i], v_B[:, i], np.zeros(3))
        add(t, "local_position/odom", message)
    servo = tables["SERVO_OUTPUT_RAW"]
    pulses = np.stack([servo[f"servo{n}_raw"] for n in range(1, 9)]).astype(np.uint16)
    for i, t in enumerate(servo["t"]):
        if servo["port"][i] == 0:
            message = make(
                "mavros_msgs/msg/RCOut",
                header=(ns(t), ""),
                channels=np.ascontiguousarray(pulses[:, i]),
            )
            add(t, "rc/out", message)
    sticks = tables["RC_CHANNELS"]
    pulses = np.stack([sticks[f"chan{n}_raw"] for n in range(1, 9)]).astype(np.uint16)
    for i, t in enumerate(sticks["t"]):
        add(
            t,
            "rc/in",
            make(
                "mavros_msgs/msg/RCIn",
                header=(ns(t), ""),
                channels=np.ascontiguousarray(pulses[:, i]),
            ),
        )
    beats = tables["HEARTBEAT"]
    for t, base, mode in zip(beats["t"], beats["base_mode"], beats["custom_mode"], strict=True):
        state = {"armed": bool(base & codec.ARMED_FLAG), "mode": codec.mode_name(int(mode))}
        add(t, "state", make("mavros_msgs/msg/State", header=(ns(t), ""), **state))
    _slow(messages, tables, add, ns)
    return rows


def _slow(messages: Messages, tables: Any, add: Any, ns: Any) -> None:
    make = messages.make
    water = tables["SCALED_PRESSURE2"]
    for t, hPa in zip(water["t"], water["press_abs"], strict=True):
        pascal = {"fluid_pressure": 100.0 * float(hPa)}
        add(t, "water", make("sensor_msgs/msg/FluidPressure", header=(ns(t), ""), **pascal))
    battery = tables["BATTERY_STATUS"]
    volts = codec.pack_voltage(battery["voltages"].T.astype(float))
    for t, volt in zip(battery["t"], volts, strict=True):
        message = make("sensor_msgs/msg/BatteryState", header=(ns(t), ""), voltage=float(volt))
        add(t, "battery", message)
    status = tables["EKF_STATUS_REPORT"]
    for t, flags in zip(status["t"], status["flags"].astype(int), strict=True):
        said = {
            "velocity_horiz_status_flag": bool(flags & 2),
            "pos_horiz_rel_status_flag": bool(flags & 8),
            "pos_horiz_abs_status_flag": bool(flags & 16),
            "const_pos_mode_status_flag": bool(flags & 128),
        }
        message = make("mavros_msgs/msg/EstimatorStatus", header=(ns(t), ""), **said)
        add(t, "estimator_status", message)
    told = tables["PARAM_VALUE"]
    for t, name, value in zip(told["t"], told["param_id"], told["param_value"], strict=True):
        name = bytes(name).rstrip(b"\0").decode()
        head = {"header": (ns(t), ""), "param_id": name}
        if messages.kind == "ros1":
            kept = make("mavros_msgs/msg/ParamValue", real=float(value))
            add(t, "param/param_value", make("mavros_msgs/msg/Param", **head, value=kept))
        else:
            kept = make("rcl_interfaces/msg/ParameterValue", type=3, double_value=float(value))
            add(t, "param/event", make("mavros_msgs/msg/ParamEvent", **head, value=kept))
