"""A row of the logs is one instant, whoever steps the diagram and whatever holds the values."""

import tracemalloc
from bisect import bisect_left

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import PassThrough, SymbolicVectorSystem

from spinndrift.systems.closed_loop import _truth, logged
from spinndrift.systems.compiled.network import flatten, holders
from spinndrift.systems.compiled.pure import Event, Pure, shown
from spinndrift.systems.compiled.signal_log import Rows, SignalLog, add_log
from spinndrift.systems.compiled.simulator import CompiledSimulator
from spinndrift.systems.growing_rows import GrowingRows


class Moves(LeafSystem):
    """A plant: its update at t moves its state, t itself, on to t + period."""

    def __init__(self, period: float = 0.01):
        super().__init__()
        self.period = period
        self.DeclareStateOutputPort("X_WB_cheat", self.DeclareDiscreteState(1))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def pure(self) -> Pure:
        update = lambda t, state, inputs: {0: t[None] + self.period}  # noqa: E731
        return Pure((Event(self.period, update),), {"X_WB_cheat": shown(0)})

    def _update(self, context, state):
        state.set_value(0, [context.get_time() + self.period])


class Copies(LeafSystem):
    """An estimator that knows: its update at t takes over the truth of t."""

    def __init__(self, period: float):
        super().__init__()
        self.period = period
        self._seen = self.DeclareVectorInputPort("seen", 1)
        self.DeclareStateOutputPort("X_WB", self.DeclareDiscreteState(1))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def pure(self) -> Pure:
        update = lambda t, state, inputs: {0: inputs["seen"]}  # noqa: E731
        return Pure((Event(self.period, update),), {"X_WB": shown(0)})

    def _update(self, context, state):
        state.set_value(0, self._seen.Eval(context))


PERIODS = (0.01, 0.04, 0.02)
"""Of the copies: of 0.01 s the multiples that are floats themselves, so that Drake has the updates
of plant and copy at one time."""


def loop(log_period: float) -> Diagram:
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", Moves())
    add_log(builder, plant.get_output_port(), "truth", log_period, early=True)
    for k, period in enumerate(PERIODS):
        copy = builder.AddNamedSystem(f"copy{k}", Copies(period))
        builder.Connect(plant.get_output_port(), copy.get_input_port())
        add_log(builder, copy.get_output_port(), f"copy{k}", log_period)
    return builder.Build()


@pytest.mark.parametrize("make", [Simulator, CompiledSimulator])
@pytest.mark.parametrize("steps", [1, 7])
def test_truth_and_a_copy_of_it_are_equal_in_every_row(make, steps):
    diagram = loop(0.2)  # 3 × 0.2 is another float than 60 × 0.01
    simulator = make(diagram)
    for k in range(steps):
        simulator.AdvanceTo(6.0 * (k + 1) / steps)
    signals = logged(diagram, simulator.get_mutable_context())
    assert set(signals) == {"truth", "copy0", "copy1", "copy2"}
    for signal in signals.values():
        np.testing.assert_array_equal(signal.time, 0.2 * np.arange(30))
        np.testing.assert_allclose(signal.value[:, 0], signal.time, atol=1e-12)


def test_a_slow_copy_is_held_and_the_present_has_no_row_yet():
    diagram = loop(0.01)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(3.0)
    signals = logged(diagram, simulator.get_context())
    t = signals["truth"].time
    assert t[-1] == pytest.approx(2.99)
    held = 0.04 * np.floor(t / 0.04 + 1e-6)
    np.testing.assert_allclose(signals["copy1"].value[:, 0], held, atol=1e-12)
    simulator.AdvanceTo(3.0 + 1e-3)
    assert logged(diagram, simulator.get_context())["truth"].time[-1] == pytest.approx(3.0)


def test_logs_belong_to_their_context():
    diagram = loop(0.2)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(1.0)
    twin = simulator.get_context().Clone()
    simulator.AdvanceTo(2.0)
    assert logged(diagram, twin)["truth"].time.size == 5
    assert logged(diagram, simulator.get_context())["truth"].time.size == 10
    whole = logged(diagram, simulator.get_context())["truth"]
    late = logged(diagram, simulator.get_context(), since=whole.time[7])["truth"]
    np.testing.assert_array_equal(late.time, whole.time[7:])
    np.testing.assert_array_equal(late.value, whole.value[7:])


def test_what_shows_the_plants_state_is_its_truth():
    """Through what keeps no state; an estimator's state is its own."""
    inner = DiagramBuilder()
    plant = inner.AddNamedSystem("plant", Moves())
    copy, through = inner.AddSystem(Copies(0.05)), inner.AddSystem(PassThrough(1))
    inner.Connect(plant.get_output_port(), copy.get_input_port())
    inner.Connect(plant.get_output_port(), through.get_input_port())
    inner.ExportInput(inner.AddSystem(PassThrough(1)).get_input_port(), "F_Bo_B")
    for name, system in (("X_WB_cheat", plant), ("X_WB", copy), ("V_WB_B", through)):
        inner.ExportOutput(system.get_output_port(), name)
    station = inner.Build()
    builder = DiagramBuilder()
    control = builder.AddSystem(PassThrough(1))
    builder.ExportInput(control.get_input_port(), "V_WB_B")
    builder.ExportOutput(control.get_output_port(), "F_Bo_B")
    controller = builder.Build()
    assert _truth(station, controller) == {(station, 0), (station, 2), (controller, 0)}
    wires = {}
    shown_ports = flatten(station, wires).shown
    assert [len(holders(port, wires)) for port in shown_ports] == [1, 1, 1]
    constant = SymbolicVectorSystem(output=[1.0])
    assert holders((constant, 0), {}) == set()


def test_a_growing_log_copies_nothing():
    """So a loop in real time never waits for its own log."""
    rows, n, size = Rows(100, 0.05), 10_000, 101 * 8
    value = np.ones(100)
    tracemalloc.start()
    try:
        for k in range(n):
            rows.AddData(0.05 * k, value)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert n * size < most < 1.1 * n * size


def test_rows_grow_and_keep_their_instants():
    rows, n = Rows(2, 0.05), 3000
    assert rows.sample_times().size == 0
    assert rows.data().shape == (2, 0)
    for k in range(n):
        rows.AddData(0.05 * k + 1e-6, np.full(2, float(k)))
    for first in (0, 1, 1023, 1024, 2048, n - 1, n):
        np.testing.assert_array_equal(rows.sample_times(first), 0.05 * np.arange(first, n))
        np.testing.assert_array_equal(rows.data(first), np.tile(np.arange(first, n), (2, 1)))
    t, values = rows.newest()
    assert t == 0.05 * (n - 1)
    assert values.tolist() == [n - 1, n - 1]
    with pytest.raises(ValueError, match="period"):
        SignalLog(1, 1e-6)


def test_growing_rows_are_a_sequence_of_rows():
    rows, n = GrowingRows(2), 2500
    for k in range(n):
        rows.new()[:] = k, -k
    assert len(rows) == n
    for k in (0, 1023, 1024, n - 1, -1, -n):
        assert rows[k].tolist() == [k % n, -(k % n)]
    for k in (n, -n - 1):
        with pytest.raises(IndexError, match=f"row {k} of {n}"):
            rows[k]
    assert bisect_left(rows, 1500.5, key=lambda row: row[0]) == 1501
