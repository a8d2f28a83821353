"""Pooled groups: windows that are samples of one law because they share scenario and start.

A law's moments need several observations. Windows of the runs of one scenario that begin at the
same time on the runs' clocks form a group. Their initial states differ, so a group's law is the
mixture over its initial states, for the prediction as for the data.
"""

import numpy as np
from jaxtyping import Int

from ...models.config.errors import UserError
from .windows import Windows


def group_labels(windows: Windows) -> Int[np.ndarray, " W"]:
    """A number for each window, equal where scenario and start agree (to half a step)."""
    ticks = np.round(windows.start / windows.dt).astype(int)
    keys = np.stack([windows.scenario, ticks])
    return np.unique(keys, axis=1, return_inverse=True)[1].reshape(-1)


def members(
    labels: Int[np.ndarray, " W"], usable: Int[np.ndarray, " U"], size: int
) -> list[Int[np.ndarray, " _"]]:
    """The usable windows of every group that has at least `size` of them."""
    own = labels[usable]
    found = (usable[own == label] for label in np.unique(own))
    return [indices for indices in found if indices.size >= size]


def group_size(windows: Windows, at_most: int) -> int:
    """Number of windows per group in a step: `at_most`, or the median group size if smaller.

    Raises:
        UserError: groups have one window only.
    """
    sizes = np.unique(group_labels(windows), return_counts=True)[1]
    size = min(at_most, int(np.median(sizes)))
    if size < 2:
        raise UserError(
            "moments need several runs of a scenario with windows that start at the same time, "
            f"but most of the {sizes.size} groups have one; record runs that repeat, or train "
            "with finite dimensional matching"
        )
    return size


def batch_indices(seed: int, number: int, batch: int, usable: np.ndarray) -> np.ndarray:
    """Indices of one step: consecutive parts of repeated shuffles of all of `usable`.

    A function of its arguments alone, so that a resumed run draws the same indices.
    """
    count = usable.size
    positions = np.arange(number * batch, (number + 1) * batch)
    chosen = np.empty(batch, int)
    for epoch in range(int(positions[0] // count), int(positions[-1] // count) + 1):
        order = np.random.default_rng([seed, epoch]).permutation(count)
        here = positions // count == epoch
        chosen[here] = order[positions[here] % count]
    return usable[chosen]


def step_indices(
    seed: int,
    number: int,
    batch: int,
    usable: Int[np.ndarray, " U"],
    labels: Int[np.ndarray, " W"],
    size: int,
) -> Int[np.ndarray, " B"]:
    """Windows of one step, about `batch` of them: whole groups one after the other if `size` > 1.

    Groups are shuffled as windows are; from a larger group `size` windows are drawn each time.
    The number of indices depends on `batch` and `size` alone. Empty if no group is large enough.
    """
    if size == 1:
        drawn = batch_indices(seed, number, min(batch, usable.size), usable)
        return np.resize(drawn, batch)
    groups = members(labels, usable, size)
    if not groups:
        return np.empty(0, int)
    chosen = batch_indices(seed, number, max(1, batch // size), np.arange(len(groups)))
    rng = np.random.default_rng([seed, number, size])
    return np.concatenate([rng.permutation(groups[g])[:size] for g in chosen])


def whole_groups(windows: Windows, size: int, at_most: int) -> Windows:
    """About `at_most` windows in groups of exactly `size`, evenly spread; small ones repeat."""
    if size == 1:
        return windows.thin(at_most)
    groups = members(group_labels(windows), np.arange(len(windows)), 1)
    kept = max(1, min(at_most // size, len(groups)))
    chosen = np.linspace(0, len(groups) - 1, kept).round().astype(int)
    return windows.take(np.concatenate([np.resize(groups[g], size) for g in chosen]))
