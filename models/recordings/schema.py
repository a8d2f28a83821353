"""Schema of a recording: names, dimensions, units, and their check.

`docs/recording.md` documents the same schema for people who write such files.
"""

from collections.abc import Hashable, Mapping

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from ..se3 import POSE, TWIST, WRENCH, XYZ
from .origin import LOW_PASS
from .outputs import check_outputs

FORMAT = "spinndrift recording 1"
FRAMES = "W: ENU z-up; B: FLU"
HOLD = "zero-order: the command at index n acts from t_n to t_(n+1)"

LEADING = ("scenario", "trajectory", "time")

STATES = {
    "X_WB": ("pose_component", "1, m"),
    "V_WB_B": ("twist_component", "m/s, rad/s"),
}
COMMANDS = {
    "F_Bo_B": ("wrench_component", "N, N m"),
    "thruster_force": ("thruster", "N"),
    "pwm": ("thruster", "us"),
}
UNEVEN = "elapsed"
"""Time since a trajectory's index 0, where its steps are uneven; dt is then a nominal step."""
PWM_STD = "pwm_std"
"""Standard deviation of the PWM in each step, of logs with sampled outputs; `pwm` is the mean."""
PWM_RISE = "pwm_rise"
"""Change of the PWM over each step by the line that fits it best, of such logs."""
SENSORS: dict[str, tuple[str | None, str]] = {
    "voltage": (None, "V"),
    "imu_specific_force": ("axis", "m/s^2"),
    "imu_angular_rate": ("axis", "rad/s"),
    "pressure_depth": (None, "m"),
    "vertical_velocity": (None, "m/s"),
    "rc": ("channel", "us"),
    PWM_STD: ("thruster", "us"),
    PWM_RISE: ("thruster", "us"),
    UNEVEN: (None, "s"),
}
LABELS: dict[str, tuple[str, ...]] = {
    "pose_component": POSE,
    "twist_component": TWIST,
    "wrench_component": WRENCH,
    "axis": XYZ,
}
LIMITS: dict[str, tuple[float, float]] = {
    "attitude": (-1.01, 1.01),
    "position": (-1e7, 1e7),
    "velocity": (-100.0, 100.0),
    "rate": (-100.0, 100.0),
    "force": (-1e6, 1e6),
    "moment": (-1e6, 1e6),
    "thrust": (-1e5, 1e5),
    "pwm": (0.0, 10000.0),
    "voltage": (0.0, 1000.0),
    "specific force": (-1e4, 1e4),
    "depth": (-1e3, 2e4),
    "channel": (0.0, 65535.0),
    "time": (0.0, 1e9),
}
"""Limits of plausible values in the units above; beyond them data are damaged or in another unit.

Positions may be map grid coordinates, whose northings go to 1e7 m."""
QUANTITIES: dict[str, tuple[str, ...]] = {
    "X_WB": ("attitude",) * 4 + ("position",) * 3,
    "V_WB_B": ("velocity",) * 3 + ("rate",) * 3,
    "F_Bo_B": ("force",) * 3 + ("moment",) * 3,
    "thruster_force": ("thrust",),
    "pwm": ("pwm",),
    "voltage": ("voltage",),
    "imu_specific_force": ("specific force",),
    "imu_angular_rate": ("rate",),
    "pressure_depth": ("depth",),
    "vertical_velocity": ("velocity",),
    "rc": ("channel",),
    UNEVEN: ("time",),
}
"""Quantity of each component of a variable, or one for all."""
# Channels that a log may lack; they are then NaN throughout a trajectory.
MAY_LACK = {"X_WB": XYZ, "V_WB_B": TWIST}
_NORM_TOLERANCE = 1e-4
_SHORTEST_STEP, _LONGEST_STEP = 1e-6, 1e4
_CUTOFFS = (1.0, 500.0)
"""Cutoffs (Hz) that an autopilot's low-pass may have."""


def variable_dims(name: str) -> tuple[str, ...]:
    """Return the dimensions of a known variable."""
    last = (STATES | COMMANDS | SENSORS)[name][0]
    return LEADING if last is None else (*LEADING, last)


def variable_units(name: str) -> str:
    """Return the units of a known variable."""
    return (STATES | COMMANDS | SENSORS)[name][1]


def present(dataset: xr.Dataset, kinds: Mapping[str, tuple[str | None, str]]) -> tuple[str, ...]:
    """Return the names of `kinds` that the dataset holds, in canonical order."""
    return tuple(name for name in kinds if name in dataset)


