"""All checks of a recording, and what is left of it."""

from collections.abc import Iterable

import numpy as np

from ...config.errors import UserError
from ...vehicles.vehicle import Vehicle
from ..build import Trajectory
from ..commands import check_count
from ..pieces import good_pieces
from ..schema import UNEVEN
from ..store import Recording
from .columns import columns_of
from .commands import command_findings
from .finding import Finding, check_accepted, enforce, findings_of, with_findings
from .flickers import flicker_finding, mended
from .held_outputs import all_held
from .small_speeds import dead_zones
from .velocity import FASTEST, held_finding, lag_findings, unmeasured, zone_finding


def examine(
    recording: Recording, vehicle: Vehicle | None, source: str, accept: Iterable[str] = ()
) -> Recording:
    """Check a recording; return it without the stretches that were cut, with the findings in it.

    Args:
        recording: of any source; findings of its import are kept.
        vehicle: whose thrusters the commands are; None if it is not known.
        source: named in messages.
        accept: words of severe findings that are accepted.

    Raises:
        UserError: for severe findings that are not accepted, if nothing is left, or if the
            commands are those of another number of thrusters.
    """
    check_accepted(accept)
    _check_thrusters(recording, vehicle, source)
    enforce(source, _in_other_lengths(recording, vehicle), accept)
    recording, mended_ = _without_flickers(recording)
    recording, cut = _without_unmeasured(recording, source)
    recording, held = _without_held(recording, vehicle, source)
    found = [*findings_of(recording.dataset), *mended_, *cut, *held, *lag_findings(recording)]
    found += command_findings(recording, vehicle)
    enforce(source, found, accept)
    return type(recording)(with_findings(recording.dataset, found))


def _check_thrusters(recording: Recording, vehicle: Vehicle | None, source: str) -> None:
    """Refuse commands that the vehicle's thrusters can't turn into a wrench."""
    if vehicle is None or "F_Bo_B" in recording.commands:
        return
    count = len(vehicle.propulsion.mounts)
    try:
        check_count(recording.dataset, recording.commands[0], count, vehicle.name)
    except UserError as error:
        raise UserError(f"{source}: {error}") from error


def _in_other_lengths(recording: Recording, vehicle: Vehicle | None) -> list[Finding]:
    """Velocities too fast for a vehicle that the commands explain in another unit: no failure."""
    speeds = np.abs(recording.dataset["V_WB_B"].to_numpy()[..., :3])
    if not np.nanmax(speeds, initial=0.0) > FASTEST:
        return []
    return [f for f in command_findings(recording, vehicle) if f.word == "length-unit"]


def _without_flickers(recording: Recording) -> tuple[Recording, list[Finding]]:
    """The recording with single poses that lie elsewhere replaced."""
    X, V = (recording.dataset[name].to_numpy() for name in ("X_WB", "V_WB_B"))
    found: list[Finding] = []
    for j, r in np.argwhere(recording.lengths > 1).tolist():
        n, t = int(recording.lengths[j, r]), recording.elapsed(j, r)
        whole = mended(t, X[j, r, :n].T, V[j, r, :n].T)
        if whole is None:
            continue
        if not found:
            X, V = X.copy(), V.copy()
        X[j, r, :n], V[j, r, :n] = whole.X.T, whole.V.T
        start = float(np.nan_to_num(recording.dataset["start_time"].to_numpy()[j, r]))
        found.append(flicker_finding(str(recording.scenarios[j]), start + t[whole.bad]))
    if not found:
        return recording, []
    changed = {
        name: (recording.dataset[name].dims, values, recording.dataset[name].attrs)
        for name, values in (("X_WB", X), ("V_WB_B", V))
    }
    return Recording(recording.dataset.assign(changed)), found


def _without_unmeasured(recording: Recording, source: str) -> tuple[Recording, list[Finding]]:
    """The recording without stretches in which the velocity was not measured."""
    runs = list(recording.trajectories())
    zones = dead_zones(runs)
    found = [zone_finding(zone) for zone in zones]
    pieces: list[Trajectory] = []
    cut = False
    for number, run in enumerate(runs):
        lost = np.zeros((len(run), 3), bool)
        for zone in zones:
            lost[:, zone.axes] |= zone.lost[number][:, None]
        t = run.sensors.get(UNEVEN, recording.dt * np.arange(len(run)))
        bad = np.zeros(len(run), bool)
        for word, columns, samples in unmeasured(run, t, lost):
            at = run.start + t[np.flatnonzero(samples)] - t[0]
            place = f"{run.scenario}, {at[0]:.1f} to {at[-1]:.1f} s, {columns}"
            found.append(held_finding(word, place, columns))
            bad |= samples
        cut |= bool(bad.any())
        pieces += [run] if not bad.any() else good_pieces(run, t, ~bad)
    if not cut:
        return recording, found
    if not pieces:
        raise UserError(f"{source}: {found[-1]}, and nothing is left; record it with a DVL's lock")
    attrs = recording.dataset.attrs
    kept = Recording.from_trajectories(pieces, recording.dt)
    return Recording(kept.dataset.assign_attrs(attrs)), found


def _without_held(
    recording: Recording, vehicle: Vehicle | None, source: str
) -> tuple[Recording, list[Finding]]:
    """The recording without stretches in which the commands were not recorded."""
    columns = columns_of(recording, vehicle)
    held = [] if columns is None else all_held(recording, *columns[:2])
    if not held:
        return recording, []
    pieces: list[Trajectory] = []
    for number, run in enumerate(recording.trajectories()):
        lost = np.any([one.samples for one in held if one.run == number] or [False], axis=0)
        t = recording.dt * np.arange(len(run))
        pieces += good_pieces(run, t, ~lost) if np.any(lost) else [run]
    found = [one.finding for one in held]
    return _of_pieces(recording, pieces, found, source), found


def _of_pieces(
    recording: Recording, pieces: list[Trajectory], found: list[Finding], source: str
) -> Recording:
    if not pieces:
        raise UserError(f"{source}: {found[-1]} Nothing is left of it")
    kept = Recording.from_trajectories(pieces, recording.dt)
    return Recording(kept.dataset.assign_attrs(recording.dataset.attrs))
