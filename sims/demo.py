"""The demo: log, diagnosis, learned model, held-out error, closed-loop dive, in one report."""

import itertools
import json
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..models.config.errors import UserError
from ..models.files.atomic import atomic_path
from ..models.files.owned import FolderKind, ForeignError, run_folder
from ..models.recordings.checks.examine import examine
from ..models.recordings.store import Recording
from ..models.vehicles.vehicle import Vehicle, load_vehicle
from ..systems.closed_loop import build_diagram
from ..systems.controllers.kinds import MppiImpedance
from ..systems.logs.load import load_data
from ..training.config import DriftConfig, TrainingConfig
from ..training.fitting.run_folder import TRAINING, CheckpointError
from .demo_diagnosis import Diagnosed, diagnosed
from .diagnosis_folder import DIAGNOSIS
from .learning import Learned, learn
from .progress import Update, console, progress_bar
from .reports.demo_report import NORMS, UNITS, demo_page, start_words
from .reports.findings import print_findings
from .run.estimate import nees_words
from .run.folder import RUN, write_files
from .run.loop import simulate
from .run.signals import log_periods
from .scenarios.scenario import Scenario

EMBEDDED = Path(__file__).with_name("data") / "sitl_dive.tlog.xz"
"""The shipped log."""
DEMO = FolderKind("demo", ("recording.nc", "report.html", "summary.json"))
"""Files that a demo writes in addition to the folders of its diagnosis, training and dive."""
DEFAULT = Path("runs/demo")
_USUAL = "bluerov2_heavy"
_ON_TOP = TrainingConfig(
    steps=100,
    batch=8,
    learning_rate=1e-3,
    warm_up=20,
    validate_every=20,
    drift=DriftConfig(iterations=0),
)
"""Training on top of an extended model, which leaves little to learn: the diagnosis has fitted its
coefficients to the same data."""


def demo(
    source: Path,
    out: Path,
    scenario: Scenario,
    config: TrainingConfig | None = None,
    vehicle_name: str | None = None,
    accept: Sequence[str] = (),
    steps: int | None = None,
) -> str:
    """Run the demo, write its files into `out` and return the summary.

    Files: recording.nc, diagnosis/ (as `spinndrift diagnose`, of the training part), training/ (as
    `spinndrift train`), dive/ (as `spinndrift run`), report.html, summary.json. A finished
    diagnosis of the same data is kept, an interrupted training on them resumed. Without a `config`
    the default one is used, or `_ON_TOP` on top of an extended model; `steps` replaces its steps.
    `out` is held by the caller (`demo_folder`).

    Raises:
        UserError: the log or the scenario can't be used; the sentence says why.
    """
    began = time.monotonic()
    if vehicle_name is not None:
        load_vehicle(vehicle_name)
    with progress_bar(f"1/5 reading {source.name}") as update:
        recording = _read(source, vehicle_name, accept, update)
    stated = recording.vehicle or _USUAL
    vehicle = load_vehicle(stated)
    recording = examine(recording, vehicle, str(source), accept)
    print_findings(console(), recording)
    scenario = replace(scenario, station=replace(scenario.station, vehicle=stated, model=None))
    _check_flies(scenario)
    recording.save(out / "recording.nc")
    windows = (config or TrainingConfig()).windows
    with progress_bar("2/5 diagnosing") as update:
        found = diagnosed(recording, vehicle, source, windows, out / "diagnosis", update)
    with progress_bar("3/5 training") as update:
        settings = _settings(config, found, steps)
        learned = _learn(recording, vehicle, settings, found, out / "training", update)
    model = out / "training" / "model.spinn"
    scenario = scenario.with_changes(model=model)
    scenario = replace(scenario, station=replace(scenario.station, model=model))
    with progress_bar("4/5 flying") as update:
        run = simulate(scenario, update)
    if run.outcome.reason == "interrupted":
        raise KeyboardInterrupt
    with progress_bar("5/5 writing the report"):
        values = write_files(run, out / "dive")
        page = demo_page(source.name, recording, vehicle, found, learned, run, values)
        page.write(out / "report.html")
    summary = _summary(found, learned, values, time.monotonic() - began)
    with atomic_path(out / "summary.json") as partial:
        partial.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    return _words(summary, out)


