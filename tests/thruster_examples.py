"""Thrusters for tests: those of the BlueROV2 Heavy at a stiff 16 V."""

import numpy as np

from spinndrift.models.thruster_curves import T200Curve
from spinndrift.models.thrusters import Thrusters
from spinndrift.models.vehicles.vehicle import load_vehicle


def prompt_thrusters(**settings: float) -> Thrusters:
    """Without lag, start pause and sag; `settings` are those of `Thrusters`."""
    base = load_vehicle("bluerov2_heavy").thrusters()
    return Thrusters(
        np.asarray(base.positions),
        np.asarray(base.directions),
        T200Curve(),
        motor_directions=np.asarray(base.motor_directions),
        **({"nominal_voltage": 16.0} | settings),
    )
