"""The vehicle's sensors as one system, each with its own rate."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import islice, pairwise
from math import lcm

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem

from ...models.sensors import SHIPPED, Sensor, SensorFault
from ...models.sensors.faults import FaultySensor
from ..compiled.jit import VectorFunction
from ..compiled.pure import Event, Inputs, Pure, State
from ..compiled.pure import shown as shown_group
from ..drake import group, set_groups, value_or_none, value_or_zeros

Outputs = tuple[Array, ...]
Motion = tuple[Array, Array, Array]


class SensorSuite(LeafSystem):
    """Measures the true motion with each sensor at its own rate and holds the readings.

    Each sensor has an output port under its name; those of the shipped ones are

    - `imu` (6): specific force (m/s²), angular rate (rad/s), every IMU period;
    - `dvl` (7): velocity (m/s, 3), 1 if valid, altitude (m), figure of merit (m/s), time of
      validity (s). A reading appears `latency` after its time of validity, at the next IMU period;
    - `depth` (3): depth (m, positive down), 1 once valid, time of the measurement (s);
    - `compass` (3): yaw (rad), 1 once valid, time of the measurement (s).

    A new reading has a new time. At initialisation `initial_noise` draws the sensors' biases,
    offsets and scale errors. All sensors take their unit Gaussians from `noise`, which should be
    redrawn at every period of the first sensor, the IMU. Unconnected inputs count as zero, an
    unconnected pose as the identity.

    Faults (`models.sensors.faults`) act on the outputs; the sensors' own states and noise are
    unchanged. Random faults have an input of their own, `fault_noise`, drawn like `noise`; without
    them there is no such port.

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
        self, on_board: Mapping[str, Sensor] = SHIPPED, faults: tuple[SensorFault, ...] = ()
    ):
        """Measure with the sensors by their ports' names, with `faults` in their outputs."""
        super().__init__()
        self._names, sensors = tuple(on_board), tuple(on_board.values())
        count, base = len(sensors), sensors[0].rate
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
        shown = [
            _Shown(s, tuple(f for f in faults if f.sensor == name)) for name, s in on_board.items()
        ]
        fault_sizes = [part.noise_size for part in shown]
        self._draws = [self._noise]
        if sum(fault_sizes):
            port = self.DeclareVectorInputPort("fault_noise", sum(fault_sizes), gaussian)
            self._draws.append(port)

        self._sizes = [*(s.state_size for s in sensors), *(s.port_size for s in sensors)]
        self._sizes += [part.memory_size for part in shown if part.faults]
        groups = [self.DeclareDiscreteState(size) for size in self._sizes]
        self._states = groups[:count]
        for name, index in zip(self._names, groups[count:], strict=False):
            self.DeclareStateOutputPort(name, index)

        self._start = VectorFunction(
            lambda *w: tuple(s.initial(part) for s, part in zip(sensors, w, strict=True)),
            initial_sizes,
            [s.state_size for s in sensors],
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._initialise)
        self._parts = parts = _parts(shown)
        # Sensors whose period is a multiple of the IMU's share its events and compiled calls.
        shared = [part for part in parts if _divides(part.rate, base)]
        self._declare(shared)
        for part in parts:
            if part not in shared:
                self._declare([part])

    def pure(self) -> Pure:
        """Each sensor's measurement as a pure function."""
        base = self._parts[0].rate
        inputs_at_rest = self._inputs_at_rest

        def event(part: _Part) -> Event:
            def update(t: Array, state: State, inputs: Inputs) -> dict[int, Array]:
                X, V, A, *draws = (
                    inputs[port.get_name()] if port.get_name() in inputs else jnp.asarray(still)
                    for port, still in inputs_at_rest
                )
                w = _joined(draws)
                own = [state[index] for index in part.reads]
                return dict(zip(part.writes, part.measure((X, V, A), t, w, *own), strict=True))

            if _divides(part.rate, base):
                return Event(1 / base, update, round(base / part.rate))
            return Event(1 / part.rate, update)

        count = len(self._names)
        outputs = {name: shown_group(count + i) for i, name in enumerate(self._names)}
        noise = tuple(port.get_name() for port in self._draws)
        return Pure(tuple(event(part) for part in self._parts), outputs, noise)

    @property
    def _inputs_at_rest(self) -> list[tuple[InputPort, np.ndarray]]:
        """The inputs that events read, with their values while unconnected."""
        ports = (self._X, self._V, self._A, *self._draws)
        pose = np.eye(7)[0]
        return [(port, pose if port is self._X else np.zeros(port.size())) for port in ports]

    def _declare(self, parts: list["_Part"]) -> None:
        """Declare events at the first part's rate; the others take part at integer multiples."""
        inputs_at_rest = self._inputs_at_rest
        drawn = [port.size() for port in self._draws]
        period = 1 / parts[0].rate
        every = [round(parts[0].rate / part.rate) for part in parts]

        @cache
        def call(due: tuple[bool, ...]) -> tuple[VectorFunction, list[int], list[int]]:
            """One compiled call from the motion and the states read to the states written."""
            used = [part for part, now in zip(parts, due, strict=True) if now]
            reads = [index for part in used for index in part.reads]
            writes = [index for part in used for index in part.writes]

            def packed(t: Array, X: Array, V: Array, A: Array, *rest: Array) -> Outputs:
                values = iter(rest)
                w = _joined(list(islice(values, len(drawn))))
                return sum(
                    (p.measure((X, V, A), t[0], w, *islice(values, len(p.reads))) for p in used), ()
                )

            inputs = [1, 7, 6, 6, *drawn, *(self._sizes[i] for i in reads)]
            function = VectorFunction(packed, inputs, [self._sizes[i] for i in writes])
            return function, reads, writes

        cycle = lcm(*every)

        @cache
        def call_at(phase: int) -> tuple[VectorFunction, list[int], list[int]]:
            return call(tuple(phase % m == 0 for m in every))

        def update(context: Context, discrete_state: DiscreteValues) -> None:
            t = context.get_time()
            function, reads, writes = call_at(round(t / period) % cycle)
            parts = [np.array([t])]
            given = [(value_or_none(port, context), still) for port, still in inputs_at_rest]
            parts += [still if value is None else value for value, still in given]
            parts += [group(context, index) for index in reads]
            set_groups(discrete_state, writes, function(*parts))

        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, update)

    def _initialise(self, context: Context, discrete_state: DiscreteValues) -> None:
        w = value_or_zeros(self._initial_noise, context)
        set_groups(discrete_state, self._states, self._start(w))