@contextmanager
def demo_folder(out: Path | None) -> Iterator[Path]:
    """Hold the folder of a demo, and those of its diagnosis, its training and its dive.

    Args:
        out: the folder; None takes runs/demo, or runs/demo-2 and so on if that is foreign.

    Raises:
        UserError: as `run_folder`, of one of them.
    """
    with ExitStack() as held:
        if out is None:
            out = _own_or_free(held, DEFAULT)
        else:
            held.enter_context(run_folder(out, DEMO))
        held.enter_context(run_folder(out / "diagnosis", DIAGNOSIS))
        held.enter_context(run_folder(out / "training", TRAINING))
        held.enter_context(run_folder(out / "dive", RUN))
        yield out


def _own_or_free(held: ExitStack, first: Path) -> Path:
    for count in itertools.count(1):
        out = first if count == 1 else first.with_name(f"{first.name}-{count}")
        try:
            return held.enter_context(run_folder(out, DEMO))
        except ForeignError:
            continue
    raise AssertionError  # unreachable


def _check_flies(scenario: Scenario) -> None:
    """Check that a scenario can be run, by building its loop with the untrained vehicle."""
    controller = scenario.controller
    if not isinstance(controller, MppiImpedance):
        raise UserError(
            f"--scenario: {scenario.name} is steered by {type(controller).__name__}, which does "
            "not plan with a model; choose a scenario with MppiImpedance"
        )
    untrained = replace(controller, model=None, vehicle=None)
    build_diagram(scenario.station, untrained, log_periods=log_periods(scenario))


def _read(source: Path, vehicle: str | None, accept: Sequence[str], update: Update) -> Recording:
    """The data at their own rate; unevenly spaced samples are resampled, for the windows."""
    recording = load_data(source, vehicle=vehicle, resample=False, accept=accept, progress=update)
    if not recording.uneven:
        return recording
    return load_data(source, vehicle=vehicle, accept=accept, progress=update)


def _settings(config: TrainingConfig | None, found: Diagnosed, steps: int | None) -> TrainingConfig:
    if config is None:
        config = TrainingConfig() if found.start is None else _ON_TOP
    return config if steps is None else replace(config, steps=steps)


def _learn(
    recording: Recording,
    vehicle: Vehicle,
    config: TrainingConfig,
    found: Diagnosed,
    out: Path,
    update: Update,
) -> Learned:
    """Resume the training in `out` if it is of the same data and settings, else start a new one."""

    def go(resume: bool) -> Learned:
        return learn(
            recording, vehicle, config, out, start=found.start, resume=resume, progress=update
        )

    try:
        return go(resume=found.kept or found.diagnosis is None)
    except CheckpointError:
        return go(resume=False)


def _summary(
    found: Diagnosed, learned: Learned, values: dict[str, Any], seconds: float
) -> dict[str, Any]:
    d = found.diagnosis
    told = None
    if d is not None:
        causes = [{"name": c.name, "where": c.where} for c in d.causes]
        told = {"verdict": d.verdict, "sentence": d.sentence, "causes": causes}
    return {
        "diagnosis": told,
        "learned_from": "preset" if found.start is None else "extended",
        "held_out": learned.evaluation.overall(),
        "training": {
            "steps": learned.result.steps,
            "best_step": learned.result.best_step,
            "seconds": learned.result.seconds,
            "words": start_words(found, learned),
        },
        "dive": values["outcome"] | {"min_clearance_m": values["path"].get("min_clearance_m")},
        "estimate": values["estimate"],
        "seconds": seconds,
    }


def _words(summary: dict[str, Any], out: Path) -> str:
    d, models = summary["diagnosis"], list(summary["held_out"])
    lines = [] if d is None else [f"the preset: {d['sentence']}"]
    lines += [summary["training"]["words"].replace("`", "")]
    lines.append(f"{'held-out error (RMS over 4 s)':<34}" + "".join(f"{m:>11}" for m in models))
    for norm, unit in zip(NORMS, UNITS, strict=True):
        errors = (summary["held_out"][m][f"rmse_{norm}"] for m in models)
        label = f"{norm.replace('_', ' ')} ({unit})"
        lines.append(f"  {label:<32}" + "".join(f"{e:>11.3f}" for e in errors))
    for band in (0.5, 0.9):
        shares = (summary["held_out"][m][f"coverage_{band:g}"] for m in models)
        label = f"inside the {band:.0%} band"
        lines.append(f"  {label:<32}" + "".join(f"{s:>11.0%}" for s in shares))
    lines.append(f"dive: {summary['dive']['words']}")
    consistent = nees_words(summary["estimate"])
    if consistent is not None:
        lines.append(f"estimator's NEES (3 on average for a consistent filter): {consistent}")
    lines.append(f"{summary['seconds']:.0f} s in total; open {out / 'report.html'}")
    return "\n".join(lines)
