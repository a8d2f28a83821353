"""Steps of the heading against the rates: a compass beside steel, or an estimator that was reset.

Kinematics alone tell them, in which no force is: from sample to sample the attitude turns about the
vertical by what the rates say, and by the change of the heading's error. A step is a change within
a few samples that lasts. Headings are turned back by the steps before a model is fitted: else the
jump of the pose looks like a knock on the vehicle, and what follows it like moving water.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ....models.recordings.build import Trajectory
from ....models.recordings.schema import UNEVEN
from ....models.recordings.store import Recording

LEAST = 0.05
"""Least step (rad), and difference between headings that count as unlike. An autopilot's heading
errs by a third of it for seconds."""
_CLEARLY = 8.0
"""Standard deviations of the difference between neighbouring stretches that a step exceeds."""
_BESIDE, _FEWEST = 0.5, 4
"""Time (s) before and after a step that is compared, and least number of samples there."""
_WITHIN, _MOSTLY = 3, 0.8
"""Steps of the records within which most of the change lies, and its share of it: a log that is
interpolated spreads it over two."""
_SHARE_OF_ONE = 0.1
"""Share of a change below which a step of the records has no part in it."""


_JOINED = 0.5
"""Longest pause (s) after which a run continues the one before: importers cut logs at resets."""


class HeadingStep(NamedTuple):
    """A step of the heading between samples `first` and `last` of a chain, by `size` (rad)."""

    first: int
    last: int
    size: float


class HeadingOff(NamedTuple):
    """A part of the data in which the heading is off.

    Attributes:
        first_run, last_run: runs in which it begins and ends, by number, scenario by scenario.
        start, end: times in these runs (s).
        ends: whether a step ends it, and not the end of the data.
        offset: recorded less true heading (rad, counter-clockwise).
        error: its standard error (rad).
    """

    first_run: int
    start: float
    last_run: int
    end: float
    ends: bool
    offset: float
    error: float


class Chain(NamedTuple):
    """Runs that continue each other: numbers, first samples, times (s), poses and twists."""

    runs: tuple[int, ...]
    first: tuple[int, ...]
    t: Float[np.ndarray, " N"]
    X_WB: Float[np.ndarray, "N 7"]
    V_WB_B: Float[np.ndarray, "N 6"]

    def at(self, sample: int) -> tuple[int, float]:
        """Run of a sample, and time since that run's first one (s)."""
        k = int(np.searchsorted(self.first, sample, side="right")) - 1
        return self.runs[k], float(self.t[sample] - self.t[self.first[k]])


class Kinematics(NamedTuple):
    """Heading less the integral of the rates (rad), and rate about the vertical (rad/s), (N,)."""

    error: Float[np.ndarray, " N"]
    rate: Float[np.ndarray, " N"]


def turned_back(recording: Recording) -> tuple[Recording, list[HeadingOff]]:
    """The recording with the heading as it is most of the time of each run, and where it was not.

    Positions that were integrated with the recorded heading are turned with it.
    """
    runs = list(recording.trajectories())
    chains = _chains(runs, recording.dt)
    steps, error = heading_steps(chains)
    off = [one for c, s in zip(chains, steps, strict=True) for one in _off(c, s, error)]
    if not off:
        return recording, []
    offsets = [_offsets(chain.t, s) for chain, s in zip(chains, steps, strict=True)]
    reckoned = _reckoned(chains, offsets)
    X = recording.dataset["X_WB"].to_numpy().copy()
    at = np.argwhere(recording.lengths > 0).tolist()
    for chain, offset in zip(chains, offsets, strict=True):
        turned = _turned(chain.X_WB, -offset, reckoned)
        for n, a in zip(chain.runs, chain.first, strict=True):
            b = a + len(runs[n])
            if offset[a:b].any():
                j, k = at[n]
                X[j, k, : b - a] = turned[a:b]
    variable = recording.dataset["X_WB"]
    mended = recording.dataset.assign(X_WB=(variable.dims, X, variable.attrs))
    return Recording(mended), off


def _chains(runs: Sequence[Trajectory], dt: float) -> list[Chain]:
    """Runs with those that continue them, in the order of time."""
    times = [run.start + run.sensors.get(UNEVEN, dt * np.arange(len(run))) for run in runs]
    chained: list[list[int]] = []
    for n in sorted(range(len(runs)), key=lambda n: times[n][0]):
        before = times[chained[-1][-1]][-1] if chained else -np.inf
        if 0 < times[n][0] - before <= _JOINED:
            chained[-1].append(n)
        else:
            chained.append([n])
    found = []
    for own in chained:
        first = np.cumsum([0, *(len(runs[n]) for n in own[:-1])]).tolist()
        t = np.concatenate([times[n] for n in own])
        X = np.concatenate([runs[n].X_WB for n in own])
        V = np.concatenate([runs[n].V_WB_B for n in own])
        found.append(Chain(tuple(own), tuple(first), t - t[0], X, V))
    return found


