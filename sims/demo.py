"""The demo: log, learned model, held-out error, closed-loop dive, in one report."""

import itertools
import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..models.config.errors import UserError
from ..models.files.atomic import atomic_path
from ..models.files.owned import FolderKind, ForeignError, run_folder
from ..models.recordings.store import Recording
from ..models.vehicles.vehicle import Vehicle, load_vehicle
from ..systems.closed_loop import build_diagram
from ..systems.controllers.kinds import MppiImpedance
from ..systems.logs.load import load_data
from ..training.config import TrainingConfig
from ..training.fitting.run_folder import TRAINING, CheckpointError
from .learning import Learned, learn
from .progress import progress_bar
from .reports.figures_path import path_figure, samples_figure
from .reports.figures_time import progress_figure, tracking_figure
from .reports.learning_report import add_data, add_evaluation, add_training
from .reports.pages import Page
from .reports.run_report import consistency
from .run.estimate import nees_words
from .run.folder import RUN, scene, write_files
from .run.loop import Run, simulate
from .run.metrics import clearance
from .run.signals import log_periods
from .scenarios.scenario import Scenario

EMBEDDED = Path(__file__).with_name("data") / "sitl_dive.tlog.xz"
"""The shipped log."""
DEMO = FolderKind("demo", ("recording.nc", "report.html", "summary.json"))
"""Files that a demo writes in addition to the folders of its training and its dive."""
DEFAULT = Path("runs/demo")
_USUAL = "bluerov2_heavy"
_NORMS = ("position", "rotation", "linear_velocity", "angular_velocity")
_UNITS = ("m", "rad", "m/s", "rad/s")


def demo(
    source: Path,
    out: Path,
    scenario: Scenario,
    config: TrainingConfig,
    vehicle_name: str | None = None,
) -> str:
    """Run the demo, write its files into `out` and return the summary.

    Files: recording.nc, training/ (as `spinndrift train`), dive/ (as `spinndrift run`),
    report.html, summary.json. An interrupted training on the same log is resumed. `out` is held by
    the caller (`demo_folder`).

    Raises:
        UserError: the log or the scenario can't be used; the sentence says why.
    """
    began = time.monotonic()
    if vehicle_name is not None:
        load_vehicle(vehicle_name)
    with progress_bar(f"1/4 reading {source.name}") as update:
        recording = load_data(source, vehicle=vehicle_name, progress=update)
    stated = recording.vehicle or _USUAL
    vehicle = load_vehicle(stated)
    scenario = replace(scenario, station=replace(scenario.station, vehicle=stated, model=None))
    _check_flies(scenario)
    recording.save(out / "recording.nc")
    with progress_bar("2/4 training") as update:
        learned = _learn(recording, vehicle, config, out / "training", update)
    model = out / "training" / "model.spinn"
    scenario = scenario.with_changes(model=model)
    scenario = replace(scenario, station=replace(scenario.station, model=model))
    with progress_bar("3/4 flying") as update:
        run = simulate(scenario, update)
    if run.outcome.reason == "interrupted":
        raise KeyboardInterrupt
    with progress_bar("4/4 writing the report"):
        values = write_files(run, out / "dive")
        _page(source, recording, vehicle, learned, run, values).write(out / "report.html")
    found = _summary(learned, values, time.monotonic() - began)
    with atomic_path(out / "summary.json") as partial:
        partial.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    return _words(found, out)


