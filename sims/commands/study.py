"""`spinndrift study`: the paper's simulation study, reproduced."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from ...models.config.checks import WORKERS, Within
from ...models.config.errors import UserError
from ...models.files.interrupts import interrupts_held
from ..progress import console, progress_bar


@dataclass(frozen=True)
class Study:
    """Train every method on simulated data of a known law, and compare the learned laws with it.

    Each run (method, seed) has its folder under `--out` and is done once: the same command resumes
    an interrupted study, and more seeds or methods are added to finished runs. At the end
    report.html, ablation.md, figures and tables are written from all runs found.
    """

    EXAMPLES: ClassVar = (
        "spinndrift study --scale tiny --seeds 1 --methods pinn --out runs/tiny",
        "spinndrift study --regime sparse --scale small --workers 2",
    )

    name: Annotated[Positional[Literal["ablation"]], arg(metavar="ablation")] = "ablation"
    """The study: `ablation`, the paper's simulation experiments."""
    regime: tuple[Literal["rich", "sparse"], ...] = ("rich", "sparse")
    """Data to learn from: `rich` (one maneuver, 100 trajectories), `sparse` (ten maneuvers,
    20 trajectories each)."""
    seeds: Annotated[int, Within(1, 10_000)] = 5
    """Number of seeds; each has data and training of its own."""
    methods: tuple[str, ...] = ()
    """Methods to train, by name; by default all."""
    scale: Literal["full", "small", "tiny"] = "full"
    """Size of the study: `full` as in the paper, `small` for a first result, `tiny` for a test."""
    start: Literal["fit", "belief"] = "fit"
    """Start of training: the maximum-likelihood constants of the data (`fit`), or, with more steps,
    a wrong `belief`, as in the paper: the objective alone then fits all coefficients."""
    config: Path | None = None
    """Settings of the study (YAML) instead of `--scale` and `--start`; `study.yaml` in `--out`
    has all of them."""
    out: Path = Path("runs/ablation")
    """Folder of all runs, tables and pages."""
    workers: Annotated[int, WORKERS] = 0
    """Worker processes on this machine; 0 runs all in this process."""
    cluster: str | None = None
    """Address of a Dask scheduler (tcp://host:port) whose workers see `--out` too."""
    together: Annotated[int, Within(1, 10_000)] = 1
    """Seeds that one task trains."""
    docs: Path | None = None
    """Markdown file that also receives the verdicts, such as docs/ablation.md."""
    render_only: Annotated[
        bool, FlagCreatePairsOff, arg(help="Run nothing, write tables and pages anew.")
    ] = False

    @contextmanager
    def place(self) -> Iterator[None]:
        """Check and lock the outputs."""
        with interrupts_held():
            from ...models.files.owned import output_file, run_folder
            from ..study.pages import check_shown, is_page
            from ..study.run import STUDY

        with ExitStack() as held:
            if self.docs is not None:
                held.enter_context(output_file(self.docs, is_page, "page of a study", "--docs"))
                check_shown(self.docs)
            held.enter_context(run_folder(self.out, STUDY))
            yield

    def run(self) -> None:
        """Train, judge, report."""
        with interrupts_held():
            from ...models.config.typed_yaml import load
            from ...training.methods import METHODS
            from ..cores import share_cores
            from ..study.config import StudyConfig, from_belief, scaled
            from ..study.pages import render
            from ..study.run import run_study
            from ..study.task import make_tasks

        if self.docs is not None and self.docs.suffix != ".md":
            raise UserError(f"--docs {self.docs}: end the name in .md")
        share_cores()
        shown = console()
        failed = []
        if not self.render_only:
            study = scaled(self.scale)
            if self.start == "belief":
                study = from_belief(study)
            if self.config is not None:
                study = load(StudyConfig, self.config)
            tasks = make_tasks(
                self.regime, self.methods or tuple(METHODS), self.seeds, self.together
            )
            with progress_bar("study") as update:
                failed = run_study(
                    study, tasks, self.out, update, cluster=self.cluster, workers=self.workers
                )
        for one in failed:
            shown.print(f"{one.task} was given up: {one.reason}")
        with progress_bar("writing tables and pages"):
            rows = render(self.out, self.docs)
        successes = sum(row["success"] for row in rows)
        shown.print(f"{successes} of {len(rows)} runs succeeded")
        shown.print(f"wrote {self.out / 'table.csv'}; open {self.out / 'report.html'}")
        if failed:
            raise UserError(
                f"{len(failed)} tasks were given up (see above); the same command tries them again"
            )
