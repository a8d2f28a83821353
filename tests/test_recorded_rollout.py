"""Windows of records played back by a model with effects: commands, memory, instruments, laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from thruster_examples import prompt_thrusters

from spinndrift.models import se3
from spinndrift.models.effects.extended import Extended
from spinndrift.models.effects.library import kind
from spinndrift.models.effects.recent import Recent
from spinndrift.models.effects.recorded_rollout import Commands, simulate_recorded
from spinndrift.models.rigid_body import FossenDynamics
from spinndrift.training.predict import predict, predict_drift

MASS, DT, STEPS, WIDE = 20.0, 0.05, 12, 3
THRUSTERS = prompt_thrusters()
INERTIA = np.array([MASS, MASS, MASS, 1.0, 1.0, 1.0])


def body(drag):
    """A body without gravity, of linear drag."""
    zero = np.zeros((6, 6))
    return FossenDynamics(
        rigid_inertia=np.diag(INERTIA), added_mass=zero, linear_drag=np.diag(drag),
        quadratic_drag=zero, weight=0.0, buoyancy=0.0, p_BoBcm_B=np.zeros(3), p_BoCb_B=np.zeros(3),
    )  # fmt: skip


FREE, BODY = body(np.zeros(6)), body(np.array([5.0, 5.0, 5.0, 1.0, 1.0, 1.0]))


def extended(*effects, body=FREE):
    return Extended.create(body, effects, THRUSTERS)


def commands(level, before=None, voltage=1.0):
    """Of thruster forces (T, 8, W), by default the first of them for ever before."""
    before = level[:1] if before is None else before
    return Commands(
        jnp.asarray(level),
        jnp.full((len(level), 1, level.shape[2]), voltage),
        jnp.asarray(before),
        jnp.zeros((len(before), 6, level.shape[2])),
    )


def surge(force):
    """Thruster forces that push ahead with `force` (N), (8,)."""
    return np.asarray(THRUSTERS.allocate(jnp.array([force, 0, 0, 0, 0, 0])))


def at_rest(width=1):
    X = jnp.broadcast_to(se3.identity(jnp.float64)[:, None], (7, width))
    return X, jnp.zeros((6, width))


def moving(seed=0):
    """Records and forces of some windows: poses anywhere, speeds and commands that vary."""
    rng = np.random.default_rng(seed)
    X = se3.from_position_rpy(*(jnp.asarray(rng.normal(size=(3, WIDE))) for _ in range(2)))
    V = jnp.asarray(rng.normal(0, 0.4, (6, WIDE)))
    return X, V, commands(rng.normal(0, 8, (STEPS, 8, WIDE)))


@pytest.mark.parametrize("before", [0.0, 10.0])
def test_what_was_commanded_before_the_window_still_arrives(before):
    """Free of drag, the impulse tells the lag; it begins from the force that was there."""
    tau, push = 0.2, 10.0
    level = np.repeat(surge(push)[None, :, None], STEPS, axis=0)
    past = np.repeat(surge(before)[None, :, None], 3, axis=0)
    model = extended(kind("thruster_lag").of(time_constant=tau))
    _, V = simulate_recorded(model, *at_rest(), commands(level, past), DT, substeps=2)
    t = DT * np.arange(1, STEPS + 1)
    impulse = push * t - (push - before) * tau * (1 - np.exp(-t / tau))
    np.testing.assert_allclose(V[:, 0, 0], impulse / MASS, rtol=1e-9)


def test_forces_that_cancel_show_a_dead_thruster():
    """The wrench alone would tell nothing of them."""
    null = np.linalg.svd(np.asarray(THRUSTERS.allocation))[2][-1] * 20
    dead = extended(kind("thruster_gain").of("3", gain=-1.0))
    level = np.repeat(null[None, :, None], 2, axis=0)
    _, V = simulate_recorded(dead, *at_rest(), commands(level), DT)
    lost = np.asarray(THRUSTERS.wrench(jnp.asarray(np.where(np.arange(8) == 2, -null, 0))))
    np.testing.assert_allclose(V[0, :, 0], DT * lost / INERTIA, rtol=1e-9, atol=1e-15)


def test_voltage_reaches_the_thrusters():
    """A supply at 0.9 of the nominal voltage, which the command's force does not know of."""
    sag = extended(kind("voltage_sag").of(exponent=1.5))
    level = np.repeat(surge(10.0)[None, :, None], 2, axis=0)
    full, low = (
        simulate_recorded(sag, *at_rest(), commands(level, None, v), DT)[1][-1, 0, 0]
        for v in (1.0, 0.9)
    )
    np.testing.assert_allclose(low / full, 0.9**1.5, rtol=1e-9)


