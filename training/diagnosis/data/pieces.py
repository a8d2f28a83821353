"""Runs cut into pieces that are filtered side by side."""

import itertools
from collections.abc import Iterator

import numpy as np

_OF_STEPS = ("rise",)
"""What belongs to the step after a sample; else to the sample."""


def cut(
    X: np.ndarray, V: np.ndarray, u: np.ndarray, volts: np.ndarray, times: np.ndarray,
    sensors: dict[str, np.ndarray], first: int, segment: int, behind: int,
) -> Iterator[dict[str, np.ndarray]]:  # fmt: skip
    """Pieces of a run from sample `first` on, with the commands of `behind` steps before each."""
    held = np.diff(times)
    last = len(held)
    count = -(-(last - first) // segment)
    edges = np.linspace(first, last, count + 1).round().astype(int)
    for a, b in itertools.pairwise(edges):
        before = np.maximum(np.arange(a - behind, a), 0)
        yield {
            "X": X[a : b + 1], "V": V[a : b + 1], "u": u[a:b], "past": u[before],
            "past_step": held[before], "voltage": volts[a:b], "step": held[a:b],
            "began": times[a : a + 1],
            **{name: values[a : b + (name not in _OF_STEPS)] for name, values in sensors.items()},
        }  # fmt: skip


def stack(parts: list[np.ndarray]) -> np.ndarray:
    """Parts side by side, the last value held to the length of the longest."""
    length = max(len(p) for p in parts)
    padded = [np.concatenate([p, np.repeat(p[-1:], length - len(p), axis=0)]) for p in parts]
    return np.stack(padded, axis=-1)


def weight_of(sizes: np.ndarray) -> np.ndarray:
    """1 for the steps that pieces of these sizes have, else 0 (N, R)."""
    return (np.arange(sizes.max())[:, None] < sizes).astype(float)
