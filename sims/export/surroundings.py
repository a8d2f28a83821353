"""The scene around a vehicle, and sampled paths, as Foxglove's scene entities."""

from collections.abc import Mapping

import numpy as np

from ..reports.figures_path import Scene
from ..run.log import Plans
from . import foxglove as fox

_PATHS, _STEPS = 30, 10
"""Of the sampled ones, at most."""
_WATER: fox.Rgba = (0.30, 0.62, 0.78, 0.15)
_BED: fox.Rgba = (0.78, 0.72, 0.58, 1.0)
_PYLON: fox.Rgba = (0.45, 0.42, 0.38, 1.0)
_GOAL: fox.Rgba = (0.18, 0.62, 0.38, 0.30)
_HULL: fox.Rgba = (0.10, 0.42, 0.75, 0.9)
_ESTIMATED: fox.Rgba = (0.10, 0.42, 0.75, 0.25)
PLANNED: fox.Rgba = (0.95, 0.42, 0.10, 1.0)
GHOST: fox.Rgba = (0.72, 0.82, 0.86, 0.5)
_USUAL_SIZE = (0.46, 0.34, 0.25)
_MARGIN_M = 4.0


def surroundings(t: float, scene: Scene | None, poses: Mapping[str, np.ndarray]) -> fox.Message:
    """foxglove.SceneUpdate with the vehicle, and if known water, bed, pylons and goal.

    `poses` are those of the frames over time.
    """
    size = _USUAL_SIZE if scene is None else scene.size
    bow = [0.1 * size[0], 0.5 * size[1], 0.5 * size[2]]
    hull = [fox.shape(size, _HULL), fox.shape(bow, PLANNED, (0.5 * size[0], 0.0, 0.0))]
    found = [fox.entity(t, "body", "vehicle", cubes=hull)]
    if "estimate" in poses:
        ghost = [fox.shape(size, _ESTIMATED)]
        found.append(fox.entity(t, "estimate", "estimate", cubes=ghost))
    if scene is None:
        return fox.scene(found)
    p = poses["body"][:, 4:]
    points = p if scene.goal is None else np.concatenate([p, [scene.goal]])
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    middle, (a, b) = (low + high) / 2, (high - low)[:2] + 2 * _MARGIN_M
    bottom = float(low[2]) - 2.0 if scene.water_depth is None else -scene.water_depth
    planes = [fox.shape((a, b, 0.01), _WATER, (middle[0], middle[1], 0.0))]
    if scene.water_depth is not None:
        planes.append(fox.shape((a, b, 0.1), _BED, (middle[0], middle[1], bottom - 0.05)))
    found.append(fox.entity(t, "world", "water", cubes=planes))
    for i, pylon in enumerate(scene.obstacles):
        foot = max(pylon.bottom, bottom)
        length = max(pylon.top - foot, 0.01)
        body = fox.shape(
            (pylon.diameter, pylon.diameter, length),
            _PYLON,
            (pylon.x, pylon.y, foot + length / 2),
            bottom_scale=1.0,
            top_scale=1.0,
        )
        found.append(fox.entity(t, "world", pylon.name or f"pylon {i + 1}", cylinders=[body]))
    if scene.goal is not None:
        goal = fox.shape((2 * scene.goal_radius,) * 3, _GOAL, scene.goal)
        found.append(fox.entity(t, "world", "goal", spheres=[goal]))
    return fox.scene(found)


def samples(plans: Plans, k: int, rgba: fox.Rgba) -> list[fox.Message]:
    """The sampled paths of plan k with the largest weights, the heavier the more opaque."""
    assert plans.p_WB is not None
    paths = plans.p_WB[k]  # (steps, 3, paths)
    weights = np.ones(paths.shape[2]) if plans.weights is None else plans.weights[k]
    order = np.argsort(-np.nan_to_num(weights), kind="stable")[:_PATHS]
    step = max(1, paths.shape[0] // _STEPS)
    origin = plans.X_WB[k][0, 4:]
    most = max(float(np.nanmax(weights)), 1e-12)
    lines = []
    for i in order.tolist():
        points = np.concatenate([[origin], paths[step - 1 :: step, :, i]])
        points = points[np.isfinite(points).all(axis=1)]
        share = float(np.nan_to_num(weights[i])) / most
        faded = (*rgba[:3], rgba[3] * (0.2 + 0.8 * share))
        if len(points) > 1:
            lines.append(fox.line(points, faded, 1.0))
    return lines
