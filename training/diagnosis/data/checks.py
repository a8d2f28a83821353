"""Faults of the data, and what is not identifiable from them, found before any model is fitted."""

from collections.abc import Sequence
from functools import partial

import numpy as np
from jaxtyping import Float

from ....models.config.errors import UserError
from ....models.recordings.checks.small_speeds import DeadZone, dead_zones
from ....models.recordings.pieces import good_pieces
from ....models.recordings.schema import UNEVEN
from ....models.recordings.store import Recording
from ....models.se3 import AXES, TWIST, XYZ
from .arrays import Data
from .faults import INSTRUMENTS, STUCK, Faults, faults_of

_HELD = 0.25
"""Share of the samples that repeat the one before where an instrument is slower than the rows."""
_MOSTLY = 0.5
"""Share of the samples that counts as most of them."""
_LEAST_ROWS, _LEAST_SECONDS = 60, 3.0
"""Least data that a diagnosis needs."""
_NAMED = 3
"""Most runs that a sentence names."""
_STILL = 0.02
"""Share of the strongest axis' command below which an axis counts as not driven."""


def problems(recording: Recording) -> tuple[list[str], list[int]]:
    """Stuck sensors, jumps of pose and clock, outliers, gaps.

    One sentence each, and the runs (by number, scenario by scenario) that have them. A channel is
    stuck where it repeats one value exactly for longer than half a second while others change; it
    is no fault if it does so in every run and is part of the pose (a vehicle held in place).
    Samples on a straight line in all velocities were filled in: a gap or a jump of the clock. The
    clock has jumped where a step is longer than others, but the motion is that of a usual step. An
    outlier is a single velocity far from both its neighbours, which agree: no impact is that short.
    Where a quarter of the samples repeat those before, an instrument is slower than the rows.
    Where a DVL loses small speeds, repeated values are these, and no fault of a run.

    Raises:
        UserError: a velocity has the sign opposite to the motion of the pose.
    """
    runs = list(recording.trajectories())
    zones = dead_zones(runs)
    faults = [faults_of(run, recording.dt, zones, n) for n, run in enumerate(runs)]
    names = [run.scenario for run in runs]
    held = {name: [f.held[i] for f in faults] for i, name in enumerate(INSTRUMENTS)}
    _refuse_signs([f.agreeing for f in faults], int(recording.lengths.sum()))
    stuck = _stuck(faults)
    jumps, clock, spiked, filled = (
        [n for n, f in enumerate(faults) if getattr(f, kind)]
        for kind in ("jumps", "late", "spiked", "filled")
    )
    which = partial(_listed, names)
    found = [
        f"{channel} repeats one value for {STUCK:g} s or more in {which(runs)}: stuck? Give the "
        "column without it, or leave the run out"
        for channel, runs in stuck.items()
    ]
    found += _slower(held, stuck, zones)
    if jumps:
        found.append(f"the position jumps by far more than the velocity says in {which(jumps)}")
    if clock:
        found.append(
            f"time stamps jump by {max(f.late for f in faults):.2g} s in {which(clock)}, while the "
            "vehicle moves on as in one step: a jump of the clock; mend the column t"
        )
    if filled:
        found.append(
            "samples were filled in on a straight line, for up to "
            f"{max(f.filled for f in faults):.2g} s, in "
            f"{which(filled)}: lost samples or a jump of the clock"
        )
    if spiked:
        far = "single velocities lie far from both their neighbours in"
        found.append(f"{far} {which(spiked)}: outliers")
    found += [
        f"samples are missing, or the clock jumped: {note}"
        for note in recording.notes
        if "cut at" in note
    ]
    found += [str(zone) for zone in zones]
    bad = sorted({*jumps, *clock, *filled, *spiked, *(n for runs in stuck.values() for n in runs)})
    if bad and len(bad) < len(names):
        found[0] += f" (left out: {len(bad)} of {len(names)} runs)"
    return found, bad


