"""Motion along records: the same as a free simulation, from any record, in any number of lanes."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from resting import at_rest

from spinndrift.models.effects import KINDS, Extended
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.filter.along_records import (
    AlongRecords,
    scan,
    settle,
    substeps,
)

VEHICLE = load_vehicle("bluerov2_heavy")
STEPS, PAST, RUNS, DT = 12, 8, 2, 0.05
LATE = 0.03  # s
EFFECTS = (
    KINDS["thruster_lag"].of(time_constant=0.1),
    KINDS["clock_offset"].of("twist", delay=LATE),
    KINDS["dvl_scale"].of(scale=0.1),
)
MODEL = Extended.create(VEHICLE.dynamics(), EFFECTS, VEHICLE.thrusters())


@pytest.fixture(scope="module")
def commanded():
    """Records of a vehicle at rest, and commands before and after."""
    n = VEHICLE.thrusters().inverse.shape[0]
    u = 10 * np.random.default_rng(0).standard_normal((PAST + STEPS, n, RUNS))
    return at_rest(u, PAST, DT)


@eqx.filter_jit
def forecast(model, records, every, lanes=None):
    """What is recorded after each step, from the record every `every` steps."""
    along = AlongRecords.of(model, substeps(DT))
    records = records if lanes is None else records.in_lanes()

    def step(state, given):
        state = along.restart(state, given.X, given.V, given.number % every == 0)
        state = along.step(state, given)
        return state, along.observe(state)

    return scan(step, along.init(records, lanes), records)


def test_a_forecast_of_a_whole_run_is_a_free_simulation(commanded):
    """`Extended.rollout` in the same substeps, whose lag begins steady under the first command."""
    parts, model = substeps(DT), MODEL.with_effects(EFFECTS[:1])
    steady = commanded._replace(past=jnp.broadcast_to(commanded.u[0], commanded.past.shape))
    u = jnp.repeat(commanded.u, parts, axis=0)
    free = model.rollout(commanded.X[0], commanded.V[0], u, DT / parts)
    assert jnp.abs(free[1][-1]).max() > 0.1
    for a, b in zip(forecast(model, steady, STEPS), free, strict=True):
        np.testing.assert_allclose(a, b[parts - 1 :: parts], atol=1e-12)


@pytest.mark.slow
def test_forecasts_from_its_own_records_are_the_same_motion(commanded):
    """Instruments that are late and wrong are undone at each restart, without noise exactly."""
    X, V = forecast(MODEL, commanded, STEPS)
    own = commanded._replace(X=commanded.X.at[1:].set(X), V=commanded.V.at[1:].set(V))
    for every in (1, 5):
        again = forecast(MODEL, own, every)
        np.testing.assert_allclose(again[0], X, atol=1e-12)
        np.testing.assert_allclose(again[1], V, atol=1e-12)


def test_every_lane_is_a_run_by_itself(commanded):
    alone, lanes = forecast(MODEL, commanded, 3), forecast(MODEL, commanded, 3, 4)
    for a, b in zip(alone, lanes, strict=True):
        np.testing.assert_allclose(b, jnp.broadcast_to(a[:, :, None], b.shape), atol=1e-12)


def test_settled_actuators_hold_what_a_lag_makes_of_the_commands(commanded):
    """f' = (u - f)/τ from the first command on: f = Σ of held commands with decaying weights."""
    memory = settle(MODEL, commanded.past, commanded.past_step[:, None])
    decay = np.exp(-DT / 0.1)
    force = np.asarray(commanded.past[0])
    for u in np.asarray(commanded.past):
        force = u + decay * (force - u)
    np.testing.assert_allclose(memory[0].reshape(force.shape), force, rtol=1e-9)
