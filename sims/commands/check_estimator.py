"""`spinndrift check estimator`: consistency of the filter, with and without sensor faults."""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from ...models.config.checks import WORKERS, Within
from ...models.files.interrupts import interrupts_held
from ..progress import console, progress_bar
from .check_outputs import check_page, held_outputs, refuse_given_up

if TYPE_CHECKING:
    from ..estimator_check.settings import Setting


@dataclass(frozen=True)
class CheckEstimator:
    """Simulate many seeds of several waters, plants and starts, and of every fault of the sensors.

    The first tables compare errors and innovations with the filter's covariance (NEES and NIS with
    their bounds), the last one shows the effect of sensor faults. Each setting is simulated once:
    the same command resumes an interrupted check. docs/estimator.md explains the tables.
    """

    only: tuple[str, ...] = ()
    """Patterns of the names of settings to simulate (`calm 'dvl_*'`), `consistency` or `faults` for
    all of one kind; by default both."""
    runs: Annotated[int, Within(1, 10_000)] = 60
    """Runs of each setting with healthy sensors."""
    seconds: Annotated[float, Within(1, 86400)] = 60.0
    """Duration of each of these runs (s)."""
    fault_runs: Annotated[int, Within(1, 10_000)] = 50
    """Runs of each fault."""
    fault_seconds: Annotated[float, Within(1, 86400)] = 30.0
    """Duration of each of these runs (s); the fault begins after a third of it."""
    model: Path | None = None
    """Learned model (.spinn) of the plant; by default the demo's, which is trained first."""
    workers: Annotated[int, WORKERS] = 0
    """Worker processes on this machine; 0 simulates all settings in this process."""
    out: Path = Path("runs/estimator")
    """Folder for the results of each setting."""
    docs: Path | None = None
    """Markdown file to write the tables into, such as docs/estimator.md."""

    def place(self) -> AbstractContextManager[None]:
        """Check and lock the outputs."""
        with interrupts_held():
            from ..estimator_check.run import ESTIMATOR

        return held_outputs(self.out, ESTIMATOR, self.docs)

    def run(self) -> None:
        """Simulate, judge, report."""
        with interrupts_held():
            from ..diagnosis_benchmark.tables import print_tables
            from ..estimator_check.pages import page_text
            from ..estimator_check.run import run_settings
            from ..estimator_check.tables import tables
            from ..reports.marked_page import write_measured

        check_page(self.docs)
        settings = self._settings()
        runs = {"consistency": self.runs, "faults": self.fault_runs}
        with progress_bar(f"{len(settings)} settings") as update:
            results, failed = run_settings(settings, self.out, runs, update, self.workers)
        shown = console()
        print_tables(shown, tables(results))
        pages = [self.out / "estimator.md", *([self.docs] if self.docs is not None else [])]
        for page in pages:
            write_measured(page, page_text(results))
        shown.print(f"wrote {pages[-1]}")
        refuse_given_up(failed, "settings")

    def _settings(self) -> list["Setting"]:
        """The settings to simulate; the model is trained first if it is needed but not given."""
        with interrupts_held():
            from ..cores import share_cores
            from ..estimator_check.model import demo_model
            from ..estimator_check.settings import (
                LEARNED,
                chosen,
                consistency_settings,
                fault_settings,
            )

        names = chosen(self.only)
        share_cores()
        model = self.model
        if model is None and LEARNED in names:
            with progress_bar("training the demo's model") as update:
                model = demo_model(self.out / "model", update)
        return [
            *consistency_settings(names, self.seconds, model),
            *fault_settings(names, self.fault_seconds),
        ]
