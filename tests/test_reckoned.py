"""Positions that follow the recorded velocities: found in data, and the same for every model."""

import equinox as eqx
import numpy as np
import pytest
from resting import at_rest

from spinndrift.models.effects import KINDS, Extended
from spinndrift.models.recordings.resample import rotations
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.data.reckoned import dead_reckoned_axes
from spinndrift.training.diagnosis.filter.along_records import (
    AlongRecords,
    scan,
    substeps,
)

VEHICLE = load_vehicle("bluerov2_heavy")
STEPS, PAST, RUNS, DT = 200, 8, 3, 0.05
WRONG = (
    KINDS["dvl_scale"].of(scale=0.05),
    KINDS["dvl_misalignment"].of("yaw", angle=0.08),
    KINDS["heading_error"].of(sine=0.05, cosine=-0.04, offset=0.1),
)
MODEL = Extended.create(VEHICLE.dynamics(), WRONG, VEHICLE.thrusters())
ALL = (0, 1, 2)


@eqx.filter_jit
def simulated(model, records, reckoned):
    """True and recorded states of a whole run."""
    along = AlongRecords.of(model, substeps(DT), reckoned=reckoned)

    def step(state, given):
        state = along.step(state, given)
        return state, ((state.X, state.V), along.observe(state))

    start = along.restart(along.init(records), records.X[0], records.V[0])
    return scan(step, start, records)


@pytest.fixture(scope="module")
def commanded():
    """Records of a vehicle at rest, and slowly changing commands."""
    n = VEHICLE.thrusters().inverse.shape[0]
    rng = np.random.default_rng(1)
    u = np.repeat(8 * rng.standard_normal((-(-(PAST + STEPS) // 20), n, RUNS)), 20, axis=0)
    return at_rest(u[: PAST + STEPS], PAST, DT)


def integrated(X, V):
    """The way of recorded velocities and attitudes, by the trapezoidal rule (N, 3, R)."""
    v_W = np.stack([rotations(X[:, :4, r].T).apply(V[:, :3, r]) for r in range(X.shape[2])], axis=2)
    return np.cumsum((v_W[1:] + v_W[:-1]) / 2 * DT, axis=0)


def test_a_reckoned_position_is_the_integral_of_what_is_recorded(commanded):
    """Velocities are 5 % too large and turned, attitudes off by up to ten degrees."""
    (X_true, V_true), (X, V) = (
        tuple(np.array(a) for a in part) for part in simulated(MODEL, commanded, ALL)
    )
    way = integrated(X, V)
    moved = X[1:, 4:] - X[:1, 4:]
    assert np.abs(way).max() > 2.0
    # trapezoids of the truth miss as much: h²/12 of the acceleration's change
    missed = integrated(X_true, V_true) - (X_true[1:, 4:] - X_true[:1, 4:])
    assert np.abs(moved - way).max() < 2 * np.abs(missed).max() + 1e-6
    assert np.abs(moved - way).max() < 0.01 * np.abs(moved - (X_true[1:] - X_true[:1])[:, 4:]).max()


def test_other_axes_keep_their_true_position(commanded):
    (X_true, _), (X, _) = simulated(MODEL, commanded, (0, 1))
    np.testing.assert_array_equal(np.asarray(X)[:, 6], np.asarray(X_true)[:, 6])
    assert np.abs(np.asarray(X - X_true)[:, 4:6]).max() > 0.05


def test_without_errors_of_instruments_nothing_changes(commanded):
    right = MODEL.with_effects(())
    for a, b in zip(
        simulated(right, commanded, ALL)[1], simulated(right, commanded, ())[1], strict=True
    ):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def recorded(model, records, reckoned, noise=0.0, axes=ALL):
    """A recording of instruments with white errors of the position (m) along some axes."""
    X, V = (np.asarray(a).copy() for a in simulated(model, records, reckoned)[1])
    for i in axes:
        X[:, 4 + i] += noise * np.random.default_rng(2).standard_normal(X[:, 4].shape)
    return X, V, np.full((len(X) - 1, RUNS), DT), np.ones((len(X) - 1, RUNS))


@pytest.mark.parametrize(
    ("effects", "reckoned", "noise", "axes", "found"),
    [
        ((), (), 0.0, ALL, ALL),  # nothing tells them apart
        (WRONG, ALL, 0.0, ALL, ALL),
        (WRONG[:1], (), 0.0, ALL, ()),  # the position contradicts the velocity
        (WRONG[1:2], (), 0.0, ALL, ()),
        (WRONG[2:], (), 0.0, ALL, ()),
        (WRONG, ALL, 0.003, (2,), (0, 1)),  # a depth gauge
        (WRONG, (), 0.003, ALL, ()),  # instruments of its own
        ((), (), 0.003, ALL, ()),
    ],
)
def test_it_is_found_whether_positions_follow_velocities(
    commanded, effects, reckoned, noise, axes, found
):
    model = MODEL.with_effects(effects)
    assert dead_reckoned_axes(*recorded(model, commanded, reckoned, noise, axes)) == found
