"""The physics of a scenario's vehicle under an autopilot: pulse widths in, true motion out."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram

from ...systems.closed_loop import seeded
from ...systems.mavlink import codec
from ...systems.station.config import StationConfig
from ...systems.station.simulated import make_driven_plant
from .autopilot.mixer import NEUTRAL, frame_for
from .autopilot.navigation import rotated

_LOWEST, _HIGHEST = 1000, 2000  # µs: at and beyond these a speed controller stops
_WARM_UP = 0.45  # s: every event of the diagram has occurred


State = tuple[Float[np.ndarray, "7"], Float[np.ndarray, "6"]]
"""Pose X_WB and twist V_WB_B."""


def mean_specific_force(before: State, after: State, period: float) -> Float[np.ndarray, "3"]:
    """Specific force (m/s²) whose integral over a period (s) is the change of velocity.

    In body axes at the period's end.
    """
    v_W, v_W_after = (rotated(X[:4], V[:3]) for X, V in (before, after))
    rate_W = (v_W_after - v_W) / period + [0.0, 0.0, codec.G]
    return rotated(after[0][:4] * [1, -1, -1, -1], rate_W)


class Physics:
    """The plant of a scenario, stepped one period at a time."""

    def __init__(
        self,
        config: StationConfig,
        build: Callable[[StationConfig], Diagram] = make_driven_plant,
    ):
        """Build and compile.

        Raises:
            UserError: a part of the configuration names what can't be read.
        """
        self.config = config
        self.vehicle = config.load_vehicle()
        self.thrusters = len(self.vehicle.propulsion.mounts)
        self._diagram = build(config)
        self.restart()
        self._simulator.AdvanceTo(_WARM_UP)
        self.restart()
        nominal = self.vehicle.propulsion.voltage
        self._resting_voltage = nominal if config.voltage is None else config.voltage

    def restart(self) -> None:
        """Go back to the start, with the same random numbers."""
        self._simulator = Simulator(self._diagram)
        context = self._simulator.get_mutable_context()
        seeded(self._diagram, context, self.config.seed)
        neutral = np.full(self.thrusters, float(NEUTRAL))
        self._pwm = self._diagram.GetInputPort("pwm").FixValue(context, neutral)
        self._simulator.Initialize()
        self._steps = 0

    def parameters(self) -> dict[str, float]:
        """Parameters of an autopilot that knows this vehicle: its frame, its motors' directions."""
        values = {"FRAME_CONFIG": float(frame_for(self.thrusters))}
        for n, mount in enumerate(self.vehicle.propulsion.mounts, 1):
            values[f"MOT_{n}_DIRECTION"] = mount.motor
        return values

    @property
    def time(self) -> float:
        """The simulation's time (s)."""
        return self._steps * self.config.period

    def driving(self, outputs: Sequence[int]) -> Float[np.ndarray, " n"]:
        """Pulse widths (µs) at which the thrusters run, of the first outputs, one a thruster."""
        us = np.full(self.thrusters, float(NEUTRAL))
        given = np.array(outputs[: self.thrusters], float)
        us[: given.size] = np.where((given <= _LOWEST) | (given >= _HIGHEST), NEUTRAL, given)
        return us

    def step(self, outputs: Sequence[int]) -> None:
        """Advance one period with the pulse widths (µs) of the first outputs, one a thruster."""
        self._pwm.GetMutableData().set_value(self.driving(outputs))
        self._steps += 1
        self._simulator.AdvanceTo(self.time)

    def truth(self) -> State:
        """Pose X_WB and twist V_WB_B."""
        return self._value("X_WB_cheat"), self._value("V_WB_B_cheat")

    def battery(self) -> tuple[float, float]:
        """Voltage under load (V) and current (A) of the battery."""
        plant: Any = self._diagram.GetSubsystemByName("plant")
        own = plant.GetMyContextFromRoot(self._simulator.get_context())
        volts = float(plant.GetOutputPort("voltage_loaded").Eval(own)[0])
        resistance = self.vehicle.propulsion.resistance
        amps = (self._resting_voltage - volts) / resistance if resistance > 0 else 0.0
        return volts, max(amps, 0.0)

    def _value(self, name: str) -> np.ndarray:
        return np.array(self._diagram.GetOutputPort(name).Eval(self._simulator.get_context()))
