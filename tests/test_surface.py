"""A hull at the surface floats where its weight is its buoyancy, and swings as Archimedes says."""

import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import se3
from spinndrift.models.config.errors import UserError
from spinndrift.models.disturbances import Surface
from spinndrift.models.vehicles.vehicle import load_vehicle

VEHICLE = load_vehicle("bluerov2_heavy")
SURFACE = Surface.of(VEHICLE)
NOTHING = jnp.zeros(0)
AT_REST = jnp.zeros(6)


def wrench(X):
    return SURFACE.wrench(NOTHING, X, AT_REST, 0.0)


def test_below_it_does_nothing_and_above_all_buoyancy_is_gone():
    deep, aloft = (se3.identity(jnp.float64).at[6].set(z) for z in (-0.2, 0.2))
    np.testing.assert_array_equal(wrench(deep), 0)
    np.testing.assert_allclose(wrench(aloft)[:3], [0, 0, -VEHICLE.buoyancy])


def test_a_heeled_hull_is_pushed_down_at_its_centre_of_buoyancy():
    X = se3.from_position_rpy(jnp.array([1.0, 2.0, 0.02]), jnp.array([0.4, -0.3, 2.0]))
    F = wrench(X)
    force_W = se3.rotate(X, F[:3])
    np.testing.assert_allclose(force_W[:2], 0, atol=1e-12)
    assert -VEHICLE.buoyancy < force_W[2] < 0
    np.testing.assert_allclose(F[3:], np.cross(VEHICLE.center_of_buoyancy, F[:3]), atol=1e-12)


def test_it_floats_with_the_share_of_its_net_buoyancy_out_of_the_water():
    dynamics = VEHICLE.dynamics()
    share = 1 - VEHICLE.weight / VEHICLE.buoyancy
    cb, height = VEHICLE.center_of_buoyancy[2], VEHICLE.size[2]
    X = se3.identity(jnp.float64).at[6].set((share - 0.5) * height - cb)
    a = dynamics.acceleration(X, AT_REST, wrench(X))
    np.testing.assert_allclose(a, 0, atol=1e-9)
    lifted = X.at[6].add(1e-3)
    stiffness = -float(wrench(lifted)[2] - wrench(X)[2]) / 1e-3
    # the waterplane's area times ρ g, of a hull whose volume is its buoyancy's
    assert stiffness == pytest.approx(VEHICLE.buoyancy / height)


@pytest.mark.parametrize("field", ["buoyancy", "height"])
def test_impossible_hulls_are_refused(field: str):
    with pytest.raises(UserError, match=f"Surface.{field}"):
        Surface(**({"buoyancy": 100.0, "height": 0.2} | {field: 0.0}))
