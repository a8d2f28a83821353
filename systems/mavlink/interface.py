"""The vehicle in a diagram: its readings are output ports, the commanded wrench is an input.

The outputs are those of a simulated station's sensors and thrusters. Times are those of the
diagram's context; the world W lies as `Anchor` says.
"""

import math
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from scipy.spatial.transform import Rotation

from ...models.sensors import Compass, DepthSensor, Dvl, Imu, Sensor
from ..drake import drake_array, set_groups, value, value_or_none
from . import telemetry
from .codec import NEUTRAL_US, body_vector, low_pass_delays
from .driver import Acted, Driver
from .inertial_samples import InertialSamples
from .link import Received
from .telemetry import Reading

HELD = 1.5
"""Periods of the filter for which an inertial sample is held, and half of those for which two are
joined."""
_AFTER = 5e-4  # s: commands go out after the updates of the same time
_FRESH = 0.5  # s: older attitude or position of the autopilot is no estimate
_GOOD, _LOST = 0.0, 2.0
_FROZEN = 1.0  # s without a change of the inertial samples while thrusters run
_REST = 0.3  # s after which a pressure that stays the same is a measurement, at rest
_TINY = 1e-4  # m: resolution of pressure
_PUSHING = 25.0  # µs from neutral
RESOLUTION = np.array([9.80665e-3] * 3 + [1e-3] * 3)
"""Of inertial samples on the link: 1 mg, 1 mrad/s."""


