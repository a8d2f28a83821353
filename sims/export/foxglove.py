"""Foxglove's well-known messages in JSON: their schemas, and functions that make them.

The names and fields are those that https://docs.foxglove.dev/docs/visualization/message-schemas
publishes; fields that a viewer takes as empty are left out of the schemas and messages.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

Message = dict[str, Any]
Rgba = tuple[float, float, float, float]
_NS = 1_000_000_000
_IDENTITY = np.array([1.0, 0, 0, 0, 0, 0, 0])


def _object(title: str = "", **properties: Any) -> Message:
    named = {"title": title} if title else {}
    return {"type": "object", **named, "properties": properties, "required": list(properties)}


def _list(of: Message) -> Message:
    return {"type": "array", "items": of}


def _numbers(title: str, names: Sequence[str]) -> Message:
    return _object(title, **dict.fromkeys(names, _NUMBER))


_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}
_WHOLE, _FLAG = {"type": "integer"}, {"type": "boolean"}
_TIME = _object("time", sec=_WHOLE, nsec=_WHOLE)
_DURATION = _object("duration", sec=_WHOLE, nsec=_WHOLE)
_VECTOR = _numbers("foxglove.Vector3", "xyz")
_POINT = _numbers("foxglove.Point3", "xyz")
_QUATERNION = _numbers("foxglove.Quaternion", "xyzw")
_COLOR = _numbers("foxglove.Color", "rgba")
_POSE = _object("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION)
_TRANSFORM = _object(
    "foxglove.FrameTransform",
    timestamp=_TIME,
    parent_frame_id=_TEXT,
    child_frame_id=_TEXT,
    translation=_VECTOR,
    rotation=_QUATERNION,
)
_CUBE = _object("foxglove.CubePrimitive", pose=_POSE, size=_VECTOR, color=_COLOR)
_SPHERE = _object("foxglove.SpherePrimitive", pose=_POSE, size=_VECTOR, color=_COLOR)
_CYLINDER = _object(
    "foxglove.CylinderPrimitive",
    pose=_POSE,
    size=_VECTOR,
    bottom_scale=_NUMBER,
    top_scale=_NUMBER,
    color=_COLOR,
)
_LINE = _object(
    "foxglove.LinePrimitive",
    type=_WHOLE,
    pose=_POSE,
    thickness=_NUMBER,
    scale_invariant=_FLAG,
    points=_list(_POINT),
    color=_COLOR,
    colors=_list(_COLOR),
    indices=_list(_WHOLE),
)
_ENTITY = _object(
    "foxglove.SceneEntity",
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_DURATION,
    frame_locked=_FLAG,
    metadata=_list(_object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)),
    arrows=_list({"type": "object", "title": "foxglove.ArrowPrimitive"}),
    cubes=_list(_CUBE),
    spheres=_list(_SPHERE),
    cylinders=_list(_CYLINDER),
    lines=_list(_LINE),
    triangles=_list({"type": "object", "title": "foxglove.TriangleListPrimitive"}),
    texts=_list({"type": "object", "title": "foxglove.TextPrimitive"}),
    models=_list({"type": "object", "title": "foxglove.ModelPrimitive"}),
)
_DELETION = _object("foxglove.SceneEntityDeletion", timestamp=_TIME, type=_WHOLE, id=_TEXT)

SCHEMAS: Mapping[str, Message] = {
    one["title"]: one
    for one in (
        _object("foxglove.FrameTransforms", transforms=_list(_TRANSFORM)),
        _object("foxglove.PoseInFrame", timestamp=_TIME, frame_id=_TEXT, pose=_POSE),
        _object("foxglove.PosesInFrame", timestamp=_TIME, frame_id=_TEXT, poses=_list(_POSE)),
        _object("foxglove.SceneUpdate", deletions=_list(_DELETION), entities=_list(_ENTITY)),
        _object(
            "foxglove.Log",
            timestamp=_TIME,
            level=_WHOLE,
            message=_TEXT,
            name=_TEXT,
            file=_TEXT,
            line=_WHOLE,
        ),
    )
}
"""JSON schemas by name."""
LEVELS = {"info": 2, "warning": 3, "error": 4}
LINE_STRIP, LINE_LIST = 0, 2


def plot_schema(title: str, names: Sequence[str]) -> Message:
    """The schema of a plot's message: named numbers, any of which may be missing."""
    schema = _numbers(title, names)
    return {**schema, "required": []}


