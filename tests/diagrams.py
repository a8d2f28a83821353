"""Small diagrams for tests: randomness from ports, seeds, runs that must agree bit for bit."""

from collections.abc import Callable, Sequence

import numpy as np
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem, System
from pydrake.systems.primitives import RandomSource

PERIOD = 0.01


def connect(builder: DiagramBuilder, source: LeafSystem, sink: LeafSystem, *names: str) -> None:
    """Connect ports of the same name."""
    for name in names:
        builder.Connect(source.GetOutputPort(name), sink.GetInputPort(name))


def add_randomness(builder: DiagramBuilder, *systems: LeafSystem, period: float = PERIOD) -> None:
    """Give every noise port its own source."""
    for system in systems:
        for i in range(system.num_input_ports()):
            port = system.get_input_port(i)
            if port.get_name() in ("noise", "initial_noise"):
                interval = period if port.get_name() == "noise" else 1e6
                kind = RandomDistribution.kGaussian
                source = builder.AddSystem(RandomSource(kind, port.size(), interval))
                builder.Connect(source.get_output_port(), port)


def seeded(diagram: Diagram, seed: int = 0) -> Simulator:
    """An initialised simulator whose randomness comes from `seed`."""
    simulator = Simulator(diagram)
    diagram.SetRandomContext(simulator.get_mutable_context(), RandomGenerator(seed))
    simulator.Initialize()
    return simulator


def read(system: System, name: str, context: Context) -> np.ndarray:
    """Value of a vector output port."""
    return np.asarray(system.GetOutputPort(name).Eval(context))


def outputs(diagram: Diagram, context: Context) -> np.ndarray:
    """All vector outputs of the diagram, one after the other."""
    count = diagram.num_output_ports()
    return np.concatenate([diagram.get_output_port(i).Eval(context) for i in range(count)])


def run(diagram: Diagram, seed: int, times: Sequence[float]) -> np.ndarray:
    """Outputs of a new simulation at the given times."""
    simulator = seeded(diagram, seed)
    rows = []
    for time in times:
        simulator.AdvanceTo(time)
        rows.append(outputs(diagram, simulator.get_context()))
    return np.stack(rows)


def check_reproducible(build: Callable[[], Diagram], end: float = 0.4) -> None:
    """Same seed, same bits, in any diagram; another seed, another run; clones go on alike."""
    diagram = build()
    times = np.linspace(0, end, 5)
    first = run(diagram, 1, times)
    assert np.all(np.isfinite(first))
    np.testing.assert_array_equal(run(diagram, 1, times), first)
    np.testing.assert_array_equal(run(build(), 1, times), first)
    assert np.any(run(diagram, 2, times)[1:] != first[1:])

    simulator = seeded(diagram, 1)
    simulator.AdvanceTo(times[2])
    twin = Simulator(diagram, simulator.get_context().Clone())
    twin.Initialize(InitializeParams(suppress_initialization_events=True))
    simulator.AdvanceTo(end)  # the original moves on first: nothing of it may leak into the clone
    twin.AdvanceTo(end)
    np.testing.assert_array_equal(outputs(diagram, simulator.get_context()), first[-1])
    np.testing.assert_array_equal(outputs(diagram, twin.get_context()), first[-1])
