"""Trajectories of maneuvers, taken from a running diagram as soon as each is finished."""

from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, Diagram

from ...models.recordings.build import Trajectory
from ...systems.closed_loop import Signal, logged
from ...systems.controllers.maneuvers import Phase
from ..scenarios.criteria import Outcome
from ..scenarios.maneuvers import Maneuvers
from ..scenarios.scenario import Scenario
from .flight_log import Journal
from .log import without_horizontal
from .signals import mean_over

Keep = Callable[[int, Trajectory], None]
"""Takes in a finished trajectory and its number among those of its maneuver; does not wait."""
LEAD = 0.5
"""Time at rest (s) that a trajectory has before its maneuver, so that it is known what thrusters
did before: a diagnosis initialises their memory with that."""
_TIMED = 1e-6  # s
_NEEDED = ("maneuver", "X_WB", "V_WB_B", "X_WB_cheat", "V_WB_B_cheat", "F_acting", "pwm")


class ManeuverTap:
    """Follows the controller `!Maneuvers` and hands over what it has finished.

    For any other controller it does nothing.
    """

    def __init__(
        self,
        scenario: Scenario,
        diagram: Diagram,
        root: Context,
        keep: Keep | None = None,
        journal: Journal | None = None,
    ):
        """`journal` is that of a vehicle, whose commands are those that were sent."""
        self.names: tuple[tuple[str, int], ...] = ()
        self._scenario, self._diagram, self._root = scenario, diagram, root
        self._journal, self._keep = journal, keep or (lambda number, trajectory: None)
        self._index, self._left_out = 0, 0
        self._taken = 0.0  # end of the last trajectory (s)
        if isinstance(scenario.controller, Maneuvers):
            controller: Any = diagram.GetSubsystemByName("controller")
            self.names = controller.program.names
            self._port = controller.GetOutputPort("maneuver")
            self._context = controller.GetMyContextFromRoot(root)

    @property
    def _lead(self) -> int:
        """Samples at rest before the maneuver."""
        assert isinstance(self._scenario.controller, Maneuvers)
        return round(min(LEAD, self._scenario.controller.steady.time) * self._scenario.log.rate)

    @property
    def done(self) -> float:
        """Share of the trajectories that are finished or left out, 0 without any."""
        if not self.names:
            return 0.0
        phase, index, *_ = self._port.Eval(self._context)
        return (index + (0.5 if phase == Phase.OPEN_LOOP else 0.1)) / len(self.names)

    def read(self, t: float) -> Outcome | None:
        """Hand over new trajectories; the outcome `finished` at the controller's end."""
        if not self.names:
            return None
        phase, index, *_ = self._port.Eval(self._context)
        if index > self._index:
            self._take(int(index))
        if phase != Phase.FINISHED:
            return None
        if self._index < len(self.names):
            name = _label(self.names[self._index - 1])
            words = f"Given up at {t:.1f} s: the vehicle did not come to rest for {name}"
            return Outcome("guard", t, f"{words} and those before it, within {self._limit}.")
        left = f", {self._left_out} left out" if self._left_out else ""
        words = f"{self._index - self._left_out} trajectories were flown in {t:.0f} s{left}."
        return Outcome("duration" if self._left_out else "finished", t, words)

    @property
    def _limit(self) -> str:
        assert isinstance(self._scenario.controller, Maneuvers)
        steady = self._scenario.controller.steady
        return (
            f"{steady.limit:g} s (steady: {steady.position:g} m, {steady.angle:g}°, "
            f"{steady.speed:g} m/s, {steady.turn_rate:g} rad/s)"
        )

    def words(self) -> str:
        """The present state in a few words; empty without maneuvers."""
        if not self.names:
            return ""
        phase, index, *_ = self._port.Eval(self._context)
        at = min(int(index), len(self.names) - 1)
        told = Phase(int(phase)).name.lower().replace("_", " ")
        return f"{at + 1} of {len(self.names)}: {_label(self.names[at])}, {told}"

    def _take(self, index: int) -> None:
        """Hand over the trajectories before the number `index` that were flown to their end."""
        signals = logged(self._diagram, self._root, _NEEDED, self._taken)
        state = signals["maneuver"].value
        for number in range(self._index, index):
            rows = np.flatnonzero((state[:, 1] == number) & (state[:, 0] == Phase.OPEN_LOOP))
            end = rows[-1] + 1 if rows.size else 0
            if rows.size:
                self._taken = float(signals["maneuver"].time[end - 1])
            if rows.size and end < len(state) and state[end, 4] == 0:
                name, repeat = self.names[number]
                first = max(int(rows[0]) - self._lead, 0)
                self._keep(repeat, self._trajectory(name, signals, slice(first, end + 1)))
            else:
                self._left_out += 1
        self._index = index

    def _trajectory(self, name: str, signals: dict[str, Signal], rows: slice) -> Trajectory:
        dt, station = 1 / self._scenario.log.rate, self._scenario.station
        X, V = (signals[name].value[rows] for name in ("X_WB", "V_WB_B"))
        start = float(signals["X_WB"].time[rows][0])
        grid = start + dt * np.arange(len(X))
        if self._journal is not None:
            commands = self._journal.steps(grid, dt)
            sensors = {n: commands.pop(n) for n in ("voltage", "pwm_shown") if n in commands}
            if not self._scenario.positioned:
                X, V, climb = without_horizontal(X, V)
                sensors["vertical_velocity"] = climb
        else:
            acting = signals["F_acting"]
            inside = (acting.time > start - _TIMED) & (acting.time < grid[-1] + dt - _TIMED)
            sent = Signal(acting.time[inside] - start, acting.value[inside])
            commands = {
                "F_Bo_B": mean_over(sent, grid - start, dt),
                "pwm": signals["pwm"].value[rows].copy(),
            }
            nominal = float(station.load_vehicle().thrusters().nominal_voltage)
            sensors = {
                "voltage": np.full(len(X), station.voltage or nominal),
                "X_WB_estimate": X,
                "V_WB_B_estimate": V,
            }
            X, V = (signals[f"{name}_cheat"].value[rows] for name in ("X_WB", "V_WB_B"))
        sensors["open_loop"] = (signals["maneuver"].value[rows, 0] == Phase.OPEN_LOOP).astype(float)
        for values in commands.values():  # the last acts after the end: no part of the trajectory
            values[-1] = values[-2]
        sensors["dive_time"] = grid
        # repeats begin at the same time of their clocks: training compares them instant by instant
        return Trajectory(name, X, V, commands, sensors)


def _label(name: tuple[str, int]) -> str:
    return f"{name[0]} {name[1]}"