def stamp(t: float) -> Message:
    """Time t (s) as a timestamp."""
    sec, nsec = divmod(nanoseconds(t), _NS)
    return {"sec": sec, "nsec": nsec}


def nanoseconds(t: float) -> int:
    """Time t (s) in whole ns."""
    return round(t * _NS)


def vector(v: Iterable[float], names: str = "xyz") -> Message:
    """Named components of a vector, point or colour."""
    return dict(zip(names, map(float, v), strict=True))


def quaternion(q: Iterable[float]) -> Message:
    """From w x y z."""
    w, x, y, z = map(float, q)
    return {"x": x, "y": y, "z": z, "w": w}


def pose(X: np.ndarray = _IDENTITY) -> Message:
    """foxglove.Pose of X_WB."""
    return {"position": vector(X[4:]), "orientation": quaternion(X[:4])}


def transforms(t: float, parent: str, poses: Mapping[str, np.ndarray]) -> Message:
    """foxglove.FrameTransforms of frames in their parent."""
    return {
        "transforms": [
            {
                "timestamp": stamp(t),
                "parent_frame_id": parent,
                "child_frame_id": name,
                "translation": vector(X[4:]),
                "rotation": quaternion(X[:4]),
            }
            for name, X in poses.items()
        ]
    }


def pose_in_frame(t: float, frame: str, X: np.ndarray) -> Message:
    """foxglove.PoseInFrame."""
    return {"timestamp": stamp(t), "frame_id": frame, "pose": pose(X)}


def poses_in_frame(t: float, frame: str, X: Iterable[np.ndarray]) -> Message:
    """foxglove.PosesInFrame: a path."""
    return {"timestamp": stamp(t), "frame_id": frame, "poses": [pose(one) for one in X]}


def log(t: float, text: str, level: str = "info") -> Message:
    """foxglove.Log."""
    head = {"timestamp": stamp(t), "level": LEVELS[level]}
    return {**head, "message": text, "name": "spinndrift", "file": "", "line": 0}


def entity(t: float, frame: str, name: str, **primitives: Sequence[Message]) -> Message:
    """foxglove.SceneEntity that stays until it is replaced, and moves with its frame."""
    kinds = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
    head = {"timestamp": stamp(t), "frame_id": frame, "id": name, "frame_locked": True}
    shapes = {kind: list(primitives.get(kind, ())) for kind in kinds}
    return {**head, "lifetime": {"sec": 0, "nsec": 0}, "metadata": [], **shapes}


def scene(entities: Sequence[Message]) -> Message:
    """foxglove.SceneUpdate."""
    return {"deletions": [], "entities": list(entities)}


def shape(
    size: Iterable[float], rgba: Rgba, p: Iterable[float] = (0.0, 0.0, 0.0), **more: float
) -> Message:
    """A cube, a sphere, or with `bottom_scale` and `top_scale` a cylinder."""
    at = pose(np.array([1.0, 0, 0, 0, *p]))
    return {"pose": at, "size": vector(size), "color": vector(rgba, "rgba"), **more}


def line(
    points: Iterable[np.ndarray],
    rgba: Rgba,
    width: float,
    kind: int = LINE_STRIP,
    colors: Sequence[Rgba] = (),
) -> Message:
    """foxglove.LinePrimitive; `width` in pixels, `colors` one of each point."""
    return {
        "type": kind,
        "pose": pose(),
        "thickness": width,
        "scale_invariant": True,
        "points": [vector(p) for p in points],
        "color": vector(rgba, "rgba"),
        "colors": [vector(c, "rgba") for c in colors],
        "indices": [],
    }


def plot(names: Sequence[str], values: Iterable[float]) -> Message:
    """Named numbers without those that are not finite, for which JSON has no word."""
    pairs = zip(names, map(float, values), strict=True)
    return {name: value for name, value in pairs if math.isfinite(value)}