def heading_steps(chains: Sequence[Chain]) -> tuple[list[list[HeadingStep]], float]:
    """Steps of the heading of each chain, and their standard error (rad)."""
    seen = [_kinematics(chain) for chain in chains]
    late = _lateness(seen)
    seen = [k._replace(error=k.error - late * (k.rate - k.rate[:1])) for k in seen]
    beside = [_samples_beside(chain.t) for chain in chains]
    differences = [_differences(k.error, m) for k, m in zip(seen, beside, strict=True)]
    sizes = np.abs(np.concatenate([np.zeros(0), *differences]))
    error = 1.4826 * float(np.median(sizes)) if len(sizes) else 0.0
    least = max(LEAST, _CLEARLY * error)
    found = [
        sorted(_steps(k, D, np.diff(chain.t), m, least))
        for k, D, chain, m in zip(seen, differences, chains, beside, strict=True)
    ]
    return found, error


def _kinematics(chain: Chain) -> Kinematics:
    """Heading against rates; a step over a lost sample adds nothing."""
    q, rates = chain.X_WB[:, [1, 2, 3, 0]], chain.V_WB_B[:, 3:]
    known = np.asarray(np.isfinite(np.concatenate([q, rates], axis=1)).all(axis=1))
    R = Rotation.from_quat(np.where(known[:, None], q, [0.0, 0, 0, 1]))
    rates = np.where(known[:, None], rates, 0.0)
    turn = (R[:-1].inv() * R[1:]).as_rotvec()
    beyond = turn - (rates[1:] + rates[:-1]) / 2 * np.diff(chain.t)[:, None]
    upright = (R[:-1] * Rotation.from_rotvec(turn / 2)).apply(beyond)[:, 2]
    upright[~(known[1:] & known[:-1])] = 0.0
    return Kinematics(np.append(0.0, np.cumsum(upright)), R.apply(rates)[:, 2])


def _lateness(seen: Sequence[Kinematics]) -> float:
    """Time (s) by which rates come before the attitude, negative: what is late is no step."""
    product = square = 0.0
    for k in seen:
        error, change = np.diff(k.error), np.diff(k.rate)
        usual = np.abs(error) < LEAST
        product += float((error * change)[usual].sum())
        square += float((change**2)[usual].sum())
    return product / max(square, 1e-12)


def _samples_beside(t: Float[np.ndarray, " N"]) -> int:
    """Samples of the stretches that are compared."""
    step = float(np.median(np.diff(t))) if len(t) > 1 else _BESIDE
    return max(round(_BESIDE / max(step, 1e-9)), _FEWEST)


def _differences(error: Float[np.ndarray, " N"], beside: int) -> Float[np.ndarray, " M"]:
    """Median after each step of the records less median before, 0 near the ends."""
    found = np.zeros(max(len(error) - 1, 0))
    if len(error) >= 2 * beside:
        medians = np.median(np.lib.stride_tricks.sliding_window_view(error, beside), axis=1)
        found[beside - 1 : len(error) - beside] = medians[beside:] - medians[:-beside]
    return found


def _steps(
    seen: Kinematics,
    differences: Float[np.ndarray, " M"],
    held: Float[np.ndarray, " M"],
    beside: int,
    least: float,
) -> Iterator[HeadingStep]:
    """Changes of more than `least`, largest first, that few steps of the records make.

    Rates between samples may lie anywhere in their range there, so a step exceeds that, too.
    """
    error, left = seen.error, differences.copy()
    while len(left) and np.abs(left).max() > least:
        at = int(np.abs(left).argmax())
        low, high = max(at - beside, 0), min(at + beside + 1, len(left))
        left[low:high] = 0.0
        sign = np.sign(differences[at])
        ends = np.minimum(np.arange(low, high) + _WITHIN, len(error) - 1)
        first = low + int((sign * (error[ends] - error[low:high])).argmax())
        last = min(first + _WITHIN, len(error) - 1)
        change = error[last] - error[first]
        if sign * change < _MOSTLY * abs(differences[at]):
            continue
        part = np.flatnonzero(
            np.abs(np.diff(error[first : last + 1])) > _SHARE_OF_ONE * abs(change)
        )
        first, last = first + int(part[0]), first + int(part[-1]) + 1
        before, after = error[max(first + 1 - beside, 0) : first + 1], error[last : last + beside]
        size = float(np.median(after) - np.median(before))
        reach = np.ptp(seen.rate[max(first - 1, 0) : last + 2]) * held[first:last].sum()
        if abs(size) > least + reach:
            yield HeadingStep(first, last, size)


# ------------------------------------------------------------------------------- turning back


