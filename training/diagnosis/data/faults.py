"""Faults of one run: what is wrong, and at which samples."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from ....models.recordings.build import Trajectory
from ....models.recordings.checks.small_speeds import DeadZone
from ....models.recordings.kinematics import spikes
from ....models.recordings.schema import UNEVEN
from ....models.se3 import POSE, TWIST

STUCK = 0.5
"""Time (s) beyond which a channel that repeats its value is stuck."""
INSTRUMENTS = {"x,y,z": (4, 5, 6), "u,v,w": (7, 8, 9), "p,q,r": (10, 11, 12)}
_FILLED = 3  # samples on a straight line
_EVEN_SHARE, _SURE = 0.9, 5.0
"""Least share of even steps for a longer one to be suspect; multiple of noise that it exceeds."""


class Faults(NamedTuple):
    """Faults of one run.

    Attributes:
        stuck: channels that repeat one value, and where.
        held: share of the samples that repeat those before, by instrument.
        jumps: whether the pose jumps.
        late: time by which the clock jumps (s), or 0.
        spiked: whether there are outliers.
        filled: longest time filled in on a straight line (s), or 0.
        agreeing: sums of motion times velocity, and of the squares of both.
        samples: those with a fault other than a stuck channel, or after a jump.
    """

    stuck: dict[str, Bool[np.ndarray, " N"]]
    held: list[float]
    jumps: bool
    late: float
    spiked: bool
    filled: float
    agreeing: Float[np.ndarray, "3 6"]
    samples: Bool[np.ndarray, " N"]


def faults_of(run: Trajectory, dt: float, zones: Sequence[DeadZone], number: int) -> Faults:
    """The faults of a run with a `number`; speeds that a DVL lost are none."""
    lost = np.zeros((len(run), 6), bool)
    for zone in zones:
        lost[:, zone.axes] |= zone.lost[number][:, None]
    state = np.concatenate([run.X_WB, run.V_WB_B], axis=1)
    held = []
    for columns in INSTRUMENTS.values():
        there = [c for c in columns if c < 7 or np.isfinite(state[:, c]).all()]
        same = (np.diff(state[:, there], axis=0) == 0).all(axis=1) & bool(there)
        held.append(float((same & run.V_WB_B[1:].any(axis=1)).mean()))
    elapsed = run.sensors.get(UNEVEN)
    step = np.full(len(state) - 1, dt) if elapsed is None else np.diff(elapsed)
    moved = motion(run.X_WB)
    expected = (run.V_WB_B[1:] + run.V_WB_B[:-1]) / 2
    both = np.isfinite(moved + expected)
    per = np.where(both, moved, 0.0) / step[:, None]
    of = np.where(both, expected, 0.0)
    agreeing = np.array([(per * of).sum(axis=0), (of**2).sum(axis=0), (per**2).sum(axis=0)])
    distance = np.linalg.norm(moved[:, :3], axis=1)
    excess = np.abs(distance - np.linalg.norm(run.V_WB_B[:-1, :3], axis=1) * step)
    known = np.isfinite(excess)
    usual = np.median(excess[known]) if known.any() else 0.0
    jumped = known & (excess > 30 * usual + 0.1)
    late, after = (0.0, jumped) if jumped.any() else clock_jump(moved, expected, step)
    V = run.V_WB_B[:, np.isfinite(run.V_WB_B).all(axis=0)]
    bend = np.abs(np.diff(V, 2, axis=0)).max(axis=1, initial=0.0)
    line = longer(bend < 1e-7 * np.nanstd(V), _FILLED)
    beside = np.pad(lost, ((1, 1), (0, 0)))
    beside = beside[:-2] | lost | beside[2:]  # a good value among lost ones is no outlier
    far = (spikes(run.V_WB_B.T) & ~beside.T).any(axis=0)
    return Faults(
        _stuck(state, np.pad(lost, ((0, 0), (7, 0))), dt),
        held,
        bool(jumped.any()),
        late,
        bool(far.any()),
        (longest(line) + 1) * dt if line.any() else 0.0,
        agreeing,
        np.append(False, after) | np.pad(line, 1) | far,
    )


def _stuck(
    state: Float[np.ndarray, "N 13"], lost: Bool[np.ndarray, "N 13"], dt: float
) -> dict[str, Bool[np.ndarray, " N"]]:
    found = {}
    for label, column, known in zip((*POSE, *TWIST), state.T, lost.T, strict=True):
        still = (np.diff(column) == 0) & ~known[1:]
        if longest(still) * dt > STUCK and np.isfinite(column).all():
            same = longer(still, int(STUCK / dt) + 1)
            found[label] = np.append(False, same) | np.append(same, False)
    return found


def motion(X_WB: Float[np.ndarray, "N 7"]) -> Float[np.ndarray, "M 6"]:
    """Displacement and rotation vector from sample to sample, in B at mid-step."""
    turns = Rotation.from_quat(np.nan_to_num(X_WB[:, [1, 2, 3, 0]], nan=1.0))
    turn = (turns[:-1].inv() * turns[1:]).as_rotvec()
    middle = turns[:-1] * Rotation.from_rotvec(turn / 2)
    turn[~np.isfinite(np.diff(X_WB[:, :4], axis=0)).all(axis=1)] = np.nan
    moved = np.diff(X_WB[:, 4:], axis=0)
    return np.concatenate([middle.inv().apply(moved), turn], axis=1)


def clock_jump(
    moved: Float[np.ndarray, "M 6"], V: Float[np.ndarray, "M 6"], step: Float[np.ndarray, " M"]
) -> tuple[float, Bool[np.ndarray, " M"]]:
    """Time (s) by which the longest step, among even ones, exceeds the motion in it; and where."""
    usual = float(np.median(step))
    even = np.abs(step - usual) < 0.1 * usual
    if even.mean() < _EVEN_SHARE:
        return 0.0, np.zeros(len(step), bool)
    late, where = 0.0, np.zeros(len(step), bool)
    for part in (slice(0, 3), slice(3, 6)):
        off = np.linalg.norm(moved[:, part] - V[:, part] * step[:, None], axis=1)
        as_usual = np.linalg.norm(moved[:, part] - V[:, part] * usual, axis=1)
        if not np.isfinite(off[even]).any():
            continue  # positions that were not measured
        noise = np.nanmedian(off[even])
        jumped = (step > 1.5 * usual) & (off > _SURE * noise) & (as_usual < off / 2)
        late = max(late, float(step[jumped].max(initial=usual)) - usual)
        where |= jumped
    return late, where


def longest(holds: Bool[np.ndarray, " M"]) -> int:
    """Length of the longest stretch in which something holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]).astype(int)))
    return int((edges[1::2] - edges[::2]).max()) if edges.size else 0


def longer(holds: Bool[np.ndarray, " M"], least: int) -> Bool[np.ndarray, " M"]:
    """Where something holds for `least` places in a row."""
    found = np.zeros(len(holds), bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]).astype(int)))
    for start, stop in edges.reshape(-1, 2).tolist():
        found[start:stop] = stop - start >= least
    return found
