"""Velocities that an instrument loses below some speed: it shows zero, or what it showed last.

Speeds are continuous: recorded ones thin out towards zero no more than a constant density does, so
that of n samples below 2 w as many lie below w as above, or (1/2)³ of the speeds of three
components. An instrument with a dead zone shows none below w. Its lost samples begin and end at
small speeds; those of an instrument that fails begin and end at any.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.stats
from jaxtyping import Bool, Float

from ...se3 import AXES
from ..build import Trajectory

_CHANCE = 1e-6
"""Probability by chance below which a dead zone is told, over all components and both kinds."""
_BESIDE = 1e-3
"""The same for small speeds beside lost samples, where speeds leave a gap, which is rare."""
_SAME = 1e-9
"""m/s: rounding of a file."""
_TRIED = 8
"""Three components and their norm, zero or held."""
_EDGE95 = 3.0
"""Mean distances between samples within which the edge lies with 95 %: ln 20 of an exponential."""


@dataclass(frozen=True)
class DeadZone:
    """Speeds below `width` that an instrument loses.

    Attributes:
        where: axis of the component, or `all` where the speed of all three decides.
        width: m/s.
        interval95: of the width (m/s).
        holds: whether the last value is repeated instead of zero.
        chance: probability that speeds would leave such a gap by chance.
        gain: nats won on each run by the gap found in the others (R,).
        lost: samples of each run that are lost.
    """

    where: str
    width: float
    interval95: tuple[float, float]
    holds: bool
    chance: float
    gain: Float[np.ndarray, " R"]
    lost: tuple[Bool[np.ndarray, " N"], ...]

    @property
    def axes(self) -> list[int]:
        """The components that are lost, by index."""
        return [0, 1, 2] if self.where == "all" else [AXES.index(self.where)]

    @property
    def share(self) -> float:
        """Share of all samples that are lost."""
        return float(np.concatenate(self.lost).mean())

    def __str__(self) -> str:
        columns = ", ".join("uvw"[i] for i in self.axes)
        shown = "show the value before" if self.holds else "are recorded as 0"
        return (
            f"{columns}: speeds below {self.width:.2g} m/s {shown}, in {self.share:.0%} of the "
            "samples: the DVL loses small speeds"
        )


def dead_zones(runs: Sequence[Trajectory]) -> list[DeadZone]:
    """Dead zones of the components, or of their speed together, that the records of all runs show.

    Samples at which no component of the whole twist differs from zero are those of a vehicle at
    rest, and tell nothing.
    """
    twists = [run.V_WB_B for run in runs]
    measured = np.all([np.isfinite(V[:, :3]).all(axis=0) for V in twists] or [[False] * 3], axis=0)
    found = [z for i in np.flatnonzero(measured) for z in _zones(twists, [int(i)])]
    return found or (list(_zones(twists, [0, 1, 2])) if measured.all() else [])


def _zones(twists: list[np.ndarray], axes: list[int]) -> Iterator[DeadZone]:
    """The dead zone of some components, of one kind at most."""
    speeds = [np.linalg.norm(V[:, axes], axis=1) for V in twists]
    rest = [np.all(V == 0, axis=1) for V in twists]
    held = [_repeats(V[:, axes]) for V in twists]
    new = [np.append(False, (np.diff(V, axis=0) != 0).any(axis=1)) for V in twists]
    for holds in (False, True):
        lost = [
            ((v < _SAME) | (h & n & holds)) & ~r
            for v, h, n, r in zip(speeds, held, new, rest, strict=True)
        ]
        fresh = [~(a | h | r) for a, h, r in zip(lost, held, rest, strict=True)]
        beside = [_beside(v, a, r) for v, a, r in zip(speeds, lost, rest, strict=True)]
        of_runs = [v[f] for v, f in zip(speeds, fresh, strict=True)]
        zone = _zone(of_runs, np.concatenate(beside), lost, axes, holds)
        if zone is not None:
            yield zone
            return


def _repeats(v: np.ndarray) -> Bool[np.ndarray, " N"]:
    return np.append(False, (np.diff(v, axis=0) == 0).all(axis=1))


def _zone(
    of_runs: list[np.ndarray],
    edges: Float[np.ndarray, " e"],
    lost: list[np.ndarray],
    axes: list[int],
    holds: bool,
) -> DeadZone | None:
    """The dead zone that new speeds of each run, and those at the `edges` of lost ones, show."""
    seen = np.concatenate(of_runs)
    if not len(seen) or not len(edges):
        return None
    width = float(seen.min())
    if width <= _SAME:
        return None
    inside = _inside(seen, width, len(axes))
    near = int((seen < 2 * width).sum())
    gap = _TRIED * (1 - inside) ** near
    test = scipy.stats.mannwhitneyu(edges, seen, alternative="less", method="asymptotic")
    if gap > _CHANCE or test.pvalue * _TRIED > _BESIDE:
        return None
    apart = width / near
    return DeadZone(
        "all" if len(axes) > 1 else AXES[axes[0]],
        width - apart,
        (width - _EDGE95 * apart, width),
        holds,
        gap,
        np.array([_gain(of_runs, k, len(axes)) for k in range(len(of_runs))]),
        tuple(lost),
    )


def _beside(v: np.ndarray, lost: np.ndarray, rest: np.ndarray) -> Float[np.ndarray, " e"]:
    """Speeds beside stretches of lost ones that begin within the run."""
    found = []
    for start, stop in pairwise(np.flatnonzero(np.diff(lost.astype(int))).tolist()):
        if lost[stop] and not lost[start]:
            found += [v[i] for i in (start, stop + 1) if not rest[i]]
    return np.array(found)


def _inside(seen: np.ndarray, width: float, size: int) -> float:
    """Share of speeds below twice a width that lie below it, in a constant density.

    Where an instrument shows multiples of a step, the first one above zero is one step.
    """
    levels = np.unique(np.round(seen[seen < 2 * width + _SAME] / _SAME)) * _SAME
    step = float(np.diff(np.append(0.0, levels)).min(initial=width))
    below, above = max(width / step - 1, 0.0), width / step
    return (below / (below + above)) ** size


def _gain(of_runs: list[np.ndarray], k: int, size: int) -> float:
    """Nats that a run wins by the gap of the others, over a constant density of speeds."""
    others = [v for j, v in enumerate(of_runs) if j != k] or of_runs
    rest, own = np.concatenate(others), of_runs[k]
    if not len(rest) or rest.min() <= _SAME:
        return 0.0
    width = float(rest.min())
    inside, near = _inside(rest, width, size), int((rest < 2 * width).sum())
    rare, own = 1 / (near + 2), own[own < 2 * width]
    hit = int((own < width).sum())
    if inside <= 0:
        return 0.0
    beyond = np.log1p(-rare) - np.log1p(-inside)
    return float(hit * np.log(rare / inside) + (len(own) - hit) * beyond)
