"""Rates of false alarms, from scores of healthy units that were each left out.

Scores of n healthy units and of a further one are exchangeable, so the further one is the largest
of all with the probability 1/(n + 1), and exceeds the k-th largest of the others with k/(n + 1)
(Vovk, Gammerman and Shafer 2005, chapter 2).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Calibration(NamedTuple):
    """A threshold of a score and what healthy units say of it.

    Attributes:
        threshold: alarm above it.
        rate: false alarms asked for.
        counted: least rate of false alarms that so few units can show; `rate` if it is above that.
        units: healthy units that were left out, each in turn.
        alarms: how many of them lie above the threshold.
        theory: threshold by theory alone.
    """

    threshold: float
    rate: float
    counted: float
    units: int
    alarms: int
    theory: float = -np.inf


def calibrate(
    scores: Float[np.ndarray, " n"], rate: float, expected: float = -np.inf
) -> Calibration:
    """The threshold that healthy units exceed at a rate.

    Enough units count the rate: the threshold is one of their scores. With fewer than 1/rate - 1 it
    is the largest of them, or that `expected` from theory if it is higher.

    Args:
        scores: of healthy units, each left out of what it is judged by; larger is worse.
        rate: of false alarms, between 0 and 1.
        expected: threshold by theory.

    Raises:
        ValueError: there are no scores.

    Example:
        >>> calibrate(np.arange(99.0), 0.05).threshold
        94.0
    """
    n = len(scores)
    if n == 0:
        raise ValueError("calibrate.scores is empty: give scores of healthy units")
    above = int(np.floor(rate * (n + 1) + 1e-9))
    ordered = np.sort(scores)
    threshold = float(ordered[n - above]) if above else max(float(ordered[-1]), expected)
    counted = rate if above else 1 / (n + 1)
    return Calibration(threshold, rate, counted, n, int(np.sum(scores > threshold)), expected)
