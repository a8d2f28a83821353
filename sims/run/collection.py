"""A collection: the trajectories of maneuvers that several dives have taken, in one Recording."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...models.config import typed_yaml
from ...models.config.errors import UserError
from ...models.files.atomic import atomic_path
from ...models.files.owned import FolderKind, run_folder
from ...models.recordings.build import Trajectory
from ...models.recordings.store import Recording
from ..scenarios.criteria import Finish, Outcome
from ..scenarios.maneuvers import Bounds, Maneuvers
from ..scenarios.scenario import LogSettings, Scenario
from .before_flight import Tell
from .flight import fly
from .folder import RUN, telemetry_log, write_files
from .live import LivePage
from .loop import Engine, Progress, simulate
from .way import position_note

COLLECTION = FolderKind("collection", ("scenario.yaml", "recording.nc"))
"""What `spinndrift collect` writes, besides a folder `dive-N` of each dive (a run's)."""
_ALIKE = ("maneuvers", "duration", "effort", "rate")
"""Settings in which the trajectories of one collection agree."""
_BELOW_SPINNING = 0.9  # share of the turn rate at which a run counts as spinning


class Collected(NamedTuple):
    """What a call has added.

    Attributes:
        outcome: of its dive; None if nothing was left to fly.
        added: trajectories of this call.
        there: trajectories of the collection.
        wanted: trajectories that it is to have.
    """

    outcome: Outcome | None
    added: int
    there: int
    wanted: int


def maneuver_scenario(scenario: Scenario, settings: Maneuvers) -> Scenario:
    """A scenario's station and link with the controller `settings`, within its bounds.

    Raises:
        UserError: it has obstacles, in whose midst nothing is driven without feedback.
    """
    if scenario.station.obstacles:
        raise UserError(
            f"station.obstacles: {scenario.name} has {len(scenario.station.obstacles)}, and "
            "maneuvers are driven without looking; collect in free water, with --scenario-text "
            "'station: {obstacles: []}'"
        )
    vehicle, link = scenario.station.load_vehicle(), scenario.vehicle_link
    half = vehicle.size[2] / 2
    depths, sides = [half, scenario.station.sensing.water_depth - half], (20.0, 20.0)
    if link is not None:
        safety = link.safety
        depths = [max(depths[0], safety.min_depth), min(depths[1], safety.max_depth)]
        sides = safety.fence
    if depths[1] <= depths[0]:
        raise UserError(
            f"depths of {depths[0]:.1f} to {depths[1]:.1f} m leave no water: check "
            "vehicle_link.safety.max_depth and station.sensing.dvl.water_depth"
        )
    rate = _BELOW_SPINNING * scenario.safety.spin_rate
    bounds = Bounds((depths[0], depths[1]), sides, rate)
    settings = replace(settings, bounds=bounds, positioned=scenario.positioned)
    return replace(
        scenario,
        controller=settings,
        success=Finish(),
        description=f"Maneuvers: {', '.join(settings.maneuvers)}, {settings.repeats} of each.",
        duration=min(settings.longest, 86400.0),
        log=LogSettings(settings.rate, samples=False, covariance=False),
    )


class Collection:
    """The Recording of a folder, written anew in a thread after every trajectory."""

    def __init__(self, folder: Path, scenario: Scenario):
        """Read what a former call has left in a folder that is held.

        Raises:
            UserError: its trajectories are of other settings, another vehicle or another world.
        """
        assert isinstance(scenario.controller, Maneuvers)
        self.folder, self._scenario = folder, scenario
        self.path = folder / "recording.nc"
        self._trajectories: list[Trajectory] = []
        if self.path.exists():
            _check_alike(typed_yaml.load(Scenario, folder / "scenario.yaml"), scenario, folder)
            self._trajectories = list(Recording.load(self.path).trajectories())
        self._due, self._over = threading.Event(), threading.Event()
        self._failed: list[Exception] = []

    @property
    def finished(self) -> tuple[str, ...]:
        """Names and numbers of what is there."""
        return tuple(f"{t.scenario} {int(t.sensors['repeat'][0])}" for t in self._trajectories)

    def left(self) -> Scenario:
        """The scenario without what is there."""
        s = self._scenario
        assert isinstance(s.controller, Maneuvers)
        return replace(s, controller=replace(s.controller, finished=self.finished))

    def keep(self, number: int, trajectory: Trajectory) -> None:
        """Take in a trajectory; it is written soon."""
        repeat = np.full(len(trajectory), float(number))
        sensors = {**trajectory.sensors, "repeat": repeat}
        self._trajectories = [*self._trajectories, replace(trajectory, sensors=sensors)]
        self._due.set()

    @contextmanager
    def written(self) -> Iterator[None]:
        """Write in a thread while the block runs, so that nothing in it has to wait.

        Raises:
            UserError: after the block: the disk is full.
        """
        thread = threading.Thread(target=self._write_all, name="collection", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._over.set()
            self._due.set()
            thread.join()
        if self._failed:
            raise self._failed[0]

    def _write_all(self) -> None:
        while not self._over.is_set() or self._due.is_set():
            self._due.wait()
            self._due.clear()
            try:
                self._save()
            except (UserError, OSError, ValueError) as error:  # raised at the end, unless it passes
                self._failed[:] = [error]
            else:
                self._failed.clear()

    def _save(self) -> None:
        s, there = self._scenario, self._trajectories
        if not there:
            return
        link = s.vehicle_link
        made = f"on the vehicle at {link.connection}" if link else "in simulation"
        recording = Recording.from_trajectories(
            there,
            1 / s.log.rate,
            vehicle=s.station.vehicle,
            source=f"maneuvers of scenario {s.name}, flown {made}",
            notes=_notes(s),
        )
        recording.save(self.path)


def collect(
    scenario: Scenario,
    folder: Path,
    *,
    arm: bool = False,
    report: bool = True,
    engine: Engine = "auto",
    say: Tell = lambda text: None,
    progress: Progress = lambda fraction, remark: None,
    live: LivePage | None = None,
) -> Collected:
    """Fly what a folder (held) lacks of a `maneuver_scenario`, in one dive.

    Each finished trajectory is written at once; one that a guard, the user or a lost estimate ends
    is discarded, and taken again by the next call. The dive's own folder is a run's.

    Raises:
        UserError: as `fly` and `simulate`; the folder has trajectories of other settings; a
            maneuver can't stay within the bounds.
    """
    collection = Collection(folder, scenario)
    before, left = collection.finished, collection.left()
    assert isinstance(left.controller, Maneuvers)
    wanted = len(before) + len(left.controller.wanted())
    if not left.controller.wanted():
        return Collected(None, 0, len(before), wanted)
    shares = {each.maneuver: each.share for each in left.controller.plan(left.station)}
    for name, share in shares.items():
        if share < 1:
            say(f"{name}: {share:.0%} of its effort, so that it stays within depths and fence")
    with atomic_path(folder / "scenario.yaml") as partial:
        partial.write_text(typed_yaml.dump(scenario), encoding="utf-8")
    number = next(n for n in range(1, 100_000) if not (folder / f"dive-{n}").exists())
    with run_folder(folder / f"dive-{number}", RUN, "", new=True) as dive, collection.written():
        if left.vehicle_link is not None:
            told: dict[str, Any] = {"say": say, "progress": progress, "live": live}
            with telemetry_log(dive) as record:
                run = fly(left, arm=arm, record=record, keep=collection.keep, **told)
        else:
            if note := position_note(left):
                say(note)
            seeded = left.with_changes(seed=(left.seed + number - 1) % 2**32)
            run = simulate(seeded, progress, engine, collection.keep, live)
        if live is not None:
            live.end(run.outcome)
        write_files(run, dive, report)
    there = collection.finished
    return Collected(run.outcome, len(there) - len(before), len(there), wanted)


def _check_alike(before: Scenario, now: Scenario, folder: Path) -> None:
    """Refuse to add trajectories of other settings to a collection."""
    one, two = before.controller, now.controller
    assert isinstance(one, Maneuvers)
    assert isinstance(two, Maneuvers)
    pairs: list[tuple[str, Any, Any]] = [(n, getattr(one, n), getattr(two, n)) for n in _ALIKE]
    pairs.append(("vehicle", before.station.vehicle, now.station.vehicle))
    worlds = ("simulated", "a vehicle's")
    old, new = (worlds[s.vehicle_link is not None] for s in (before, now))
    pairs.append(("kind", old, new))
    for name, old, new in pairs:
        if old != new:
            raise UserError(
                f"--out {folder}: its trajectories have {name} {_told(old)}, these "
                f"{_told(new)}; name another folder"
            )


def _told(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, tuple) else f"{value}"


def _notes(scenario: Scenario) -> list[str]:
    settings = scenario.controller
    assert isinstance(settings, Maneuvers)
    notes = [
        f"Each trajectory begins with the end of its rest at the start; {settings.duration:g} s of "
        "its maneuver follow without feedback, where open_loop is 1.",
        "F_Bo_B and pwm are means over each step of what was commanded.",
    ]
    if scenario.vehicle_link is None:
        notes.append("X_WB and V_WB_B are the simulation's truth; the estimates are beside them.")
    elif not scenario.positioned:
        notes.append(
            "The vehicle has no horizontal aid: a start is an attitude, a depth and a heading, at "
            "rest means turn rates and climb, and x, y, u, v are missing."
        )
    else:
        notes.append("X_WB and V_WB_B are the estimate; there is no truth.")
    return notes
