"""The vehicle's sensors as one system with a rate for each."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import islice, pairwise
from math import lcm

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from ..models.sensors import Compass, DepthSensor, Dvl, Imu, Sensor
from .jit import VectorFunction, value_or_zeros
from .pure import Event, Inputs, Pure, State, shown

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

        n = [int(index) for index in groups]
        parts = [
            _Part(imu.rate, tick, (n[0], n[1]), (n[0], n[4], n[5])),
            _Part(dvl.rate, ping, (n[1],), (n[1],)),
            _Part(depth.rate, _stamped(depth, shares[2]), (n[2],), (n[2], n[6])),
            _Part(compass.rate, _stamped(compass, shares[3]), (n[3],), (n[3], n[7])),
        ]
        self._parts = parts
        # Sensors whose period is a multiple of the IMU's share its events and its calls.
        shared = [part for part in parts if _divides(part.rate, imu.rate)]
        self._declare(shared)
        for part in parts:
            if part not in shared:
                self._declare([part])

    def pure(self) -> Pure:
        """Each sensor's measurement as a pure function."""
        base = self._parts[0].rate

        def event(part: _Part) -> Event:
            def update(t: Array, state: State, inputs: Inputs) -> dict[int, Array]:
                X, V, A, w = (
                    inputs.get(port.get_name(), jnp.zeros(port.size()))
                    for port in (self._X, self._V, self._A, self._noise)
                )
                own = [state[index] for index in part.reads]
                return dict(zip(part.writes, part.measure((X, V, A), t, w, *own), strict=True))

            if _divides(part.rate, base):
                return Event(1 / base, update, round(base / part.rate))
            return Event(1 / part.rate, update)

        names = ("imu", "dvl", "depth", "compass")
        outputs = {name: shown(len(names) + i) for i, name in enumerate(names)}
        return Pure(tuple(event(part) for part in self._parts), outputs, ("noise",))

    def _declare(self, parts: list["_Part"]) -> None:
        """Declare events at the first part's rate; the others take part in every so many."""
        ports = (self._X, self._V, self._A, self._noise)
        period = 1 / parts[0].rate
        every = [round(parts[0].rate / part.rate) for part in parts]

        @cache
        def call(due: tuple[bool, ...]) -> tuple[VectorFunction, list[int], list[int]]:
            """One compiled call from the motion and the states read to what is written."""
            used = [part for part, now in zip(parts, due, strict=True) if now]
            reads = [index for part in used for index in part.reads]
            writes = [index for part in used for index in part.writes]

            def packed(t: Array, X: Array, V: Array, A: Array, w: Array, *own: Array) -> Outputs:
                values = iter(own)
                return sum(
                    (p.measure((X, V, A), t[0], w, *islice(values, len(p.reads))) for p in used), ()
                )

            inputs = [1, 7, 6, 6, self._noise.size(), *(self._sizes[i] for i in reads)]
            function = VectorFunction(packed, inputs, [self._sizes[i] for i in writes])
            return function, reads, writes

        cycle = lcm(*every)

        @cache
        def call_at(phase: int) -> tuple[VectorFunction, list[int], list[int]]:
            return call(tuple(phase % m == 0 for m in every))

        def update(context: Context, discrete_state: DiscreteValues) -> None:
            t = context.get_time()
            function, reads, writes = call_at(round(t / period) % cycle)
            state = context.get_discrete_state()
            parts = [np.array([t])]
            parts += [value_or_zeros(port, context) for port in ports]
            parts += [state.value(index) for index in reads]
            for index, value in zip(writes, function(*parts), strict=True):
                discrete_state.set_value(index, value)

        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, update)

    def _initialise(self, context: Context, discrete_state: DiscreteValues) -> None:
        w = value_or_zeros(self._initial_noise, context)
        for index, value in zip(self._states, self._start(w), strict=True):
            discrete_state.set_value(index, value)


@dataclass(frozen=True)
class _Part:
    """What one sensor does in its event, with the state groups that it reads and writes."""

    rate: float
    measure: Callable[..., Outputs]
    reads: tuple[int, ...]
    writes: tuple[int, ...]


def _divides(rate: float, of: float) -> bool:
    ratio = of / rate
    return ratio > 0.5 and abs(ratio - round(ratio)) < 1e-9 * ratio


def _stamped(sensor: Sensor, share: slice) -> Callable[..., Outputs]:
    """A measurement whose reading goes with a valid mark and its time."""

    def measure(motion: Motion, t: Array, w: Array, state: Array) -> Outputs:
        X, V, A = motion
        state = sensor.measure(state, X, V, A, t, w[share])
        return state, jnp.concatenate([sensor.reading(state, t), jnp.stack([jnp.ones_like(t), t])])

    return measure
