"""The log of a simulated vehicle: a Recording of its true motion, with commands and state."""

from pathlib import Path

import numpy as np

from ...models.recordings.build import Trajectory
from ...models.recordings.store import Recording
from .autopilot.channels import COUNT as CHANNELS
from .plant import Plant
from .vehicle import Vehicle


class TruthLog:
    """Samples of truth, pulse widths and the autopilot's state at a fixed rate.

    Variables besides those of every recording: `rc` (the pilot's channels, µs), `voltage`, and in
    `autopilot_state` mode, armed, failsafe, gain and number of boots.
    """

    def __init__(self, plant: Plant, vehicle: Vehicle, rate: float):
        self._plant, self._vehicle = plant, vehicle
        self.dt = 1 / rate
        self._rows: list[np.ndarray] = []

    def sample(self, time: float) -> None:
        """Take a sample if one is due by `time` (s)."""
        if time < len(self._rows) * self.dt - 1e-9:
            return
        autopilot, n = self._vehicle.autopilot, self._plant.thrusters
        state = [
            autopilot.mode,
            autopilot.armed,
            autopilot.failsafes.any,
            autopilot.pilot.gain,
            self._vehicle.boots,
        ]
        parts = (
            *self._plant.truth(),
            np.array(autopilot.outputs.us[:n], float),
            np.array(autopilot.channels.us, float),
            np.array([autopilot.motion.voltage]),
            np.array(state, float),
        )
        self._rows.append(np.concatenate(parts))

    def save(self, path: Path, name: str, source: str) -> None:
        """Write a Recording."""
        if not self._rows:
            self.sample(0.0)
        n = self._plant.thrusters
        ends = np.cumsum([7, 6, n, CHANNELS, 1])
        X, V, pwm, rc, voltage, state = np.split(np.stack(self._rows), ends, axis=1)
        sensors = {"rc": rc, "voltage": voltage[:, 0], "autopilot_state": state}
        Recording.from_trajectories(
            [Trajectory(name, X, V, {"pwm": pwm}, sensors)],
            self.dt,
            vehicle=self._plant.vehicle.name,
            source=source,
        ).save(path)
