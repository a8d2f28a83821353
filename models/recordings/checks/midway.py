"""Columns or directions of commands that change in the middle of a record.

The record is cut into blocks whose responses add up. At each place between two of them, the
commands as they are must explain what is on one side, and clearly better with one change what is on
the other.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ...vehicles.vehicle import Vehicle
from ..build import Trajectory
from ..pieces import good_pieces
from ..store import Recording
from .columns import columns_of
from .finding import Finding
from .hypotheses import CAUSAL, EVIDENCE, LEAST_COUNT, PLAUSIBLE, Driven
from .orders import with_changes
from .response import AxisResponse, responses_along

ORDERS = ("columns-exchanged", "axis-reversed", "thruster-reversed", "thruster-exchanged")
"""Words of what may change in mid-record."""
_BLOCK_S, _MOST, _COARSE = 5.0, 60, 10
"""s of a block; most blocks, which are longer in long records; places that are tried first."""


@dataclass(frozen=True)
class Parts:
    """A recording before and after a place: seconds in a stretch."""

    halves: tuple[Recording, Recording]
    place: tuple[float, str]

    def placed(self, finding: Finding, late: bool) -> Finding:
        """The finding of one part, with its place."""
        seconds, run = self.place
        where = f"from {seconds:.0f} s on" if late else f"until {seconds:.0f} s"
        text = f"{finding.text}, in this part of the record alone"
        return replace(finding, place=f"{finding.place}; {run}, {where}", text=text)


def changed_midway(recording: Recording, vehicle: Vehicle | None, data: Driven) -> Parts | None:
    """The parts between which columns or directions change; None if they do not."""
    columns = columns_of(recording, vehicle)
    tried = data.judged or (tuple(range(6)) if recording.thrust_from == "F_Bo_B" else ())
    if columns is None or not tried:
        return None
    whole = recording.dt * float(recording.lengths.sum())
    seconds = max(_BLOCK_S, whole / _MOST)
    blocks = responses_along(recording, columns[0], recording.command_period, seconds)
    start = np.nan_to_num(recording.dataset["start_time"].to_numpy())
    blocks.sort(key=lambda block: (start[block[0]], block[0], block[1]))
    changes = [("reversed", k, k) for k in tried]
    changes += [("exchanged", a, b) for a, b in combinations(tried, 2)]
    weights = np.stack([data.weights, *(with_changes(data, [one]) for one in changes)], axis=-1)
    least = EVIDENCE + np.log(max(len(blocks), 1))

    def worth(n: int) -> float:
        """Nats that a change at the beginning of block n gives; 0 unless both sides are clear."""
        sides = [_sum([axes for _, _, axes in part]) for part in (blocks[:n], blocks[n:])]
        gains = [_gains(replace(data, axes=_judged(side, data)), weights) for side in sides]
        both = [(early, late) for early, late in (gains, [-gain for gain in gains])]
        found = [np.where(np.minimum(-a, b) > least, b - a, 0.0) for a, b in both]
        return float(np.max(found))

    step = max(-(-len(blocks) // _COARSE), 1)
    coarse = max(range(step, len(blocks), step), key=worth, default=0)
    if not coarse or not worth(coarse):
        return None
    at = max(range(max(coarse - step + 1, 1), min(coarse + step, len(blocks))), key=worth)
    return _parts(recording, [(run, sample) for run, sample, _ in blocks], at)


def _judged(side: dict[int, AxisResponse], data: Driven) -> dict[int, AxisResponse]:
    return {i: r for i, r in side.items() if i in data.axes and r.count >= LEAST_COUNT}


def _gains(data: Driven, weights: np.ndarray) -> np.ndarray:
    """Nats by which each change explains the motion better than the commands as they are."""
    if not data.axes:
        return np.zeros(weights.shape[-1] - 1)
    usual = data.best(weights[..., :1], PLAUSIBLE)[0]
    return data.best(weights[..., 1:], CAUSAL, strict=True)[0] - usual


def _sum(blocks: list[dict[int, AxisResponse]]) -> dict[int, AxisResponse]:
    found: dict[int, AxisResponse] = {}
    for block in blocks:
        for i, r in block.items():
            found[i] = r if i not in found else _added(found[i], r)
    return found


def _added(a: AxisResponse, b: AxisResponse) -> AxisResponse:
    return AxisResponse(
        a.RR + b.RR, a.RC + b.RC, a.CC + b.CC, a.count + b.count, a.windows + b.windows
    )


def _parts(
    recording: Recording, blocks: list[tuple[tuple[int, int], int]], at: int
) -> Parts | None:
    """The recording before and after the beginning of a block, in the order of the blocks."""
    here, sample = blocks[at]
    seconds = sample * recording.dt
    before = {run for run, _ in blocks[:at]}
    runs = [(int(j), int(k)) for j, k in np.argwhere(recording.lengths > 0)]
    halves: tuple[list[Trajectory], list[Trajectory]] = ([], [])
    for own, run in zip(runs, recording.trajectories(), strict=True):
        t = recording.elapsed(*own)
        late = t - t[0] >= seconds if own == here else np.full(len(t), own not in before)
        halves[0].extend(good_pieces(run, t, ~late))
        halves[1].extend(good_pieces(run, t, late))
    if not all(halves):
        return None
    start = float(np.nan_to_num(recording.dataset["start_time"].to_numpy()[here]))
    kept = [Recording.from_trajectories(half, recording.dt) for half in halves]
    attrs = recording.dataset.attrs
    early, late_ = (Recording(one.dataset.assign_attrs(attrs)) for one in kept)
    return Parts((early, late_), (start + seconds, str(recording.scenarios[here[0]])))
