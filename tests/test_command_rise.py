"""Commands that change within a step: mean and rise stand for what is not resolved."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import se3
from spinndrift.models.effects import KINDS, Extended
from spinndrift.models.effects.deterministic_step import advance
from spinndrift.models.effects.recorded_rollout import Commands, simulate_recorded
from spinndrift.models.integrate import over_substeps
from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.commands import forces_of, rises_of
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.data.windows import make_windows
from spinndrift.training.diagnosis.data.arrays import make_data
from spinndrift.training.predict import predict_drift

VEHICLE = load_vehicle("ardusub_sitl")
STEP, PARTS = 0.1, 40


def turning(linear):
    """The vehicle with linear drag alone in yaw, whose rate settles within 1/linear s."""
    damping = (0.0,) * 5 + (linear * VEHICLE.inertia[2],)
    own = dataclasses.replace(VEHICLE, linear_damping=damping, quadratic_damping=(0.0,) * 6)
    return Extended.create(own.dynamics(), (), own.thrusters())


@jax.jit
def yaw_rates(model, commands, h, rise=None):
    """Yaw rates (P) after commands (S, n, P) in turn, each for h s, from rest."""
    P = commands.shape[2]
    X = jnp.tile(se3.identity(jnp.float64)[:, None], P)
    inertia = model.inertia()

    def after(state, u):
        return advance(model, inertia, (), *state, u, h, 10, rise=rise)[1:3], None

    return jax.lax.scan(after, (X, jnp.zeros((6, P))), commands)[0][1][5]


def test_steps_at_any_time_are_right_in_the_mean_with_rises_alone():
    """A rate that settles in a third of a step, under commands that step at all times within it."""
    model = turning(30.0)
    push = np.asarray(model.inverse[:, 5])
    share = (np.arange(PARTS) + 0.5) / PARTS
    at = np.arange(PARTS)[:, None]
    stepped = np.where(at == np.arange(PARTS), 0.5, at > np.arange(PARTS))  # part by step's time
    exact = yaw_rates(model, jnp.asarray(push[:, None] * stepped[:, None]), STEP / PARTS)
    mean = push[None, :, None] * (1 - share)
    held = yaw_rates(model, jnp.asarray(mean), STEP)
    rise = jnp.asarray(push[:, None] * (6 * share * (1 - share)))
    risen = yaw_rates(model, jnp.asarray(mean), STEP, rise)
    settled = 1 / (30.0 * VEHICLE.inertia[2])
    mean = np.mean([exact, held, risen], axis=1) / settled
    # ∫ over the time of the step: 1 - (1 - e^-ah) / ah, and half of what a held command settles to
    assert mean[0] == pytest.approx(1 - (1 - np.exp(-3)) / 3, abs=1e-3)
    assert mean[1] == pytest.approx((1 - np.exp(-3)) / 2, abs=1e-3)
    assert mean[2] == pytest.approx(mean[0], abs=1e-3)


@pytest.mark.parametrize("name", ["thruster_lag", "actuation_delay"])
def test_actuators_follow_a_rise_within_the_step(name):
    model = turning(1.0).with_effects((KINDS[name].neutral(thrusters=8),))
    u, rise = jnp.arange(8.0), jnp.linspace(-2.0, 2.0, 8)
    memory = model.remember(u)
    _, levels = model.actuate(memory, u, STEP, 20, rise)
    _, plain = turning(1.0).actuate((), u, STEP, 20, rise)
    np.testing.assert_allclose(plain.mean(axis=-1), u, atol=1e-12)
    np.testing.assert_allclose(plain[:, -1] - plain[:, 0], 0.95 * rise, atol=1e-12)
    np.testing.assert_allclose(levels, plain, atol=0.02)  # neutral: no lag, no delay


MIDDLE = 20


def recording(rise=4.0, std=0.0, **commands):
    """Commands whose PWM is 1600 us at step `MIDDLE`, and rises by 4 us a step."""
    N = 60
    X = np.tile([1.0, 0, 0, 0, 0, 0, -2.0], (N, 1))
    ramp = np.repeat(1600.0 + 4.0 * (np.arange(N) - MIDDLE)[:, None], 8, axis=1)
    sensors = {"pwm_rise": np.zeros((N, 8)) + rise, "pwm_std": np.zeros((N, 8)) + std}
    run = Trajectory("still", X, np.zeros((N, 6)), commands or {"pwm": ramp}, sensors)
    return Recording.from_trajectories([run], STEP, vehicle="ardusub_sitl")


def rise_at_middle(dataset):
    rise = rises_of(dataset, VEHICLE.thrusters())
    assert rise is not None
    return np.abs(rise[0, 0, MIDDLE])


def quadratic(after, before):
    """Rise of 51.48 u|u| N with u = (pwm - 1500) / 400, of pulses (us) above neutral."""
    return 51.48 * (after**2 - before**2) / 400**2


def test_rises_of_forces_are_those_of_the_curve():
    made = recording()
    np.testing.assert_allclose(rise_at_middle(made.dataset), quadratic(102, 98), rtol=1e-6)
    data = make_data(made, VEHICLE)
    assert data.rise is not None
    assert data.rise.shape == data.u.shape
    rise = rises_of(made.dataset, VEHICLE.thrusters())
    found = [np.unique(np.round(np.abs(x), 6)) for x in (data.rise, rise)]
    assert set(found[0]) <= set(found[1])
    assert len(found[0]) > 40  # the first and the last steps are left out, or padding
    forces = recording(thruster_force=np.ones((60, 8)))
    assert rises_of(forces.dataset, VEHICLE.thrusters()) is None
    assert make_data(forces, VEHICLE).rise is None


def test_a_diagnosis_takes_commands_behind_the_filter_of_the_rates():
    rng = np.random.default_rng(0)
    own = recording(pwm=1500 + 100 * rng.choice([-1.0, 1.0], (60, 8))).dataset
    before = np.roll(own["pwm"].to_numpy(), 1, axis=2)
    own = own.assign(pwm_rise=(own["pwm"].dims, 0.3 * (own["pwm"].to_numpy() - before), {}))
    made = make_data(Recording(own.assign_attrs(rates_low_pass=2.0)), VEHICLE)
    plain = make_data(Recording(own), VEHICLE)
    assert made.rise is not None
    kept = (made.weight > 0)[:, None] & np.ones_like(made.u, bool)
    assert np.std(made.u[kept]) < 0.8 * np.std(plain.u[kept])  # 10 Hz of steps behind 2 Hz
    assert Recording.concat([Recording(own.assign_attrs(rates_low_pass=2.0))] * 2).dataset.attrs[
        "rates_low_pass"
    ] == pytest.approx(2.0)


def test_a_pwm_that_was_changed_without_its_rises_is_taken_alone():
    t = STEP * np.arange(60)[:, None]
    wave = 200 * np.sin(2 * t + np.arange(8.0))
    rise = 400 * STEP * np.cos(2 * (t + STEP / 2) + np.arange(8.0))
    own = recording(rise, pwm=1500 + wave).dataset
    assert rises_of(own, VEHICLE.thrusters()) is not None
    signs = np.where(np.arange(8) == 2, -1, 1)
    for pwm in (1500 + signs * wave, 1500 + wave[:, ::-1]):
        changed = own.assign(pwm=(own["pwm"].dims, pwm[None, None], {}))
        plain = changed.drop_vars(["pwm_rise", "pwm_std"])
        assert rises_of(changed, VEHICLE.thrusters()) is None
        both = [forces_of(d, "pwm", VEHICLE.thrusters()) for d in (changed, plain)]
        np.testing.assert_array_equal(*both)


def test_rise_of_the_force_of_a_step_of_the_pulse_at_half_time_is_exact():
    """From 1540 to 1700 us: by the best line 1.5 times the change of the force."""
    step = np.arange(60)[:, None] - np.full(8, MIDDLE)
    pwm = 1620.0 + 80.0 * np.sign(step)
    made = recording(np.where(step == 0, 240.0, 0.0), np.where(step == 0, 80.0, 0.0), pwm=pwm)
    np.testing.assert_allclose(rise_at_middle(made.dataset), 1.5 * quadratic(200, 40), rtol=1e-6)


def test_a_predicted_motion_follows_a_rise_as_it_does_steps_of_the_substeps():
    """By the wrench, and by the thrusters of a model with effects."""
    T, parts, W = 6, 4, 3
    rng = np.random.default_rng(1)
    start = jnp.tile(se3.identity(jnp.float64)[:, None], W), jnp.zeros((6, W))
    level, rise = jnp.asarray(rng.normal(size=(2, T, 8, W)))
    fine = over_substeps(level, rise, parts)
    np.testing.assert_allclose(fine.mean(axis=-1), level, atol=1e-12)
    each = jnp.moveaxis(fine, -1, 1).reshape(T * parts, 8, W)
    model = turning(5.0)
    allocation = jnp.asarray(VEHICLE.thrusters().allocation, jnp.float64)

    def wrench(u):
        return jnp.einsum("in,tnw->tiw", allocation, u)

    found = predict_drift(
        model.base, *start, wrench(level), STEP, substeps=parts, rise=wrench(rise)
    )
    right = predict_drift(model.base, *start, wrench(each), STEP / parts)
    for a, b in zip(found, right, strict=True):
        np.testing.assert_allclose(a, b[parts - 1 :: parts], atol=1e-9)

    def commands(u, rise=None):
        volts, past = jnp.ones((len(u), 1, W)), jnp.zeros((1, 8, W))
        return Commands(u, volts, past, jnp.zeros((1, 6, W)), rise)

    given = [commands(level, rise), commands(each)]
    found = simulate_recorded(model, *start, given[0], STEP, substeps=parts)
    right = simulate_recorded(model, *start, given[1], STEP / parts)
    for a, b in zip(found, right, strict=True):
        np.testing.assert_allclose(a, b[parts - 1 :: parts], atol=1e-9)


def test_windows_have_the_rises_of_their_steps():
    made = recording(pwm=1500.0 + np.linspace(100, 336, 60)[:, None] * np.ones(8))
    whole = rises_of(made.dataset, VEHICLE.thrusters())
    assert whole is not None
    w = make_windows(made, length_s=1.0, stride_s=0.5, remembered=0.2, dtype=np.float64)
    assert w.rise is not None
    assert w.commands is not None
    rises = w.commands.rise
    assert rises is not None
    allocation = np.asarray(VEHICLE.thrusters().allocation)
    for i, begin in enumerate(np.round(w.start / STEP).astype(int)):
        own = whole[0, 0, begin : begin + 10]
        np.testing.assert_allclose(rises[..., i], own, atol=1e-9)
        np.testing.assert_allclose(w.rise[..., i], own @ allocation.T, atol=1e-5)
    part = w.subdivide(2).take([0, 1])
    assert part.rise is not None
    np.testing.assert_array_equal(part.rise, w.rise[:2, :, :2])
    held = Recording(made.dataset.drop_vars("pwm_rise"))
    assert make_windows(held, length_s=1.0).rise is None