def without_faults(recording: Recording) -> Recording:
    """The recording without the faulty stretches of its runs, for one whose runs all have some.

    A channel that stands still in most of a run is one that does not move there. Pieces of a second
    or more remain; the recording itself where these are less than half of it.
    """
    runs, dt = list(recording.trajectories()), recording.dt
    zones = dead_zones(runs)
    faults = [faults_of(run, dt, zones, n) for n, run in enumerate(runs)]
    stuck, pieces = _stuck(faults), []
    for run, f in zip(runs, faults, strict=True):
        bad = f.samples.copy()
        for channel, where in f.stuck.items():
            if channel in stuck and where.mean() < _MOSTLY:
                bad |= where
        t = run.sensors.get(UNEVEN, dt * np.arange(len(run)))
        pieces += good_pieces(run, t, ~bad)
    if sum(map(len, pieces)) < _MOSTLY * recording.lengths.sum():
        return recording
    kept = Recording.from_trajectories(pieces, dt).dataset
    return Recording(kept.assign_attrs(recording.dataset.attrs))


def _slower(
    held: dict[str, list[float]], stuck: dict[str, list[int]], zones: Sequence[DeadZone]
) -> list[str]:
    """Instruments that are slower than the rows."""
    return [
        f"{name} repeat the sample before in {np.median(shares):.0%} of the rows: the instrument "
        "is slower, and what is late by that is no cause; give rows at its rate"
        for name, shares in held.items()
        if np.median(shares) > _HELD
        and not any(c in channel for channel in stuck for c in name)
        and not (name == "u,v,w" and zones)
    ]


def _stuck(faults: list[Faults]) -> dict[str, list[int]]:
    """Runs in which a channel is stuck; a pose that is so in all runs was held in place."""
    channels = dict.fromkeys(c for f in faults for c in f.stuck)
    runs = {c: [n for n, f in enumerate(faults) if c in f.stuck] for c in channels}
    return {c: r for c, r in runs.items() if len(r) < len(faults) or c in TWIST}


def _listed(names: list[str], numbers: list[int]) -> str:
    """Scenarios of some runs, with the repetition where there are several."""
    listed = []
    for number in numbers[:_NAMED]:
        first = names.index(names[number])
        several = names.count(names[number]) > 1
        listed.append(names[number] + (f" (run {number - first + 1})" if several else ""))
    more = f" and {len(numbers) - _NAMED} more" if len(numbers) > _NAMED else ""
    return f"{', '.join(listed)}{more}"


def _refuse_signs(agreeing: Sequence[Float[np.ndarray, "3 6"]], samples: int) -> None:
    """Refuse wrong signs; `agreeing`: sums of motion times velocity, and of the squares of both."""
    product, square, moved = sum(agreeing, np.zeros((3, 6)))
    slope = product / np.maximum(square, 1e-12)
    left = np.maximum(moved - slope * product, 0.0) / max(samples, 1)
    error = np.sqrt(left / np.maximum(square, 1e-12))
    turned = [c for c, s, e in zip("uvwpqr", slope, error, strict=True) if s < -max(0.5, 5 * e)]
    if turned:
        raise UserError(
            f"{', '.join(turned)}: the recorded sign is opposite to the motion of the pose. B is x "
            "forward, y left, z up, rates are right-handed about these axes, W is z up: turn the "
            "sign of the column, or state the frames of the files (frames: NED/FRD)"
        )


def require_enough(data: Data) -> None:
    """Refuse data that are too few.

    Raises:
        UserError: they are too few.
    """
    seconds = data.steps * data.dt
    if data.steps < _LEAST_ROWS or seconds < _LEAST_SECONDS:
        raise UserError(
            f"recording: runs that are long enough have {data.steps} samples, {seconds:.2g} s in "
            f"all: too little for a diagnosis. Give runs of some seconds, at least "
            f"{_LEAST_SECONDS:g} s and {_LEAST_ROWS} samples together"
        )


_ABOVE = 0.5
"""Median height (m) above the surface from which depth counts as unknown."""
_SETTLED = 0.5
"""Share of a velocity's error that is left after a step, below which it settles within the step."""
SPARSE = 1.5
"""Steps between samples of commands from which these count as sparse."""


