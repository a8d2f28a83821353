"""The ports of a station: one table, and what follows from it for a configuration."""

from collections.abc import Callable
from typing import NamedTuple

from ...models.sensors import Sensor
from ..estimation.error_state import INERTIAL
from .config import StationConfig


class StationPort(NamedTuple):
    """A row of the table.

    Attributes:
        name: of the port.
        length: in words; n is the number of sensors that the filter fuses, m that of thrusters.
        size: the length, given n and m.
        holds: what it holds.
        period: at which a closed loop logs it (s).
    """

    name: str
    length: str
    size: Callable[[int, int], int]
    holds: str
    period: float = 0.05


INPUTS = (StationPort("F_Bo_B", "6", lambda n, m: 6, "commanded wrench about Bo (N, N·m)"),)

ESTIMATES = (
    StationPort("X_WB", "7", lambda n, m: 7, "estimated pose"),
    StationPort("V_WB_B", "6", lambda n, m: 6, "estimated twist (m/s, rad/s)"),
)

COMMANDS = (StationPort("pwm", "m", lambda n, m: m, "pulse widths of the thrusters (µs)"),)

REPORTED = (
    StationPort(
        "covariance",
        "(15 + n)²",
        lambda n, m: (INERTIAL + n) ** 2,
        "of the estimate's error, by rows (`systems.estimation.error_state`)",
        0.2,
    ),
    StationPort(
        "status",
        "1 + 3 n",
        lambda n, m: 1 + 3 * n,
        "time of the filter's horizon (s); NIS, rejections in a row, age (s) of each fused sensor",
        0.2,
    ),
    StationPort(
        "health",
        "2 + n",
        lambda n, m: 2 + n,
        "0 good, 1 degraded, 2 lost; then 1 where the imu and each fused sensor are trusted",
    ),
)
"""What a filter may leave out: NaN then, and good health."""

CHEATS = (
    StationPort("X_WB_cheat", "7", lambda n, m: 7, "true pose"),
    StationPort("V_WB_B_cheat", "6", lambda n, m: 6, "true twist (m/s, rad/s)"),
    StationPort("F_disturbance_cheat", "6", lambda n, m: 6, "disturbances' wrench (N, N·m)"),
    StationPort("flow_cheat", "6", lambda n, m: 6, "water's velocity and acceleration in W"),
)
"""Ports that only a simulation has: the truth."""


def sensor_ports(config: StationConfig) -> tuple[StationPort, ...]:
    """An output for each sensor on board, under its name."""

    def row(name: str, sensor: Sensor) -> StationPort:
        values, size = sensor.value_size, sensor.port_size
        period = 0.05 if size == values else 0.2 if sensor.late else 0.1
        marks = {0: "", 2: ", valid, time (s)"}.get(size - values, ", valid, …, time (s)")
        holds = f"{type(sensor).__name__}: {values} value{'s' * (values > 1)}{marks}"
        return StationPort(name, str(size), lambda n, m: size, holds, period)

    return tuple(row(name, sensor) for name, sensor in config.sensing.sensors.items())


def outputs(config: StationConfig, hardware: bool = False) -> tuple[StationPort, ...]:
    """The table's rows of a station's output ports, in their order."""
    real = (*ESTIMATES, *sensor_ports(config), *COMMANDS, *REPORTED)
    return real if hardware else (*real, *CHEATS)


def station_ports(
    config: StationConfig | None = None, hardware: bool = False
) -> tuple[dict[str, int], dict[str, int]]:
    """Names and sizes of a station's input and output ports."""
    config = config or StationConfig()
    counts = len(config.sensing.fused), len(config.load_vehicle().propulsion.mounts)
    rows = (INPUTS, outputs(config, hardware))
    first, second = ({port.name: port.size(*counts) for port in part} for part in rows)
    return first, second


def default_log_periods(config: StationConfig) -> dict[str, float]:
    """How often a closed loop logs a station's output ports (s)."""
    return {port.name: port.period for port in outputs(config)}


def ports_page() -> str:
    """The text of `docs/ports.md`."""
    config = StationConfig()
    sizes = dict(pair for part in station_ports(config) for pair in part.items())
    parts = (
        ("Input", INPUTS),
        ("Outputs: estimate and commands", (*ESTIMATES, *COMMANDS, *REPORTED)),
        ("Outputs: sensors, here those that a station has by default", sensor_ports(config)),
        ("Cheats: outputs that only a simulation has", CHEATS),
    )
    lines = [_HEAD]
    for title, rows in parts:
        lines += [f"## {title}", "", "| port | length | by default | holds |", "|---|---|---|---|"]
        lines += [f"| `{p.name}` | {p.length} | {sizes[p.name]} | {p.holds} |" for p in rows]
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


_HEAD = """# Ports of a station

A station (`systems.station.simulated.make_station`) is the diagram from the commanded wrench to the
estimated state. Its ports follow from its configuration and the table `systems/station/ports.py`,
from which this page is written (`spinndrift.systems.station.ports.ports_page()`). *n* is the number
of sensors that the filter fuses, *m* that of thrusters. Frames and the order of components are
as in `models/se3.py`.
"""
