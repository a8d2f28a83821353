"""`spinndrift import`: a log or a CSV folder to a Recording."""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import FlagCreatePairsOff, Positional

from ...models.config.checks import WATER_DENSITY, Within
from ...models.config.errors import UserError
from ...models.files.interrupts import interrupts_held
from ..progress import console, progress_bar


@dataclass(frozen=True)
class Import:
    """Convert a log to a Recording, the input of the other commands.

    Reads ArduPilot DataFlash logs (.BIN), MAVLink telemetry logs (.tlog), both also as .gz or .xz,
    ROS bags (.bag, .db3, .mcap or their folder; needs the extra `ros`) and folders of CSV files
    (docs/recording.md). Clocks are aligned, everything is resampled to one
    rate, and the summary says what the log lacks and what can therefore not be learned from it.
    """

    EXAMPLES: ClassVar = (
        "spinndrift import sims/data/sitl_dive.tlog.xz --out dive.nc",
        "spinndrift import sims/data/sitl_dive.tlog.xz --rate 50 --water-density 1025 --out sea.nc",
    )

    log: Positional[Path]
    """The log file, ROS bag or CSV folder."""
    out: Path | None = None
    """File to write (.nc); by default the log's name in the current folder."""
    rate: Annotated[float | None, Within(1, 400)] = None
    """Samples per second; by default 20 for a log or a bag, for CSV files that of their
    recording.yaml, else their own, and that of a recording."""
    vehicle: str | None = None
    """Preset name or YAML file of the vehicle; by default what the data name, or for a log bluerov2
    if its frame has six thrusters, else bluerov2_heavy."""

    minimum: Annotated[float, Within(0.5, 3600)] = 5.0
    """Shortest stretch of a log that is kept (s)."""
    gap: Annotated[float, Within(0.01, 60)] = 0.5
    """Longest pause between samples of one of a log's signals (s); a longer one ends a stretch."""
    water_density: Annotated[float | None, WATER_DENSITY] = None
    """kg/m³, if a log's autopilot assumed fresh water in the sea: corrects depth and climb."""
    disarmed: Annotated[bool, FlagCreatePairsOff] = False
    """Keep a log's disarmed stretches too."""
    system: Annotated[int | None, Within(1, 255)] = None
    """MAVLink system id, if a log holds several autopilots."""
    topics: tuple[Path, ...] | None = None
    """Topic map of a ROS bag (YAML); without a file, print a proposal and import nothing."""
    align: Path | None = None
    """Recording of the same dive (.nc), or the folder of its run: the log is cut to it, with its
    samples, times and world frame, as with a .BIN that is fetched from the vehicle."""
    accept: tuple[str, ...] = ()
    """Words of severe findings on the data that are accepted (docs/checks.md), such as no-commands.
    """

    def place(self) -> AbstractContextManager[Path]:
        """Check and lock the outputs."""
        if self._asks():
            return nullcontext(self.log)
        with interrupts_held():
            from ...models.files.owned import output_file
            from ...models.recordings.store import Recording

        return output_file(self._out(), Recording.is_one, "recording of spinndrift")

    def run(self) -> None:
        """Read, convert, write, summarise."""
        with interrupts_held():
            from ...models.recordings.checks.examine import examine
            from ...models.recordings.checks.finding import check_accepted
            from ...models.recordings.summary import summarize
            from ...models.vehicles.places import load_named
            from ...models.vehicles.vehicle import load_vehicle
            from ...systems.logs.load import LogOptions, load_data
            from ..acceptance import acceptance
            from ..reports.findings import print_findings

        check_accepted(self.accept)
        if self._asks():
            self._propose()
            return
        out = self._out()
        if out.suffix != ".nc":
            raise UserError(f"--out {out}: a Recording is a NetCDF file; give a name ending in .nc")
        if self.align is not None and self.rate is not None:
            raise UserError(
                f"--rate {self.rate:g}: the rate is that of --align {self.align}; leave --rate away"
            )
        if self.vehicle is not None:
            load_vehicle(self.vehicle)  # fails now, not after the data are read
        options = LogOptions(
            self.minimum,
            self.gap,
            self.water_density,
            self.disarmed,
            self.system,
            self._map(),
            self.align,
        )
        with progress_bar(f"reading {self.log.name}") as update:
            recording = load_data(
                self.log,
                rate=self.rate,
                vehicle=self.vehicle,
                options=options,
                accept=self.accept,
                progress=update,
            )
        named = recording.vehicle
        vehicle = load_named(named, str(self.log)) if named else None
        recording = examine(recording, vehicle, str(self.log), self.accept)
        recording.save(out)
        shown = console()
        shown.print(summarize(recording), markup=False)
        print_findings(shown, recording)
        if vehicle is not None and (told := vehicle.instability()):
            shown.print(told)
        shown.print("what the other commands can use of it:")
        for line in acceptance(recording):
            shown.print(f"  {line}", markup=False, soft_wrap=True)
        shown.print(f"wrote {out}")

    def _asks(self) -> bool:
        """Whether `--topics` was given without a file."""
        return self.topics is not None and not self.topics

    def _map(self) -> Path | None:
        files = list(self.topics or ())
        if len(files) > 1:
            raise UserError(
                f"--topics {files[0]}: give one file, or none for a proposal; the log stands "
                "before it"
            )
        return files[0] if files else None

    def _propose(self) -> None:
        """Print the topic map that an import without one takes."""
        with interrupts_held():
            from ...systems.logs.bags.bag import open_bag
            from ...systems.logs.bags.propose import propose, written

        if self.out is not None:
            raise UserError(
                f"--out {self.out}: --topics without a file prints a proposal and writes nothing; "
                "leave --out away and redirect the output"
            )
        with open_bag(self.log) as bag:
            try:
                print(written(bag, propose(bag)), end="")  # noqa: T201 - the command's output
            except UserError as error:
                raise UserError(f"{self.log}: {error}") from error

    def _out(self) -> Path:
        return self.out if self.out is not None else Path(f"{stem(self.log)}.nc")


def stem(path: Path) -> str:
    """A file's name without the suffixes of its format and compression."""
    name = path.name
    for ending in (".xz", ".gz"):
        name = name.removesuffix(ending)
    return Path(name).stem or "recording"
