"""Thruster forces of the commands that a recording has: recorded, or from PWM and voltage."""

import os
from typing import Any

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float

from ..config.errors import UserError
from ..vehicles.vehicle import load_vehicle
from .schema import PWM_RISE, PWM_STD

_OF_THIS_PWM = 0.2
"""Slope of changes of the PWM over its rises below which it was changed without these."""
_LEAST_US = 1.0
"""Least width (us) over which the slope of a thrust curve is taken."""


def thrusters_of(dataset: xr.Dataset, vehicle: Any, command: str) -> Any:
    """Thrusters of a `Vehicle`, a preset or file by name, or the one named in the recording."""
    named = str(dataset.attrs.get("vehicle", ""))
    if vehicle is None and not named:
        raise UserError(
            f"vehicle: the recording holds {command} and names no vehicle; "
            "name one to turn it into a wrench"
        )
    if vehicle is None or isinstance(vehicle, str | os.PathLike):
        vehicle = load_vehicle(named if vehicle is None else os.fspath(vehicle))
    return vehicle.thrusters(jnp.result_type(float))


def forces_of(dataset: xr.Dataset, name: str, thrusters: Any) -> Float[Array, "n J K N"]:
    """Forces (N) of a command in forces or PWM; of none beyond a trajectory's end.

    Where the PWM changed within a step by `pwm_std` about its mean, the mean force is that of the
    two pulses with this mean and deviation: exact for a quadratic curve (Gauss's rule).
    """
    values, mask = dataset[name].to_numpy(), dataset["mask"].to_numpy()
    check_count(dataset, name, thrusters.allocation.shape[1])
    if name == "thruster_force":
        return jnp.asarray(np.moveaxis(np.where(mask[..., None], values, 0.0), -1, 0))
    command = _pulses(dataset)
    volts = jnp.asarray(voltage_of(dataset, thrusters))
    if PWM_STD not in dataset or not _unchanged(dataset):
        return thrusters.force(command, volts)
    std = _of_pwm(dataset, PWM_STD)
    return (thrusters.force(command + std, volts) + thrusters.force(command - std, volts)) / 2


def rises_of(dataset: xr.Dataset, thrusters: Any) -> Float[np.ndarray, "J K N n"] | None:
    """Changes of the thrusters' forces (N) over each step; None where commands are held.

    Those of `pwm_rise` by the slope of the thrust curve from one deviation below the mean PWM to
    one above it. 0 beyond a trajectory's end.
    """
    if not {"pwm", PWM_RISE} <= set(dataset) or "thruster_force" in dataset:
        return None
    if not _unchanged(dataset):
        return None
    change = _of_pwm(dataset, PWM_RISE)
    width = jnp.abs(change) / np.sqrt(12.0)  # deviation of a line
    if PWM_STD in dataset:
        width = jnp.maximum(width, _of_pwm(dataset, PWM_STD))
    width = jnp.maximum(width, _LEAST_US)
    pwm = _pulses(dataset)
    volts = jnp.asarray(voltage_of(dataset, thrusters))
    above, below = (thrusters.force(pwm + sign * width, volts) for sign in (1, -1))
    return np.moveaxis(np.asarray(change * (above - below) / (2 * width)), 0, -1)


def _pulses(dataset: xr.Dataset) -> Float[Array, "n J K N"]:
    """Mean PWM of each step; neutral beyond a trajectory's end."""
    pwm, mask = dataset["pwm"].to_numpy(), dataset["mask"].to_numpy()[..., None]
    return jnp.asarray(np.moveaxis(np.where(mask, pwm, 1500.0), -1, 0))


def _unchanged(dataset: xr.Dataset) -> bool:
    """Whether the rises of a recording are those of its PWM, which was not changed without them.

    Half the change from the step before to the step after one is `pwm_rise` for a line, and a third
    of it for steps of the PWM in the middle of a step.
    """
    if PWM_RISE not in dataset:
        return True
    pwm, rise = (dataset[name].to_numpy() for name in ("pwm", PWM_RISE))
    around, rise = (pwm[:, :, 2:] - pwm[:, :, :-2]) / 2, rise[:, :, 1:-1]
    both = np.isfinite(around) & np.isfinite(rise)
    product, square = (np.where(both, x * rise, 0.0).sum((0, 1, 2)) for x in (around, rise))
    return bool(np.all(product >= _OF_THIS_PWM * square))


def _of_pwm(dataset: xr.Dataset, name: str) -> Float[Array, "n J K N"]:
    """A variable beside the PWM; 0 where it is not known."""
    return jnp.asarray(np.nan_to_num(np.moveaxis(dataset[name].to_numpy(), -1, 0)))


def check_count(dataset: xr.Dataset, name: str, count: int, vehicle: str = "the vehicle") -> None:
    """Refuse commands of another number of thrusters than the vehicle's `count`.

    Raises:
        UserError: the sentence says both numbers.
    """
    found = dataset[name].shape[-1]
    if name != "F_Bo_B" and found != count:
        raise UserError(
            f"{name}: the recording has {found} thrusters, {vehicle} {count}; choose the vehicle "
            "it was recorded with (--vehicle)"
        )


def voltage_of(dataset: xr.Dataset, thrusters: Any) -> Float[np.ndarray, "J K N"]:
    """Voltage at each sample (V), the nominal one where none was measured."""
    nominal = float(thrusters.nominal_voltage)
    if "voltage" not in dataset:
        return np.full(dataset["mask"].shape, nominal)
    measured = dataset["voltage"].to_numpy()
    return np.where(np.isfinite(measured), measured, nominal)
