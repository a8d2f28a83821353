"""What each command will take of a recording, and why not the rest: the last lines of an import."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..models.config.errors import UserError
from ..models.recordings.commands import check_count
from ..models.recordings.store import Recording
from ..models.se3 import TWIST
from ..models.vehicles.vehicle import load_vehicle
from ..training.config import TrainingConfig, WindowConfig
from ..training.data.windows import window_places
from ..training.diagnosis.data.arrays import unmeasured_channels

_EVALUATED_S = 4.0
_DIAGNOSED_S = 3.0
_USUAL = "bluerov2_heavy"
"""The vehicle that the commands take where none is named."""


class _Command(NamedTuple):
    """A command's check of a recording, and the command of the thrusters that it begins with."""

    check: Callable[[Recording], str]
    thrust: Callable[[Recording], str]


def acceptance(recording: Recording) -> list[str]:
    """One line for each command, by the checks that it begins with itself."""
    known = bool(recording.vehicle) or "F_Bo_B" in recording.commands
    told = [] if known else ["No vehicle is named: give --vehicle to every command."]
    commands = {
        "train": _Command(_train, lambda r: r.commands[0]),
        "evaluate": _Command(_evaluate, lambda r: r.commands[0]),
        "diagnose": _Command(_diagnose, lambda r: r.thrust_from),
    }
    for name, command in commands.items():
        try:
            _check_vehicle(recording, command.thrust(recording))
            told.append(f"{name}: {command.check(recording)}")
        except UserError as error:
            told.append(f"{name}: nothing ({str(error).removeprefix('recording: ')})")
    return told


def _check_vehicle(recording: Recording, thrust: str) -> None:
    """Refuse a vehicle that can't be read, or has another number of thrusters than commands."""
    vehicle = load_vehicle(recording.vehicle or _USUAL)
    named = vehicle.name if recording.vehicle else f"{_USUAL}, which is taken where none is named,"
    check_count(recording.dataset, thrust, len(vehicle.propulsion.mounts), named)


def _train(recording: Recording) -> str:
    config = TrainingConfig().windows
    rest, last = recording.split(config.held_out, config.by, config.gap_s)
    remedy = "train with shorter windows (windows: {length_s: …} in a --config)"
    learn = _seconds(rest, config.length_s, config.stride_s, "to learn from", remedy)
    judged = _seconds(last, config.length_s, config.length_s, _held_out(recording, config), remedy)
    return (
        f"{learn:.0f} s to learn from and {judged:.0f} s held out, in windows of "
        f"{config.length_s:g} s{_short(recording, config)}"
    )


def _evaluate(recording: Recording) -> str:
    remedy = "evaluate with a shorter --length"
    seconds = _seconds(recording, _EVALUATED_S, _EVALUATED_S, "", remedy)
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


def _held_out(recording: Recording, config: WindowConfig) -> str:
    """Which part of a recording is held out, in words."""
    by_run = bool((np.count_nonzero(recording.lengths, axis=1) > 1).all())
    if config.by == "run" or (config.by == "auto" and by_run):
        return "held out"
    return f"held out (the last {config.held_out:.0%} of each, less a gap of {config.gap_s:g} s)"


def _seconds(
    recording: Recording, length_s: float, stride_s: float, part: str, remedy: str
) -> float:
    """Time that windows cover (s) of a `part` of the data; refused if none fits."""
    longest = (int(recording.lengths.max()) - 1) * recording.dt
    if not recording.uneven and longest < length_s - recording.dt / 2:
        runs = " ".join(("the longest run", part)).strip()
        raise UserError(
            f"{runs} lasts {longest:.3g} s, and a window needs {length_s:g} s; record longer, or "
            f"{remedy}"
        )
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
