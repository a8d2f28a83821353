"""Damped least squares: minima that are known, and losses that are not finite."""

import numpy as np
import pytest

from spinndrift.training.least_squares import Damping, LocalModel, marquardt, minimise


def problem(residuals, jacobian):
    """Half the sum of squares."""

    def loss(x):
        return float(np.sum(residuals(x) ** 2)) / 2

    def local(x):
        J = jacobian(x)
        H, g = J.T @ J, J.T @ residuals(x)
        return LocalModel(loss(x), loss, lambda damping: x + marquardt(H, g, damping))

    return local


def valley(x):
    """Rosenbrock's function, whose minimum is 0 at (1, 1)."""
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def slopes(x):
    return np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])


def test_a_curved_valley_is_followed_to_its_minimum():
    found = minimise(np.array([-1.2, 1.0]), problem(valley, slopes), 100, 1e-20)
    np.testing.assert_allclose(found, [1, 1], atol=1e-9)


def test_a_linear_problem_takes_one_undamped_step():
    rng = np.random.default_rng(0)
    A, b = rng.standard_normal((9, 4)), rng.standard_normal(9)
    local = problem(lambda x: A @ x - b, lambda x: A)
    found = minimise(np.zeros(4), local, 1, 0.0, Damping(start=0.0))
    np.testing.assert_allclose(found, np.linalg.lstsq(A, b)[0], atol=1e-8)


def test_a_damped_step_does_not_depend_on_units():
    """But for 1e-9 on the diagonal, which is at least 1 here."""
    rng, units = np.random.default_rng(1), np.array([1.0, 30.0, 1e3])
    J = rng.standard_normal((9, 3))
    H, g = 10 * J.T @ J, rng.standard_normal(3)
    for damping in (1e-3, 1.0, 1e3):
        other = marquardt(H * np.outer(units, units), g * units, damping) * units
        np.testing.assert_allclose(other, marquardt(H, g, damping), rtol=1e-7)


@pytest.mark.parametrize("beyond", [np.inf, np.nan])
def test_steps_to_losses_that_are_not_finite_are_damped(beyond):
    """The full step of log x = 0 from 4 leads to x = 4 - 4 log 4, where there is no logarithm."""

    def loss(x):
        return float(np.log(x[0]) ** 2) / 2 if x[0] > 0 else beyond

    def local(x):
        H, g = np.array([[1 / x[0] ** 2]]), np.array([np.log(x[0]) / x[0]])
        return LocalModel(loss(x), loss, lambda damping: x + marquardt(H, g, damping))

    np.testing.assert_allclose(minimise(np.array([4.0]), local, 50, 1e-20), [1], atol=1e-9)


def test_where_no_step_is_better_the_start_is_returned():
    start = np.array([3.0])
    uphill = LocalModel(1.0, lambda x: 2.0, lambda damping: start + 1)
    np.testing.assert_array_equal(minimise(start, lambda x: uphill, 5, 0.0), start)
