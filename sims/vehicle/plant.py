"""The simulated station under an autopilot: pulse widths in, motion and a DVL's readings out."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydrake.systems.analysis import Simulator

from ...models.frames import frd_to_flu
from ...models.se3 import from_position_rpy
from ...systems.closed_loop import seeded
from ...systems.mavlink import codec
from ...systems.station.config import StationConfig
from ...systems.station.simulated import make_driven_station
from .autopilot.mixer import NEUTRAL, frame_for
from .autopilot.navigation import Motion, rotated

_LOWEST, _HIGHEST = 1000, 2000  # µs: at and beyond these a speed controller stops
_WARM_UP = 0.45  # s: every event of the diagram has occurred


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


class Plant:
    """The station of a scenario, stepped one period at a time."""

    def __init__(self, config: StationConfig):
        """Build and compile.

        Raises:
            UserError: a part of the configuration names what can't be read.
        """
        self.config = config
        self.vehicle = config.load_vehicle()
        self.thrusters = len(self.vehicle.propulsion.mounts)
        self._station = make_driven_station(config)
        self._simulator = self._started()
        self._simulator.AdvanceTo(_WARM_UP)
        self._simulator = self._started()
        self._steps = 0
        nominal = self.vehicle.propulsion.voltage
        self._resting_voltage = nominal if config.voltage is None else config.voltage
        self._dvl_time = 0.0
        dvl = config.sensing.dvl
        rpy = jnp.array((0.0, 0.0, 0.0) if dvl is None else dvl.rpy)
        self._q_BD = np.array(from_position_rpy(jnp.zeros(3), rpy)[:4])

    def _started(self) -> Simulator:
        simulator = Simulator(self._station)
        context = simulator.get_mutable_context()
        seeded(self._station, context, self.config.seed)
        neutral = np.full(self.thrusters, float(NEUTRAL))
        self._pwm = self._station.GetInputPort("pwm").FixValue(context, neutral)
        simulator.Initialize()
        return simulator

    def parameters(self) -> dict[str, float]:
        """Parameters of an autopilot that knows this vehicle: frame, directions, DVL's place."""
        values = {"FRAME_CONFIG": float(frame_for(self.thrusters))}
        dvl = self.config.sensing.dvl
        if dvl is not None:
            place = frd_to_flu(np.array(dvl.position)).tolist()
            values |= dict(zip(("VISO_POS_X", "VISO_POS_Y", "VISO_POS_Z"), place, strict=True))
        for n, mount in enumerate(self.vehicle.propulsion.mounts, 1):
            values[f"MOT_{n}_DIRECTION"] = mount.motor
        return values

    @property
    def time(self) -> float:
        """The simulation's time (s)."""
        return self._steps * self.config.period

    def step(self, outputs: list[int]) -> None:
        """Advance one period with the pulse widths (µs) of the first outputs, one a thruster."""
        us = np.array(outputs[: self.thrusters], float)
        us[(us <= _LOWEST) | (us >= _HIGHEST)] = NEUTRAL
        self._pwm.GetMutableData().set_value(us)
        self._steps += 1
        self._simulator.AdvanceTo(self.time)

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
        volts = self._loaded_voltage()
        resistance = self.vehicle.propulsion.resistance
        amps = (self._resting_voltage - volts) / resistance if resistance > 0 else 0.0
        return Motion(
            q_WB=X[:4],
            omega_B=imu[3:],
            f_B=imu[:3],
            height=float(X[6] * gradient / own),
            climb=float(climb * gradient / own),
            pressure=float((depth[0] if depth[1] else -X[6]) * gradient),
            voltage=float(volts),
            current=float(max(amps, 0.0)),
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

    def truth(self) -> tuple[Float[np.ndarray, "7"], Float[np.ndarray, "6"]]:
        """Pose X_WB and twist V_WB_B."""
        return self._value("X_WB_cheat"), self._value("V_WB_B_cheat")

    def _value(self, name: str) -> np.ndarray:
        return np.array(self._station.GetOutputPort(name).Eval(self._simulator.get_context()))

    def _loaded_voltage(self) -> float:
        plant: Any = self._station.GetSubsystemByName("plant")
        own = plant.GetMyContextFromRoot(self._simulator.get_context())
        return float(plant.GetOutputPort("voltage_loaded").Eval(own)[0])
