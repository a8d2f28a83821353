"""A run as an animated 3-D scene in one self-contained HTML file."""

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    Meshcat,
    MeshcatParams,
    Rgba,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix

from ...models.files.atomic import atomic_path
from ...models.vehicles.vehicle import Vehicle
from ...systems.drake import drake_array
from ..run.log import Plans, RunLog
from .figures_path import Scene

FRAMES = 20  # per second
_PIECE = 0.5  # s of path that appear at once
_PLANS = 120  # shown at most
_PATHS, _STEPS = 20, 10  # of the sampled ones

_WATER, _BED = Rgba(0.30, 0.62, 0.78, 0.22), Rgba(0.78, 0.72, 0.58, 1.0)
_PYLON, _GOAL = Rgba(0.45, 0.42, 0.38, 1.0), Rgba(0.18, 0.62, 0.38, 0.30)
_FLOWN, _PLANNED = Rgba(0.98, 0.83, 0.25, 1.0), Rgba(0.95, 0.42, 0.10, 1.0)
_SAMPLED = Rgba(0.72, 0.82, 0.86, 0.4)
_FRAME, _FLOAT = Rgba(0.13, 0.14, 0.16, 1.0), Rgba(0.10, 0.42, 0.75, 1.0)
_TUBE, _RING = Rgba(0.80, 0.82, 0.85, 1.0), Rgba(0.07, 0.07, 0.08, 1.0)


def write_replay(path: str | os.PathLike[str], log: RunLog, scene: Scene, vehicle: Vehicle) -> Path:
    """Write the replay of a run as one HTML file (about 3 MB), atomically.

    It shows water, bed, pylons, goal, the vehicle with its thrusters, the path so far, and at every
    time the plan and the sampled paths it was chosen from.
    """
    with _quiet():
        meshcat = Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))
    _surroundings(meshcat, log, scene)
    _vehicle(meshcat, vehicle)
    meshcat.StartRecording(frames_per_second=FRAMES, set_visualizations_while_recording=False)
    _motion(meshcat, log)
    _flown(meshcat, log)
    if log.plans is not None:
        _planned(meshcat, log.plans, float(log.time[-1]))
    meshcat.StopRecording()
    meshcat.PublishRecording()
    with atomic_path(path) as partial:
        partial.write_text(meshcat.StaticHtml(), encoding="utf-8")
    return Path(path)


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Drake's message about its local server, which is not used."""
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)


def _pose(p: Float[np.ndarray, "3"], R: RotationMatrix | None = None) -> RigidTransform:
    return RigidTransform(R or RotationMatrix(), np.asarray(p, float))  # pyright: ignore


def _add(
    meshcat: Meshcat, path: str, shape: Shape, rgba: Rgba, p: Float[np.ndarray, "3"] | None = None
) -> None:
    meshcat.SetObject(path, shape, rgba)
    if p is not None:
        meshcat.SetTransform(path, _pose(p))


def _surroundings(meshcat: Meshcat, log: RunLog, scene: Scene) -> None:
    """Water, bed, pylons, goal, camera."""
    for path in ("/Grid", "/Axes"):
        meshcat.SetProperty(path, "visible", False)
    meshcat.SetProperty("/Background", "top_color", [0.80, 0.90, 0.95])
    meshcat.SetProperty("/Background", "bottom_color", [0.16, 0.36, 0.46])
    p = _poses(log)[:, 4:]
    points = p if scene.goal is None else np.concatenate([p, [scene.goal]])
    low, high = points.min(axis=0), points.max(axis=0)
    middle = (low + high) / 2
    span = max(6.0, 1.4 * float(np.linalg.norm((high - low)[:2])))
    depth = scene.water_depth if scene.water_depth else 2 - float(low[2])
    side = span + 8
    _add(meshcat, "water", Box(side, side, 0.01), _WATER, np.array([*middle[:2], 0.0]))
    _add(meshcat, "bed", Box(side, side, 0.1), _BED, np.array([*middle[:2], -depth - 0.05]))
    for i, pylon in enumerate(scene.obstacles):
        bottom = max(pylon.bottom, -depth)
        length = max(pylon.top - bottom, 0.01)
        centre = np.array([pylon.x, pylon.y, bottom + length / 2])
        _add(meshcat, f"pylons/{i}", Cylinder(pylon.diameter / 2, length), _PYLON, centre)
    if scene.goal is not None:
        _add(meshcat, "goal", Sphere(scene.goal_radius), _GOAL, np.array(scene.goal))
    # camera behind and left of the direction of travel, above the surface
    way = (points[-1] - p[0])[:2]
    norm = float(np.linalg.norm(way))
    ahead = way / norm if norm > 0.5 else np.array([1.0, 0.0])
    left = np.array([-ahead[1], ahead[0]])
    eye = middle[:2] - 0.42 * span * ahead + 0.36 * span * left
    meshcat.SetCameraPose(drake_array([*eye, middle[2] + 0.6 * span]), middle)


