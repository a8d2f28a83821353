"""Samples at which an instrument lost a small speed: what is known of them, and in which errors."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ....models.recordings.checks.small_speeds import DeadZone, dead_zones
from ....models.recordings.store import Recording


def with_lost_zero(
    recording: Recording,
) -> tuple[Recording, tuple[DeadZone, ...], dict[str, Float[np.ndarray, "S K N 6"]]]:
    """The recording with zero for lost velocities, their dead zones, and what they add to records.

    The last is by name (`spread`), scenario, run and sample, and empty where nothing is lost.
    """
    zones = dead_zones(list(recording.trajectories()))
    if not zones:
        return recording, (), {}
    lengths, V = recording.lengths, recording.dataset["V_WB_B"].to_numpy().copy()
    spread = np.zeros_like(V)
    for run, (j, k) in enumerate(np.argwhere(lengths > 0).tolist()):
        spread[j, k, : lengths[j, k]] = spread_of(zones, run, int(lengths[j, k]))
    V[spread > 0] = 0.0
    dataset = recording.dataset.copy()
    dataset["V_WB_B"] = (dataset["V_WB_B"].dims, V, dataset["V_WB_B"].attrs)
    return Recording(dataset), tuple(zones), {"spread": spread}


def spread_of(zones: Sequence[DeadZone], run: int, length: int) -> Float[np.ndarray, "N 6"]:
    """Standard deviations that lost velocities of a run add to their records.

    A lost speed lies anywhere in the zone: w² / 3. Lost samples in a row are lost together, so they
    count as one reading: each has the variance times their number.
    """
    found = np.zeros((length, 6))
    for zone in zones:
        lost = zone.lost[run]
        edges = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]]).astype(int)))
        for start, stop in edges.reshape(-1, 2).tolist():
            found[start:stop, zone.axes] = zone.width * np.sqrt((stop - start) / 3)
    return found


def known_errors(spread: Float[np.ndarray, "M 6 R"]) -> Float[np.ndarray, "N 12 R"]:
    """1 for one-step errors (pose, twist) without a lost velocity in them, else 0.

    Those along an axis need its velocity before and after the step, those of rates all velocities
    before it: moments are products of them (Munk's).
    """
    there = (spread[:, :3] == 0).astype(float)
    along = there[1:] * there[:-1]
    turning = np.repeat(there[:-1].min(axis=1, keepdims=True), 3, axis=1)
    return np.concatenate([along, np.ones_like(along), along, turning], axis=1)