@contextmanager
def demo_folder(out: Path | None) -> Iterator[Path]:
    """Hold the folder of a demo, and those of its training and its dive.

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


def _learn(
    recording: Recording, vehicle: Vehicle, config: TrainingConfig, out: Path, update: Any
) -> Learned:
    """Resume the training in `out` if it is of the same data and settings, else start a new one."""
    try:
        return learn(recording, vehicle, config, out, resume=True, progress=update)
    except CheckpointError:
        return learn(recording, vehicle, config, out, progress=update)


def _page(
    source: Path,
    recording: Recording,
    vehicle: Vehicle,
    learned: Learned,
    run: Run,
    values: dict[str, Any],
) -> Page:
    overall = learned.evaluation.overall()
    ratio = {n: overall["learned"][f"rmse_{n}"] / overall["preset"][f"rmse_{n}"] for n in _NORMS}
    outcome = values["outcome"]
    better = all(r < 1 for r in ratio.values())
    page = Page("From a log to a dive", f"`{source.name}`, from the preset `{vehicle.name}`")
    page.verdict(
        f"On held-out data: {_compared(overall, 'position', 'm')}; "
        f"{_compared(overall, 'linear_velocity', 'm/s')}. {outcome['words']}",
        better and outcome["success"],
    )
    page.tiles(
        [
            (f"{norm.replace('_', ' ')} error", f"{overall['learned'][f'rmse_{norm}']:.3f} {unit}",
             f"preset {overall['preset'][f'rmse_{norm}']:.3f} {unit}")
            for norm, unit in zip(_NORMS, _UNITS, strict=True)
        ]
    )  # fmt: skip
    add_evaluation(add_training(add_data(page, recording), learned), learned)
    page.section(
        "The dive",
        f"The learned model is both the plant and MPPI's model: {_task(run.scenario)}, on the "
        f"estimates of the Kalman filter.{consistency(values['estimate'])} The run has a "
        "[report](dive/report.html) and a [3-D replay](dive/meshcat.html).",
    )
    around = scene(run.scenario)
    page.figure(path_figure(run.log, around), "Planned, flown and estimated path.")
    obstacles = run.scenario.station.obstacles
    room = clearance(run.log, vehicle, obstacles)
    for figure, caption in (
        (
            progress_figure(run.log, room, around.goal, around.goal_radius),
            "Distance to the goal, and clearance.",
        ),
        (samples_figure(run.log, around), "Sampled paths at six times."),
        (tracking_figure(run.log), "Plan minus truth, in B."),
    ):
        if figure is not None:
            page.figure(figure, caption)
    return page


def _task(scenario: Scenario) -> str:
    """The task in words: start, goal, planning rate."""

    def place(p: Any) -> str:
        return f"({', '.join(f'{x:g}' for x in p)}) m"

    start = place(scenario.station.initial_state()[0][4:])
    to = "" if scenario.goal is None else f" to {place(scenario.goal)}"
    assert isinstance(scenario.controller, MppiImpedance)
    return f"from {start}{to}, with {1 / scenario.controller.planner.period:g} plans a second"


def _compared(overall: dict[str, dict[str, float]], norm: str, unit: str) -> str:
    """A learned model's error, and its share of the preset's error."""
    learned, preset = (overall[model][f"rmse_{norm}"] for model in ("learned", "preset"))
    share = f"{100 * learned / preset:.0f} % of the preset's {preset:.2f} {unit}"
    return f"{norm.replace('_', ' ')} error {learned:.2f} {unit}, {share}"


def _summary(learned: Learned, values: dict[str, Any], seconds: float) -> dict[str, Any]:
    return {
        "held_out": learned.evaluation.overall(),
        "training": {"steps": learned.result.steps, "seconds": learned.result.seconds},
        "dive": values["outcome"] | {"min_clearance_m": values["path"].get("min_clearance_m")},
        "estimate": values["estimate"],
        "seconds": seconds,
    }


def _words(found: dict[str, Any], out: Path) -> str:
    lines = ["held-out error (RMS over 4 s)       preset    learned"]
    for norm, unit in zip(_NORMS, _UNITS, strict=True):
        preset, learned = (found["held_out"][m][f"rmse_{norm}"] for m in ("preset", "learned"))
        label = f"{norm.replace('_', ' ')} ({unit})"
        lines.append(f"  {label:<32}{preset:>8.3f}{learned:>11.3f}")
    inside = found["held_out"]["learned"]
    lines.append(
        f"  coverage of held-out motion: 50 % band {inside['coverage_0.5']:.0%}, "
        f"90 % band {inside['coverage_0.9']:.0%}"
    )
    lines.append(f"dive: {found['dive']['words']}")
    consistent = nees_words(found["estimate"])
    if consistent is not None:
        lines.append(f"estimator's NEES (3 on average for a consistent filter): {consistent}")
    lines.append(f"{found['seconds']:.0f} s in total; open {out / 'report.html'}")
    return "\n".join(lines)
