"""Settings of the simulated vehicle behind its server."""

from dataclasses import dataclass, field

from ...models.config.checks import check_numbers, require
from .link_faults import LinkFaults


@dataclass(frozen=True)
class VehicleServer:
    """Settings of `spinndrift vehicle`, in a scenario's block `vehicle_server`.

    Attributes:
        parameters: changes to the autopilot's parameters, by name.
        dvl: whether a DVL sends VISION_POSITION_DELTA and DISTANCE_SENSOR to the autopilot and to
            all links.
        leak: time (s) from which the leak sensor is wet, never if left out.
        clock: what the boot clock shows at the start (s); 4290 has its 32-bit microseconds
            overflow after 5 s.
        reboots: times (s) at which the autopilot boots anew.
        faults: of every link, in both directions.
    """

    parameters: dict[str, float] = field(default_factory=dict)
    dvl: bool = True
    leak: float | None = None
    clock: float = 0.0
    reboots: tuple[float, ...] = ()
    faults: LinkFaults = field(default_factory=LinkFaults)

    def __post_init__(self) -> None:
        """Check numbers."""
        check_numbers(self)
        require(0 <= self.clock <= 1e6, self, "clock", "give a time from 0 to 1e6 s")
        require(all(t > 0 for t in self.reboots), self, "reboots", "give times above 0 s")
