"""The results of a study as tables, one row per run or one row per method, and as NetCDF."""

import csv
import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ...models.config.errors import UserError
from ...models.files.atomic import atomic_path
from ...models.files.netcdf import save_netcdf
from .config import REGIMES

Row = dict[str, Any]
"""One run: regime, method, seed, success, …, and numbers by name; NaN for missing ones."""
QUANTITIES = (
    "w2",
    "w2_debiased",
    "energy_score",
    "rmse_mean_geodesic",
    "rmse_mean_velocity",
    "rmse_samples_geodesic",
    "rmse_samples_velocity",
    "spread_geodesic",
    "spread_velocity",
    "coverage_50",
    "coverage_90",
    "finite",
)
_FLAGS = ("success", "trained", "finite", "converged")
_COUNTS = ("windows", "steps", "best_step", "bad_steps")
_TIMES = ("data", "training", "judging")


def done_runs(out: str | os.PathLike[str]) -> list[Path]:
    """Folders of all finished runs, in a fixed order.

    Raises:
        UserError: there is none.
    """
    found = [
        path.parent
        for regime in REGIMES
        for path in sorted((Path(out) / regime).glob("*/seed-*/result.json"))
    ]
    if not found:
        raise UserError(f"{out}: holds no finished run of a study; run one first")
    return found


def collect(out: str | os.PathLike[str]) -> list[Row]:
    """The runs of a study's folder as rows.

    Raises:
        UserError: there is none, or a file is damaged.
    """
    rows = []
    for folder in done_runs(out):
        path = folder / "result.json"
        try:
            rows.append(_row(json.loads(path.read_text("utf-8"))))
        except (ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"{path}: is no result of a run ({error}); remove its folder"
            ) from error
    return rows


def _row(result: dict[str, Any]) -> Row:
    def number(value: Any) -> float:
        return math.nan if value is None else float(value)

    row: Row = {k: result[k] for k in ("regime", "method", "seed")}
    row |= {k: bool(result[k]) for k in _FLAGS}
    row |= {"failure": result["failure"]}
    row |= {k: int(result[k]) for k in _COUNTS}
    row |= {f"seconds_{k}": number(result["seconds"][k]) for k in _TIMES}
    for name in QUANTITIES:
        metric = result["metrics"].get(name, {})
        label = "bounded" if name == "finite" else name
        row[label] = number(metric.get("value"))
        if name != "finite":
            row[f"{label}_floor"] = number(metric.get("floor"))
            row[f"{label}_ratio"] = number(metric.get("ratio"))
    for name, entry in result["diffusion"].items():
        row[f"{name}_ratio"] = number(entry["ratio"])
    return row


def numeric(rows: Sequence[Row]) -> list[str]:
    """Names of the columns that hold measured numbers."""
    skip = {"regime", "method", "seed", "failure", *_FLAGS}
    names = dict.fromkeys(name for row in rows for name in row)
    return [name for name in names if name not in skip]


def summarise(rows: Sequence[Row]) -> list[Row]:
    """One row per regime and method: number of runs, of successful runs, mean and std over those.

    The std is the sample standard deviation (n - 1), NaN for a single run. A method without a
    successful run has no numbers.
    """
    found = []
    for regime in REGIMES:
        for method in dict.fromkeys(r["method"] for r in rows if r["regime"] == regime):
            runs = [r for r in rows if (r["regime"], r["method"]) == (regime, method)]
            good = [r for r in runs if r["success"]]
            row: Row = {"regime": regime, "method": method, "runs": len(runs)}
            row |= {"successes": len(good)}
            for name in numeric(rows):
                values = np.array([r.get(name, math.nan) for r in good], float)
                values = values[np.isfinite(values)]
                row[name] = float(values.mean()) if values.size else math.nan
                row[f"{name}_std"] = float(values.std(ddof=1)) if values.size > 1 else math.nan
            found.append(row)
    return found


def write_csv(path: str | os.PathLike[str], rows: Sequence[Row]) -> None:
    """Write rows with the union of their columns; empty cells are NaN."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    with atomic_path(path) as partial, partial.open("w", encoding="utf-8", newline="") as handle:
        writer = csv.writer(handle, lineterminator="\n")
        writer.writerow(names)
        writer.writerows([_cell(row.get(name)) for name in names] for row in rows)


def read_csv(path: str | os.PathLike[str]) -> list[Row]:
    """The rows that `write_csv` wrote.

    Raises:
        UserError: there is no such file.
    """
    try:
        with Path(path).open(encoding="utf-8", newline="") as handle:
            return [
                {name: _value(name, cell) for name, cell in row.items()}
                for row in csv.DictReader(handle)
            ]
    except OSError as error:
        raise UserError(f"{path}: can't be read ({error.strerror})") from error


def _cell(value: Any) -> Any:
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}"
    return "" if value is None else value


def _value(name: str, cell: str) -> Any:
    if name in ("regime", "method", "failure"):
        return cell
    if name in _FLAGS:
        return cell == "1"
    if name in ("seed", "runs", "successes", *_COUNTS):
        return int(float(cell)) if cell else 0
    return float(cell) if cell else math.nan


def write_netcdf(out: str | os.PathLike[str]) -> list[Path]:
    """Join the metrics of each regime's runs in `<regime>.nc`, dims (run, scenario, side, …)."""
    written = []
    for regime in REGIMES:
        parts: list[xr.Dataset] = []
        for folder in done_runs(out):
            path = folder / "metrics.nc"
            if folder.parent.parent.name != regime or not path.exists():
                continue
            with xr.open_dataset(path, engine="h5netcdf") as dataset:
                run = dataset.load().expand_dims(run=[len(parts)])
            seed = int(folder.name.removeprefix("seed-"))
            names = {"method": folder.parent.name, "seed": seed}
            parts.append(run.assign_coords({k: ("run", [v]) for k, v in names.items()}))
        if parts:
            path = Path(out) / f"{regime}.nc"
            joined = xr.concat(parts, dim="run")
            save_netcdf(
                joined, path, {str(name): {"compression": "gzip"} for name in joined.data_vars}
            )
            written.append(path)
    return written
