"""A diagram as a flat network of systems with pure functions."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
from jaxtyping import Array
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, InputPortIndex, OutputPortIndex, System
from pydrake.systems.primitives import ConstantVectorSource, RandomSource, VectorLogSink

from .jit import VectorFunction
from .pure import Event, HasPure, Pure, State
from .signal_log import SignalLog

Port = tuple[System, int]
"""A system's port by its number."""

Group = tuple[System, int]
"""A system's group of discrete state by its number."""


class NotPureError(Exception):
    """A diagram contains a system that only Drake can step."""


@dataclass(frozen=True, eq=False)
class Leaf:
    """A system with its pure functions, and the sizes of its groups of discrete state."""

    system: System
    pure: Pure
    sizes: tuple[int, ...]


class Log(NamedTuple):
    """A log, the output port that it logs, and when: at `offset` and every `period` after (s)."""

    system: VectorLogSink | SignalLog
    port: Port
    period: float
    offset: float


@dataclass(frozen=True, eq=False)
class Network:
    """A diagram's leaf systems and their connections, without the subdiagrams.

    Attributes:
        leaves: systems with pure functions.
        wires: the output port that feeds an input port.
        constants: output ports whose values never change.
        noise: sources of random numbers, with the period (s) at which they draw.
        logs: the logs.
    """

    leaves: tuple[Leaf, ...]
    wires: Mapping[Port, Port]
    constants: tuple[Port, ...]
    noise: tuple[tuple[RandomSource, float], ...]
    logs: tuple[Log, ...]

    @staticmethod
    def of(diagram: Diagram, log_periods: Mapping[str, float]) -> "Network":
        """The network of a diagram without inputs; `log_periods` (s) of Drake's logs by name.

        Raises:
            NotPureError: a system is none of the above, or a source draws at another period than
                its readers.
        """
        wires: dict[Port, Port] = {}
        leaves, constants, logs, sources = [], [], [], []
        for system in flatten(diagram, wires).leaves:
            if isinstance(system, HasPure):
                context = system.CreateDefaultContext()
                count = context.num_discrete_state_groups()
                sizes = (context.get_discrete_state(i).size() for i in range(count))
                leaves.append(Leaf(system, system.pure(), tuple(sizes)))
            elif isinstance(system, ConstantVectorSource):
                constants.append((system, 0))
            elif isinstance(system, SignalLog):
                logs.append(Log(system, wires[system, 0], system.period, system.offset))
            elif isinstance(system, VectorLogSink):
                name = system.get_name()
                if name not in log_periods:
                    raise NotPureError(f"the period of {name} is not given")
                logs.append(Log(system, wires[system, 0], log_periods[name], 0.0))
            elif isinstance(system, RandomSource):
                sources.append(system)
            else:
                raise NotPureError(f"{system.get_name()} does not tell what it computes")
        noise = _noise(leaves, wires, sources)
        return Network(tuple(leaves), wires, tuple(constants), tuple(noise.items()), tuple(logs))

    @cached_property
    def groups(self) -> tuple[tuple[Group, slice], ...]:
        """Every group of state with its slice of the state vector."""
        found, at = [], 0
        for leaf in self.leaves:
            for index, size in enumerate(leaf.sizes):
                found.append(((leaf.system, index), slice(at, at + size)))
                at += size
        return tuple(found)

    @cached_property
    def by_system(self) -> Mapping[System, Leaf]:
        """The leaves by their systems."""
        return {leaf.system: leaf for leaf in self.leaves}


def places(ports: Iterable[Port]) -> tuple[list[slice], int]:
    """The slices of concatenated output port values, and their total length."""
    found, at = [], 0
    for system, index in ports:
        size = system.get_output_port(index).size()
        found.append(slice(at, at + size))
        at += size
    return found, at


class Ports:
    """Values of output ports for one state, computed on demand."""

    def __init__(self, network: Network, state: Mapping[Group, Array], known: Mapping[Port, Array]):
        """`known` are the values of constants and of noise."""
        self._network, self._values = network, dict(known)
        self._states = {
            leaf.system: [state[leaf.system, i] for i in range(len(leaf.sizes))]
            for leaf in network.leaves
        }

    def value(self, port: Port) -> Array:
        """Value of an output port."""
        if port not in self._values:
            system, index = port
            output = self._network.by_system[system].pure.outputs[
                system.get_output_port(index).get_name()
            ]
            self._values[port] = output(self._states[system], self._inputs(system))
        return self._values[port]

    def update(self, leaf: Leaf, event: Event, t: Array) -> dict[Group, Array]:
        """The groups that an event changes, after it."""
        state: State = self._states[leaf.system]
        changed = event.update(t, state, self._inputs(leaf.system))
        return {(leaf.system, group): value for group, value in changed.items()}

    def _inputs(self, system: System) -> "_Inputs":
        return _Inputs(self.value, system, self._network.wires)


