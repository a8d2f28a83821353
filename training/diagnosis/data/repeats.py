"""Repeated runs: those with the same commands share the deterministic errors of a simulation."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ....models.se3 import AXES
from .arrays import Data

_ALIKE = 0.1
"""Share of their size by which commands of repeated runs may differ, as with the supply voltage."""
_CLEARLY, _MUCH = 6.0, 4.0
"""Standard errors, and ratio to chance, from which errors count as repeating: the mean effect of a
large current that is drawn for every run is about twice that of chance.
"""


class Shares(NamedTuple):
    """Variances by origin, of each axis, 1 for unit white noise; nan where no runs repeat.

    Attributes:
        between: of the means of runs, times their length.
        together: of the means of repeated runs at each step, times their number.
        within: of repeated runs around those means.
        unsure: standard error of `together` by chance, as a share of it.
    """

    between: Float[np.ndarray, " a"]
    together: Float[np.ndarray, " a"]
    within: Float[np.ndarray, " a"]
    unsure: Float[np.ndarray, " a"]


def repeats(d: Data) -> list[Int[np.ndarray, " _"]]:
    """Pieces that had the same commands at the same steps, two or more together."""
    size = max(float(np.abs(d.u).mean()), 1e-9)
    found, left = [], [int(r) for r in np.flatnonzero(d.weight.any(axis=0))]
    while left:
        first = left[0]
        alike = [
            r for r in left
            if np.array_equal(d.weight[:, r], d.weight[:, first])
            and np.abs(d.u[..., r] - d.u[..., first]).mean() < _ALIKE * size
        ]  # fmt: skip
        left = [r for r in left if r not in alike]
        if len(alike) > 1:
            found.append(np.array(alike))
    return found


def shares(z: Float[np.ndarray, "N a R"], d: Data) -> Shares:
    """Decomposition of the variance of whitened errors by origin."""
    n = d.weight.sum(axis=0)
    some = n > 0
    means = (z * d.weight[:, None]).sum(axis=0)[:, some] / n[some]
    between = (means**2 * n[some]).mean(axis=1)
    steps, axes = 0, z.shape[1]
    together, within, memory = np.zeros((3, axes))
    for group in repeats(d):
        own = z[:, :, group][d.weight[:, group[0]] > 0]
        mean = own.mean(axis=2)
        steps += len(own)
        together += (len(group) * mean**2).sum(axis=0)
        within += ((own - mean[..., None]) ** 2).sum(axis=(0, 2)) / (len(group) - 1)
        square = np.maximum((mean**2).sum(axis=0), 1e-300)
        for lag in range(1, len(own)):
            memory += len(own) * ((mean[lag:] * mean[:-lag]).sum(axis=0) / square) ** 2
    if not steps:
        none = np.full(axes, np.nan)
        return Shares(between, none, none, none)
    unsure = np.sqrt(2 / steps * (1 + 2 * memory / steps))
    return Shares(between, together / steps, within / steps, unsure)


def repeating(z: Float[np.ndarray, "N 12 R"], d: Data) -> dict[str, float]:
    """Axes whose errors repeat clearly more than chance, with the ratio to it."""
    found = shares(z[:, 6:].astype(float), d)
    if np.isnan(found.together).all():
        return {}
    ratio = found.together / np.maximum(found.within, 1e-300)
    least = np.maximum(_MUCH, 1 + _CLEARLY * found.unsure)
    return {axis: float(r) for axis, r, low in zip(AXES, ratio, least, strict=True) if r > low}
