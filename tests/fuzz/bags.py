"""ROS bags of three kinds and their topic maps: numbers, names and definitions, and the bytes."""

import sqlite3
import warnings
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from bag_writers import EPOCH_NS, KINDS, Messages
from log_writers import outputs, truth
from scipy.spatial.transform import Rotation

from spinndrift.models.recordings.summary import summarize
from spinndrift.systems.logs.load import LogOptions, load_data

from .harness import Kind
from .mutate import FLOATS, WORDS, Rng, bytes_spoiled, part, pick, text_spoiled, yaml_spoiled

_ENDS = {"ros1": ".bag", "sqlite3": ".db3", "mcap": ".mcap"}
_MAP = """topics:
- {topic: /odom, gives: [attitude, position, velocity, rates], frame: ENU/FLU, delay: 0.0}
- {topic: /imu, type: sensor_msgs/msg/Imu, gives: [acceleration]}
- {topic: /pwm, gives: [pwm], scale: 1.0, channels: [1, 2, 3, 4, 5, 6, 7, 8]}
- {topic: /mavros/state, gives: [state]}
"""
_DVL = (
    "own_msgs/msg/DVL",
    """std_msgs/Header header
geometry_msgs/Vector3 velocity
float64[9] velocity_covariance
float64 altitude
bool velocity_valid
""",
)
_SENSORS = """topics:
- {topic: /imu, gives: [attitude, rates], rpy: [0.1, 0.2, 3.0], xyz: [0.1, 0, 0]}
- {topic: /dvl, gives: [velocity], frame: ENU/FRD, xyz: [0.3, 0, -0.1]}
- {topic: /depth, gives: [depth], scale: -1}
- {topic: /t1, gives: [forces], thruster: 1, scale: 0.01, squared: true}
"""
_SINGLE = """topics:
- {topic: /odom, gives: [attitude, position, velocity, rates]}
- {topic: /t1, gives: [forces], thruster: 1, delay: 0.1}
- {topic: /t2, gives: [forces], thruster: 8}
"""


def _rows(messages: Messages, rng: Rng | None) -> list[tuple[int, str, Any]]:
    """A second of a moving vehicle; with a generator some numbers are such as readers seldom meet.

    Definitions and sizes stay sound, so that the numbers reach what follows the reader.
    """
    rows: list[tuple[int, str, Any]] = []
    messages.define(*_DVL)
    for k, t in enumerate(100.0 + np.arange(0, 1.0, 0.05)):
        X, V, _ = (np.array(x) for x in truth(t))
        n, pwm = EPOCH_NS + round(t * 1e9), outputs(t)
        stamp = n
        if rng is not None and rng.random() < 0.2:
            with np.errstate(all="ignore"):
                pick(rng, (X, V, pwm))[part(rng, 6)] = pick(rng, FLOATS)
            stamp = int(pick(rng, (n, 0, n - 10**9, 10**9 * (2**31 - 1), n + k)))
        word = pick(rng, WORDS[:40]) if rng is not None and rng.random() < 0.1 else "MANUAL"
        state = {"armed": True, "mode": word.encode("utf-8", "replace").decode()}
        with np.errstate(invalid="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            array = messages.array("UInt16", pwm)
        rows += [
            (n, "/odom", messages.odometry(stamp, X[:4], X[4:], V[:3], V[3:])),
            (n, "/imu", messages.imu(n, X[:4], V[3:], V[:3] + np.array([0, 0, 9.81]))),
            (n, "/pwm", array),
            (n, "/t1", messages.make("std_msgs/msg/Float64", data=float(pwm[0]))),
            (n, "/t2", messages.make("std_msgs/msg/Float64", data=float(pwm[1]))),
            (n, "/mavros/state", messages.make("mavros_msgs/msg/State", header=(n, ""), **state)),
        ]
        if k % 4 == 0:
            rows += _sensors(messages, k, n, stamp, X, V)
    return rows


def _sensors(
    messages: Messages, k: int, n: int, stamp: int, X: np.ndarray, V: np.ndarray
) -> list[tuple[int, str, Any]]:
    """A DVL of another package with its mounting, which may move, and a depth."""
    dvl = {"velocity": messages.xyz("Vector3", V[:3]), "velocity_valid": k % 8 != 0}
    turn = Rotation.from_rotvec(0.1 * np.nan_to_num(V[3:], posinf=1.0, neginf=1.0) % 7.0)
    place = ("base_link", "dvl", X[4:], Rotation.identity() if k % 8 else turn)
    return [
        (n, "/dvl", messages.make(_DVL[0], header=(stamp, "dvl"), **dvl)),
        (n, "/tf", messages.transforms(place)),
        (n, "/depth", messages.make("std_msgs/msg/Float64", data=float(-X[6]))),
    ]


@cache
def _sound(kind: str) -> bytes:
    return _bytes(kind, None)


def _bytes(kind: str, rng: Rng | None) -> bytes:
    with TemporaryDirectory() as folder:
        messages = Messages(kind)
        path = messages.write(Path(folder) / "fuzz", _rows(messages, rng))
        return (path if path.is_file() else path / f"fuzz{_ENDS[kind]}").read_bytes()


def _spoil(rng: Rng, folder: Path) -> Path:
    kind = pick(rng, KINDS)
    path = folder / f"fuzz{_ENDS[kind]}"
    chance = rng.random()
    numbers = chance < 0.4
    path.write_bytes(_bytes(kind, rng) if numbers else _sound(kind))
    if not numbers and kind == "sqlite3" and rng.random() < 0.5:
        _spoil_base(rng, path)
    elif chance > 0.7:
        data = path.read_bytes()
        for _ in range(int(rng.integers(1, 4))):
            data = bytes_spoiled(rng, data)
        path.write_bytes(data)
    if rng.random() < 0.3:
        text = pick(rng, (_MAP, _SINGLE, _SENSORS))
        text = yaml_spoiled(rng, text) if rng.random() < 0.6 else text
        text = text_spoiled(rng, text) if rng.random() < 0.3 else text
        text = text.encode("utf-8", "replace").decode()
        (folder / "fuzz.topics.yaml").write_text(text, encoding="utf-8")
    return path


def _spoil_base(rng: Rng, path: Path) -> None:
    """Rows of the tables of a `sqlite3` bag."""
    value = pick(rng, ("", "cdr", "std_msgs/msg/Empty", -1, 2**62, None, 1.5, b"\0\xff", "a/b/c"))
    at = int(rng.integers(1, 5))
    columns = {
        "topics": ("id", "name", "type", "serialization_format", "offered_qos_profiles"),
        "messages": ("topic_id", "timestamp", "data"),
        "message_definitions": ("topic_type", "encoding", "encoded_message_definition"),
        "schema": ("schema_version",),
    }
    table = pick(rng, list(columns))
    column = pick(rng, columns[table])
    base = sqlite3.connect(path)
    try:
        if rng.random() < 0.15:
            base.execute(f"delete from {table}")
        else:
            base.execute(f"update {table} set {column} = ? where rowid % 4 = ?", (value, at % 4))
        base.commit()
    except sqlite3.Error:
        pass  # the base refuses it: a sound file is an input too
    finally:
        base.close()


def _read(path: Path) -> None:
    options = LogOptions(minimum=0.5, gap=0.5, water_density=1025.0)
    summarize(load_data(path, rate=20.0, options=options))


BAG = Kind("bag", _spoil, _read)
