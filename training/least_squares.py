"""Damped least squares: the loop that all fits by Gauss–Newton steps or Fisher scoring share.

At any x a fit gives its loss there and the minimiser of a quadratic model of it under a damping
λ. A step that raises the loss is tried again with more damping; after a step that lowers it λ is
reduced (Levenberg 1944; Marquardt 1963; Nocedal and Wright 2006, section 10.3). How λ enters, and
how bounds do, is the fit's own; `marquardt` is the usual way. SciPy's `least_squares` needs the
whole Jacobian in memory and errors that are independent; these fits sum JᵀJ piece by piece, or
minimise likelihoods of covariances.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_TRIES = 8
"""Dampings that a step is tried with."""


class LocalModel(NamedTuple):
    """A loss about a point x.

    Attributes:
        now: the loss at x.
        loss: the loss elsewhere; where errors are weighted anew at every x, with the weights of x.
        stepped: the minimiser of the quadratic model at x, by its damping.
    """

    now: float
    loss: Callable[[Float[np.ndarray, " k"]], float]
    stepped: Callable[[float], Float[np.ndarray, " k"]]


class Damping(NamedTuple):
    """λ of the first step, least λ after a step that failed, least λ of all; factor of changes."""

    start: float = 1e-3
    after_failure: float = 1e-2
    least: float = 1e-6
    factor: float = 10.0


USUAL = Damping()


def minimise(
    x: Float[np.ndarray, " k"],
    model: Callable[[Float[np.ndarray, " k"]], LocalModel],
    rounds: int,
    enough: float,
    damping: Damping = USUAL,
) -> Float[np.ndarray, " k"]:
    """Minimise a loss from a first guess, given its local model at every x.

    The fit ends after `rounds` steps, after one that gains less than `enough`, or where no damping
    gives a finite loss that is no larger.
    """
    strength = damping.start
    for _ in range(rounds):
        now, loss, stepped = model(x)
        for _ in range(_TRIES):
            trial = stepped(strength)
            then = loss(trial)
            if then <= now and np.isfinite(then):
                break
            strength = max(damping.factor * strength, damping.after_failure)
        else:
            return x
        x, strength = trial, max(strength / damping.factor, damping.least)
        if now - then < enough:
            break
    return x


def marquardt(
    H: Float[np.ndarray, "k k"], g: Float[np.ndarray, " k"], damping: float
) -> Float[np.ndarray, " k"]:
    """-(H + λ diag H)⁻¹ g, which does not depend on units; 1e-9 for parameters without effect."""
    return -np.linalg.solve(H + np.diag(damping * np.diag(H) + 1e-9), g)
