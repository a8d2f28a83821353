"""The forces that a recording's commands are, and their weights in the wrench."""

import numpy as np

from ...se3 import WRENCH
from ...vehicles.vehicle import Vehicle
from ..commands import voltage_of
from ..store import Recording


def columns_of(
    recording: Recording, vehicle: Vehicle | None
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]] | None:
    """Forces (J, K, N, m), their weights in the wrench (6, m), and the columns' names."""
    name = recording.thrust_from
    values = recording.dataset[name].to_numpy()
    if name == "F_Bo_B":
        return values, np.eye(6), WRENCH
    if vehicle is None or values.shape[-1] != len(vehicle.propulsion.mounts):
        return None
    thrusters = vehicle.thrusters()
    names = tuple(f"{'pwm' if name == 'pwm' else 'f'}{k + 1}" for k in range(values.shape[-1]))
    if name == "pwm":
        pulses = np.nan_to_num(values, nan=1500.0)
        mirrored = 1500 + np.asarray(thrusters.motor_directions) * (pulses - 1500)
        volts = voltage_of(recording.dataset, thrusters)[..., None]
        values = thrusters.curve.steady(mirrored, volts)
    return values, np.asarray(thrusters.allocation), names
