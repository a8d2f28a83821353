"""Assembly of trajectories into a padded dataset, and windows of such a dataset."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from .schema import (
    COMMANDS,
    FORMAT,
    FRAMES,
    HOLD,
    LABELS,
    LEADING,
    SENSORS,
    STATES,
    variable_dims,
    variable_units,
)

_KNOWN = STATES | COMMANDS | SENSORS


@dataclass(frozen=True)
class Trajectory:
    """One run on a uniform time grid, time first: the unit that importers and simulations yield.

    Attributes:
        scenario: name; trajectories of equal name are repetitions of one scenario.
        X_WB: poses; quaternion w x y z, position (m).
        V_WB_B: body twists (m/s, rad/s).
        commands: one or more of `F_Bo_B` (N, 6), `thruster_force` (N, n), `pwm` (N, n).
        sensors: optional further variables of the schema, `voltage` (N,) and the like.
        start: time of index 0 on the source's clock (s).

    Example:
        >>> X_WB, zero = np.tile([1.0, 0, 0, 0, 0, 0, -2], (41, 1)), np.zeros((41, 6))
        >>> run = Trajectory("hover", X_WB, zero, {"F_Bo_B": zero})
        >>> Recording.from_trajectories([run], dt=0.05).duration
        2.0
    """

    scenario: str
    X_WB: Float[np.ndarray, "N 7"]
    V_WB_B: Float[np.ndarray, "N 6"]
    commands: Mapping[str, np.ndarray]
    sensors: Mapping[str, np.ndarray] = field(default_factory=dict)
    start: float = 0.0

    def variables(self) -> dict[str, np.ndarray]:
        """Return all arrays by variable name."""
        return {"X_WB": self.X_WB, "V_WB_B": self.V_WB_B, **self.commands, **self.sensors}

    def __len__(self) -> int:
        return self.X_WB.shape[0]


def assemble(
    trajectories: Sequence[Trajectory],
    dt: float,
    *,
    vehicle: str = "",
    source: str = "",
    notes: Sequence[str] = (),
) -> xr.Dataset:
    """Pad trajectories to one length and stack them by scenario; padding is NaN and masked out.

    Raises:
        ValueError: if there is none, or if the arrays of a trajectory have unequal lengths.
    """
    if not trajectories:
        raise ValueError("trajectories: none given; a recording needs at least one")
    groups: dict[str, list[Trajectory]] = {}
    for trajectory in trajectories:
        groups.setdefault(trajectory.scenario, []).append(trajectory)
    J, K = len(groups), max(map(len, groups.values()))
    N = max(map(len, trajectories))
    mask = np.zeros((J, K, N), bool)
    start = np.full((J, K), np.nan)
    stacked: dict[str, np.ndarray] = {}
    for j, members in enumerate(groups.values()):
        for k, trajectory in enumerate(members):
            mask[j, k, : len(trajectory)] = True
            start[j, k] = trajectory.start
            for name, values in trajectory.variables().items():
                array = np.asarray(values, np.float64)
                if array.shape[0] != len(trajectory):
                    raise ValueError(
                        f"{name}: {array.shape[0]} samples but X_WB has {len(trajectory)} "
                        f"in scenario '{trajectory.scenario}'"
                    )
                target = stacked.setdefault(name, np.full((J, K, N, *array.shape[1:]), np.nan))
                target[j, k, : len(trajectory)] = array
    return dataset_of(
        stacked, mask, list(groups), dt, start=start, vehicle=vehicle, source=source, notes=notes
    )


def dataset_of(
    arrays: Mapping[str, np.ndarray],
    mask: np.ndarray,
    scenarios: Sequence[str],
    dt: float,
    *,
    start: np.ndarray | None = None,
    vehicle: str = "",
    source: str = "",
    notes: Sequence[str] = (),
) -> xr.Dataset:
    """Name the dimensions of stacked arrays (scenario, trajectory, time, …) and add units."""
    variables: dict[str, object] = {"mask": (LEADING, mask)}
    coords: dict[str, object] = {
        "scenario": ("scenario", np.array(list(scenarios), dtype=object)),
        "trajectory": ("trajectory", np.arange(mask.shape[1])),
        "time": ("time", dt * np.arange(mask.shape[2]), {"units": "s"}),
    }
    for name, values in arrays.items():
        dims = variable_dims(name) if name in _KNOWN else _free_dims(name, values)
        attrs = {"units": variable_units(name)} if name in _KNOWN else {}
        variables[name] = (dims, np.where(_lift(mask, values.ndim), values, np.nan), attrs)
        if len(dims) == 4:
            count = values.shape[-1]
            coords[dims[-1]] = list(LABELS.get(dims[-1], range(1, count + 1)))
    if start is not None:
        variables["start_time"] = (LEADING[:2], start, {"units": "s"})
    attrs = {
        "format": FORMAT,
        "frames": FRAMES,
        "hold": HOLD,
        "dt": float(dt),
        "vehicle": vehicle,
        "source": source,
        "notes": "\n".join(notes),
    }
    return xr.Dataset(variables, coords=coords, attrs=attrs)  # pyright: ignore[reportArgumentType]


def _free_dims(name: str, values: np.ndarray) -> tuple[str, ...]:
    return LEADING if values.ndim == 3 else (*LEADING, f"{name}_component")


def _lift(mask: np.ndarray, ndim: int) -> np.ndarray:
    return mask.reshape(mask.shape + (1,) * (ndim - mask.ndim))


def window(
    dataset: xr.Dataset, first: Int[np.ndarray, "J K"], stop: Int[np.ndarray, "J K"]
) -> xr.Dataset:
    """Return samples first … stop-1 of every trajectory, moved to index 0 and time 0."""
    mask = dataset["mask"].to_numpy()
    lengths = np.maximum(np.minimum(stop, mask.sum(axis=2)) - first, 0)
    N = max(int(lengths.max()), 1)
    index = np.minimum(first[..., None] + np.arange(N), mask.shape[2] - 1)
    inside = np.arange(N) < lengths[..., None]
    dt = float(dataset.attrs["dt"])
    result = dataset.isel(time=slice(0, N)).assign_coords(
        time=("time", dt * np.arange(N), {"units": "s"})
    )
    for name, variable in dataset.data_vars.items():
        if variable.dims[:3] != LEADING or name == "mask":
            continue
        values = variable.to_numpy()
        taken = np.take_along_axis(values, _lift(index, values.ndim), axis=2)
        filled = np.where(_lift(inside, values.ndim), taken, np.nan)
        result[name] = (variable.dims, filled, variable.attrs)
    result["mask"] = (LEADING, inside)
    if "start_time" in result:
        moved = dataset["start_time"].to_numpy() + dt * first
        result["start_time"] = (LEADING[:2], moved, dataset["start_time"].attrs)
    kept = np.any(inside, axis=2)
    return result.isel(
        scenario=np.flatnonzero(np.any(kept, axis=1)),
        trajectory=np.flatnonzero(np.any(kept, axis=0)),
    )
