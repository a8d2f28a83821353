"""Configuration of the station: vehicle, water, sensors, start, seed."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ...models.config.checks import Vector6, check_numbers, require
from ...models.config.errors import UserError
from ...models.disturbances import Combined, Kind, preset
from ...models.dynamics import Dynamics
from ...models.effects.effect_config import EffectConfig, check_distinct
from ...models.effects.extended import Extended, core
from ...models.files.checkpoint import load_model
from ...models.lasting import lasting_wrench
from ...models.sensors import SHIPPED, Compass, DepthSensor, Dvl, Imu, Sensor, SensorFault
from ...models.sensors import Kind as SensorKind
from ...models.vehicles.vehicle import Vehicle, load_vehicle
from ..estimation.config import EkfConfig
from ..own import Offered, OwnFilter, OwnSensor
from ..planning.obstacles import Pylon
from ..planning.paths import PoseConfig

_TAKEN = ("F_Bo_B", "X_WB", "V_WB_B", "covariance", "pwm", "status", "health")


@dataclass(frozen=True)
class Sensing:
    """The sensors on board, their faults, and the filter that fuses them.

    Attributes:
        imu: the inertial unit.
        dvl: the Doppler velocity log; none if null, and so for the next two.
        depth: the depth gauge.
        compass: the compass.
        more: further sensors by the names of their ports.
        faults: of the sensors' outputs (`docs/sensor-faults.md`); the filter does not know of them.
        ekf: settings of the filter.
        filter: user-defined, in place of the one that `ekf` configures.
    """

    imu: Imu = field(default_factory=Imu)
    dvl: Dvl | None = field(default_factory=Dvl)
    depth: DepthSensor | None = field(default_factory=DepthSensor)
    compass: Compass | None = field(default_factory=Compass)
    more: dict[str, SensorKind | OwnSensor | Sensor] = field(default_factory=dict)
    ekf: EkfConfig = field(default_factory=EkfConfig)
    faults: tuple[SensorFault, ...] = ()
    filter: OwnFilter | None = None

    def __post_init__(self) -> None:
        """Check the names of sensors, and the faults of those that need no user code."""
        for name in self.more:
            fit = name.isidentifier() and name not in (*SHIPPED, *_TAKEN)
            remedy = "name each sensor by a word of its own, which no port of a station has"
            require(fit, self, "more", remedy)
        on_board = self._on_board()
        for fault in self.faults:
            if not isinstance(on_board.get(fault.sensor), OwnSensor):
                fault.check(on_board)

    def _on_board(self) -> dict[str, Any]:
        shipped = {name: getattr(self, name) for name in SHIPPED}
        return {name: each for name, each in (shipped | self.more).items() if each is not None}

    @cached_property
    def sensors(self) -> dict[str, Sensor]:
        """The sensors on board by the names of their ports.

        Raises:
            UserError: one of the user's own can't be made, or does not have what a fault needs.
        """
        found = {
            name: each.make({}) if isinstance(each, OwnSensor) else each
            for name, each in self._on_board().items()
        }
        for fault in self.faults:
            fault.check(found)
        return found

    @property
    def fused(self) -> tuple[str, ...]:
        """Names of the sensors that the filter fuses, besides the IMU."""
        return tuple(n for n, each in self.sensors.items() if each.observes is not None)

    @property
    def horizontal(self) -> bool:
        """Whether a sensor observes horizontal motion."""
        seen = ("velocity", "position")
        every = self.sensors.values()
        return any(s.observes in seen and not isinstance(s, DepthSensor) for s in every)

    @property
    def water_depth(self) -> float:
        """Depth of the bed as the DVL is told it (m); that of a DVL by default without one."""
        return (self.dvl or Dvl()).water_depth


@dataclass(frozen=True)
class StationConfig:
    """Configuration of the station that a controller runs on.

    Attributes:
        vehicle: a preset's name or the path of a vehicle's YAML file: hull, thrusters, physics.
        model: a checkpoint of the dynamics to simulate; the vehicle's physics if left out.
        effects: effects of the plant besides these dynamics; planners don't know of them.
        diffusion: b of the physics' process noise (N√s and N·m√s); disturbances are usually better.
        disturbance_set: a named set (`models.disturbances.preset`).
        disturbances: further disturbances, by kind.
        obstacles: pylons.
        sensing: sensors and filter.
        start: pose at t = 0.
        start_twist: twist at t = 0, in B (m/s, rad/s).
        voltage: of the battery, without load (V); the vehicle's nominal one if left out.
        period: of plant, thrusters and disturbances (s).
        substeps: Lie-group steps of the plant in a period.
        seed: of everything that is random.

    Example:
        >>> StationConfig(disturbance_set="harbour", seed=1).load_vehicle().name
        'bluerov2_heavy'
    """

    vehicle: str = "bluerov2_heavy"
    model: Path | None = None
    effects: tuple[EffectConfig, ...] = ()
    diffusion: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    disturbance_set: str = "still"
    disturbances: tuple[Kind, ...] = ()
    obstacles: tuple[Pylon, ...] = ()
    sensing: Sensing = field(default_factory=Sensing)
    start: PoseConfig = field(default_factory=lambda: PoseConfig((0.0, 0.0, -1.5)))
    start_twist: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    voltage: float | None = None
    period: float = 0.01
    substeps: int = 2
    seed: int = 0

    def __post_init__(self) -> None:
        """Check numbers and the name of the disturbance set."""
        check_numbers(self)
        require(min(self.diffusion) >= 0, self, "diffusion", "give six numbers of zero or more")
        require(1e-4 <= self.period <= 1, self, "period", "give a time from 0.0001 to 1")
        require(self.substeps >= 1, self, "substeps", "give 1 or more")
        require(0 <= self.seed < 2**32, self, "seed", "give a whole number from 0 to 4294967295")
        require(self.voltage is None or self.voltage > 0, self, "voltage", "give a voltage above 0")
        preset(self.disturbance_set)
        check_distinct(self.effects)

    def load_vehicle(self) -> Vehicle:
        """The vehicle.

        Raises:
            UserError: there is no such preset or file, or it is not a vehicle.
        """
        try:
            return load_vehicle(self.vehicle)
        except UserError as error:
            raise UserError(f"station.vehicle: {error}") from error

    def dynamics(self) -> Dynamics:
        """The dynamics to simulate, in double precision.

        Raises:
            UserError: the vehicle or the checkpoint can't be read.
        """
        vehicle = self.load_vehicle()
        if self.model is not None:
            model = load_model(self.model, float)[0]
        else:
            model = vehicle.dynamics(np.array(self.diffusion))
        if not self.effects:
            return model
        own = model.effects if isinstance(model, Extended) else ()
        more = tuple(effect.build() for effect in self.effects)
        return Extended.create(core(model), (*own, *more), vehicle.thrusters())

    def disturbance(self) -> Combined:
        """All disturbances as one, including the correlated wrench of a learned model.

        Raises:
            UserError: the checkpoint can't be read.
        """
        members = (*preset(self.disturbance_set).members, *self.disturbances)
        if self.model is not None:
            members += lasting_wrench(load_model(self.model, float)[0])
        return Combined(members)

    def initial_state(self) -> tuple[Float[np.ndarray, "7"], Float[np.ndarray, "6"]]:
        """X_WB and V_WB_B at t = 0."""
        return np.asarray(self.start.pose()), np.array(self.start_twist, float)

    def offered(self, goal: Float[np.ndarray, "3"] | None) -> Offered:
        """What the constructor of a user-defined class at this station may have as arguments."""
        return {
            "vehicle": self.load_vehicle,
            "obstacles": lambda: self.obstacles,
            "goal": lambda: None if goal is None else np.array(goal, float),
            "station": lambda: self,
        }
