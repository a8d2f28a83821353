"""The simulated station under an autopilot: what it senses, and a DVL's readings."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ...models.frames import frd_to_flu
from ...models.se3 import from_position_rpy
from ...systems.mavlink import codec
from ...systems.station.config import StationConfig
from ...systems.station.simulated import make_driven_station
from .autopilot.low_pass import LowPass
from .autopilot.navigation import Motion, rotated
from .autopilot.parameters import Parameters
from .physics import Physics, State, mean_specific_force


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
        # an autopilot reads its IMU so often that its samples are instantaneous
        imu = replace(config.sensing.imu, integrating=False)
        sensing = replace(config.sensing, imu=imu)
        super().__init__(replace(config, sensing=sensing), make_driven_station)
        dvl = config.sensing.dvl
        rpy = jnp.array((0.0, 0.0, 0.0) if dvl is None else dvl.rpy)
        self._q_BD = np.array(from_position_rpy(jnp.zeros(3), rpy)[:4])

    def restart(self) -> None:
        """Go back to the start, with the same random numbers."""
        super().restart()
        self._dvl_time = 0.0
        self._low_passes: dict[str, LowPass] = {}
        self._told, self._off = np.zeros(13), (Rotation.identity(), np.zeros(9))
        self._before: deque[State] = deque([self.truth()] * 2, maxlen=2)

    def step(self, outputs: Sequence[int]) -> None:
        """Advance one period with the pulse widths (µs) of the first outputs, one a thruster."""
        self._before.append(self.truth())
        super().step(outputs)

    def parameters(self) -> dict[str, float]:
        """Parameters of an autopilot that knows this vehicle: frame, directions, DVL's place."""
        values = super().parameters()
        dvl = self.config.sensing.dvl
        if dvl is not None:
            place = frd_to_flu(np.array(dvl.position)).tolist()
            values |= dict(zip(("VISO_POS_X", "VISO_POS_Y", "VISO_POS_Z"), place, strict=True))
        return values

    def motion(self, parameters: Parameters, leak: bool = False) -> Motion:
        """What the autopilot knows after a step: the filter's estimates and the last readings.

        By its `parameters` the autopilot has low-passes on inertial samples (INS_GYRO_FILTER,
        INS_ACCEL_FILTER) and takes the water for one of BARO_SPEC_GRAV.
        """
        X, V = self._estimate()
        imu = self._inertial()
        gyro = self._low_passed("INS_GYRO_FILTER", parameters, imu[3:])
        force = self._low_passed("INS_ACCEL_FILTER", parameters, imu[:3])
        own = codec.pascal_per_metre(parameters["BARO_SPEC_GRAV"])
        gradient = codec.pascal_per_metre(density=self.vehicle.water_density)
        climb = rotated(X[:4], V[:3])[2]
        gauge = self.config.sensing.depth is not None
        depth = self._value("depth") if gauge else np.zeros(2)
        volts, amps = self.battery()
        return Motion(
            q_WB=X[:4],
            omega_B=gyro,
            f_B=force,
            height=float(X[6] * gradient / own),
            climb=float(climb * gradient / own),
            pressure=float((depth[0] if depth[1] else -X[6]) * gradient),
            voltage=volts,
            current=amps,
            leak=leak,
        )

    def _estimate(self) -> State:
        """The truth with the error of the filter's last estimate.

        An autopilot estimates in each of its loops, the station's filter less often: between two
        estimates its error is held. An estimate appears one step after its time.
        """
        told = np.concatenate([self._value("X_WB"), self._value("V_WB_B")])
        if not np.array_equal(told, self._told):
            X, V = self._before[-1]
            wrong = _turn(X).inv() * Rotation.from_quat(told[:4], scalar_first=True)
            self._told, self._off = told, (wrong, told[4:] - np.concatenate([X[4:], V]))
        (X, V), (wrong, off) = self.truth(), self._off
        q = (_turn(X) * wrong).as_quat(canonical=True, scalar_first=True)
        return np.concatenate([q, X[4:] + off[:3]]), V + off[3:]

    def _inertial(self) -> Float[np.ndarray, "6"]:
        """Specific force and angular rate now: the IMU's sample, which is one step old, plus the
        true change since then.
        """
        states = [*self._before, self.truth()]
        forces = [mean_specific_force(*two, self.config.period) for two in pairwise(states)]
        turned = states[-1][1][3:] - states[-2][1][3:]
        return self._value("imu") + np.concatenate([forces[1] - forces[0], turned])

    def _low_passed(
        self, name: str, parameters: Parameters, sample: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "3"]:
        """A sample after the low-pass of a parameter (Hz); a new cutoff restarts the filter."""
        cutoff = parameters[name]
        known = self._low_passes.get(name)
        if known is None or known.cutoff != cutoff:
            known = self._low_passes[name] = LowPass(cutoff, 1 / self.config.period)
        return known(sample)

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


def _turn(X_WB: Float[np.ndarray, "7"]) -> Rotation:
    return Rotation.from_quat(X_WB[:4], scalar_first=True)
