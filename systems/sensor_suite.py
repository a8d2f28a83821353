"""The vehicle's sensors as one system with a rate for each."""

from collections.abc import Callable
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Context, DiscreteStateIndex, DiscreteValues, LeafSystem

from ..models.sensors import Compass, DepthSensor, Dvl, Imu, Sensor
from .jit import VectorFunction, value_or_zeros

Outputs = tuple[Array, ...]
Motion = tuple[Array, Array, Array]


class SensorSuite(LeafSystem):
    """Measures the true motion with each sensor at its own rate and holds what was read.

    - `imu` (6): specific force (m/s²), angular rate (rad/s), every IMU period;
    - `dvl` (7): velocity (m/s, 3), 1 if valid, altitude (m), figure of merit (m/s), time of
      validity (s). A reading appears `latency` after its time of validity, at the next IMU period;
    - `depth` (3): depth (m, positive down), 1 once valid, time of the measurement (s);
    - `compass` (3): yaw (rad), 1 once valid, time of the measurement (s).

    A reading is new when its time is. At initialisation `initial_noise` draws the sensors' biases,
    offsets and scale errors. All four sensors take their unit Gaussians from `noise`, which should
    be drawn anew every IMU period. Unconnected inputs count as zero.

    .. pydrake_system::

        name: SensorSuite
        input_ports:
        - X_WB
        - V_WB_B
        - A_WB_B
        - noise
        - initial_noise
        output_ports:
        - imu
        - dvl
        - depth
        - compass

    """

    def __init__(
        self,
        imu: Imu | None = None,
        dvl: Dvl | None = None,
        depth: DepthSensor | None = None,
        compass: Compass | None = None,
    ):
        """Carry the given sensors, or their defaults."""
        super().__init__()
        imu, dvl = imu or Imu(), dvl or Dvl()
        depth, compass = depth or DepthSensor(), compass or Compass()
        sensors: tuple[Sensor, ...] = (imu, dvl, depth, compass)
        self._X = self.DeclareVectorInputPort("X_WB", 7)
        self._V = self.DeclareVectorInputPort("V_WB_B", 6)
        self._A = self.DeclareVectorInputPort("A_WB_B", 6)
        gaussian = RandomDistribution.kGaussian
        sizes = [s.noise_size for s in sensors]
        self._noise = self.DeclareVectorInputPort("noise", sum(sizes), gaussian)
        initial_sizes = [s.initial_noise_size for s in sensors]
        self._initial_noise = self.DeclareVectorInputPort(
            "initial_noise", sum(initial_sizes), gaussian
        )
        self._sizes = [*(s.state_size for s in sensors), 6, 7, 3, 3]
        groups = [self.DeclareDiscreteState(size) for size in self._sizes]
        self._states, self._shown = groups[:4], groups[4:]
        for name, index in zip(("imu", "dvl", "depth", "compass"), self._shown, strict=True):
            self.DeclareStateOutputPort(name, index)

        self._start = VectorFunction(
            lambda *w: tuple(s.initial(part) for s, part in zip(sensors, w, strict=True)),
            initial_sizes,
            [s.state_size for s in sensors],
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._initialise)
        ends = np.cumsum([0, *sizes])
        shares = [slice(a, b) for a, b in pairwise(ends)]

        def tick(motion: Motion, t: Array, w: Array, state: Array, dvl_state: Array) -> Outputs:
            X, V, A = motion
            state = imu.measure(state, X, V, A, t, w[shares[0]])
            # A reading of the DVL becomes visible between its pings.
            return state, imu.reading(state, t), dvl.reading(dvl_state, t)

        def ping(motion: Motion, t: Array, w: Array, state: Array) -> Outputs:
            X, V, A = motion
            return (dvl.measure(state, X, V, A, t, w[shares[1]]),)

        states, shown = self._states, self._shown
        self._declare(imu, tick, [states[0], states[1]], [states[0], shown[0], shown[1]])
        self._declare(dvl, ping, [states[1]], [states[1]])
        for i, sensor in ((2, depth), (3, compass)):
            measure = _stamped(sensor, shares[i])
            self._declare(sensor, measure, [states[i]], [states[i], shown[i]])

    def _declare(
        self,
        sensor: Sensor,
        measure: Callable[..., Outputs],
        reads: list[DiscreteStateIndex],
        writes: list[DiscreteStateIndex],
    ) -> None:
        """Declare a sensor's event: one compiled call from the motion to states and readings."""
        ports = (self._X, self._V, self._A, self._noise)

        def packed(t: Array, X: Array, V: Array, A: Array, w: Array, *own: Array) -> Outputs:
            return measure((X, V, A), t[0], w, *own)

        def size(index: DiscreteStateIndex) -> int:
            return self._sizes[int(index)]

        inputs = [1, 7, 6, 6, self._noise.size(), *map(size, reads)]
        call = VectorFunction(packed, inputs, [size(index) for index in writes])

        def update(context: Context, discrete_state: DiscreteValues) -> None:
            t = np.array([context.get_time()])
            parts = [value_or_zeros(port, context) for port in ports]
            parts += [context.get_discrete_state(index).value() for index in reads]
            for index, value in zip(writes, call(t, *parts), strict=True):
                discrete_state.set_value(index, value)

        self.DeclarePeriodicDiscreteUpdateEvent(1 / sensor.rate, 0.0, update)

    def _initialise(self, context: Context, discrete_state: DiscreteValues) -> None:
        w = value_or_zeros(self._initial_noise, context)
        for index, value in zip(self._states, self._start(w), strict=True):
            discrete_state.set_value(index, value)


def _stamped(sensor: Sensor, share: slice) -> Callable[..., Outputs]:
    """A measurement whose reading goes with a valid mark and its time."""

    def measure(motion: Motion, t: Array, w: Array, state: Array) -> Outputs:
        X, V, A = motion
        state = sensor.measure(state, X, V, A, t, w[share])
        return state, jnp.concatenate([sensor.reading(state, t), jnp.stack([jnp.ones_like(t), t])])

    return measure
