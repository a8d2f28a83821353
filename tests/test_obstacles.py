from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.geometry import (
    Box,
    Cylinder,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    ProximityProperties,
    SceneGraph,
)
from pydrake.math import RigidTransform, RollPitchYaw

from spinndrift.models import se3
from spinndrift.models.config.errors import UserError
from spinndrift.models.config.typed_yaml import loads
from spinndrift.systems.planning.obstacles import BoxHull, Cylinders, Pylon, SphereHull

SIZE = (0.457, 0.575, 0.254)
PYLONS = [Pylon(1.5, -0.65), Pylon(3.0, 0.4, diameter=0.5, bottom=-3.0, top=-0.5)]


pose_of = jax.jit(se3.from_position_rpy)
clearance = jax.jit(lambda hull, X_WB, cylinders: hull.clearance(X_WB, cylinders))


def pose(position, rpy=(0.0, 0.0, 0.0)):
    return pose_of(jnp.array(position, float), jnp.array(rpy, float))


class DrakeOracle:
    """Signed distance of the box to the cylinders as Drake's geometry engine measures it."""

    def __init__(self, pylons):
        self.graph = SceneGraph()
        self.source = self.graph.RegisterSource("test")
        self.frame = self.graph.RegisterFrame(self.source, GeometryFrame("hull"))
        self.box = self.graph.RegisterGeometry(
            self.source, self.frame, GeometryInstance(RigidTransform(), Box(*SIZE), "box")
        )
        self.cylinders = [
            self.graph.RegisterAnchoredGeometry(
                self.source,
                GeometryInstance(
                    RigidTransform(np.array([p.x, p.y, (p.top + p.bottom) / 2])),
                    Cylinder(p.diameter / 2, p.top - p.bottom),
                    f"pylon {i}",
                ),
            )
            for i, p in enumerate(pylons)
        ]
        for shape in (self.box, *self.cylinders):
            self.graph.AssignRole(self.source, shape, ProximityProperties())
        self.context = self.graph.CreateDefaultContext()

    def clearance(self, position, rpy):
        poses = FramePoseVector()
        poses.set_value(self.frame, RigidTransform(RollPitchYaw(rpy), position))
        port = self.graph.get_source_pose_port(self.source)
        port.FixValue(self.context, poses)
        query: Any = self.graph.get_query_output_port().Eval(self.context)
        pairs = [
            query.ComputeSignedDistancePairClosestPoints(self.box, c).distance
            for c in self.cylinders
        ]
        return min(pairs)


def test_box_agrees_with_drakes_geometry_beside_the_cylinders():
    oracle = DrakeOracle(PYLONS[:1])
    cylinders, hull = Cylinders.create(PYLONS[:1]), BoxHull.create(SIZE)
    rng = np.random.default_rng(1)
    positions = rng.uniform([0.3, -2.0, -4.0], [2.7, 0.7, -1.0], (200, 3))
    angles = rng.uniform(-0.6, 0.6, (200, 3))
    ours = clearance(hull, pose(positions.T, angles.T), cylinders)
    theirs = [oracle.clearance(p, a) for p, a in zip(positions, angles, strict=True)]
    outside = np.array(theirs) > 0
    assert outside.sum() > 100
    # Drake iterates to some 1e-5 m for this pair of shapes
    np.testing.assert_allclose(np.asarray(ours)[outside], np.array(theirs)[outside], atol=2e-5)
    inside = np.array(theirs) < -1e-6
    assert inside.sum() > 10
    assert np.all(np.asarray(ours)[inside] < 0)


def test_a_level_box_that_faces_a_pylon_has_the_distance_of_its_face():
    cylinders = Cylinders.create(PYLONS[:1])
    hull = BoxHull.create(SIZE)
    at = clearance(hull, pose([1.5 - 1.0, -0.65, -1.5]), cylinders)
    assert at == pytest.approx(1.0 - SIZE[0] / 2 - 0.15, abs=1e-9)
    touching = clearance(hull, pose([1.5, -0.65 + SIZE[1] / 2 + 0.15, -1.5]), cylinders)
    assert touching == pytest.approx(0.0, abs=1e-9)


def test_points_have_the_exact_distance_to_a_capped_cylinder():
    c = Cylinders.create([Pylon(0.0, 0.0, diameter=2.0, bottom=-2.0, top=0.0)])
    points = jnp.array([[3.0, 0, -1], [0, 0, 1], [0, 0, -1.0], [0, 0.75, -1], [4, 0, 4]]).T
    np.testing.assert_allclose(c.point_distance(points)[0], [2, 1, -1, -0.25, 5], atol=1e-12)


@settings(max_examples=30)
@given(
    x=st.floats(-1, 5),
    y=st.floats(-3, 3),
    yaw=st.floats(-3.1, 3.1),
    count=st.sampled_from([(1, 1), (2, 2), (2, 3)]),
)
def test_spheres_never_see_more_room_than_a_level_box_has(x, y, yaw, count):
    cylinders = Cylinders.create(PYLONS[:1])
    X = pose([x, y, -1.5], [0.0, 0.0, yaw])
    spheres = clearance(SphereHull.cover(SIZE, count), X, cylinders)
    box = clearance(BoxHull.create(SIZE), X, cylinders)
    diagonal = np.hypot(SIZE[0] / count[0], SIZE[1] / count[1]) / 2
    if box > 0:
        assert spheres <= box + 1e-9
        # and they waste no more than what a sphere sticks out of the face of its rectangle
        assert spheres >= box - diagonal
    else:  # the depth of an overlap is another for each hull
        assert spheres <= 0


def test_without_obstacles_there_is_room_without_end():
    X = jnp.stack([pose([0, 0, 0])] * 3, axis=1)
    none = Cylinders.create([])
    for hull in (SphereHull.cover(SIZE), BoxHull.create(SIZE)):
        assert np.all(np.isposinf(clearance(hull, X, none)))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_batches_and_precision_are_kept(dtype):
    X = jnp.broadcast_to(pose([0, 0, 0]).astype(dtype)[:, None, None], (7, 4, 5))
    cylinders = Cylinders.create(PYLONS, dtype)
    for hull in (SphereHull.cover(SIZE, dtype=dtype), BoxHull.create(SIZE, dtype)):
        distance = clearance(hull, X, cylinders)
        assert distance.shape == (4, 5)
        assert distance.dtype == dtype


def test_faults_are_named():
    with pytest.raises(UserError, match="diameter"):
        Pylon(0.0, 0.0, diameter=0.0)
    with pytest.raises(UserError, match="top"):
        loads(Pylon, "{x: 0, y: 0, bottom: 2}")
    with pytest.raises(ValueError, match="size"):
        SphereHull.cover((0.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="size"):
        BoxHull.create((1.0, -1.0, 1.0))
