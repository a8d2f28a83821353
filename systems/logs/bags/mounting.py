"""Where the sensors of a bag are mounted: constant transforms of `tf` and `tf_static`.

A topic's numbers are in the axes of the sensor that its header names. The chain of constant
transforms from `base_link` to it gives R_BS and p_BoS_B (REP 105); joints that move end a chain.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from .bag import Bag, Column
from .foreign import NAVIGATION
from .messages import Quantity
from .topics import FARTHEST_M, Frames, Topic, TopicMap, frames_of, is_down, is_world

_TYPES = ("/TFMessage", "/tfMessage")
_READ, _SAME = 1000, 1e-4
"""Messages read of each publisher; m and rad by which a constant transform may differ."""
_BASE = "base_link"
_BODY = re.compile(
    r"(^|[_/])(base_link|base_footprint|base|body|fcu|vehicle|cog|com)(_(frd|ned|flu|enu))?$", re.I
)
"""Names of frames at Bo, with or without their own axes."""
_MOUNTED: set[Quantity] = {
    "attitude", "position", "velocity", "rates", "acceleration", "depth", "wrench",
}  # fmt: skip
_FRD = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
_FLIP = RigidTransform.from_rotation(_FRD)
_SMALL = 1e-6
_ARM_M = 0.05
"""Lever arm of an accelerometer from which on it is said that it stays."""


@dataclass(frozen=True)
class Mounts:
    """Constant transforms between frames.

    Attributes:
        near: X_AS of each frame S beside a frame A, both ways.
    """

    near: Mapping[str, Mapping[str, RigidTransform]] = field(default_factory=dict)

    @property
    def named(self) -> bool:
        """Whether a frame is called base_link."""
        return any(_is_base(one) for one in self.near)

    def find(self, sensor: str, body: str) -> RigidTransform | None:
        """X_BS; B is the nearest frame called base_link, or else `body`. None without a chain."""
        start = _bare(sensor)
        found, edge = {start: RigidTransform.identity()}, [start]
        while edge:
            here = edge.pop(0)
            if _is_base(here):
                return found[here]
            if not self.named and here == _bare(body):
                return _FLIP * found[here] if is_down(body) else found[here]
            for there, X in self.near.get(here, {}).items():
                if there not in found:
                    found[there] = X * found[here]  # X_(there)(here) X_(here)S
                    edge.append(there)
        return None


def _bare(frame: str) -> str:
    return frame.strip("/")


def _is_base(frame: str) -> bool:
    return frame.rsplit("/", 1)[-1] == _BASE


def is_tf(type_: str) -> bool:
    """Whether a topic's type is that of tf."""
    return type_.endswith(_TYPES)


def read_mounts(bag: Bag) -> Mounts:
    """The constant transforms of a bag; of a frame with several parents each counts."""
    topics = [topic for topic, kind in bag.topics.items() if is_tf(kind)]
    seen: dict[tuple[str, str], RigidTransform | None] = {}
    last: dict[tuple[str, str], tuple[float, ...]] = {}
    for message in bag.decoded(topics, _READ):
        for one in getattr(message, "transforms", ()):
            pair = (_bare(str(one.header.frame_id)), _bare(str(one.child_frame_id)))
            values = _numbers(one.transform)
            if last.get(pair) == values or (pair in seen and seen[pair] is None):
                continue
            last[pair], X = values, _transform(values)
            known = seen.setdefault(pair, X)
            if known is not None and (X is None or not _alike(known, X)):
                seen[pair] = None  # it moves
    near: dict[str, dict[str, RigidTransform]] = {}
    for (parent, child), X in seen.items():
        if X is not None and parent != child and not is_world(parent):
            near.setdefault(child, {})[parent] = X
            near.setdefault(parent, {})[child] = X.inv()
    return Mounts(near)


def _numbers(transform: Any) -> tuple[float, ...]:
    p, q = transform.translation, transform.rotation
    return tuple(map(float, (p.x, p.y, p.z, q.x, q.y, q.z, q.w)))


