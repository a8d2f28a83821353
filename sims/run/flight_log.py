"""The log of a flight: the commands and guards of every call, and one Recording of it."""

import math
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ...systems.closed_loop import Signal
from ...systems.growing_rows import GrowingRows
from ...systems.mavlink import telemetry
from ...systems.mavlink.driver import Acted, Driver
from ...systems.mavlink.safety import AGED
from ..scenarios.scenario import Scenario
from .log import RunLog, without_horizontal
from .signals import PlanTap, consistency, mean_over

ORDERS = ("fly", "neutral", "hold_depth", "disarm", "yield")
"""Orders of the guards, by their number in the log."""
AGES = tuple(age for age, *_ in AGED.values())
"""Names of the ages in the log, in their order."""
_SAME = 1e-6  # s
_NOTED = ("t", "order", "voltage", "silence", "F", "expected", "shown", "ages")
_KEPT = 3  # calls: one of them is that of the newest row of the log
_RECENT = 60.0  # s for which a text of the vehicle is shown
_NOTES = (
    "X_WB and V_WB_B are the estimate, flown on a vehicle; there is no truth.",
    "F_Bo_B is the mean over each step of the wrench that was sent, within the guards' limits. pwm "
    "is the output that the vehicle showed at the sample; pwm_commanded is what it was to show.",
    f"guard_ages are the ages that the guards saw (s): {', '.join(AGES)}.",
)


class Entry(NamedTuple):
    """What was done at one call."""

    t: float
    order: int
    F_Bo_B: Float[np.ndarray, "6"]
    expected: Float[np.ndarray, " n"]
    shown: Float[np.ndarray, " n"]
    voltage: float
    silence: float
    ages: Mapping[str, float]


class Journal:
    """What was commanded, call by call, and what the vehicle showed."""

    def __init__(self, driver: Driver):
        self._driver = driver
        n = driver.thrusters
        self._sizes = (1, 1, 1, 1, 6, n, n, len(AGES))
        self._rows = GrowingRows(sum(self._sizes))
        self._newest: deque[Entry] = deque(maxlen=_KEPT)
        self.late: list[float] = []
        """Time from the planned instant of each command to its end (s)."""
        self.reason = ""
        """Why the dive has ended; empty while it goes on."""
        self.tripped = ""
        """Name of the guard that has ended it."""
        self.epoch: float | None = None
        """Local time at which the dive begins (s)."""
        self.boot: float = math.nan
        """Time at which it begins on the vehicle's boot clock (s)."""

    def act(self, t: float, acted: Acted) -> None:
        """Take in a command at time t (s)."""
        driver, now = self._driver, time.monotonic()
        outputs = telemetry.outputs(driver.link, driver.thrusters)
        shown = np.full(acted.expected.size, np.nan) if outputs is None else outputs.value
        sent, shown = driver.as_described(acted.expected), driver.as_described(shown)
        order, volts = ORDERS.index(acted.order), telemetry.battery(driver.link)
        silence = driver.link.silence
        entry = Entry(t, order, acted.F_Bo_B, sent, shown, volts, silence, acted.ages)
        self._newest.append(entry)
        numbers = t, order, volts, silence
        self._rows.new()[:] = np.hstack([numbers, acted.F_Bo_B, sent, shown, _ages(entry)])
        self.reason, self.tripped = acted.reason, acted.tripped
        if self.epoch is not None:
            self.late.append(now - self.epoch - t)

    def before(self, t: float) -> Entry | None:
        """The newest entry of time t (s) or before, which the log has at t."""
        return next((entry for entry in reversed(self._newest) if entry.t <= t + _SAME), None)

    @property
    def finished(self) -> bool:
        """Whether the end that follows a guard has been reached."""
        return self._driver.finished

    def words(self) -> str:
        """The present state in a few words."""
        if not self._newest:
            return ""
        last = self._newest[-1]
        volts = "" if math.isnan(last.voltage) else f", {last.voltage:.1f} V"
        return f"{ORDERS[last.order]}{volts}"

    def vehicle(self) -> dict[str, Any]:
        """What the vehicle says of itself, and how well it is heard."""
        link, now = self._driver.link, time.monotonic()
        status, found = telemetry.status(link, now), link.statistics(rated=False)
        total = max(found.received + found.lost, 1)
        return {
            "mode": "" if status is None else status.mode,
            "armed": status is not None and status.armed,
            "link_lost": found.lost / total,
            "round_trip": found.round_trip,
            "reconnections": found.reconnections,
            "heard": [text for _, _, text in link.texts(now - _RECENT)][-8:],
        }

    def summary(self) -> dict[str, Any]:
        """Times in each order (s), the reason, the lowest voltage, the longest silence."""
        noted = self._noted()
        times, orders = noted["t"][:, 0], noted["order"][:, 0]
        spent = np.diff(times, append=times[-1:])
        found: dict[str, Any] = {
            f"{name}_s": float(spent[orders == i].sum())
            for i, name in enumerate(ORDERS)
            if np.any(orders == i)
        }
        known = noted["voltage"][np.isfinite(noted["voltage"])]
        return found | {
            "reason": self.reason or None,
            "lowest_voltage_V": float(known.min()) if known.size else None,
            "longest_silence_s": float(noted["silence"].max()) if times.size else None,
        }

    def steps(self, grid: Float[np.ndarray, " n"], dt: float) -> dict[str, np.ndarray]:
        """What was sent in the step that begins at each time of the grid: its mean.

        With the voltage and the outputs that the vehicle showed at the step's begin.
        """
        noted = self._noted(bisect_left(self._rows, grid[0] - 1.0, key=lambda row: row[0]))
        times = noted["t"][:, 0]
        index = np.clip(np.searchsorted(times, grid + _SAME, side="right") - 1, 0, None)
        ahead = times - grid[0]
        sent = {"F_Bo_B": noted["F"], "pwm": noted["expected"]}
        inside = (ahead > -_SAME) & (ahead < grid[-1] - grid[0] + dt - _SAME)
        found = {
            name: mean_over(Signal(ahead[inside], v[inside]), grid - grid[0], dt)
            for name, v in sent.items()
        }
        volts = noted["voltage"][index, 0]
        if np.isfinite(volts).all():
            found["voltage"] = volts
        return found | {"pwm_shown": noted["shown"][index]}

    def at(self, grid: Float[np.ndarray, " n"]) -> dict[str, np.ndarray]:
        """Variables of a log over the times of the grid."""
        noted = self._noted()
        times = noted["t"][:, 0]
        index = np.clip(np.searchsorted(times, grid + _SAME, side="right") - 1, 0, None)
        columns = {
            "pwm": noted["shown"],
            "pwm_commanded": noted["expected"],
            "guard_order": noted["order"],
            "voltage": noted["voltage"][:, 0],
            "silence": noted["silence"],
            "guard_ages": noted["ages"],
        }
        sent = Signal(times, noted["F"])
        dt = float(grid[1] - grid[0]) if grid.size > 1 else 1.0
        return {"F_Bo_B": mean_over(sent, grid, dt)} | {n: c[index] for n, c in columns.items()}

    def _noted(self, first: int = 0) -> dict[str, Float[np.ndarray, "n _"]]:
        """What was noted from one call on, by name."""
        parts = np.split(self._rows.since(first), np.cumsum(self._sizes)[:-1], axis=1)
        return dict(zip(_NOTED, parts, strict=True))


