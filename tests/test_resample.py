"""Resampling: exact where the signal is what the method assumes, right order where it is not."""

import jax.numpy as jnp
import numpy as np
from motion import smooth_motion

from spinndrift.models import se3
from spinndrift.models.recordings.resample import (
    continuous,
    deviation,
    geodesic,
    grid,
    hermite,
    hold,
    linear,
    mean,
    rise,
    slerp,
)

RNG = np.random.default_rng(0)


def uneven(n=40):
    return np.cumsum(RNG.uniform(0.02, 0.3, n))


def test_grid_includes_an_end_that_is_a_whole_number_of_steps_away():
    np.testing.assert_allclose(grid(1.0, 1.3, 0.1), [1.0, 1.1, 1.2, 1.3])
    assert grid(0.0, 0.99, 0.25).size == 4


def test_a_constant_twist_is_reproduced_exactly():
    t = uneven()
    xi = np.array([0.7, -0.3, 0.2, 0.5, -0.8, 1.1])
    screw = np.asarray(se3.exp(jnp.asarray(xi[:, None] * t)))
    new = np.linspace(t[0], t[-1], 101)
    expected = np.asarray(se3.exp(jnp.asarray(xi[:, None] * new)))
    got = geodesic(new, t, screw)
    error = se3.local(jnp.asarray(expected), jnp.asarray(got))
    assert float(jnp.abs(error).max()) < 1e-12
    np.testing.assert_allclose(slerp(new, t, screw[:4]), got[:4], atol=1e-12)


def test_geodesic_agrees_with_se3_interpolate_between_any_poses():
    t = np.array([0.0, 1.0, 2.0, 3.0])
    q = continuous(RNG.normal(size=(4, 4)))
    X = np.concatenate([q, RNG.normal(size=(3, 4))])
    for s in (0.0, 0.3, 0.9):
        expected = se3.interpolate(jnp.asarray(X[:, :-1]), jnp.asarray(X[:, 1:]), s)
        got = geodesic(t[:-1] + s, t, X)
        assert float(jnp.abs(se3.local(expected, jnp.asarray(got))).max()) < 1e-9


def test_linear_and_hermite_are_exact_on_lines_and_cubics_and_hold_at_the_ends():
    t, new = uneven(), np.linspace(0.5, 3.0, 50)
    np.testing.assert_allclose(linear(new, t, 2 * t[None] - 1)[0], 2 * new - 1, atol=1e-12)
    cubic, slope = t**3 - t, 3 * t**2 - 1
    np.testing.assert_allclose(
        hermite(new, t, cubic[None], slope[None])[0], new**3 - new, atol=1e-9
    )
    assert linear(np.array([-1.0, 99.0]), t, t[None])[0].tolist() == [t[0], t[-1]]


def test_hold_is_the_sample_on_its_own_grid_and_keeps_the_impulse_elsewhere():
    t = 0.05 * np.arange(60)
    x = RNG.normal(size=(8, 60))
    np.testing.assert_allclose(hold(t, t, x, 0.05), x, atol=1e-10)
    fast = np.sort(RNG.uniform(0, 3, 500))
    fast[0] = 0.0
    y = RNG.normal(size=500)
    new = grid(0.0, 2.9, 0.1)
    impulse = np.sum(y * np.diff(np.append(fast, 3.0)))
    np.testing.assert_allclose(hold(new, fast, y[None], 0.1).sum() * 0.1, impulse, atol=1e-10)


def test_mean_of_a_line_is_its_middle_and_of_a_sine_its_integral():
    t = np.linspace(0, 3, 3001)
    new = np.linspace(0.5, 2.5, 11)
    np.testing.assert_allclose(mean(new, t, (3 * t)[None], 0.2)[0], 3 * new, atol=1e-10)
    expected = (np.cos(new - 0.1) - np.cos(new + 0.1)) / 0.2
    np.testing.assert_allclose(mean(new, t, np.sin(t)[None], 0.2)[0], expected, atol=1e-6)


