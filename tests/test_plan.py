import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import se3
from spinndrift.systems.planning.plan import Plan, PlanLayout
from spinndrift.systems.planning.plan_samples import SampleLayout

LAYOUT = PlanLayout(4, 0.5)
at_time = jax.jit(LAYOUT.at)
log_between = jax.jit(se3.local)
exponential = jax.jit(se3.exp)


def screw_plan(t0=2.0):
    """Constant twist: the plan at any time must be the exponential of it."""
    xi = jnp.array([0.4, -0.2, 0.1, 0.3, 0.2, -0.5])
    X = exponential(xi[:, None] * jnp.arange(5.0)[None] * 0.5)
    F = jnp.arange(24.0).reshape(6, 4)
    return xi, Plan(jnp.asarray(t0), X, jnp.stack([xi] * 5, axis=1), F)


def test_packing_is_undone_by_unpacking_and_puts_states_first():
    _, plan = screw_plan()
    vector = LAYOUT.pack(plan)
    assert vector.shape == (LAYOUT.size,) == (1 + 5 * 13 + 4 * 6,)
    for a, b in zip(LAYOUT.unpack(vector), plan, strict=True):
        np.testing.assert_array_equal(a, b)
    assert vector[0] == 2.0
    np.testing.assert_array_equal(vector[1 + 13 : 1 + 20], plan.X_WB[:, 1])
    np.testing.assert_array_equal(vector[-6:], plan.F_Bo_B[:, -1])


@pytest.mark.parametrize("t", [2.0, 2.3, 3.1, 3.999])
def test_between_knots_the_pose_runs_on_the_geodesic(t):
    xi, plan = screw_plan()
    at = at_time(LAYOUT.pack(plan), jnp.asarray(t))
    error = log_between(at.X_WB, exponential(xi * (t - 2.0)))
    np.testing.assert_allclose(error, 0, atol=1e-12)
    np.testing.assert_allclose(at.V_WB_B, xi, atol=1e-12)
    np.testing.assert_array_equal(at.F_Bo_B, plan.F_Bo_B[:, int((t - 2.0) / 0.5)])
    assert at.valid


def test_before_the_plan_its_start_counts_and_after_it_the_vehicle_stays():
    _, plan = screw_plan()
    vector = LAYOUT.pack(plan)
    early, late = at_time(vector, jnp.asarray(1.0)), at_time(vector, jnp.asarray(9.0))
    np.testing.assert_allclose(early.X_WB, plan.X_WB[:, 0], atol=1e-12)
    np.testing.assert_allclose(late.X_WB, plan.X_WB[:, -1], atol=1e-12)
    np.testing.assert_array_equal(late.V_WB_B, np.zeros(6))
    np.testing.assert_array_equal(late.F_Bo_B, plan.F_Bo_B[:, -1])


@pytest.mark.parametrize("fault", [0.0, np.nan])
def test_zeros_and_nan_are_no_plan(fault):
    vector = jnp.full(LAYOUT.size, fault)
    at = at_time(vector, jnp.asarray(1.0))
    assert not at.valid
    for part in at[:3]:
        assert np.all(np.isfinite(part))
    assert np.all(at.F_Bo_B == 0)


def test_samples_come_back_and_hold_no_nan():
    layout = SampleLayout(3, 0.1, 2)
    p = jnp.arange(18.0).reshape(3, 3, 2).at[0, 0, 0].set(jnp.nan)
    vector = layout.pack(jnp.asarray(1.5), p, jnp.array([0.25, 0.75]))
    back = layout.unpack(vector)
    assert vector.shape == (layout.size,)
    assert back.t0 == 1.5
    assert back.p_WB[0, 0, 0] == 0
    np.testing.assert_array_equal(back.p_WB[1:], p[1:])
    np.testing.assert_array_equal(back.weights, [0.25, 0.75])


def test_sizes_must_be_positive():
    with pytest.raises(ValueError, match="positive"):
        PlanLayout(0, 0.05)
    with pytest.raises(ValueError, match="positive"):
        PlanLayout(3, 0.0)


def test_reading_a_plan_is_differentiable_in_time():
    xi, plan = screw_plan()
    vector = LAYOUT.pack(plan)
    slope = jax.jit(jax.jacfwd(lambda t: LAYOUT.at(vector, t).X_WB[4:]))(jnp.asarray(2.2))
    at = at_time(vector, jnp.asarray(2.2))
    np.testing.assert_allclose(slope, se3.rotate(at.X_WB, xi[:3]), atol=1e-9)
