"""ArduSub's mixer and its inverse."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.vehicle.autopilot.autopilot import Autopilot
from spinndrift.sims.vehicle.autopilot.navigation import Motion
from spinndrift.sims.vehicle.autopilot.parameters import Parameters
from spinndrift.sims.vehicle.autopilot.pilot import Sticks
from spinndrift.systems.mavlink.codec import (
    manual_control_demand,
    manual_control_fields,
    rc_override_fields,
    rc_override_passthrough,
)
from spinndrift.systems.mavlink.mixer import AxisInverse, mixer_factors


@pytest.fixture(scope="module")
def heavy():
    thrusters = load_vehicle("bluerov2_heavy").thrusters()
    inverse = AxisInverse(thrusters, 2)
    return thrusters, inverse, jax.jit(lambda F, volts, limit: inverse(F, volts, limit))


def reach(thrusters) -> np.ndarray:
    """Wrench of all thrusters at 25 N."""
    return 25.0 * np.abs(np.asarray(thrusters.allocation)).sum(axis=1)


def test_each_demand_pushes_along_its_own_axis(heavy):
    thrusters, *_ = heavy
    wrenches = (np.asarray(thrusters.allocation) @ mixer_factors(2)).T / reach(thrusters)
    for axis, F in enumerate(wrenches):
        assert F[axis] > 0
        assert np.abs(np.delete(F, axis)).max() < 0.5 * F[axis]  # horizontals are above Bo


def test_the_wrench_asked_for_is_the_wrench_given(heavy):
    thrusters, _, solve = heavy
    rng, full = np.random.default_rng(0), reach(thrusters)
    errors = []
    for _ in range(300):
        F, volts = rng.normal(size=6) * full * rng.uniform(0.02, 0.15), rng.uniform(13.0, 16.8)
        found = solve(jnp.asarray(F), volts, 1.0)
        given = np.asarray(thrusters.wrench(thrusters.force(found.pwm, volts)))
        np.testing.assert_allclose(given, found.F_Bo_B, atol=1e-9)
        errors.append(np.abs((given - F) / full).max() / np.abs(F / full).max())
    # demands in proportion to the wrench are wrong by tens of percent
    assert np.quantile(errors, 0.99) < 0.005
    assert max(errors) < 0.02


def test_a_wrench_beyond_the_limits_keeps_its_direction(heavy):
    thrusters, _, solve = heavy
    rng, full = np.random.default_rng(1), reach(thrusters)
    for _ in range(30):
        F = rng.normal(size=6) * full
        found = solve(jnp.asarray(F), 16.0, 1.0)
        a, b = F / full, np.asarray(found.F_Bo_B) / full
        assert a @ b / np.linalg.norm(a) / np.linalg.norm(b) > 0.9
        assert np.all((found.pwm >= 1100 - 1e-6) & (found.pwm <= 1900 + 1e-6))
        assert np.abs(found.demand).max() <= 1 + 1e-9


def test_the_pilot_gain_bounds_the_four_scaled_axes(heavy):
    _, inverse, solve = heavy
    found = solve(jnp.array([150.0, 0, 0, 0, 0, 0]), 16.0, 0.25)
    assert np.abs(np.asarray(found.demand)[[0, 1, 2, 5]]).max() == pytest.approx(0.25)
    np.testing.assert_allclose(found.pwm, 1500 + 400 * inverse.outputs(found.demand))


def test_no_wrench_is_neutral(heavy):
    found = heavy[2](jnp.zeros(6), 16.0, 1.0)
    np.testing.assert_allclose(found.pwm, 1500.0, atol=1.0)
    np.testing.assert_allclose(found.F_Bo_B, 0.0, atol=1e-4)


def test_a_motor_that_turns_backwards_gets_the_mirrored_output(heavy):
    thrusters, *_ = heavy
    signs = np.array([1, -1, 1, 1, -1, 1, 1, 1.0])
    turned = AxisInverse(_with_directions(thrusters, signs), 2)(
        jnp.array([20.0, 0, 0, 0, 0, 2]), 16.0
    )
    straight = heavy[2](jnp.array([20.0, 0, 0, 0, 0, 2]), 16.0, 1.0)
    np.testing.assert_allclose(turned.F_Bo_B, straight.F_Bo_B, atol=1e-6)
    np.testing.assert_allclose(turned.pwm - 1500, signs * (straight.pwm - 1500), atol=1e-6)


def _with_directions(thrusters, signs):
    return eqx.tree_at(lambda t: t.motor_directions, thrusters, jnp.asarray(signs))


def test_a_frame_that_does_not_fit_is_refused(heavy):
    with pytest.raises(UserError, match=r"\(vectored\) has 6 thrusters .* vehicle 8"):
        AxisInverse(heavy[0], 1)
    with pytest.raises(UserError, match="FRAME_CONFIG is 7, a frame whose mixer is not known"):
        mixer_factors(7)


def test_fields_of_manual_control_and_overrides_mean_the_same_demand():
    demand = np.array([0.2, -0.1, 0.3, -0.4, 0.15, -0.05])
    fields = manual_control_fields(*demand, gain=0.5)
    np.testing.assert_allclose(manual_control_demand(**fields, gain=0.5), demand, atol=2e-3)
    channels = rc_override_fields(demand)
    # pitch (nose up), roll, heave, yaw (clockwise), forward, right
    signs, order = np.array([-1, 1, 1, -1, 1, -1]), [4, 3, 2, 5, 0, 1]
    assert [channels[f"chan{k}_raw"] for k in range(1, 7)] == [
        round(1500 + 400 * value) for value in signs * demand[order]
    ]
    assert channels["chan7_raw"] == channels["chan8_raw"] == 65535  # left to others


def test_passed_through_pulses_are_clamped_and_finite():
    fields = rc_override_passthrough(np.array([1000.0, 1500, 2000, 1550.4, 1449.6, 1500]))
    assert [fields[f"chan{k}_raw"] for k in range(1, 9)] == [
        1100,
        1500,
        1900,
        1550,
        1450,
        1500,
        65535,
        65535,
    ]
    with pytest.raises(ValueError, match="finite"):
        rc_override_passthrough(np.array([np.nan] * 8))


def test_the_simulated_autopilot_puts_out_what_was_foreseen(heavy):
    # `sims.vehicle.autopilot` was written from measurements of ArduSub, apart from the inverse
    thrusters, _, solve = heavy
    rng, full = np.random.default_rng(2), reach(thrusters)
    autopilot, t = Autopilot(Parameters()), 0.0

    def run(seconds: float, sticks: Sticks | None = None, channels: list[int] | None = None):
        nonlocal t
        us: list[int] = []
        for _ in range(round(seconds / 0.02)):
            if sticks is not None:
                autopilot.manual_control(255, 1, sticks)
            if channels is not None:
                autopilot.override(255, channels)
            t += 0.02
            us = autopilot.step(t, Motion())
        return us[:8]

    neutral = Sticks(**manual_control_fields())
    run(3.0, neutral)
    assert autopilot.arm(force=True)
    run(2.0, neutral)
    for _ in range(20):
        found = solve(jnp.asarray(rng.normal(size=6) * full * 0.05), 16.0, autopilot.pilot.gain)
        demand, gain = np.asarray(found.demand), autopilot.pilot.gain
        us = run(0.1, Sticks(**manual_control_fields(*demand, gain=gain)))
        np.testing.assert_allclose(us, found.pwm, atol=3.0)  # whole µs on three axes
        us = run(0.1, channels=list(rc_override_fields(demand).values()))
        np.testing.assert_allclose(us, found.pwm, atol=3.0)