def unexcited(data: Data, wrench_of: np.ndarray) -> list[str]:
    """Axes that were not driven: effects along them are not identifiable from these data.

    `wrench_of` (6, n) is the wrench of unit thruster forces.
    """
    w = data.weight[:, None]
    if not np.any((data.u != data.u[:1, :, :1]) & (w > 0)):
        return list(AXES)
    F = np.einsum("ij,njr->nir", wrench_of, data.u)
    rms = np.sqrt((F**2 * w).sum(axis=(0, 2)) / data.weight.sum())
    scale = np.repeat([rms[:3].max(), rms[3:].max()], 3)
    return [a for a, f, s in zip(AXES, rms, scale, strict=True) if f <= _STILL * s]


def _of_latent(data: Data) -> list[str]:
    """What velocities that were not measured leave unknown."""
    names = ", ".join(TWIST[i] for i in data.latent)
    found = [
        f"{names} were not measured: they are simulated by the model, other motions compared with "
        "the records; errors of a DVL, currents and the tether are not identifiable"
    ]
    if data.felt:
        axes = ", ".join(AXES[i] for i in data.felt)
        found.append(
            f"{axes}: the accelerometer alone tells of them: a constant push there looks like its "
            "bias, and fast changes alone tell thrust from drag"
        )
    if data.unseen:
        found.append(
            f"{', '.join(data.unseen)}: no instrument tells of this motion, so drag, inertia and "
            "thrust there stay as believed; log u, v (a DVL), or the accelerometer at every sample"
        )
    return found


def settled(kept: np.ndarray, dt: float) -> list[str]:
    """Axes that settle within a step, by the share `kept` of their errors over one (6,)."""
    fast = [axis for axis, share in zip(AXES, kept, strict=True) if share < _SETTLED]
    if not fast:
        return []
    return [
        f"{', '.join(fast)} settle within about a step of {1e3 * dt:.3g} ms: the data tell thrust "
        "over drag there, but each alone is uncertain beyond its interval; log attitude, rates and "
        "outputs at 50 Hz or more"
    ]


def limits(
    data: Data,
    quiet: list[str],
    resampled: bool,
    estimated: bool = False,
    command_period: float = 0.0,
) -> list[str]:
    """What is not identifiable from these data, one sentence each."""
    found = [
        f"{axis} was not driven: its drag and inertia are not identifiable from these data"
        for axis in quiet
    ]
    height = float(np.median(data.X[:-1, 6][data.weight > 0]))
    if height > _ABOVE:
        found.append(
            f"positions lie {height:.1f} m above the surface (z is up, 0 there): what depends on "
            "depth is not identifiable; if z is down in the files, give frames: NED/FRD"
        )
    if data.command == "F_Bo_B":
        found.append("commands are wrenches: single thrusters are not identifiable")
    if data.latent:
        found += _of_latent(data)
    elif data.reckoned:
        axes = data.unmeasured or [XYZ[i] for i in data.reckoned]
        how = "were not measured" if data.unmeasured else "follow the recorded velocities"
        found.append(
            f"{', '.join(axes)} of the position {how} (dead-reckoned): errors of the DVL and of "
            "the heading show in the forces alone, so that small ones are not identifiable"
        )
    if not data.has_voltage:
        found.append("no voltage was recorded: voltage_sag is not identifiable")
    if resampled:
        found.append(
            "time steps were uneven: effects of a tenth of a step in time, and rare impacts, "
            "are not distinguishable from the resampling"
        )
    if command_period > SPARSE * data.dt:
        found.append(
            f"commands were logged at {1 / command_period:.3g} Hz: what they did in between is not "
            f"known, so lags and delays below {command_period:.2g} s and what turns settle to "
            "within that time are uncertain beyond their intervals; log outputs at 50 Hz or more"
        )
    if estimated:
        found.append(
            "the states are a filter's estimate, with slow errors of its own: laws of the "
            "disturbance and unmodelled structure are not distinguishable from them, and samples "
            "count for fewer than there are"
        )
    if data.left_out == "run":
        found.append(
            "there is one scenario: runs were left out in turn, so other motions stay unknown"
        )
    if data.left_out == "block":
        found.append(
            "there are few runs: blocks of them were left out in turn, so other runs stay unknown"
        )
    return found
