"""`spinndrift check`: the accuracy of this package on cases with a known answer."""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import OmitArgPrefixes, subcommand

from ...models.config.checks import RATE_OF_ALARMS, WORKERS
from ...models.files.interrupts import interrupts_held
from ..progress import console, progress_bar
from .check_estimator import CheckEstimator
from .check_logs import CheckLogs
from .check_outputs import check_page, held_outputs, refuse_given_up


@dataclass(frozen=True)
class CheckDiagnosis:
    """Diagnose cases of hidden effects, compare with the hidden answers, report the result.

    A case is a folder with data (CSV runs or one log) and the answer; docs/blind-cases.md describes
    the format. Each is judged once: the same command resumes an interrupted check.
    """

    cases: Path = Path("runs/blind")
    """Folder of cases, such as `make blind` writes."""
    only: tuple[str, ...] = ()
    """Patterns of the names of cases or of causes to take (`'lag-*' net_buoyancy`)."""
    alpha: Annotated[float, RATE_OF_ALARMS] = 0.01
    """Rate of false alarms of the diagnosis."""
    workers: Annotated[int, WORKERS] = 0
    """Worker processes on this machine; 0 judges all cases in this process."""
    rivals: bool = False
    """Judge sparse regression (pysindy: STLSQ and weak form) and random features on the same files
    too."""
    out: Path = Path("runs/check")
    """Folder for the results of each case."""
    docs: Path | None = None
    """Markdown file to write the tables into, such as docs/diagnosis.md."""

    def place(self) -> AbstractContextManager[None]:
        """Check and lock the outputs."""
        with interrupts_held():
            from ..diagnosis_benchmark.run import CHECK

        return held_outputs(self.out, CHECK, self.docs)

    def run(self) -> None:
        """Diagnose, judge, report."""
        with interrupts_held():
            from ..diagnosis_benchmark.cases import find_cases
            from ..diagnosis_benchmark.pages import write_page
            from ..diagnosis_benchmark.run import run_cases
            from ..diagnosis_benchmark.tables import print_tables, tables

        check_page(self.docs)
        cases = find_cases(self.cases, self.only)
        with progress_bar(f"{len(cases)} cases") as update:
            rows, failed = run_cases(cases, self.out, self.alpha, update, self.rivals, self.workers)
        shown = console()
        print_tables(shown, tables(rows))
        write_page(self.out / "diagnosis.md", rows, cases)
        if self.docs is not None:
            write_page(self.docs, rows, cases)
        shown.print(f"wrote {self.docs or self.out / 'diagnosis.md'}")
        refuse_given_up(failed, "cases")


@dataclass(frozen=True)
class Check:
    """Measure the accuracy of this package on cases with a known answer."""

    EXAMPLES: ClassVar = (
        "spinndrift check estimator --only calm --runs 2 --seconds 10",
        "spinndrift check diagnosis --cases runs/blind  # after: make blind",
    )

    what: Annotated[
        Annotated[CheckDiagnosis, subcommand("diagnosis", prefix_name=False)]
        | Annotated[CheckEstimator, subcommand("estimator", prefix_name=False)]
        | Annotated[CheckLogs, subcommand("logs", prefix_name=False)],
        OmitArgPrefixes,
    ]

    def place(self) -> AbstractContextManager[None]:
        """Check and lock the outputs."""
        return self.what.place()

    def run(self) -> None:
        """Measure, judge, report."""
        self.what.run()
