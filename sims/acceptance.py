"""What each command will take of a recording, and why not the rest: the last lines of an import."""

from collections.abc import Callable

from ..models.config.errors import UserError
from ..models.recordings.store import Recording
from ..models.se3 import TWIST
from ..training.config import TrainingConfig, WindowConfig
from ..training.data.windows import window_places
from ..training.diagnosis.data.arrays import unmeasured_channels

_EVALUATED_S = 4.0
_DIAGNOSED_S = 3.0


def acceptance(recording: Recording) -> list[str]:
    """One line for each command, by the checks that it begins with itself."""
    known = bool(recording.vehicle) or "F_Bo_B" in recording.commands
    told = [] if known else ["No vehicle is named: give --vehicle to every command."]
    checks: dict[str, Callable[[Recording], str]] = {
        "train": _train,
        "evaluate": _evaluate,
        "diagnose": _diagnose,
    }
    for command, check in checks.items():
        try:
            told.append(f"{command}: {check(recording)}")
        except UserError as error:
            told.append(f"{command}: nothing ({str(error).removeprefix('recording: ')})")
    return told


def _train(recording: Recording) -> str:
    config = TrainingConfig().windows
    rest, last = recording.split(config.held_out, config.by, config.gap_s)
    learn = _seconds(rest, config.length_s, config.stride_s)
    judged = _seconds(last, config.length_s, config.length_s)
    return (
        f"{learn:.0f} s to learn from and {judged:.0f} s held out, in windows of "
        f"{config.length_s:g} s{_short(recording, config)}"
    )


def _evaluate(recording: Recording) -> str:
    seconds = _seconds(recording, _EVALUATED_S, _EVALUATED_S)
    return f"{seconds:.0f} s in windows of {_EVALUATED_S:g} s"


def _diagnose(recording: Recording) -> str:
    unmeasured = unmeasured_channels(recording)
    if recording.duration < _DIAGNOSED_S:
        raise UserError(f"{recording.duration:.2g} s in all is too little; record longer")
    velocities = [name for name in unmeasured if name in TWIST]
    dead = f"; {', '.join(unmeasured)} from the velocity" if unmeasured else ""
    if velocities:
        dead = f"; {', '.join(velocities)} not measured, so simulated by the model"
    return f"{recording.duration:.0f} s{dead}"


def _seconds(recording: Recording, length_s: float, stride_s: float) -> float:
    """Time that windows cover (s); refused if none fits."""
    steps, places = window_places(recording, length_s, stride_s)
    covered = {(j, k): 0.0 for j, k, _ in places}
    for j, k, first in places:
        covered[j, k] = max(covered[j, k], (first + steps) * recording.dt)
    return sum(covered.values())


def _short(recording: Recording, config: WindowConfig) -> str:
    """Runs that are too short for a window."""
    lengths = recording.lengths[recording.lengths > 0]
    count = int((lengths <= round(config.length_s / recording.dt)).sum())
    return f"; {count} shorter run{'s' * (count > 1)} left out" if count else ""
