"""A run on disk: a folder that appears whole."""

import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from ..models import config
from ..models.errors import UserError
from ..models.files import partial_folder
from ..systems.wrench_limits import ThrusterLimits
from ..training.provenance import revision
from .criteria import ReachGoal
from .figures_path import Scene
from .meshcat_replay import write_replay
from .metrics import clearance, metrics
from .pages import Page
from .report import PACKAGES, run_page
from .run_loop import Run
from .scenario import Scenario


def write_run(run: Run, folder: str | os.PathLike[str], report: bool = True) -> dict[str, Any]:
    """Write a run as a new folder, which appears when all of it is there, and return its metrics.

    `scenario.yaml` (defaults written out), `log.nc` (a recording), `metrics.json`, and with
    `report` also `report.html` and `meshcat.html`. But for the block `timing` the metrics of equal
    seeds are equal.

    Raises:
        UserError: the folder exists and is not empty, or can't be made.
    """
    values = run_metrics(run)
    with atomic_folder(folder) as partial:
        (partial / "scenario.yaml").write_text(config.dump(run.scenario), encoding="utf-8")
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
    return {**head, **values, "versions": made, "timing": run.timing.summary()}


def scene(scenario: Scenario) -> Scene:
    """What stands around the vehicle in a scenario's pictures."""
    goal, success = scenario.goal, scenario.success
    return Scene(
        scenario.station.load_vehicle().size,
        scenario.station.obstacles,
        None if goal is None else (float(goal[0]), float(goal[1]), float(goal[2])),
        success.radius if isinstance(success, ReachGoal) else 0.5,
        scenario.station.sensing.dvl.water_depth,
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
        description=run.scenario.description,
        scenario_text=config.dump(run.scenario),
        limits=np.asarray(limits),
        clearance=clearance(run.log, vehicle, station.obstacles),
        replay=replay,
    )


def free_folder(parent: str | os.PathLike[str], scenario: Scenario) -> Path:
    """The first of <name>-<seed>, <name>-<seed>-2, … in `parent` that doesn't exist yet."""
    first = Path(parent) / f"{scenario.name}-{scenario.seed}"
    path, count = first, 1
    while path.exists():
        count += 1
        path = first.with_name(f"{first.name}-{count}")
    return path


def check_free(folder: str | os.PathLike[str]) -> None:
    """Refuse a folder that `write_run` would refuse, before anything is simulated.

    Raises:
        UserError: the path is a file or a folder with something in it.
    """
    path = Path(folder)
    if path.exists() and not path.is_dir():
        raise UserError(f"{path} is a file; name a folder that doesn't exist yet")
    if path.is_dir() and any(path.iterdir()):
        raise UserError(f"{path} is not empty; name a folder that doesn't exist yet")


@contextmanager
def atomic_folder(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary sibling folder that becomes `folder` when the block ends.

    On an error or an interrupt nothing is left behind.

    Raises:
        UserError: the folder exists and is not empty, or can't be made.
    """
    final = Path(folder)
    check_free(final)
    with partial_folder(final.with_name(f".partial-{secrets.token_hex(8)}"), final) as partial:
        yield partial
        os.replace(partial, final)
