"""Evaluation of models on held-out windows: errors, coverage and scores over the horizon."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import xarray as xr
from jaxtyping import Array

from ...models.dynamics import Dynamics
from ...models.files.atomic import atomic_path
from ...models.files.netcdf import load_netcdf, save_netcdf
from ...models.se3 import CHANNELS
from ..data.windows import Windows
from ..losses.base import Batch
from ..predict import predict
from .metrics import BANDS, GROUPS, coverage, displacement, energy_score, norms

_CHUNK = 16
_COLUMNS = ("model", "quantity", "of", "band", "horizon_s", "value")


@dataclass(frozen=True)
class Evaluation:
    """Results by model, horizon and axis or norm, in one `xarray.Dataset`.

    Variables (`norm`: position m, rotation rad, linear_velocity m/s, angular_velocity rad/s,
    geodesic, velocity):
        rmse (model, norm, horizon): RMSE of the noise-free motion.
        rmse_samples (model, norm, horizon): RMSE over windows and samples.
        rmse_mean (model, norm, horizon): RMSE over windows of the samples' mean displacement.
        rmse_axis (model, axis, horizon): RMSE of the noise-free motion, by axis.
        coverage (model, band, axis, horizon): share of windows inside the central band.
        energy_score (model, law, horizon): of poses and of velocities.
        finite (model): share of windows with finite predictions (the others are left out).
    """

    dataset: xr.Dataset

    def overall(self) -> dict[str, dict[str, float]]:
        """One number per model and quantity: mean over horizons and axes; RMS for errors."""
        table = {}
        for model in self.dataset["model"].to_numpy():
            d = self.dataset.sel(model=model)
            row = {
                f"rmse_{norm}": float(np.sqrt((d["rmse"].sel(norm=norm) ** 2).mean()))
                for norm in GROUPS
            }
            row |= {
                f"coverage_{band:g}": float(d["coverage"].sel(band=band).mean())
                for band in self.dataset["band"].to_numpy()
            }
            row |= {
                f"energy_{law}": float(d["energy_score"].sel(law=law).mean())
                for law in ("pose", "velocity")
            }
            row["finite"] = float(d["finite"])
            table[str(model)] = row
        return table

    def tidy(self) -> list[dict[str, Any]]:
        """Rows of model, quantity, of (norm, axis or law), band, horizon_s and value."""
        rows = []
        for name in ("rmse", "rmse_mean", "rmse_samples", "rmse_axis", "coverage", "energy_score"):
            stacked = self.dataset[name].stack(row=self.dataset[name].dims)
            for index, value in zip(stacked["row"].to_numpy(), stacked.to_numpy(), strict=True):
                at = dict(zip(self.dataset[name].dims, index, strict=True))
                which = at.get("norm") or at.get("axis") or at.get("law")
                rows.append(
                    {
                        "model": str(at["model"]),
                        "quantity": name,
                        "of": str(which),
                        "band": float(at["band"]) if "band" in at else "",
                        "horizon_s": round(float(at["horizon"]), 6),
                        "value": float(value),
                    }
                )
        return rows

    def save(self, path: str | Path) -> None:
        """Write the tidy table (`.csv`), the overall numbers (`.json`) or everything (`.nc`).

        Raises:
            ValueError: another suffix.
        """
        path = Path(path)
        if path.suffix not in (".csv", ".json", ".nc"):
            raise ValueError(f"{path}: save an evaluation as .csv, .json or .nc")
        if path.suffix == ".nc":
            save_netcdf(self.dataset, path)
            return
        with atomic_path(path) as partial:
            if path.suffix == ".json":
                text = json.dumps({k: _plain(v) for k, v in self.overall().items()}, indent=2)
                partial.write_text(text + "\n", encoding="utf-8")
            else:
                rows = self.tidy()
                lines = [",".join(_COLUMNS), *(",".join(str(r[c]) for c in _COLUMNS) for r in rows)]
                partial.write_text("\n".join(lines) + "\n", encoding="utf-8")

    def summary(self) -> str:
        """A short text table: errors and coverage of each model over all horizons."""
        lines = [
            f"{'model':<12}{'position':>10}{'rotation':>10}{'velocity':>10}{'rate':>10}"
            f"{'in 50 %':>9}{'in 90 %':>9}{'energy':>9}",
            f"{'':<12}{'m':>10}{'rad':>10}{'m/s':>10}{'rad/s':>10}",
        ]
        for model, row in self.overall().items():
            numbers = "".join(
                f"{row[f'rmse_{n}']:>10.4f}" if np.isfinite(row[f"rmse_{n}"]) else f"{'–':>10}"
                for n in ("position", "rotation", "linear_velocity", "angular_velocity")
            )
            lines.append(
                f"{model:<12}{numbers}{row['coverage_0.5']:>9.0%}{row['coverage_0.9']:>9.0%}"
                f"{row['energy_pose'] + row['energy_velocity']:>9.4f}"
            )
        return "\n".join(lines)


def is_evaluation(path: Path) -> bool:
    """Whether a file was written by `Evaluation.save`."""
    try:
        if path.suffix == ".nc":
            return {"rmse", "coverage", "energy_score"} <= set(load_netcdf(path).data_vars)
        if path.suffix == ".json":
            found = json.loads(path.read_text(encoding="utf-8"))
            return all("rmse_position" in row for row in found.values()) and bool(found)
        with path.open(encoding="utf-8") as handle:
            return handle.readline().strip() == ",".join(_COLUMNS)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


def evaluate(
    models: Mapping[str, Dynamics],
    windows: Windows,
    *,
    samples: int = 59,
    substeps: int = 1,
    seed: int = 0,
) -> Evaluation:
    """Predict every window by every model with the same noise, and compare with the observation.

    `samples` must be one less than a multiple of 20, so that the bands of 50 and 90 % are exact.
    A model without diffusion has bands of zero width.

    Example:
        >>> vehicle = load_vehicle("bluerov2_heavy")
        >>> recording = generate(GenerateConfig(trajectories=1, duration=4.0), vehicle)
        >>> windows = make_windows(recording, length_s=1.0)
        >>> physics = vehicle.dynamics(dtype=np.float32)
        >>> evaluate({"preset": physics}, windows, samples=19).dataset.sizes["horizon"]
        20
    """
    parts = [
        _evaluate_one(model, windows, samples, substeps, seed).expand_dims(model=[name])
        for name, model in models.items()
    ]
    dataset = xr.concat(parts, dim="model")
    dataset.attrs |= {
        "windows": len(windows),
        "samples": samples,
        "normalise": windows.normalise,
        "units": "m, rad, m/s, rad/s",
    }
    return Evaluation(dataset)


def _evaluate_one(
    model: Dynamics, windows: Windows, samples: int, substeps: int, seed: int
) -> xr.Dataset:
    rows: dict[str, list[np.ndarray]] = {}
    finite = 0
    for first in range(0, len(windows), _CHUNK):
        # the last chunk is padded so that one compiled function serves all
        wanted = np.arange(first, min(first + _CHUNK, len(windows)))
        chunk = windows.take(np.resize(wanted, min(_CHUNK, len(windows))))
        key = jax.random.fold_in(jax.random.key(seed), first)
        found = _judge(model, Batch.of(chunk), windows.dt, key, samples, substeps)
        values = {name: np.asarray(a)[..., : wanted.size] for name, a in found.items()}
        good = np.logical_and.reduce(
            [np.isfinite(v).all(tuple(range(v.ndim - 1))) for v in values.values()]
        )
        finite += int(good.sum())
        for name, v in values.items():
            rows.setdefault(name, []).append(v[..., good])
    merged = {name: np.concatenate(parts, axis=-1).astype(float) for name, parts in rows.items()}
    _without_hidden(merged, windows)
    horizon = windows.dt * np.arange(1, windows.steps + 1)

    def mean(name: str) -> np.ndarray:
        count = merged[name].shape[-1]
        return merged[name].mean(axis=-1) if count else np.full(merged[name].shape[:-1], np.nan)

    return xr.Dataset(
        {
            "rmse": (("norm", "horizon"), np.sqrt(mean("square"))),
            "rmse_samples": (("norm", "horizon"), np.sqrt(mean("square_samples"))),
            "rmse_mean": (("norm", "horizon"), np.sqrt(mean("square_mean"))),
            "rmse_axis": (("axis", "horizon"), np.sqrt(mean("square_axis"))),
            "coverage": (("band", "axis", "horizon"), mean("inside")),
            "energy_score": (("law", "horizon"), mean("energy")),
            "finite": ((), finite / len(windows)),
        },
        coords={
            "norm": list(GROUPS),
            "axis": list(CHANNELS),
            "band": list(BANDS),
            "law": ["pose", "velocity"],
            "horizon": ("horizon", horizon, {"units": "s"}),
        },
    )


def _without_hidden(merged: dict[str, np.ndarray], windows: Windows) -> None:
    """Set to NaN what no window has measured."""
    if windows.hidden is None:
        return
    seen: np.ndarray = np.any(windows.hidden.seen, axis=(0, 2))
    axes = np.concatenate([seen[:3], np.ones(3, bool), seen[3:]])
    merged["square_axis"][~axes] = np.nan
    merged["inside"][:, ~axes] = np.nan
    for n, part in enumerate(GROUPS.values()):
        if not axes[part].any():
            for name in ("square", "square_samples", "square_mean"):
                merged[name][n] = np.nan


def _judge(
    model: Dynamics, batch: Batch, dt: float, key: Array, samples: int, substeps: int
) -> dict[str, np.ndarray]:
    """Squared errors, bands and scores of each window (last axis)."""
    X, V, squares, energy = _compare(model, batch, dt, key, samples, substeps)
    inside = coverage(
        X[:, :, :samples],
        V[:, :, :samples],
        batch.X[1:],
        batch.V[1:],
        X[:, :, samples:],
        V[:, :, samples:],
    )
    judged = {name: np.asarray(a) for name, a in squares.items()}
    return judged | {"inside": inside, "energy": np.stack([np.asarray(a) for a in energy])}


@eqx.filter_jit
def _compare(
    model: Dynamics, batch: Batch, dt: float, key: Array, samples: int, substeps: int
) -> tuple[Array, Array, dict[str, Array], tuple[Array, Array]]:
    X, V = predict(
        model,
        batch.X[0],
        batch.V[0],
        batch.F,
        dt,
        key,
        samples,
        substeps=substeps,
        with_path_of_drift=True,
        commands=batch.commands,
        spread=batch.spread,
        rise=batch.rise,
    )
    X, V = batch.shown(X, V)
    y = batch.X[1:, :, None], batch.V[1:, :, None]
    e = displacement(X, V, *y)  # (12, T, P + 1, W), last one noise-free
    drift, sampled = e[:, :, samples], e[:, :, :samples]

    def squares(d: Array) -> Array:
        return jax.numpy.stack([n**2 for n in norms(d).values()])

    found = {
        "square": squares(drift),
        "square_axis": drift**2,
        "square_samples": squares(sampled).mean(axis=2),
        "square_mean": squares(sampled.mean(axis=2)),
    }
    scores = energy_score(X[:, :, :samples], V[:, :, :samples], batch.X[1:], batch.V[1:])
    return X, V, found, scores


def _plain(row: Mapping[str, float]) -> dict[str, float | None]:
    return {name: value if np.isfinite(value) else None for name, value in row.items()}
