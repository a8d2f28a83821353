"""The transition of errors over a step, in turns that drag ends within it."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from spinndrift.models import se3
from spinndrift.models.effects import Extended
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.filter.along_records import substeps
from spinndrift.training.diagnosis.filter.innovations import step_jacobian

VEHICLE = load_vehicle("bluerov2")
MODEL = Extended.create(VEHICLE.dynamics(), (), VEHICLE.thrusters())
STILL = jnp.zeros((VEHICLE.thrusters().inverse.shape[0], 1))


POSE = jnp.asarray([0.9, 0.3, -0.2, 0.1, 0, 0, -5]) / jnp.asarray([0.9746794] * 4 + [1] * 3)
DELTA = 1e-6


def generator_of(V):
    """J of the errors of pose (in B) and twist, with the slopes of dV/dt by differences."""
    rest = MODEL.inertia()

    def rate(d):
        X = se3.retract(POSE, jnp.asarray(d[:6]))
        return np.asarray(MODEL.drift(rest, X[:, None], jnp.asarray(V + d[6:])[:, None], STILL))

    slopes = [(rate(d) - rate(-d))[:, 0] / (2 * DELTA) for d in DELTA * np.eye(12)]
    top = np.concatenate([-np.asarray(se3.ad(jnp.asarray(V))), np.eye(6)], axis=1)
    return np.concatenate([top, np.stack(slopes, axis=1)])


@pytest.mark.parametrize("dt", [0.02, 0.05, 0.1])
@pytest.mark.parametrize("rate", [0.5, 6.0])  # rad/s; at 6 drag ends a turn at 67 1/s
def test_an_error_ends_as_drag_ends_it(dt, rate):
    V = np.array([0.3, 0.1, -0.2, 0.1, -0.1, rate])
    J, parts = dt * generator_of(V), substeps(dt)
    found, slope = step_jacobian(
        MODEL, MODEL.inertia(), POSE[:, None], jnp.asarray(V)[:, None], STILL, jnp.asarray([dt]),
        parts,
    )  # fmt: skip
    np.testing.assert_allclose(slope[..., 0], J[6:, 6:] / dt, rtol=1e-5, atol=1e-5)
    exact = scipy.linalg.expm(J)
    # a series to third order over each part leaves x⁴ / 24 of it
    x = np.linalg.norm(J, 2) / parts
    assert np.linalg.norm(found[..., 0] - exact, 2) < parts * x**4 / 24 * np.exp(x)
    if rate > 1 and dt > 0.04:
        series = np.eye(12) + J + J @ J / 2 + J @ J @ J / 6
        assert np.linalg.norm(series - exact, 2) > 10 * np.linalg.norm(found[..., 0] - exact, 2)