class Anchor(NamedTuple):
    """Where W lies in the autopilot's world (x east, y north, z up): turned by −yaw, then moved.

    A point p of the autopilot's world is at Rz(yaw) p + shift in W.
    """

    yaw: float = 0.0
    """(rad)"""
    shift: tuple[float, float] = (0.0, 0.0)
    """Along x and y (m)."""

    @classmethod
    def at_start(
        cls, X_WB: Float[np.ndarray, "7"], heading: float, p: Float[np.ndarray, "3"] | None
    ) -> "Anchor":
        """W in which a vehicle at `p` (m) with a `heading` (rad) has the place and yaw of X_WB.

        Without a known `p` the vehicle's place is that of X_WB when the dive begins.
        """
        own = _rotation(X_WB[:4]).as_euler("ZYX")[0]
        yaw = float(own - heading)
        moved = np.zeros(3) if p is None else Rotation.from_euler("z", yaw).apply(p)
        return cls(yaw, (float(X_WB[4] - moved[0]), float(X_WB[5] - moved[1])))

    def attitude(self, q: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"]:
        """q_WB of an attitude in the autopilot's world."""
        turned = Rotation.from_euler("z", self.yaw) * _rotation(q)
        return turned.as_quat(canonical=True, scalar_first=True)

    def place(self, p: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """p_WBo of a place in the autopilot's world."""
        return Rotation.from_euler("z", self.yaw).apply(p) + np.array([*self.shift, 0.0])


class VehicleInterface(LeafSystem):
    """Readings of a connected vehicle, and commands to it.

    Each sensor has an output port of its name with the layout of a simulated station's
    (`systems.plant.sensor_suite`); `pwm` are the outputs that the vehicle is told to give (µs).
    The IMU's reading is that of `imu_latency` ago, by when its samples have come; NaN where none
    came or while they do not change under thrust. The delays of the autopilot's low-passes are
    taken off. Samples are dithered by their resolution: a vehicle at rest repeats them,
    which is no fault (non-subtractive dither; Lipshitz et al. 1992). Other readings are
    taken at the sensors' configured rates at most, with their times of validity. A sensor that no
    message measures is never valid. `X_WB` and `health`, the estimate's, are for the guards.

    Until `begin`, readings are invalid and nothing is commanded.

    .. pydrake_system::

        name: VehicleInterface
        input_ports:
        - F_Bo_B
        - X_WB
        - health
        output_ports:
        - imu
        - dvl
        - depth
        - compass
        - X_WB_autopilot
        - V_WB_B_autopilot
        - health_autopilot
        - pwm

    """

    def __init__(
        self,
        sensors: Mapping[str, Sensor],
        thrusters: int,
        health: int,
        *,
        command_period: float = 0.02,
        autopilot: bool = False,
        imu_latency: float = 0.0,
    ):
        """For sensors by their ports' names, a number of thrusters and the length of `health`.

        `imu_latency` (s) is the filter's (`EkfConfig`). Without `autopilot` the ports of its
        estimate stay as they begin, lost.
        """
        super().__init__()
        self._sensors = dict(sensors)
        mounts = {n: np.asarray(each.mount(jnp.dtype(float))) for n, each in sensors.items()}
        self._mounts = {name: _rotation(mount[:4]).as_matrix() for name, mount in mounts.items()}
        self._estimated, self._imu_latency = autopilot, imu_latency
        self._F = self.DeclareVectorInputPort("F_Bo_B", 6)
        self._X = self.DeclareVectorInputPort("X_WB", 7)
        self._health = self.DeclareVectorInputPort("health", health)
        rates = [each.rate for each in sensors.values() if isinstance(each, Imu)]
        self.period = 1 / max(rates, default=100.0)
        started = {name: np.zeros(each.port_size) for name, each in sensors.items()}
        for name, each in sensors.items():
            if isinstance(each, Imu):
                started[name][:] = np.nan
        lost = [_LOST, *[0.0] * (health - 1)]
        started |= {
            "X_WB_autopilot": np.array([1.0, 0, 0, 0, 0, 0, 0]),
            "V_WB_B_autopilot": np.zeros(6),
            "health_autopilot": np.array(lost),
        }
        self._shown = {n: self.DeclareDiscreteState(drake_array(x)) for n, x in started.items()}
        self._pwm = self.DeclareDiscreteState(drake_array(np.full(thrusters, NEUTRAL_US)))
        for name, group in {**self._shown, "pwm": self._pwm}.items():
            self.DeclareStateOutputPort(name, group)
        self.DeclarePeriodicDiscreteUpdateEvent(self.period, 0.0, self._sense)
        self.DeclarePeriodicDiscreteUpdateEvent(command_period, _AFTER, self._act)

        self._driver: Driver | None = None
        self._held = ExitStack()
        self._epoch, self._anchor = 0.0, Anchor()
        self._samples, self._sampled = InertialSamples(), 0.0
        self._dither = np.random.default_rng(0)
        self._raw, self._changed, self._pushed = np.full(6, np.nan), 0.0, math.inf
        self._depth_seen = math.nan, 0.0
        self._taken: dict[str, float] = {}
        self.ages: dict[str, Callable[[], float]] = {}
        """Further ages for the guards (s): of the `plan`, of the `dead_man` key."""
        self.on_act: Callable[[float, Acted], None] = lambda t, acted: None
        """Called with the time (s) and what was done, for a log."""
        self.commanding = True
        """Whether the wrench goes to the vehicle."""

    def begin(self, driver: Driver, epoch: float, anchor: Anchor | None = None) -> None:
        """Take readings from `driver`; `epoch` is the local time (s) at the context's time 0."""
        self.end()
        self._driver, self._epoch, self._anchor = driver, epoch, anchor or Anchor()
        delays = low_pass_delays(driver.parameters)
        self._samples, self._taken = InertialSamples(HELD * self.period, delays), {}
        self._sampled = time.monotonic()
        self._held.enter_context(driver.link.reading(self._inertial))

    def end(self) -> None:
        """Leave the driver; readings stay as they are."""
        self._held.close()
        self._driver = None

    def age(self, name: str) -> float:
        """Time since a sensor's newest valid reading was taken, or else since `begin` (s)."""
        return time.monotonic() - self._epoch - self._taken.get(name, 0.0)

    # ------------------------------------------------------------------------------------- events

    def _sense(self, context: Context, state: DiscreteValues) -> None:
        if self._driver is None:
            return
        t = context.get_time()
        for name, sensor in self._sensors.items():
            if isinstance(sensor, Imu):
                found = self._samples.at(t + self._epoch - self._imu_latency)
                if self._frozen():
                    found = np.full(6, np.nan)
            else:
                found = self._reading(name, sensor)
            if found is not None:
                set_groups(state, [self._shown[name]], [found])
        if self._estimated:
            self._autopilot(state)

    def _act(self, context: Context, state: DiscreteValues) -> None:
        driver = self._driver
        if driver is None or not self.commanding:
            return
        t = context.get_time()
        health = value_or_none(self._health, context)
        ages = self._ages(driver, t, health is not None)
        if not (self._estimated or self._aids):
            health = None  # velocity is soon lost without them, which is known before the dive
        acted = driver.act(
            t,
            value(self._F, context),
            value(self._X, context)[4:],
            0 if health is None else int(health[0]),
            ages,
        )
        if np.abs(acted.expected - NEUTRAL_US).max() < _PUSHING:
            self._pushed = math.inf
        elif math.isinf(self._pushed):
            self._pushed = time.monotonic()
        set_groups(state, [self._pwm], [driver.as_described(acted.expected)])
        self.on_act(t, acted)

    @property
    def _aids(self) -> list[str]:
        """Sensors of horizontal motion."""
        seen = ("velocity", "position")
        aids = [name for name, each in self._sensors.items() if each.observes in seen]
        return [name for name in aids if not isinstance(self._sensors[name], DepthSensor)]

    def _ages(self, driver: Driver, t: float, told: bool) -> dict[str, float]:
        """Ages for the guards (s); `told` says whether the estimate comes with its health."""
        now = time.monotonic()
        ages = {name: age() for name, age in self.ages.items()}
        ages["loop"] = max(0.0, now - self._epoch - t)
        if self._estimated:
            ages["aid"] = driver.link.age("LOCAL_POSITION_NED")
            return ages
        ages["imu"] = now - self._sampled
        if self._aids:
            newest = min(self.age(name) for name in self._aids)
            ages["dead_reckoning" if told else "aid"] = newest
        return ages

    # ----------------------------------------------------------------------------------- readings

    def _inertial(self, found: Received) -> None:
        """Take an inertial sample, in the link's thread."""
        driver = self._driver
        if driver is None or found.message.get_type() not in telemetry.IMUS:
            return
        preferred = next(n for n in telemetry.IMUS if driver.link.latest(n) is not None)
        if found.message.get_type() == preferred:
            self._sampled = found.arrival
            sample = telemetry.inertial(driver.link, found)
            if not np.array_equal(sample.value, self._raw):
                self._raw, self._changed = sample.value, sample.arrival
            noise = RESOLUTION * self._dither.uniform(-0.5, 0.5, 6)
            self._samples.add(sample.taken, sample.value + noise)

    def _frozen(self) -> bool:
        """Whether thrusters run and the inertial samples do not change."""
        now = time.monotonic()
        return min(now - self._changed, now - self._pushed) > _FROZEN

    def _reading(self, name: str, sensor: Sensor) -> np.ndarray | None:
        """The port's new value, None while there is no new reading."""
        assert self._driver is not None
        read = next((r for kind, r in _READERS.items() if isinstance(sensor, kind)), None)
        if read is None:
            return None
        found = read(self._driver, sensor, self._anchor, self._mounts[name])
        if found is None:
            return None
        if isinstance(sensor, DepthSensor):
            # messages repeat a measurement until the next one; a vehicle at rest repeats it as well
            first, seen = self._depth_seen
            if found.value[0] == first and found.arrival - seen < _REST:
                return None
            self._depth_seen = float(found.value[0]), found.arrival
            tiny = _TINY * self._dither.uniform(-1, 1)
            found = found._replace(value=found.value + np.array([tiny, 0.0]))
        taken = found.taken - self._epoch
        before = self._taken.get(name, -math.inf)
        # times of one stream jitter: half a period early is the next reading
        if taken <= before or taken < before + 0.9 / sensor.rate - 0.5 * self.period:
            return None
        if found.value[sensor.value_size] > 0:
            self._taken[name] = taken
        return np.array([*found.value, taken])

    def _autopilot(self, state: DiscreteValues) -> None:
        """The autopilot's estimate in W."""
        assert self._driver is not None
        link = self._driver.link
        attitude, position = telemetry.attitude(link), telemetry.position(link)
        turn = telemetry.turn_rate(link)
        if attitude is None or position is None or turn is None:
            return
        q = self._anchor.attitude(attitude.value)
        v = _rotation(attitude.value).inv().apply(position.value[3:])
        oldest = min(attitude.arrival, position.arrival)
        good = time.monotonic() - oldest <= _FRESH
        health = np.ones(self._health.size()) * good
        health[0] = _GOOD if good else _LOST
        values = {
            "X_WB_autopilot": np.concatenate([q, self._anchor.place(position.value[:3])]),
            "V_WB_B_autopilot": np.concatenate([v, turn.value]),
            "health_autopilot": health,
        }
        set_groups(state, [self._shown[name] for name in values], values.values())


def _depth(driver: Driver, sensor: Sensor, anchor: Anchor, R_BS: np.ndarray) -> Reading | None:
    del anchor, R_BS
    assert isinstance(sensor, DepthSensor)
    found = telemetry.depth(driver.link, driver.parameters, sensor.assumed_density)
    if found is None:
        return None
    return found._replace(value=np.array([*found.value, 1.0]))


def _compass(driver: Driver, sensor: Sensor, anchor: Anchor, R_BS: np.ndarray) -> Reading | None:
    del sensor, R_BS
    found = telemetry.heading(driver.link)
    if found is None:
        return None
    yaw = math.remainder(float(found.value[0]) + anchor.yaw, 2 * math.pi)
    return found._replace(value=np.array([yaw, 1.0]))


def _dvl(driver: Driver, sensor: Sensor, anchor: Anchor, R_BS: np.ndarray) -> Reading | None:
    """Velocity in the sensor's axes, valid, altitude, figure of merit (0: unknown)."""
    del anchor, sensor
    if driver.dvl is None:
        found = telemetry.dvl(driver.link, driver.parameters)
        if found is None:
            return None
        v, merit = found.value[:3] @ R_BS, 0.0
        valid, altitude = found.value[3], found.value[4]
    else:
        newest = driver.dvl.newest
        if newest is None:
            return None
        r = newest.reading
        # the instrument's axes are forward, right, down; those of a mount may be turned up
        v = r.velocity if R_BS[2, 2] < 0 else body_vector(*r.velocity)
        valid, altitude, merit = float(r.valid), r.altitude, np.nan_to_num(r.figure_of_merit)
        found = Reading(v, newest.validity, newest.arrival)
    return found._replace(value=np.array([*v, valid, np.nan_to_num(altitude), merit]))


_READERS: dict[type[Sensor], Callable[[Driver, Sensor, Anchor, np.ndarray], Reading | None]] = {
    DepthSensor: _depth,
    Compass: _compass,
    Dvl: _dvl,
}
"""Reading of each kind of sensor as [values, valid, …], without its time."""


def unread(sensors: Mapping[str, Sensor]) -> list[str]:
    """Names of the sensors that no vehicle's message measures."""
    known = (Imu, *_READERS)
    return [name for name, each in sensors.items() if not isinstance(each, known)]


def _rotation(q: Float[np.ndarray, "4"]) -> Rotation:
    return Rotation.from_quat(q, scalar_first=True)