def observed(
    values: Float[np.ndarray, "J K N C"], mask: Bool[np.ndarray, "J K N"]
) -> Bool[np.ndarray, "J K C"]:
    """Whether each channel of each trajectory has any finite value."""
    return np.any(np.isfinite(values) & mask[..., None], axis=2)


def is_recording(dataset: xr.Dataset) -> bool:
    """Whether a dataset has this format, in any version."""
    return str(dataset.attrs.get("format", "")).startswith(FORMAT.rsplit(" ", 1)[0])


def check(dataset: xr.Dataset) -> None:
    """Refuse a dataset that is not a recording.

    Raises:
        ValueError: with one sentence naming the variable, the location and the remedy.
    """
    _check_layout(dataset)
    _check_time(dataset)
    mask = dataset["mask"].to_numpy()
    if not mask.any():
        raise ValueError("mask: the recording holds no sample at all")
    if (mask[..., 1:] & ~mask[..., :-1]).any():
        raise ValueError(
            "mask: a trajectory must run from index 0 without holes; cut at gaps into trajectories"
        )
    for name in present(dataset, STATES) + present(dataset, COMMANDS):
        _check_values(dataset, name, mask)
    _check_quaternions(dataset, mask)
    if UNEVEN in dataset:
        _check_elapsed(dataset, mask)
    check_outputs(dataset)


def check_plausible(dataset: xr.Dataset) -> None:
    """Refuse measured data outside `LIMITS`; data of a diverged simulation may exceed them.

    Raises:
        ValueError: with one sentence naming the variable, the location and the remedy.
    """
    for name, quantities in QUANTITIES.items():
        if name not in dataset:
            continue
        values = dataset[name].to_numpy()
        low, high = np.array([LIMITS[quantity] for quantity in quantities]).T
        if dataset[name].dims == LEADING:
            low, high = low[0], high[0]
        bad = (values < low) | (values > high)
        if bad.any():
            where = tuple(np.argwhere(bad)[0].tolist())
            j, k, n, *component = where
            labels = LABELS.get(str(dataset[name].dims[-1]), tuple(range(1, values.shape[-1] + 1)))
            label = f"[{labels[component[0]]}]" if component else ""
            c = component[0] if component and len(quantities) > 1 else 0
            low, high = LIMITS[quantities[c]]
            scenario = str(dataset["scenario"].to_numpy()[j])
            raise ValueError(
                f"{name}{label}: {values[where]:.4g} at scenario '{scenario}', trajectory {k}, "
                f"index {n}; no vehicle goes below {low:g} or above {high:g} "
                f"{variable_units(name)}: mend the unit, or cut the trajectory there"
            )


def _check_elapsed(dataset: xr.Dataset, mask: np.ndarray) -> None:
    times = dataset[UNEVEN].to_numpy()
    rises = (np.diff(times, axis=2) > 0) | ~mask[..., 1:]
    some = np.isfinite(times) & mask
    bad = some.any(axis=2) & ~(np.all(some | ~mask, axis=2) & rises.all(axis=2))
    if bad.any():
        j, k = np.argwhere(bad)[0]
        raise ValueError(
            f"{UNEVEN}: times of scenario '{dataset['scenario'].to_numpy()[j]}', trajectory {k} "
            "lack or don't rise; give one for each sample, in order"
        )


def _check_layout(dataset: xr.Dataset) -> None:
    for name in ("X_WB", "V_WB_B", "mask"):
        if name not in dataset:
            raise ValueError(f"{name}: missing; a recording needs X_WB, V_WB_B, mask and a command")
    if not present(dataset, COMMANDS):
        raise ValueError(
            f"no command: give at least one of {', '.join(COMMANDS)} so that there is an input"
        )
    for name in dataset.variables:
        _check_variable(dataset, name)
    for name in ("format", "vehicle", "source", "notes"):
        if not isinstance(dataset.attrs.get(name, ""), str):
            raise ValueError(f"{name}: this attribute must be text")
    if dataset["mask"].dtype != np.bool_ or dataset["mask"].dims != LEADING:
        raise ValueError(f"mask: must be bool over {LEADING}")
    names = [str(s) for s in dataset["scenario"].to_numpy()]
    if "scenario" not in dataset.coords or len(set(names)) != len(names):
        raise ValueError(f"scenario: needs one distinct name each, got {names}")
    for dim, labels in LABELS.items():
        if dim in dataset.dims and dataset.sizes[dim] != len(labels):
            raise ValueError(f"{dim}: must have {len(labels)} entries {labels}")