def test_deviation_of_a_line_and_of_a_step_at_an_unknown_time():
    t = np.arange(0.0, 8.0)
    middle = np.array([3.5])
    line = np.stack([2.0 * t, np.full(8, 5.0)])
    found = deviation(middle, t, line, 0.5)
    np.testing.assert_allclose(found[:, 0], [2.0 * 0.5 / np.sqrt(12), 0.0], rtol=3e-3, atol=1e-12)
    # between its two samples a step leaves both values equally likely, beside them nothing is open
    step = (t > 3.5).astype(float) * 4.0
    np.testing.assert_allclose(deviation(middle, t, step, 1.0), [2.0], rtol=1e-3)
    np.testing.assert_allclose(deviation(np.array([1.5, 5.5]), t, step, 1.0), 0.0, atol=1e-9)
    # a fine record of a step has the deviation of its two values
    fine = np.arange(0.0, 8.0, 1e-3)
    for share in (0.25, 0.5):
        x = (fine > 3.0 + share).astype(float)
        found = deviation(middle, fine, x, 1.0)
        np.testing.assert_allclose(found, np.sqrt(share * (1 - share)), rtol=0.05)


def test_deviation_of_a_smooth_signal_is_its_own():
    t = np.arange(0.0, 6.0, 0.1)
    middle = np.arange(1.0, 5.0, 0.07)
    fine = middle + 0.1 * ((np.arange(1000) + 0.5)[:, None] / 1000 - 0.5)
    own = np.sin(3 * fine).std(axis=0)
    found = deviation(middle, t, np.sin(3 * t), 0.1)
    # the slope of a line is that at its middle: off by h f''/2 at most
    np.testing.assert_allclose(found, own, atol=0.1 * 9 / 2 * 0.1 / np.sqrt(12))
    assert abs(np.mean(found**2) / np.mean(own**2) - 1) < 0.02


def test_rise_is_that_of_the_best_line():
    t = np.arange(0.0, 3.0, 1e-3)
    line = np.stack([4.0 * t, 1.0 - 2.0 * t])
    np.testing.assert_allclose(rise(np.array([0.5, 1.7]), t, line, 0.4).T, [[1.6, -0.8]] * 2)
    for share in (0.1, 0.5, 0.8):  # a step at a share of the width: 6 s (1 - s) by least squares
        x = (t > 1.0 + 0.4 * share - 0.2 - 1e-9).astype(float)
        found = rise(np.array([1.0]), t, x, 0.4)
        np.testing.assert_allclose(found, 6 * share * (1 - share), atol=0.02)
    at = 0.9 + 0.2 * (np.arange(4000) + 0.5) / 4000
    x = 1500 + 100 * np.sin(40 * t)
    fine = np.interp(at, t, x)
    slope = np.polynomial.polynomial.polyfit(at, fine, 1)[1]
    np.testing.assert_allclose(rise(np.array([1.0]), t, x, 0.2)[0], 0.2 * slope, rtol=0.01)


def test_smooth_motion_converges_with_second_order():
    new = np.linspace(1.0, 9.0, 333)
    exact = smooth_motion(new)[0]
    errors = []
    for step in (0.1, 0.05):
        t = np.arange(0.0, 10.0, step)
        got = geodesic(new, t, smooth_motion(t)[0])
        error = se3.local(jnp.asarray(exact), jnp.asarray(got))
        errors.append(float(jnp.sqrt(jnp.mean(error**2))))
    assert np.log2(errors[0] / errors[1]) > 1.9


def test_no_times_have_no_rotations():
    q = np.array([[1.0, 1], [0, 0], [0, 0], [0, 0]])
    assert slerp(np.zeros(0), np.array([0.0, 1.0]), q).shape == (4, 0)


def test_signs_of_quaternions_are_made_continuous():
    X = smooth_motion(np.arange(0, 10, 0.05))[0]
    flipped = X[:4] * RNG.choice([-1.0, 1.0], X.shape[1])
    smooth = continuous(flipped)
    assert ((smooth[:, 1:] * smooth[:, :-1]).sum(axis=0) > 0.9).all()
    assert smooth[0, 0] >= 0


def test_what_is_unknown_beside_a_sample_does_not_hide_it():
    t, x = np.arange(4.0), np.array([[0.0, 1.0, np.nan, 3.0]])
    found = linear(np.array([0.0, 1.0, 1.5, 2.0, 3.0]), t, x)
    np.testing.assert_array_equal(found, [[0.0, 1.0, np.nan, np.nan, 3.0]])
