"""A run on disk: a folder whose files are written atomically together."""

import itertools
import json
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from ...models.config import typed_yaml
from ...models.config.errors import UserError
from ...models.files.atomic import atomic_files
from ...models.files.locks import BusyError
from ...models.files.owned import FolderKind, run_folder
from ...systems.plant.wrench_limits import ThrusterLimits
from ...training.data.provenance import revision
from ..reports.figures_path import Scene
from ..reports.meshcat_replay import write_replay
from ..reports.pages import Page
from ..reports.run_report import PACKAGES, run_page
from ..scenarios.criteria import ReachGoal
from ..scenarios.scenario import Scenario
from .loop import Run
from .metrics import clearance, metrics

RUN = FolderKind("run", (
    "scenario.yaml", "log.nc", "metrics.json", "report.html", "meshcat.html", "telemetry.tlog",
))  # fmt: skip
"""What `spinndrift run` writes."""


def write_run(run: Run, folder: str | os.PathLike[str], report: bool = True) -> dict[str, Any]:
    """Write a run as a new folder and return its metrics.

    `scenario.yaml` (defaults written out), `log.nc` (a recording), `metrics.json`, and with
    `report` also `report.html` and `meshcat.html`. Except for the block `timing`, equal seeds give
    equal metrics.

    Raises:
        UserError: the folder exists and is not empty, or can't be made.
    """
    with run_folder(folder, RUN, "", new=True) as held:
        return write_files(run, held, report)


@contextmanager
def telemetry_log(folder: Path) -> Iterator[Path]:
    """The path of a flight's telemetry log, which is removed if nothing was flown (`fly`).

    The same command can then be given again.

    Raises:
        UserError: it is there, of a flight that ended early.
    """
    record = folder / "telemetry.tlog"
    if record.exists():
        raise UserError(
            f"--out {folder}: holds telemetry.tlog of a run that ended early; name another folder"
        )
    try:
        yield record
    except UserError:
        record.unlink(missing_ok=True)
        raise


def write_files(run: Run, folder: Path, report: bool = True) -> dict[str, Any]:
    """As `write_run`, into a folder that is held (`run_folder`); all files appear at once."""
    values = run_metrics(run)
    with atomic_files(folder) as partial:
        (partial / "scenario.yaml").write_text(typed_yaml.dump(run.scenario), encoding="utf-8")
        run.log.save(partial / "log.nc")
        text = json.dumps(values, indent=2, allow_nan=False, ensure_ascii=False)
        (partial / "metrics.json").write_text(text + "\n", encoding="utf-8")
        if report:
            vehicle = run.scenario.station.load_vehicle()
            report_page(run, values, replay="meshcat.html").write(partial / "report.html")
            write_replay(partial / "meshcat.html", run.log, scene(run.scenario), vehicle)
    return values


def run_metrics(run: Run) -> dict[str, Any]:
    """All numbers of a run, with its seed, versions and timing."""
    scenario = run.scenario
    station = scenario.station
    values = metrics(
        run.log,
        run.outcome,
        scenario.success,
        station.load_vehicle(),
        station.obstacles,
        scenario.goal,
    )
    made = {"revision": revision(), **{name: metadata.version(name) for name in PACKAGES}}
    head = {"scenario": scenario.name, "seed": scenario.seed}
    return {**head, **values, **run.numbers, "versions": made, "timing": run.timing.summary()}


def scene(scenario: Scenario) -> Scene:
    """The surroundings of the vehicle for a scenario's figures."""
    goal, success = scenario.goal, scenario.success
    return Scene(
        scenario.station.load_vehicle().size,
        scenario.station.obstacles,
        None if goal is None else (float(goal[0]), float(goal[1]), float(goal[2])),
        success.radius if isinstance(success, ReachGoal) else 0.5,
        scenario.station.sensing.water_depth,
    )


def report_page(run: Run, values: dict[str, Any], replay: str = "") -> Page:
    """The report of a run; `replay` is the address of its 3-D replay."""
    station = run.scenario.station
    vehicle = station.load_vehicle()
    limits = ThrusterLimits.create(vehicle.thrusters(), station.voltage).axes()
    title = run.scenario.name.replace("_", " ").capitalize()
    return run_page(
        run.log,
        values,
        scene(run.scenario),
        title=f"{title}, seed {run.scenario.seed}",
        description=f"{run.scenario.description} {run.note}".strip(),
        scenario_text=typed_yaml.dump(run.scenario),
        limits=np.asarray(limits),
        limitation=vehicle.limitation(),
        clearance=clearance(run.log, vehicle, station.obstacles),
        replay=replay,
        checks=run.checks,
    )


@contextmanager
def new_folder(
    out: str | os.PathLike[str] | None, scenario: Scenario, parent: str | os.PathLike[str] = "runs"
) -> Iterator[Path]:
    """Hold a new folder for a run: `out`, or the first free of <name>-<seed>, <name>-<seed>-2, ….

    Raises:
        UserError: `out` exists and is not empty, or it can't be made.
    """
    with ExitStack() as stack:
        if out is not None:
            yield stack.enter_context(run_folder(out, RUN, new=True))
            return
        names = (f"{scenario.name}-{scenario.seed}{end}" for end in _endings())
        for path in (Path(parent) / name for name in names):
            if os.path.lexists(path):
                continue
            try:
                yield stack.enter_context(run_folder(path, RUN, "", new=True))
            except BusyError:  # another process holds it
                continue
            return


def _endings() -> Iterator[str]:
    yield ""
    yield from (f"-{count}" for count in itertools.count(2))
