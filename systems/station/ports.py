"""The ports of a station: one table, and what follows from it for a configuration."""

from collections.abc import Callable
from typing import NamedTuple

from ...models.sensors import Sensor
from ..estimation.delayed import health_names, status_names
from ..estimation.error_state import INERTIAL
from .config import StationConfig


class StationPort(NamedTuple):
    """A row of the table.

    Attributes:
        name: of the port.
        size: its length, for a station's configuration.
        told: the length in words.
        holds: what it holds.
        period: at which a closed loop logs it (s).
    """

    name: str
    size: Callable[[StationConfig], int]
    told: str
    holds: str
    period: float


def _fixed(size: int) -> tuple[Callable[[StationConfig], int], str]:
    return (lambda config: size), str(size)


def _of_fused(
    size: Callable[[list[str]], int], told: str
) -> tuple[Callable[[StationConfig], int], str]:
    """Of a length that follows from the sensors that the filter fuses."""
    return (lambda config: size(list(config.sensing.fused))), told


def _thrusters(config: StationConfig) -> int:
    return len(config.load_vehicle().propulsion.mounts)


INPUTS = (StationPort("F_Bo_B", *_fixed(6), "commanded wrench about Bo (N, N·m)", 0.05),)

ESTIMATES = (
    StationPort("X_WB", *_fixed(7), "estimated pose", 0.05),
    StationPort("V_WB_B", *_fixed(6), "estimated twist (m/s, rad/s)", 0.05),
)

COMMANDS = (
    StationPort(
        "pwm", _thrusters, "number of thrusters", "pulse widths of the thrusters (µs)", 0.05
    ),
)

REPORTED = (
    StationPort(
        "covariance",
        *_of_fused(lambda fused: (INERTIAL + len(fused)) ** 2, "(15 + n)²"),
        "of the estimate's error, by rows (`systems.estimation.error_state`)",
        0.2,
    ),
    StationPort(
        "status",
        *_of_fused(lambda fused: len(status_names(fused)), "1 + 3 n"),
        "time of the filter's horizon (s); NIS, rejections in a row, age (s) of each fused sensor",
        0.2,
    ),
    StationPort(
        "health",
        *_of_fused(lambda fused: len(health_names(fused)), "2 + n"),
        "0 good, 1 degraded, 2 lost; then 1 where the imu and each fused sensor are trusted",
        0.05,
    ),
)
"""What a filter may leave out: NaN then, and good health."""

CHEATS = (
    StationPort("X_WB_cheat", *_fixed(7), "true pose", 0.05),
    StationPort("V_WB_B_cheat", *_fixed(6), "true twist (m/s, rad/s)", 0.05),
    StationPort("F_disturbance_cheat", *_fixed(6), "disturbances' wrench about Bo (N, N·m)", 0.05),
    StationPort("flow_cheat", *_fixed(6), "water's velocity and acceleration in W", 0.05),
)
"""Ports that only a simulation has: the truth."""


def sensor_ports(config: StationConfig) -> tuple[StationPort, ...]:
    """An output for each sensor on board, under its name."""

    def row(name: str, sensor: Sensor) -> StationPort:
        n, size = sensor.value_size, sensor.port_size
        more = "" if size == n else ", valid, time (s)" if size == n + 2 else ", valid, …, time (s)"
        period = 0.05 if size == n else 0.2 if sensor.late else 0.1
        words = f"{type(sensor).__name__}: {_counted(n)}{more}"
        return StationPort(name, *_fixed(size), words, period)

    return tuple(row(name, sensor) for name, sensor in config.sensing.sensors.items())


def _counted(n: int) -> str:
    return "1 value" if n == 1 else f"{n} values"


def outputs(config: StationConfig, hardware: bool = False) -> tuple[StationPort, ...]:
    """The table's rows of a station's output ports, in their order."""
    real = (*ESTIMATES, *sensor_ports(config), *COMMANDS, *REPORTED)
    return real if hardware else (*real, *CHEATS)


def station_ports(
    config: StationConfig | None = None, hardware: bool = False
) -> tuple[dict[str, int], dict[str, int]]:
    """Names and sizes of a station's input and output ports."""
    config = config or StationConfig()
    rows = (INPUTS, outputs(config, hardware))
    first, second = ({port.name: port.size(config) for port in part} for part in rows)
    return first, second


def default_log_periods(config: StationConfig) -> dict[str, float]:
    """How often a closed loop logs a station's output ports (s)."""
    return {port.name: port.period for port in outputs(config)}


def ports_page() -> str:
    """The text of `docs/ports.md`."""
    config = StationConfig()
    parts = (
        ("Input", INPUTS),
        ("Outputs: estimate and commands", (*ESTIMATES, *COMMANDS, *REPORTED)),
        ("Outputs: sensors, here those that a station has by default", sensor_ports(config)),
        ("Cheats: outputs that only a simulation has", CHEATS),
    )
    lines = [_HEAD]
    for title, rows in parts:
        lines += [f"## {title}", "", "| port | length | by default | holds |", "|---|---|---|---|"]
        lines += [f"| `{p.name}` | {p.told} | {p.size(config)} | {p.holds} |" for p in rows]
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


_HEAD = """# Ports of a station

A station (`systems.station.simulated.make_station`) is the diagram from the commanded wrench to the
estimated state. Its ports follow from its configuration and the table `systems/station/ports.py`,
from which this page is written (`spinndrift.systems.station.ports.ports_page()`). *n* is the number
of sensors that the filter fuses. Frames and the order of components are those of `models/se3.py`.
"""
