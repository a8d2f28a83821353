"""The simulated station under an autopilot: what it senses, and a DVL's readings."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...models.frames import frd_to_flu
from ...models.se3 import from_position_rpy
from ...systems.mavlink import codec
from ...systems.station.config import StationConfig
from ...systems.station.simulated import make_driven_station
from .autopilot.navigation import Motion, rotated
from .physics import Physics


@dataclass(frozen=True)
class DvlReading:
    """A new reading of the DVL.

    Attributes:
        time: of its validity (s).
        dt: since the reading before (s).
        v_B: velocity of the transducer, in B's axes (m/s).
        merit: figure of merit (m/s).
        altitude: above the bed (m).
    """

    time: float
    dt: float
    v_B: Float[np.ndarray, "3"]
    merit: float
    altitude: float


class Plant(Physics):
    """The station of a scenario: physics, sensors and filter."""

    def __init__(self, config: StationConfig):
        """Build and compile.

        Raises:
            UserError: a part of the configuration names what can't be read.
        """
        super().__init__(config, make_driven_station)
        dvl = config.sensing.dvl
        rpy = jnp.array((0.0, 0.0, 0.0) if dvl is None else dvl.rpy)
        self._q_BD = np.array(from_position_rpy(jnp.zeros(3), rpy)[:4])

    def restart(self) -> None:
        """Go back to the start, with the same random numbers."""
        super().restart()
        self._dvl_time = 0.0

    def parameters(self) -> dict[str, float]:
        """Parameters of an autopilot that knows this vehicle: frame, directions, DVL's place."""
        values = super().parameters()
        dvl = self.config.sensing.dvl
        if dvl is not None:
            place = frd_to_flu(np.array(dvl.position)).tolist()
            values |= dict(zip(("VISO_POS_X", "VISO_POS_Y", "VISO_POS_Z"), place, strict=True))
        return values

    def motion(self, specific_gravity: float = 1.0, leak: bool = False) -> Motion:
        """What the autopilot knows: the filter's estimates and the last readings.

        Its depth is that of an autopilot which takes the water's specific gravity for
        `specific_gravity`.
        """
        X, V, imu = (self._value(name) for name in ("X_WB", "V_WB_B", "imu"))
        own = codec.pascal_per_metre(specific_gravity)
        gradient = codec.pascal_per_metre(density=self.vehicle.water_density)
        climb = rotated(X[:4], V[:3])[2]
        gauge = self.config.sensing.depth is not None
        depth = self._value("depth") if gauge else np.zeros(2)
        volts, amps = self.battery()
        return Motion(
            q_WB=X[:4],
            omega_B=imu[3:],
            f_B=imu[:3],
            height=float(X[6] * gradient / own),
            climb=float(climb * gradient / own),
            pressure=float((depth[0] if depth[1] else -X[6]) * gradient),
            voltage=volts,
            current=amps,
            leak=leak,
        )

    def dvl(self) -> DvlReading | None:
        """The DVL's reading if it is new and valid."""
        if self.config.sensing.dvl is None:
            return None
        reading = self._value("dvl")
        time = float(reading[6])
        if time <= self._dvl_time:
            return None
        dt, self._dvl_time = time - self._dvl_time, time
        if not reading[3]:
            return None
        v_B = rotated(self._q_BD, reading[:3])
        return DvlReading(time, min(dt, 1.0), v_B, float(reading[5]), float(reading[4]))