def _ages(entry: Entry) -> Float[np.ndarray, " a"]:
    """Ages in the order of `AGES`; NaN for those that there are not, or that are infinite."""
    found = [entry.ages.get(name, math.nan) for name in AGES]
    return np.array([math.nan if math.isinf(age) else age for age in found])


def collect_flight(
    scenario: Scenario,
    signals: Mapping[str, Signal],
    tap: PlanTap,
    end: float,
    journal: Journal,
) -> RunLog:
    """One log of all signals from 0 to `end` (s)."""
    dt = 1 / scenario.log.rate
    n = max(1, min(round(end / dt) + 1, len(signals["X_WB"].time)))
    grid = dt * np.arange(n)
    X, V = signals["X_WB"].value[:n], signals["V_WB_B"].value[:n]
    notes = _NOTES
    if not scenario.positioned:
        X, V, _ = without_horizontal(X, V)
        notes = (*notes, "There is no horizontal aid: x, y, u and v are unknown, NaN.")
    variables = {
        "X_WB": X,
        "V_WB_B": V,
        **journal.at(grid),
        "health": signals["health"].value[:n],
    }
    if "maneuver" in signals:
        variables["maneuver"] = signals["maneuver"].value[:n]
    if "covariance" in signals and np.isfinite(signals["covariance"].value[:n]).any():
        variables |= consistency(signals, n, scenario.station.sensing.fused)
    link = scenario.vehicle_link
    return RunLog.create(
        scenario.name,
        dt,
        variables | tap.setpoints(grid),
        tap.plans(float(grid[-1])),
        vehicle=scenario.station.vehicle,
        source=f"scenario {scenario.name} on the vehicle at {link and link.connection}",
        notes=notes,
        fused=scenario.station.sensing.fused,
        start=journal.boot,
    )