@dataclass(frozen=True)
class _Part:
    """One sensor's update in its event, with the state groups that it reads and writes."""

    rate: float
    measure: Callable[..., Outputs]
    reads: tuple[int, ...]
    writes: tuple[int, ...]


def _parts(shown: Sequence["_Shown"]) -> list[_Part]:
    """The updates of all sensors.

    State groups are the sensors' states, their outputs, and the memories of those with faults; the
    noise is that of the sensors, then that of their faults.
    """
    count, parts = len(shown), []
    sizes = [*(each.sensor.noise_size for each in shown), *(each.noise_size for each in shown)]
    draws = [slice(a, b) for a, b in pairwise(np.cumsum([0, *sizes]))]
    memories = itertools.count(2 * count)
    for i, each in enumerate(shown):
        memory = (next(memories),) if each.faults else ()
        groups, noise = (i, count + i, *memory), (draws[i], draws[count + i])
        if each.sensor.late:
            parts.append(each.appears(shown[0].sensor.rate, groups, noise[1]))
        parts.append(each.measured(groups, noise))
    return parts


def _divides(rate: float, of: float) -> bool:
    ratio = of / rate
    return ratio > 0.5 and abs(ratio - round(ratio)) < 1e-9 * ratio


def _joined(draws: list[Array]) -> Array:
    return jnp.concatenate(draws) if len(draws) > 1 else draws[0]


@dataclass(frozen=True)
class _Shown:
    """A sensor with the faults of its output."""

    sensor: Sensor
    faults: tuple[SensorFault, ...]

    @property
    def _faulty(self) -> FaultySensor:
        return FaultySensor(self.sensor, self.faults)

    @property
    def noise_size(self) -> int:
        """Number of unit Gaussians for the faults of one reading."""
        return self._faulty.noise_size

    @property
    def memory_size(self) -> int:
        """Size of the faults' memory; a late sensor's includes its last held reading."""
        held = self.sensor.reading_size if self.sensor.late else 0
        return held + self._faulty.memory_size

    def measured(self, groups: tuple[int, ...], noise: tuple[slice, slice]) -> _Part:
        """The measurement; a late sensor's is output separately, after its latency."""
        sensor, (state, output, *memory) = self.sensor, groups
        own, of_faults = noise

        def measure(motion: Motion, t: Array, w: Array, state: Array, *kept: Array) -> Outputs:
            state = sensor.measure(state, *motion, t, w[own])
            if sensor.late:
                return (state,)
            reading = sensor.reading(state, t)
            if sensor.port_size > reading.size:  # with a validity flag and its time
                reading = jnp.concatenate([reading, jnp.stack([jnp.ones_like(t), t])])
            return state, *self.show(reading, t, w[of_faults], *kept)

        if sensor.late:
            return _Part(sensor.rate, measure, (state,), (state,))
        return _Part(sensor.rate, measure, (state, *memory), (state, output, *memory))

    def appears(self, rate: float, groups: tuple[int, ...], noise: slice) -> _Part:
        """The output of a late sensor's newest reading, at `rate`."""
        state, output, *memory = groups

        def appear(motion: Motion, t: Array, w: Array, state: Array, *kept: Array) -> Outputs:
            del motion
            return self.show_held(self.sensor.reading(state, t), w[noise], *kept)

        held = (output, *memory) if memory else ()
        return _Part(rate, appear, (state, *held), (output, *memory))

    def show(self, reading: Array, t: Array, w: Array, *memory: Array) -> Outputs:
        """The output for a reading measured at t, and the faults' memory if there are any."""
        if not self.faults:
            return (reading,)
        bare = reading.size == self.sensor.value_size
        marks = [jnp.stack([jnp.ones_like(t), t])] if bare else []
        kept, seen = self._faulty.show(memory[0], jnp.concatenate([reading, *marks]), t, w)
        return seen[: reading.size], kept

    def show_held(self, reading: Array, w: Array, *memory: Array) -> Outputs:
        """The same for a late sensor's held reading; faults act on it once, when it appears."""
        if not self.faults:
            return (reading,)
        before, kept = memory
        last, own = kept[: reading.size], kept[reading.size :]
        n = self.sensor.value_size + 1
        own, seen = self._faulty.show(own, self.sensor.marked(reading), reading[-1], w)
        seen = jnp.concatenate([seen[:n], reading[n:-1], seen[n:]])
        new = jnp.any(reading != last)
        return jnp.where(new, seen, before), jnp.where(new, jnp.concatenate([reading, own]), kept)
