"""The log of a simulated vehicle: a Recording of its true motion, with commands and state."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from ...models.recordings.build import Trajectory
from ...models.recordings.store import Recording
from .physics import Physics

Seen = Mapping[str, np.ndarray]


class TruthLog:
    """Samples of truth, pulse widths and further variables at a fixed rate.

    `seen` gives the pulse widths `pwm` (µs) of the thrusters and the further variables, each a
    vector. An hour at 20 Hz takes about 30 MB.
    """

    def __init__(self, physics: Physics, rate: float, seen: Callable[[], Seen]):
        self._physics, self._seen = physics, seen
        self.dt = 1 / rate
        self._rows: list[np.ndarray] = []
        self._sizes: dict[str, int] = {}

    def sample(self, time: float) -> None:
        """Take a sample if one is due by `time` (s)."""
        if time < len(self._rows) * self.dt - 1e-9:
            return
        X, V = self._physics.truth()
        parts = {"X": X, "V": V, **self._seen()}
        self._sizes = {name: part.size for name, part in parts.items()}
        self._rows.append(np.concatenate(list(parts.values())))

    def save(self, path: Path, name: str, source: str) -> None:
        """Write a Recording."""
        if not self._rows:
            self.sample(0.0)
        ends = np.cumsum(list(self._sizes.values()))[:-1]
        values = np.split(np.stack(self._rows), ends, axis=1)
        found = dict(zip(self._sizes, values, strict=True))
        X, V, pwm = (found.pop(name) for name in ("X", "V", "pwm"))
        sensors = {
            name: value[:, 0] if value.shape[1] == 1 else value for name, value in found.items()
        }
        Recording.from_trajectories(
            [Trajectory(name, X, V, {"pwm": pwm}, sensors)],
            self.dt,
            vehicle=self._physics.config.vehicle,
            source=source,
        ).save(path)
