"""`spinndrift evaluate`: errors of a model on data that it was not trained on."""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import Positional, arg

from ...models.config.checks import SECONDS
from ...models.config.errors import UserError
from ...models.files.interrupts import interrupts_held
from ..progress import console, progress_bar


@dataclass(frozen=True)
class Evaluate:
    """Compare a learned model and its preset with data.

    Prints errors, coverage of the 50 % and 90 % bands and energy scores over all horizons, and
    writes them against the horizon. All of DATA is used: give data not used in training.
    """

    EXAMPLES: ClassVar = (
        "spinndrift evaluate runs/mine/model.spinn sea.nc",
        "spinndrift evaluate runs/tank/model.spinn harbour.nc --length 2 --out errors.csv",
    )

    model: Annotated[Positional[Path], arg(metavar="MODEL")]
    """Model file (.spinn)."""
    data: Annotated[Positional[Path], arg(metavar="DATA")]
    """Recording (.nc), log (.tlog, .BIN), ROS bag or CSV folder."""
    out: Path | None = None
    """File for the results: .csv (tidy), .json (overall) or .nc."""
    length: Annotated[float, SECONDS] = 4.0
    """Length of each window (s)."""
    vehicle: str | None = None
    """Preset name or YAML file to compare with; by default what the model names."""
    accept: tuple[str, ...] = ()
    """Words of severe findings on the data that are accepted (docs/checks.md), such as no-commands.
    """

    def place(self) -> AbstractContextManager[Path | None]:
        """Check and lock the outputs."""
        with interrupts_held():
            from ...models.files.owned import output_file
            from ...training.evaluation.evaluate import is_evaluation

        if self.out is None:
            return nullcontext()
        return output_file(self.out, is_evaluation, "evaluation of spinndrift")

    def run(self) -> None:
        """Load, predict, compare."""
        with interrupts_held():
            from ...models.recordings.checks.examine import examine
            from ...models.recordings.checks.finding import check_accepted
            from ...models.vehicles.places import load_named
            from ...models.vehicles.vehicle import load_vehicle
            from ...systems.logs.load import load_data
            from ...training.data.windows import window_places
            from ..learning import Start, compare, prepared
            from ..reports.findings import print_findings

        if self.out is not None and self.out.suffix not in (".csv", ".json", ".nc"):
            raise UserError(f"--out {self.out}: end the name in .csv, .json or .nc")
        check_accepted(self.accept)
        if self.data.suffix == ".spinn" and self.model.suffix != ".spinn":
            raise UserError(
                f"{self.model}: the model, a .spinn file, comes first and the data second: "
                f"spinndrift evaluate {self.data} {self.model}"
            )
        start, metadata = Start.read(self.model)
        if self.vehicle is not None:
            vehicle = load_vehicle(self.vehicle)
        else:
            vehicle = load_named(metadata.get("vehicle") or "bluerov2_heavy", str(self.model))
        with progress_bar(f"reading {self.data.name}") as update:
            recording = load_data(
                self.data, vehicle=self.vehicle, accept=self.accept, progress=update
            )
        window_places(recording, self.length, self.length)  # refuses what is too short now
        recording = examine(recording, vehicle, str(self.data), self.accept)
        with progress_bar("evaluating"):
            models, windows = prepared(recording, vehicle, start, self.length)
            found = compare(models, windows)
        if self.out is not None:
            found.save(self.out)
        shown = console()
        print_findings(shown, recording)
        shown.print(f"{len(windows['learned'])} windows of {self.length:g} s")
        shown.print(found.summary())
        if self.out is not None:
            shown.print(f"wrote {self.out}")
