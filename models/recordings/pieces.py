"""Pieces of a run."""

import numpy as np

from .build import Trajectory

_SHORTEST_S = 1.0
"""A shorter piece beside a cut is left out too."""


def good_pieces(run: Trajectory, t: np.ndarray, good: np.ndarray) -> list[Trajectory]:
    """The stretches of good samples that are not too short."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]])))
    found = []
    for a, b in edges.reshape(-1, 2).tolist():
        if t[b - 1] - t[a] < _SHORTEST_S:
            continue
        part = slice(a, b)
        found.append(
            Trajectory(
                run.scenario,
                run.X_WB[part],
                run.V_WB_B[part],
                {name: values[part] for name, values in run.commands.items()},
                {name: values[part] for name, values in run.sensors.items()},
                run.start + float(t[a] - t[0]),
            )
        )
    return found