def _check_variable(dataset: xr.Dataset, name: Hashable) -> None:
    known = STATES | COMMANDS | SENSORS
    if name not in known:
        return
    variable = dataset[name]
    if name in dataset.coords:
        raise ValueError(f"{name}: is a coordinate; make it a variable over {LEADING}")
    if variable.dims != variable_dims(str(name)):
        raise ValueError(
            f"{name}: dimensions must be {variable_dims(str(name))}, got {variable.dims}"
        )
    if not np.issubdtype(variable.dtype, np.floating):
        raise ValueError(f"{name}: must be floating point, got {variable.dtype}")
    units = variable.attrs.get("units", variable_units(str(name)))
    if units != variable_units(str(name)):
        raise ValueError(
            f"{name}: units must be '{variable_units(str(name))}', got '{units}'; convert first"
        )


def _check_time(dataset: xr.Dataset) -> None:
    if "time" not in dataset.coords or "dt" not in dataset.attrs:
        raise ValueError("time: needs the coordinate `time` (s) and the attribute `dt` (s)")
    time, dt = dataset["time"].to_numpy(), _seconds(dataset, "dt")
    if "command_period" in dataset.attrs:
        _seconds(dataset, "command_period")
    if LOW_PASS in dataset.attrs:
        _number(dataset, LOW_PASS, _CUTOFFS, "Hz")
    if not np.issubdtype(time.dtype, np.floating) or time.ndim != 1:
        raise ValueError(f"time: must be numbers (s), got {time.dtype}")
    if "start_time" in dataset:
        start = dataset["start_time"]
        if start.dims != LEADING[:2] or not np.issubdtype(start.dtype, np.floating):
            raise ValueError(f"start_time: must be numbers (s) over {LEADING[:2]}")
    expected = dt * np.arange(time.size)
    if not np.allclose(time, expected, rtol=0, atol=1e-6 * dt * max(1, time.size)):
        raise ValueError(
            f"time: must be 0, {dt:g}, {2 * dt:g}, … s; resample uneven data to one step first"
        )


def _seconds(dataset: xr.Dataset, name: str) -> float:
    """An attribute that is a time step."""
    return _number(dataset, name, (_SHORTEST_STEP, _LONGEST_STEP), "seconds")


def _number(dataset: xr.Dataset, name: str, limits: tuple[float, float], unit: str) -> float:
    """An attribute that is a number within limits."""
    value, (least, most) = dataset.attrs[name], limits
    number = isinstance(value, int | float | np.floating | np.integer)
    if not number or not least <= value <= most:
        raise ValueError(
            f"{name}: must be a number of {unit} from {least:g} to {most:g}, got {str(value)[:60]}"
        )
    return float(value)


def _check_values(dataset: xr.Dataset, name: str, mask: np.ndarray) -> None:
    values = dataset[name].to_numpy()
    if np.isfinite(values[~mask]).any():
        raise ValueError(f"{name}: numbers outside the mask; padding must be NaN")
    missing = ~np.isfinite(values) & mask[..., None]
    partly = missing.any(axis=2) & (
        observed(values, mask) | ~_may_lack(dataset, name)[None, None, :]
    )
    if partly.any():
        j, k, c = np.argwhere(partly)[0]
        n = int(np.argmax(missing[j, k, :, c]))
        label = LABELS.get(str(dataset[name].dims[-1]), tuple(range(1, values.shape[-1] + 1)))[c]
        scenario = str(dataset["scenario"].to_numpy()[j])
        raise ValueError(
            f"{name}[{label}]: not a finite number at scenario '{scenario}', trajectory {k}, "
            f"index {n}; cut the trajectory there or fill the value"
        )


def _may_lack(dataset: xr.Dataset, name: str) -> np.ndarray:
    labels = LABELS.get(str(dataset[name].dims[-1]), ())
    allowed = MAY_LACK.get(name, ())
    count = dataset[name].shape[-1]
    return np.array([bool(labels) and labels[i] in allowed for i in range(count)])


def _check_quaternions(dataset: xr.Dataset, mask: np.ndarray) -> None:
    with np.errstate(over="ignore"):  # an infinite norm is refused like any other wrong one
        norm = np.linalg.norm(dataset["X_WB"].to_numpy()[..., :4], axis=-1)
    off = mask & (np.abs(norm - 1) > _NORM_TOLERANCE)
    if off.any():
        j, k, n = np.argwhere(off)[0]
        raise ValueError(
            f"X_WB: quaternion of length {norm[j, k, n]:.4g} at scenario "
            f"'{dataset['scenario'].to_numpy()[j]}', trajectory {k}, index {n}; normalise it"
        )
