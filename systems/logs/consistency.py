"""Whether the streams of a log fit each other: poses and velocities, heights and climb, gravity.

An integrated velocity that gives the displacements only in another unit, or with another sign, was
recorded in another convention than the rest.
"""

from collections.abc import Sequence

import numpy as np

from ...models.recordings.build import Trajectory
from ...models.recordings.checks.finding import Finding
from ...models.recordings.checks.velocity import lag_findings
from ...models.recordings.conventions import LENGTHS, SPEEDS
from ...models.recordings.kinematics import UNNAMED, contradictions
from ...models.recordings.store import Recording
from .signals import Signals

_MOST = 0.5
"""Share of the recorded time in which a convention must be wrong."""
_FAST = 0.2
"""m/s rms: an idle vehicle's estimate drifts by a few cm/s."""
_WINDOW_S, _LEAST_M, _FEWEST = 2.0, 0.2, 10
"""Changes of height over windows are compared if their rms is as large and they are as many: a
barometer's noise is 0.1 to 0.3 m."""
_FITS, _BETTER = 0.7, 0.3
"""Share of the squared change that the right climb explains, and what it leaves of the rest."""
_SCALES = {
    "has the other sign than the height": -1.0,
    **{f"looks like {unit}": size for unit, size in SPEEDS.items()},
    **{
        f"is in m/s, while the height looks like {unit}": 1 / size for unit, size in LENGTHS.items()
    },
}


def motion_findings(
    signals: Signals, kept: Sequence[Trajectory], recording: Recording
) -> list[Finding]:
    """Poses and velocities that contradict each other in most of the recorded time.

    Those that are shifted in time do too: they are findings of the recording, whatever its source.
    """
    sources = {
        "p,q,r": dict.fromkeys([signals.attitude.source, signals.rates.source]),
        "u,v,w": dict.fromkeys(
            s.source for s in (signals.position, signals.velocity) if s is not None
        ),
    }
    dt, lengths = recording.dt, dict[tuple[str, str], int]()
    for k in kept:
        errors, _ = contradictions(dt * np.arange(len(k)), k.X_WB.T, k.V_WB_B.T)
        for error in errors:
            found, reading = error.split(": ", 1)
            what = next(name for name in sources if name in found)
            lengths[what, reading] = lengths.get((what, reading), 0) + len(k)
    whole = sum(len(k) for k in kept)
    often = [key for key, n in lengths.items() if n > _MOST * whole]
    late = {f.place for f in lag_findings(recording)} if often else set()
    told = []
    for what, reading in often:
        place = ", ".join(sources[what])
        if reading != UNNAMED:
            told.append(_contradiction(place, *reading.split("; ", 1)))
        elif what not in late and (what == "p,q,r" or _fast(kept)):
            text = f"{what} and the poses contradict each other: no unit or sign explains it"
            told.append(_contradiction(place, text, UNNAMED))
    return told or _climb_findings(signals, kept, dt)


def _fast(kept: Sequence[Trajectory]) -> bool:
    """Whether the vehicle moves so fast that an estimate's own errors are small against it."""
    speeds = np.concatenate([np.sum(k.V_WB_B[:, :3] ** 2, axis=1) for k in kept])
    return bool(np.sqrt(np.nanmean(speeds)) > _FAST) if np.isfinite(speeds).any() else False


def _contradiction(place: str, text: str, remedy: str = "") -> Finding:
    mend = "give the log with the streams as the autopilot sends them, or its data as CSV"
    return Finding("motion-contradiction", place, text, f"{remedy}: {mend}" if remedy else mend)


def _climb_findings(signals: Signals, kept: Sequence[Trajectory], dt: float) -> list[Finding]:
    """A climb that fits the height only in another unit, or with the other sign."""
    if signals.position is None or signals.velocity is None:
        return []
    n = max(round(_WINDOW_S / dt), 1)
    pairs = []
    for k in kept:
        climb = k.sensors.get("vertical_velocity")
        if climb is None or not np.isfinite(climb).all() or not np.isfinite(k.X_WB[:, 6]).all():
            continue
        path = np.concatenate([[0.0], np.cumsum((climb[1:] + climb[:-1]) / 2 * dt)])
        pairs.append(np.stack([np.diff(k.X_WB[::n, 6]), np.diff(path[::n])]))
    moved, integral = np.concatenate(pairs, axis=1) if pairs else np.zeros((2, 0))
    size = float(np.sum(moved**2))
    if moved.size < _FEWEST or size < moved.size * _LEAST_M**2:
        return []
    given = float(np.sum((moved - integral) ** 2)) / size
    left = {
        how: float(np.sum((moved - scale * integral) ** 2)) / size for how, scale in _SCALES.items()
    }
    best = min(left, key=lambda how: left[how])
    if left[best] > 1 - _FITS or left[best] > _BETTER * given:
        return []
    place = f"{signals.position.source}, {signals.velocity.source}"
    return [_contradiction(place, f"the climb of {signals.velocity.source} {best}")]
