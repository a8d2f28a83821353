"""Readings of sensors that tell of velocities without an instrument."""

from collections.abc import Sequence

import numpy as np

from ....models.recordings.build import window
from ....models.recordings.schema import observed
from ....models.recordings.store import Recording

_READ, _BRIDGED = 0.9, 0.5
"""Least share of the samples at which a sensor has a reading, and longest gap (s) that is
interpolated: the one that an import allows in the state (`LogOptions.gap`)."""


def with_velocity(recording: Recording) -> tuple[Recording, str]:
    """The runs whose velocity was measured, if they hold most of the samples, and a sentence.

    Else all runs and none: then the velocity counts as not measured in any of them.
    """
    lengths, V = recording.lengths, recording.dataset["V_WB_B"].to_numpy()
    measured = observed(V, recording.mask)[..., :3].all(axis=-1) & (lengths > 0)
    seconds, total = recording.dt * lengths[measured].sum(), recording.dt * lengths.sum()
    if measured.sum() == (lengths > 0).sum() or seconds <= total / 2:
        return recording, ""
    kept = window(recording.dataset, np.zeros_like(lengths), np.where(measured, lengths, 0))
    return Recording(kept), (
        f"in {total - seconds:.0f} of {total:.0f} s the velocity was not measured: these runs are "
        "left out"
    )


def sensors_of_latent(recording: Recording, latent: Sequence[int]) -> dict[str, np.ndarray]:
    """Readings that tell of latent velocities, where every run has them.

    Single lost samples are interpolated, as those of the state are.
    """
    found = {}
    wanted = {"specific_force": "imu_specific_force", "climb": "vertical_velocity"}
    for name, variable in wanted.items() if latent else ():
        if variable not in recording.dataset:
            continue
        values = _bridged(recording, variable)
        if values is not None:
            found[name] = values
    if 2 in latent:
        found.pop("climb", None)
    return found


def _bridged(recording: Recording, variable: str) -> np.ndarray | None:
    """Readings with their gaps interpolated; None if in a run they are too long or too many."""
    values = recording.dataset[variable].to_numpy().copy()
    for j, k in np.argwhere(recording.lengths > 0):
        length = int(recording.lengths[j, k])
        own = values[j, k, :length].reshape(length, -1)
        there = np.isfinite(own).all(axis=1)
        t = recording.elapsed(int(j), int(k))
        longest = max(_BRIDGED, 1.5 * recording.dt)
        if there.mean() < _READ or np.diff(t[there], prepend=t[0], append=t[-1]).max() > longest:
            return None
        for x in own.T:
            x[~there] = np.interp(t[~there], t[there], x[there])
    return values
