"""`spinndrift import`: a log or a CSV folder becomes a Recording."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from ...models.errors import UserError
from ..progress import console, progress_bar


@dataclass(frozen=True)
class Import:
    """Turn a log into a Recording that every other command takes.

    Reads ArduPilot DataFlash logs (.BIN), MAVLink telemetry logs (.tlog), both also as .gz or .xz,
    and folders of CSV files (docs/recording.md). Clocks are aligned, everything is resampled to one
    rate, and the summary says what the log lacks and what can therefore not be learned from it.
    """

    log: Positional[Path]
    """The log file or CSV folder."""
    out: Path | None = None
    """File to write (.nc); by default the log's name in the current folder."""
    rate: float = 20.0
    """Samples a second."""
    vehicle: str | None = None
    """Preset name or YAML file of the vehicle; by default what the data name, or bluerov2_heavy."""

    def run(self) -> None:
        """Read, convert, write, summarise."""
        from ...systems.mavlink.logs import load_data

        out = self.out if self.out is not None else Path(f"{stem(self.log)}.nc")
        if out.suffix != ".nc":
            raise UserError(f"--out {out}: a Recording is a NetCDF file; give a name ending in .nc")
        with progress_bar(f"reading {self.log.name}") as update:
            recording = load_data(self.log, rate=self.rate, vehicle=self.vehicle, progress=update)
        recording.save(out)
        shown = console()
        shown.print(recording.summary())
        shown.print(f"wrote {out}")


def stem(path: Path) -> str:
    """A file's name without the endings of its format and compression."""
    name = path.name
    for ending in (".xz", ".gz"):
        name = name.removesuffix(ending)
    return Path(name).stem or "recording"