def _vehicle(meshcat: Meshcat, vehicle: Vehicle) -> None:
    """Two floats on a dark frame, a tube for electronics, and a ring for each thruster."""
    L, W, H = vehicle.size
    parts: tuple[tuple[str, Shape, Rgba, tuple[float, float, float]], ...] = (
        ("left_side", Box(L, 0.02, 0.75 * H), _FRAME, (0, 0.33 * W, -0.1 * H)),
        ("right_side", Box(L, 0.02, 0.75 * H), _FRAME, (0, -0.33 * W, -0.1 * H)),
        ("keel", Box(0.9 * L, 0.66 * W, 0.02), _FRAME, (0, 0, -0.42 * H)),
        ("left_float", Box(0.94 * L, 0.24 * W, 0.24 * H), _FLOAT, (0, 0.19 * W, 0.36 * H)),
        ("right_float", Box(0.94 * L, 0.24 * W, 0.24 * H), _FLOAT, (0, -0.19 * W, 0.36 * H)),
    )
    for name, shape, rgba, p in parts:
        _add(meshcat, f"vehicle/{name}", shape, rgba, np.array(p))
    along = RotationMatrix.MakeYRotation(np.pi / 2)
    meshcat.SetObject("vehicle/tube", Capsule(0.2 * W / 2, 0.62 * L), _TUBE)
    meshcat.SetTransform("vehicle/tube", _pose(np.array([0.02, 0, 0]), along))
    for i, mount in enumerate(vehicle.propulsion.mounts):
        axis = np.array(mount.direction) / np.linalg.norm(mount.direction)
        R = RotationMatrix.MakeFromOneVector(drake_array(axis), 2)
        X = _pose(np.array(mount.position), R)
        meshcat.SetObject(f"vehicle/thruster_{i + 1}", Cylinder(0.048, 0.05), _RING)
        meshcat.SetTransform(f"vehicle/thruster_{i + 1}", X)


def _poses(log: RunLog) -> np.ndarray:
    """X_WB; a vehicle whose place is not known is shown at x = y = 0."""
    return np.nan_to_num(log["X_WB"])


def _motion(meshcat: Meshcat, log: RunLog) -> None:
    every = max(1, round(1 / (FRAMES * log.dt)))
    for t, X in zip(log.time[::every], _poses(log)[::every], strict=True):
        R = RotationMatrix(Quaternion(X[:4] / np.linalg.norm(X[:4])))
        meshcat.SetTransform("vehicle", _pose(X[4:], R), float(t))


def _flown(meshcat: Meshcat, log: RunLog) -> None:
    """The path, piece by piece over time."""
    p = _poses(log)[:, 4:]
    size = max(1, round(_PIECE / log.dt))
    for k in range(0, max(len(p) - 1, 0), size):
        path = f"flown/{k:05d}"
        _tube(meshcat, path, p[k : k + size + 1 : max(1, size // 4)], 0.014, _FLOWN)
        _visible(meshcat, path, float(log.time[min(k + size, len(p) - 1)]), None)


def _planned(meshcat: Meshcat, plans: Plans, end: float) -> None:
    """For every plan the planned and the sampled paths, until the next one."""
    every = -(-plans.time.size // _PLANS)
    shown = range(0, plans.time.size, every)
    ends = [*(float(plans.time[k]) for k in shown[1:]), end + 1]
    for k, until in zip(shown, ends, strict=True):
        start = float(plans.time[k])
        _tube(meshcat, f"plan/{k:05d}", plans.X_WB[k][:, 4:], 0.03, _PLANNED)
        _visible(meshcat, f"plan/{k:05d}", start, until)
        if plans.p_WB is None:
            continue
        first, last = _segments(plans.p_WB[k], plans.X_WB[k][0, 4:])
        first, last = drake_array(first), drake_array(last)
        meshcat.SetLineSegments(f"samples/{k:05d}", first, last, 1.0, _SAMPLED)
        _visible(meshcat, f"samples/{k:05d}", start, until)


def _tube(meshcat: Meshcat, path: str, p: np.ndarray, radius: float, rgba: Rgba) -> None:
    """A polyline (n, 3) as a square tube, since browsers draw lines one pixel wide."""
    if len(p) < 2:
        p = np.repeat(p, 2, axis=0) + np.array([[0.0, 0, 0], [1e-4, 0, 0]])
    along = np.gradient(p, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    side = np.cross(along, [0.0, 0.0, 1.0])
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    up = np.cross(side, along)
    corners = [p + radius * (a * side + b * up) for a, b in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    vertices = np.stack(corners, axis=1).reshape(-1, 3)
    k = 4 * np.arange(len(p) - 1)[:, None]
    i, j = np.arange(4)[None], (np.arange(4)[None] + 1) % 4
    faces = [np.stack([k + i, k + j, k + 4 + i]), np.stack([k + j, k + 4 + j, k + 4 + i])]
    triangles = np.concatenate([face.reshape(3, -1) for face in faces], axis=1)
    faces = drake_array(triangles.astype(np.int32))
    meshcat.SetTriangleMesh(path, drake_array(vertices.T), faces, rgba)


def _segments(p: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the segments of decimated sampled paths (steps, 3, paths): two arrays (3, n)."""
    p = p[:, :, :: max(1, p.shape[2] // _PATHS)]
    step = max(1, p.shape[0] // _STEPS)
    origin = np.broadcast_to(start[None, :, None], (1, 3, p.shape[2]))
    p = np.concatenate([origin, p[step - 1 :: step]])
    flat = [part.transpose(1, 0, 2).reshape(3, -1) for part in (p[:-1], p[1:])]
    return flat[0], flat[1]


def _visible(meshcat: Meshcat, path: str, start: float, end: float | None) -> None:
    if start > 0:
        meshcat.SetProperty(path, "visible", False, 0.0)
    meshcat.SetProperty(path, "visible", True, start)
    if end is not None:
        meshcat.SetProperty(path, "visible", False, end)
