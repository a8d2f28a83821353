"""Settings of the link to a vehicle."""

from dataclasses import dataclass, field
from typing import Literal

from ...models.config.checks import check_numbers, require
from ..dvl.config import DvlKind
from .safety import SafetyConfig
from .transport import Connection

Way = Literal["manual_control", "rc_override", "thruster_passthrough"]
"""How a wrench is commanded (`systems.mavlink.actuation`)."""

GROUND_STATION = 255
"""The system id that ArduSub obeys by default (SYSID_MYGCS)."""
OBEYED = ("SYSID_MYGCS", "MAV_GCS_SYSID")
"""The parameter with the system id whose commands ArduSub follows, until 4.6 and since."""


@dataclass(frozen=True)
class Mavlink:
    """A vehicle over MAVLink, in place of the simulated plant.

    W has the station's `start` at the vehicle's place and heading when the dive begins, unless
    `world` is `north`: then x points east and y north, about that place. Depth is absolute.

    Attributes:
        connection: tcp:HOST:PORT, tcpin:HOST:PORT, udpin:HOST:PORT, udpout:HOST:PORT or
            serial:DEVICE:BAUD (`systems.mavlink.transport`).
        actuation: how wrenches are commanded.
        estimate: `own` filter on the vehicle's sensors, or the `autopilot`'s estimate.
        world: what W's axes follow.
        imu_rate: inertial samples to ask for (Hz).
        dvl: a DVL that is read directly; that of messages on the link if left out.
        system: our system id; the vehicle obeys its SYSID_MYGCS.
        safety: limits and watchdogs.
    """

    connection: str
    actuation: Way = "manual_control"
    estimate: Literal["own", "autopilot"] = "own"
    world: Literal["start", "north"] = "start"
    imu_rate: float = 100.0
    dvl: DvlKind | None = None
    system: int = GROUND_STATION
    safety: SafetyConfig = field(default_factory=SafetyConfig)

    def __post_init__(self) -> None:
        """Check the connection and the numbers."""
        check_numbers(self)
        Connection.parse(self.connection, "Mavlink.connection")
        require(20 <= self.imu_rate <= 400, self, "imu_rate", "give a rate from 20 to 400 Hz")
        require(1 <= self.system <= 255, self, "system", "give a system id from 1 to 255")