def _transform(values: tuple[float, ...]) -> RigidTransform | None:
    place, turn = np.array(values[:3]), np.array(values[3:])
    if not (np.isfinite(place).all() and abs(np.linalg.norm(turn) - 1) < 0.1):
        return None
    return RigidTransform.from_components(place, Rotation.from_quat(turn))


def _alike(one: RigidTransform, other: RigidTransform) -> bool:
    apart = one.inv() * other
    return bool(np.abs(apart.translation).max() < _SAME and apart.rotation.magnitude() < _SAME)


def mounted(
    used: TopicMap, columns: Mapping[str, Column], mounts: Mounts, proposed: bool = False
) -> tuple[TopicMap, list[str]]:
    """The map with `xyz` and `rpy` of tf where it gives neither, and sentences on them.

    In a `proposed` map a DVL that tf places has no axes by its package's convention.
    """
    place = used.of("position") or used.of("attitude")
    body = columns[place.topic].child if place and place.topic in columns else ""
    found = [_mounted(one, columns.get(one.topic), mounts, body, proposed) for one in used.topics]
    return TopicMap(tuple(one for one, _ in found)), [note for _, notes in found for note in notes]


def _mounted(
    one: Topic, column: Column | None, mounts: Mounts, body: str, proposed: bool
) -> tuple[Topic, list[str]]:
    frame = "" if column is None else sensor_frame(column)
    if not frame or one.xyz or one.rpy or not _MOUNTED & set(one.gives):
        return one, []
    if one.expressed == "world" and not {"attitude", "position", "acceleration"} & set(one.gives):
        return one, []
    if _is_base(_bare(frame)) or (_bare(frame) == _bare(body) != "" and not mounts.named):
        return one, []
    X = mounts.find(frame, body)
    if X is None or np.abs(X.translation).max() > FARTHEST_M:
        if _BODY.search(frame) or _bare(frame) == _bare(body):
            return one, []
        return one, [
            f"{one.topic}: no tf leads from {_BASE} to {frame}; its axes and place are taken as "
            "those of the body (`rpy` and `xyz` in a topic map)."
        ]
    if proposed:
        one = replace(one, frame=_named_frame(one, column))
    turn = X.rotation * _FRD if one.body_down else X.rotation
    rpy = turn.as_euler("xyz", suppress_warnings=True)
    still = turn.magnitude() < _SMALL
    if still and np.abs(X.translation).max() < _SMALL:
        return one, []
    xyz, rpy = _rounded(X.translation), (0.0, 0.0, 0.0) if still else _rounded(rpy)
    return replace(one, xyz=xyz, rpy=rpy), _told(one, frame, xyz, rpy)


def sensor_frame(column: Column) -> str:
    """The frame whose axes and origin a topic's numbers have; empty if it is a world or unknown."""
    if column.type.startswith("nav_msgs/msg/Odometry"):
        return column.child
    world = column.type.startswith(("geometry_msgs/msg/Pose", "geometry_msgs/msg/Point"))
    if world or column.type.endswith(NAVIGATION):
        return ""
    return "" if is_world(column.frame) else column.frame


def _named_frame(one: Topic, column: Column | None) -> Frames:
    """The topic's axes; of a DVL by the names alone: tf says how the instrument is turned."""
    if column is None or column.form.gives.keys() != {"velocity"}:
        return one.frame
    return frames_of("", column.frame, column.child)[0]


def _rounded(x: np.ndarray) -> tuple[float, float, float]:
    a, b, c = (round(float(value), 9) + 0.0 for value in x)
    return a, b, c


def _told(one: Topic, frame: str, xyz: Sequence[float], rpy: Sequence[float]) -> list[str]:
    said = [
        f"{one.topic}: {frame} is mounted at xyz {_words(xyz)} m, rpy {_words(rpy)} rad (tf), and "
        "its numbers were moved to the body."
    ]
    if "acceleration" in one.gives and np.linalg.norm(xyz) > _ARM_M:
        said.append(
            f"{one.topic}: its accelerations are turned, and stay those of its place: the lever "
            "arm is not corrected."
        )
    return said


def _words(x: Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in x) + ")"
