"""Inertial samples: what is left out, what stands in for it, what it leaves open."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import se3
from spinndrift.models.sensors import Imu
from spinndrift.systems.estimation.error_state import Navigation, apply, sample_increment
from spinndrift.systems.estimation.inertial import FEW, LEFT_OPEN, Motion, Samples, take

IMU = Imu()
T = 1 / IMU.rate
N = 400
FORCE, RATE = slice(1, 4), slice(4, 7)


@jax.jit
def taken(samples: jax.Array) -> tuple[Samples, jax.Array]:
    def over(memory, given):
        return take(IMU, memory, *given)

    numbers = jnp.arange(len(samples), dtype=samples.dtype)
    return jax.lax.scan(over, Samples.start(jnp.zeros(3)), (samples, numbers))


def noisy(seed: int = 0, force: float = 0.01, rate: float = 0.001) -> np.ndarray:
    """Samples at rest, with noise."""
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((N, 6)) * np.repeat([force, rate], 3)
    return noise + np.array([0, 0, 9.81, 0, 0, 0])


def rows(samples: np.ndarray) -> np.ndarray:
    return np.asarray(taken(jnp.asarray(samples))[1])


def left_out(row: np.ndarray) -> np.ndarray:
    """Whether force and rate of rows are left out."""
    return row[..., -LEFT_OPEN::2] > 0


def test_good_samples_go_through_as_they_are():
    samples = noisy()
    found = rows(samples)
    np.testing.assert_array_equal(found[:, 1:7], samples)
    np.testing.assert_array_equal(found[:, 0], np.arange(N) >= 1)  # the first moves nothing
    assert not found[:, -LEFT_OPEN:].any()


def test_a_spike_is_a_fault_and_a_hard_start_is_a_motion():
    spike, start = noisy(), noisy()
    spike[100, 0] += 50
    start[100:, 0] += 20  # more than was ever seen, and it stays
    for samples, calm in ((spike, (N - 102) * T), (start, 1e3 + N * T)):
        memory, found = taken(jnp.asarray(samples))
        assert left_out(np.asarray(found))[100, 0]
        np.testing.assert_allclose(memory.calm, calm, rtol=1e-12)
    memory, _ = taken(jnp.asarray(start[:104]))
    assert memory.calm > 1e3


def test_what_is_not_finite_or_out_of_range_is_left_out():
    for value in (np.nan, np.inf, -np.inf, 1000.0, -IMU.accelerometer_range):
        samples = noisy()
        samples[100, 0] = value
        samples[200, 5] = value
        found = rows(samples)
        assert np.isfinite(found).all()
        out = left_out(found)
        np.testing.assert_array_equal(np.flatnonzero(out[:, 0]), [100])
        np.testing.assert_array_equal(np.flatnonzero(out[:, 1]), [200])
        # nothing was refused that could have been true
        assert not found[:, -LEFT_OPEN + 1 :: 2].any()


def test_a_frozen_unit_is_found_out_and_coarse_steps_are_none():
    samples = noisy()
    samples[100:200] = samples[99]
    out = left_out(rows(samples)).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(out), np.arange(104, 200))
    coarse = np.round(noisy() / 0.02) * 0.02  # steps of twice the noise of the force
    coarse[:, 3:] = np.round(noisy()[:, 3:] / 0.001) * 0.001
    assert not left_out(rows(coarse)).any()


def test_one_value_that_stands_still_is_found_out():
    samples = noisy()
    samples[100:, 1] = samples[99, 1]
    out = left_out(rows(samples))
    assert not out[:140].any()
    assert out[150:, 0].all()


def test_a_spike_in_range_is_refused_and_may_have_been_true():
    samples = noisy()
    samples[100, 0] += 50.0
    samples[200, 4] += 5.0
    found = rows(samples)
    assert left_out(found)[100, 0]
    assert left_out(found)[200, 1]
    doubted = found[:, -LEFT_OPEN + 1 :: 2]
    np.testing.assert_allclose(doubted[100, 0], (50 * T) ** 2, rtol=1e-2)
    np.testing.assert_allclose(doubted[200, 1], (5 * T) ** 2, rtol=1e-2)
    np.testing.assert_allclose(found[200, RATE], 0, atol=0.01)  # the last rate goes on


def test_a_step_that_stays_is_a_motion():
    samples = noisy()
    samples[100:, 0] += 30.0
    samples[100:, 4] += 3.0
    out = np.asarray(left_out(rows(samples)).any(axis=1))
    assert 0 < out.sum() <= 10
    assert not out[120:].any()


def test_the_scatter_is_that_of_white_noise():
    """A sample minus the mean of the last few: σ² (1 + 1/few); rates minus the last: 2 σ²."""
    memory, _ = taken(jnp.asarray(noisy(force=0.3, rate=0.02)))
    scatter = np.diag(memory.steps)
    effective = N / 2  # two seconds of memory in four
    bound = 4 * math.sqrt(2 / effective)
    np.testing.assert_allclose(scatter[:3] / (0.09 * (1 + 1 / FEW)), 1, atol=bound)
    np.testing.assert_allclose(scatter[3:] / (2 * 0.0004), 1, atol=bound)


def test_what_a_missing_force_leaves_open():
    """a² t² while an acceleration lasts, growing as time later."""
    motion = Motion(jnp.zeros(6), jnp.array([0.5**2, 0.1**2]))
    samples = noisy()
    samples[100:300, :3] = np.nan
    opened = jax.vmap(motion.variances)(jnp.asarray(rows(samples)[:, -LEFT_OPEN:]))
    total = np.cumsum(np.asarray(opened)[:, 0])
    np.testing.assert_allclose(total[149], 0.25 * 0.5**2, rtol=0.03)
    np.testing.assert_allclose(total[299] - total[199], 2 * 0.25 * 1.0, rtol=0.02)
    assert not np.asarray(opened)[:, 1].any()


def test_how_a_vehicle_usually_moves():
    after = jax.jit(partial(Motion.after, dt=jnp.asarray(0.01)))
    motion = Motion.start(jnp.dtype("float64"))
    for _ in range(6000):
        motion = after(motion, jnp.array([0.6, 0, 0.8]), jnp.array([0, 0.3, 0.4]))
    np.testing.assert_allclose(motion.usual, [1.0, 0.25], rtol=0.02)
    for _ in range(12000):
        motion = after(motion, jnp.zeros(3), jnp.zeros(3))
    np.testing.assert_allclose(motion.usual, [0.1**2, 0.05**2])  # no vehicle is quite at rest


@pytest.mark.parametrize("integrating", [True, False])
def test_the_rate_between_samples_is_as_uncertain_as_is_said(integrating):
    """A Brownian rate: means over a period, or points, and the rate at the end of a sample."""
    fine, n, density = 64, 20_000, 0.3
    rng = np.random.default_rng(0)
    rate = np.cumsum(density * np.sqrt(T / fine) * rng.standard_normal((3, n * fine)), axis=1)
    ends = rate[:, fine - 1 :: fine]
    points = np.concatenate([np.zeros((3, 1)), ends[:, :-1]], axis=1)
    rows = rate.reshape(3, n, fine).mean(axis=2) if integrating else (points + ends) / 2
    error = (rows[:, :-1] + rows[:, 1:]) / 2 - ends[:, :-1]
    bends = np.diff(rows if integrating else ends, 2, axis=1)
    start = Samples.start(jnp.zeros(3))
    steps = start.bends.at[3:, 3:].set(bends @ bends.T / bends.shape[1])
    claimed = start._replace(bends=steps).rate_covariance(integrating)
    np.testing.assert_allclose(np.diag(claimed), (error**2).mean(axis=1), rtol=0.05)


def test_after_a_gap_another_motion_is_no_jolt():
    """A step of the same size without a gap is one; nothing is known of what a gap hides."""
    jolted, hidden = noisy(), noisy()
    jolted[120:, [0, 4]] += 1.5, 0.4
    hidden[100:120] = np.nan
    hidden[120:, [0, 4]] += 1.5, 0.4
    assert np.abs(taken(jnp.asarray(jolted))[0].jolts).max() > 0.3
    memory, found = taken(jnp.asarray(hidden))
    np.testing.assert_array_equal(memory.jolts, 0)
    out = left_out(np.asarray(found))
    np.testing.assert_array_equal(np.flatnonzero(out.any(axis=1)), np.arange(100, 120))


def test_instantaneous_samples_are_integrated_to_second_order():
    """A vehicle that turns back and forth at a constant velocity in W: v_W stays."""

    def moved(rate: float) -> float:
        imu = Imu(rate=rate, integrating=False)
        t = jnp.arange(2 * rate + 1) / rate
        size, w = jnp.array([0.3, 0.4, 0.5])[:, None], jnp.array([3.0, 4.0, 5.0])[:, None]
        axis = jnp.array([2.0, 3.0, 6.0]) / 7
        angle = jnp.sum(size * jnp.sin(w * t[None]), 0)
        omega = jnp.sum(size * w * jnp.cos(w * t[None]), 0)
        X = se3.exp(jnp.concatenate([jnp.zeros((3, t.size)), jnp.outer(axis, angle)]))
        force = se3.rotate_inverse(X, jnp.array([0.0, 0.0, imu.gravity])[:, None])
        samples = jnp.concatenate([force, jnp.outer(axis, omega)]).T

        def over(memory, given):
            return take(imu, memory, *given)

        numbers = jnp.arange(t.size, dtype=t.dtype)
        start = Samples.start(samples[0, 3:])
        _, found = jax.lax.scan(over, start, (samples, numbers))
        zero = jnp.zeros(3)
        x = Navigation(se3.identity(), jnp.array([0.3, -0.2, 0.1]), zero, zero, zero[:0])

        def step(x, row):
            increment = sample_increment(row[1:4], row[4:7], row[0] / rate)
            return apply(x, increment, imu.gravity), None

        x, _ = jax.lax.scan(step, x, found)
        v_W = se3.rotate(x.X_WB, x.v_B)
        return float(jnp.linalg.norm(v_W - jnp.array([0.3, -0.2, 0.1])))

    coarse, fine = moved(50.0), moved(100.0)
    assert coarse < 0.01
    assert coarse / fine == pytest.approx(4, rel=0.15)
