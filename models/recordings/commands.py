"""Thruster forces of the commands that a recording has: recorded, or from PWM and voltage."""

import os
from typing import Any

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float

from ..config.errors import UserError
from ..vehicles.vehicle import load_vehicle
from .schema import PWM_STD


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
    rest = 1500.0 if name == "pwm" else 0.0
    command = jnp.asarray(np.moveaxis(np.where(mask[..., None], values, rest), -1, 0))
    if name == "thruster_force":
        return command
    volts = jnp.asarray(voltage_of(dataset, thrusters))
    if PWM_STD not in dataset:
        return thrusters.force(command, volts)
    std = jnp.asarray(np.nan_to_num(np.moveaxis(dataset[PWM_STD].to_numpy(), -1, 0)))
    return (thrusters.force(command + std, volts) + thrusters.force(command - std, volts)) / 2


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
