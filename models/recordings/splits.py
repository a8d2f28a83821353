"""Which samples of each trajectory are for training, and which are held out."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from ..config.errors import UserError

Lengths = Int[np.ndarray, "J K"]


def time_parts(lengths: Lengths, dt: float, held_out: float, gap: float) -> tuple[Lengths, Lengths]:
    """Where training ends and where the held-out part begins, `gap` (s) later."""
    _check_fraction(held_out)
    skip = int(np.ceil(gap / dt - 1e-9))
    known = np.rint(lengths * (1 - held_out)).astype(int)
    if not (lengths > known + skip).any() or not (known > 1).any():
        raise UserError(
            f"split: trajectories of {lengths.max() * dt:g} s are too short for "
            f"{held_out:g} held out after a gap of {gap:g} s"
        )
    return known, known + skip


def run_parts(
    lengths: Lengths, scenarios: Sequence[str], held_out: float, seed: int | None
) -> tuple[Lengths, Lengths]:
    """The lengths with zero for the held-out runs, and with zero for the others."""
    _check_fraction(held_out)
    learn, test = lengths.copy(), lengths.copy()
    rng = np.random.default_rng(seed) if seed is not None else None
    for j in range(lengths.shape[0]):
        runs = np.flatnonzero(lengths[j])
        if runs.size < 2:
            raise UserError(
                f"split: scenario '{scenarios[j]}' has a single run; split by time "
                "or name the scenarios to hold out"
            )
        order = runs if rng is None else rng.permutation(runs)
        count = int(np.clip(round(held_out * runs.size), 1, runs.size - 1))
        learn[j, order[-count:]] = 0
        test[j, order[:-count]] = 0
    return learn, test


def _check_fraction(held_out: float) -> None:
    if not 0 < held_out < 1:
        raise UserError(f"held_out: must lie between 0 and 1, got {held_out:g}")
