"""`spinndrift export`: a run or a recording as MCAP, for Foxglove and PlotJuggler."""

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import Positional, arg

from ...models.config.errors import UserError
from ...models.files.interrupts import interrupts_held
from ..progress import console, progress_bar

if TYPE_CHECKING:
    from ...models.recordings.store import Recording
    from ..reports.figures_path import Scene

_SUFFIX, _LAYOUT = ".mcap", ".json"


@dataclass(frozen=True)
class Export:
    """Write a run or a recording as an MCAP file, which Foxglove and PlotJuggler open.

    The file has frames, poses, the path, plans with the sampled paths, the scene and a log in
    Foxglove's well-known messages, and everything else as numbers to plot (docs/export.md).
    """

    EXAMPLES: ClassVar = (
        "spinndrift export runs/pylon_crossing_harbour-1 harbour.mcap",
        "spinndrift export dive.nc dive.mcap --layout layout.json",
    )

    data: Annotated[Positional[Path], arg(metavar="DATA")]
    """Folder of a run, recording (.nc), log (.tlog, .BIN), ROS bag or CSV folder."""
    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """File to write (.mcap)."""
    layout: Path | None = None
    """Also write Foxglove's layout for these files there (.json)."""
    scenario: tuple[str, ...] = ()
    """Only these scenarios of the recording."""

    @contextmanager
    def place(self) -> Iterator[None]:
        """Check and lock the outputs."""
        with interrupts_held():
            from ...models.files.owned import output_file
            from ..export.layout import is_layout
            from ..export.mcap_file import checked_package, is_ours

        if self.out.suffix != _SUFFIX:
            raise UserError(f"{self.out}: give a name ending in {_SUFFIX}")
        if self.layout is not None and self.layout.suffix != _LAYOUT:
            raise UserError(f"--layout {self.layout}: give a name ending in {_LAYOUT}")
        checked_package(self.out)
        with ExitStack() as stack:
            stack.enter_context(output_file(self.out, is_ours, "MCAP file of spinndrift", ""))
            if self.layout is not None:
                own = output_file(self.layout, is_layout, "layout of spinndrift", "--layout")
                stack.enter_context(own)
            yield

    def run(self) -> None:
        """Read and write."""
        with interrupts_held():
            from ..export.content import write_recording
            from ..export.layout import write_layout
            from ..export.mcap_file import mcap_file

        recording, scene, said = self._read()
        if self.scenario:
            try:
                recording = recording.select(self.scenario)
            except UserError as error:
                raise UserError(f"{self.data}: --{error}") from error
        with progress_bar(f"writing {self.out.name}") as update, mcap_file(self.out) as into:
            duration = write_recording(into, recording, scene, said, update)
        shown = console()
        shown.print(f"wrote {self.out}: {duration:.1f} s", markup=False)
        if self.layout is not None:
            write_layout(self.layout)
            shown.print(f"wrote {self.layout}", markup=False)

    def _read(self) -> "tuple[Recording, Scene | None, list[str]]":
        """The recording, and of a run its surroundings and its outcome in words."""
        with interrupts_held():
            from ...models.recordings.store import Recording
            from ...systems.logs.load import load_data

        if not (self.data / "log.nc").is_file():
            recording = load_data(self.data)
            return recording, _hull(recording.vehicle), []
        return Recording.load(self.data / "log.nc"), *self._told()

    def _told(self) -> "tuple[Scene | None, list[str]]":
        """Surroundings and outcome of a run's folder, as far as its files are there."""
        with interrupts_held():
            from ...models.config import typed_yaml
            from ..export.content import outcome_of
            from ..run.folder import scene
            from ..scenarios.scenario import Scenario

        around, said = None, []
        if (self.data / "scenario.yaml").is_file():
            around = scene(typed_yaml.load(Scenario, self.data / "scenario.yaml"))
        if (self.data / "metrics.json").is_file():
            try:
                found = json.loads((self.data / "metrics.json").read_text(encoding="utf-8"))
            except ValueError as error:
                raise UserError(
                    f"{self.data / 'metrics.json'}: is no JSON; restore it or move it away"
                ) from error
            said = outcome_of(found) if isinstance(found, dict) else []
        return around, said


def _hull(named: str) -> "Scene | None":
    """The hull of a recording's vehicle; None if it names none, or one that is not here."""
    with interrupts_held():
        from ...models.vehicles.vehicle import load_vehicle
        from ..reports.figures_path import Scene

    try:
        return Scene(load_vehicle(named).size) if named else None
    except UserError:
        return None