class _Inputs(Mapping[str, Array]):
    """A system's connected input ports."""

    def __init__(self, value: Callable[[Port], Array], system: System, wires: Mapping[Port, Port]):
        names = [system.get_input_port(i).get_name() for i in range(system.num_input_ports())]
        self._value = value
        self._from = {
            name: wires[system, i] for i, name in enumerate(names) if (system, i) in wires
        }

    def __getitem__(self, name: str) -> Array:
        return self._value(self._from[name])

    def __contains__(self, name: object) -> bool:
        return name in self._from

    def __iter__(self) -> Iterator[str]:
        return iter(self._from)

    def __len__(self) -> int:
        return len(self._from)


class Flat(NamedTuple):
    """A system's leaves: the systems in it that are not diagrams.

    Attributes:
        leaves: all of them.
        feeds: the leaves' input ports behind each input port.
        shown: the leaf's output port behind each output port.
    """

    leaves: list[System]
    feeds: list[list[Port]]
    shown: list[Port]


def flatten(system: System, wires: dict[Port, Port]) -> Flat:
    """The leaves of a system; adds the connections among them to `wires`."""
    if not isinstance(system, Diagram):
        feeds = [[(system, i)] for i in range(system.num_input_ports())]
        return Flat([system], feeds, [(system, i) for i in range(system.num_output_ports())])
    inner = {part: flatten(part, wires) for part in system.GetSystems()}
    for (reader, i), (source, j) in system.connection_map().items():
        for port in inner[reader].feeds[int(i)]:
            wires[port] = inner[source].shown[int(j)]
    feeds = [
        [
            port
            for part, i in system.GetInputPortLocators(InputPortIndex(k))
            for port in inner[part].feeds[int(i)]
        ]
        for k in range(system.num_input_ports())
    ]
    shown = []
    for k in range(system.num_output_ports()):
        part, i = system.get_output_port_locator(OutputPortIndex(k))
        shown.append(inner[part].shown[int(i)])
    return Flat([leaf for part in inner.values() for leaf in part.leaves], feeds, shown)


def compile_functions(system: System) -> None:
    """Compile every `VectorFunction` of a system's leaves, so that no event has to wait for it."""
    parts = [part for leaf in flatten(system, {}).leaves for part in vars(leaf).values()]
    VectorFunction.compile(*(part for part in parts if isinstance(part, VectorFunction)))


def holders(port: Port, wires: Mapping[Port, Port]) -> set[System]:
    """The leaves with state on which a leaf's output port depends, through stateless leaves."""
    system, index = port
    if (
        system.num_continuous_states()
        or system.num_discrete_state_groups()
        or system.num_abstract_states()
    ):
        return {system}
    found: set[System] = set()
    for i in range(system.num_input_ports()):
        if (system, i) in wires and system.HasDirectFeedthrough(i, index):
            found |= holders(wires[system, i], wires)
    return found


def _noise(
    leaves: list[Leaf], wires: Mapping[Port, Port], sources: list[RandomSource]
) -> dict[RandomSource, float]:
    """The sources that are read at events, with the period at which they draw."""
    found: dict[RandomSource, float] = {}
    for leaf in leaves:
        for name in leaf.pure.noise:
            port = leaf.system, int(leaf.system.GetInputPort(name).get_index())
            source = wires[port][0] if port in wires else None
            if isinstance(source, RandomSource) and source in sources:
                period = leaf.pure.events[0].period
                if found.setdefault(source, period) != period or not _draws(source, period):
                    raise NotPureError(f"{source.get_name()} draws at another period than is used")
    return found


def _draws(source: RandomSource, period: float) -> bool:
    """Whether a source draws at 0 and at every period after."""
    simulator = Simulator(source)
    counts = []
    for periods in (0.5, 1.5, 10.5):
        simulator.AdvanceTo(periods * period)
        counts.append(simulator.get_num_unrestricted_updates())
    return counts == [1, 2, 11]


def simultaneous(
    network: Network, periods: list[float]
) -> dict[tuple[int, int], list[tuple[Leaf, Event]]]:
    """Events by the index of their period in `periods` and their `every`."""
    found: dict[tuple[int, int], list[tuple[Leaf, Event]]] = {}
    for leaf in network.leaves:
        for event in leaf.pure.events:
            key = periods.index(event.period), event.every
            found.setdefault(key, []).append((leaf, event))
    return found


def changed_by(
    events: list[tuple[Leaf, Event]], ports: Callable[[], Ports], t: Array
) -> tuple[list[Group], Callable[[], tuple[Array, ...]]]:
    """The groups that simultaneous events change, and a function that computes them."""

    def change() -> dict[Group, Array]:
        own = ports()  # values of this trace only
        found: dict[Group, Array] = {}
        for leaf, event in events:
            found |= own.update(leaf, event, t)
        return found

    names: list[Group] = []

    def values() -> tuple[Array, ...]:
        found = change()
        names[:] = found
        return tuple(found.values())

    jax.eval_shape(values)
    return names, values