def _levels(
    t: Float[np.ndarray, " N"], steps: Sequence[HeadingStep]
) -> tuple[list[tuple[int, int]], Float[np.ndarray, " s"]]:
    """Stretches between steps (first sample, one after the last), and how far each one is off.

    The heading that lasts longest counts as right, the first of equals; what is like it is.
    """
    edges = [0, *(step.last for step in steps), len(t)]
    level = np.cumsum([0.0, *(step.size for step in steps)])
    lasts = np.array([t[b - 1] - t[a] for a, b in pairwise(edges)])
    alike = np.abs(level[:, None] - level) < LEAST
    right = level[int(np.argmax(np.round(alike @ lasts, 1)))]
    off = level - right
    off[np.abs(off) < LEAST] = 0.0
    return list(pairwise(edges)), off


def _off(chain: Chain, steps: Sequence[HeadingStep], error: float) -> Iterator[HeadingOff]:
    """Parts of a chain in which the heading is off."""
    stretches, levels = _levels(chain.t, steps)
    for (a, b), level in zip(stretches, levels.tolist(), strict=True):
        if level:
            ends = b < len(chain.t)
            to = chain.at(b - 1)
            if ends and b not in chain.first:
                to = chain.at(b)
            yield HeadingOff(*chain.at(a), *to, ends, level, error)


def _offsets(t: Float[np.ndarray, " N"], steps: Sequence[HeadingStep]) -> Float[np.ndarray, " N"]:
    """How far the heading is off at every sample; within a step, a part of it."""
    offset = np.zeros(len(t))
    stretches, levels = _levels(t, steps)
    for (a, b), level in zip(stretches, levels, strict=True):
        offset[a:b] = level
    for step, (before, after) in zip(steps, pairwise(levels.tolist()), strict=True):
        between = np.linspace(before, after, step.last - step.first + 1)
        offset[step.first : step.last + 1] = between
    return offset


def _turned(
    X_WB: Float[np.ndarray, "N 7"], angle: Float[np.ndarray, " N"], reckoned: bool
) -> Float[np.ndarray, "N 7"]:
    """Poses with attitudes turned about the vertical, and if `reckoned` the path with them."""
    found, known = X_WB.copy(), np.asarray(np.isfinite(X_WB[:, :4]).all(axis=1))
    turn = Rotation.from_rotvec(angle[known][:, None] * [0.0, 0.0, 1.0])
    attitude = turn * Rotation.from_quat(X_WB[known][:, [1, 2, 3, 0]])
    found[known, :4] = attitude.as_quat()[:, [3, 0, 1, 2]]
    if reckoned and np.isfinite(X_WB).all():
        halfway = Rotation.from_rotvec((angle[1:] + angle[:-1])[:, None] / 2 * [0.0, 0.0, 1.0])
        path = np.cumsum(halfway.apply(np.diff(X_WB[:, 4:], axis=0)), axis=0)
        found[1:, 4:] = X_WB[0, 4:] + path
    return found


def _reckoned(chains: Sequence[Chain], offsets: Sequence[Float[np.ndarray, " N"]]) -> bool:
    """Whether positions follow the velocities by the recorded heading where that is off."""
    lost = np.zeros(2)
    for chain, offset in zip(chains, offsets, strict=True):
        for k, X in enumerate((chain.X_WB, _turned(chain.X_WB, -offset, False))):
            moved = np.diff(X[:, 4:], axis=0)
            R = Rotation.from_quat(np.nan_to_num(X[:, [1, 2, 3, 0]], nan=1.0))
            v = R.apply(chain.V_WB_B[:, :3])
            apart = moved - (v[1:] + v[:-1]) / 2 * np.diff(chain.t)[:, None]
            there = np.flatnonzero((offset[1:] != 0) & np.isfinite(apart).all(axis=1))
            lost[k] += float((apart[there] ** 2).sum())
    return bool(lost[0] < lost[1])


def in_words(
    off: Sequence[HeadingOff], labels: Sequence[str], notes: Sequence[str] = ()
) -> list[str]:
    """A sentence where the heading is off, or `notes` of an import tell that the attitude jumps."""
    if not off:
        jumps = (note for note in notes if "attitude reset" in note)
        return [f"the attitude jumps against the rates: {note.rstrip('.')}" for note in jumps]
    runs = [labels[n] for n in dict.fromkeys(one.first_run for one in off)]
    more = f" and {len(runs) - 3} more runs" if len(runs) > 3 else ""
    largest = max(off, key=lambda one: abs(one.offset))
    return [
        f"the heading jumps against the rates, by up to {abs(largest.offset):.2g} rad, in "
        f"{', '.join(runs[:3])}{more}: a compass beside steel or a current, or an estimator that "
        "was reset; it was turned back by these jumps"
    ]