INSTRUMENTS = {
    "heading_error": kind("heading_error").of(sine=0.01, offset=0.005),
    "dvl_misalignment": kind("dvl_misalignment").of("yaw", angle=0.08),
    "dvl_lever_arm": kind("dvl_lever_arm").of("x", offset=0.2),
}


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_records_lead_to_records(name):
    """From what an instrument showed to what it will show: the true motion, read by it."""
    X, V, given = moving()
    true, crooked = extended(body=BODY), extended(INSTRUMENTS[name], body=BODY)
    Xs, Vs = simulate_recorded(true, X, V, given, DT)
    still = Recent.steady(jnp.zeros((6, WIDE)), DT)
    seen = [crooked.observe(x, v, still) for x, v in zip((X, *Xs), (V, *Vs), strict=True)]
    off = [jnp.abs(a - b).max() for a, b in zip(seen[1], (Xs[0], Vs[0]), strict=True)]
    assert max(off) > 1e-3
    Xr, Vr = simulate_recorded(crooked, *seen[0], given, DT)
    # a heading's error is taken off in three steps, each of which leaves a hundredth
    np.testing.assert_allclose(Xr, [x for x, _ in seen[1:]], atol=1e-7)
    np.testing.assert_allclose(Vr, [v for _, v in seen[1:]], atol=1e-7)


@pytest.mark.slow
def test_late_instruments_show_what_was():
    """Late by 0.6 of a step; what is left is what linear motion within steps leaves."""
    late, fine = 0.6 * DT, 20
    t = np.arange(STEPS + 1) * DT
    force = 12 * np.sin(2 * t)[:-1]
    level = np.stack([surge(f) for f in force])[:, :, None]
    plain = extended(body=BODY)
    before = np.repeat(surge(0.0)[None, :, None], 1, axis=0)
    dense = commands(np.repeat(level, fine, axis=0), before)
    _, Vf = simulate_recorded(plain, *at_rest(), dense, DT / fine)
    path = np.concatenate([np.zeros(1), np.asarray(Vf[:, 0, 0])])
    shown = np.interp(t - late, np.arange(len(path)) * DT / fine, path)
    model = extended(kind("clock_offset").of("twist", delay=late), body=BODY)
    _, V = simulate_recorded(model, *at_rest(), commands(level, before), DT, substeps=fine)
    ignored = np.abs(path[::fine][1:] - shown[1:]).max()
    assert np.abs(np.asarray(V[:, 0, 0]) - shown[1:]).max() < 0.05 * ignored


def test_pushes_that_last_are_in_the_samples():
    """A mean-reverting force: Var v = (σ/m)² 2 τ (t - τ (1 - e^(-t/τ))), begun in its law."""
    std, tau, count = 2.0, 0.3, 4000
    model = extended(kind("disturbance_colour").of("surge", std=std, time_constant=tau))
    given = commands(np.zeros((STEPS, 8, 1)))
    X, V = at_rest()
    F = jnp.zeros((STEPS, 6, 1))
    _, Vs = predict(
        model, X, V, F, DT, jax.random.key(0), count, substeps=2, commands=given
    )  # fmt: skip
    t = DT * np.arange(1, STEPS + 1)
    expected = std / MASS * np.sqrt(2 * tau * (t - tau * (1 - np.exp(-t / tau))))
    # the standard deviation of so many samples is known to 1.1 %, steps of 25 ms add 1 %
    np.testing.assert_allclose(np.std(Vs[:, 0, :, 0], axis=1), expected, rtol=0.05)


def test_wrenches_alone_do_where_no_commands_are_given():
    """Both ways agree for a model that neither remembers nor tells thrusters apart."""
    X, V, given = moving()
    model = extended(kind("linear_drag").of("surge", change=3.0), body=BODY)
    F = jnp.stack([THRUSTERS.wrench(u) for u in given.level])
    by_wrench = predict_drift(model, X, V, F, DT)
    by_thrusters = predict_drift(model, X, V, F, DT, commands=given)
    for a, b in zip(by_wrench, by_thrusters, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)
