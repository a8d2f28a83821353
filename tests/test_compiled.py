"""A diagram steps in one compiled loop as it does in Drake."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import (
    ConstantVectorSource,
    Integrator,
    LogVectorOutput,
    RandomSource,
    VectorLogSink,
)

from helpers import ROOT
from spinndrift.models.config.errors import UserError
from spinndrift.sims.run.loop import _simulator, simulate
from spinndrift.sims.scenarios.scenario import load_scenario, scenario_names
from spinndrift.systems.closed_loop import build_diagram
from spinndrift.systems.compiled.network import NotPureError
from spinndrift.systems.compiled.pure import Event, Pure, shown
from spinndrift.systems.compiled.simulator import CompiledSimulator
from spinndrift.systems.drake import value_or_zeros


class Mixer(LeafSystem):
    """x ← 0.9 x + u + 0.1 w + t every period, every third time n ← n + 1; y is x, or 2 x + u.

    With `late` the count goes on at that period and by w, whatever was drawn last.
    """

    def __init__(
        self,
        period: float,
        feedthrough: bool = False,
        factor: float = 0.9,
        late: float | None = None,
    ):
        super().__init__()
        self.late = late
        self.period, self.factor = period, factor
        self._u = self.DeclareVectorInputPort("u", 2)
        self._w = self.DeclareVectorInputPort("noise", 2, RandomDistribution.kGaussian)
        self._x = self.DeclareDiscreteState(2)
        self._n = self.DeclareDiscreteState(1)
        if feedthrough:
            self.DeclareVectorOutputPort("y", 2, self._put)
        else:
            self.DeclareStateOutputPort("y", self._x)
        self.DeclareStateOutputPort("n", self._n)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        if late is not None:
            self.DeclarePeriodicDiscreteUpdateEvent(late, 0.0, self._add)
        self._feedthrough = feedthrough

    def pure(self) -> Pure:
        def update(t, state, inputs):
            zero = jnp.zeros(2)
            u, w = inputs.get("u", zero), inputs.get("noise", zero)
            return {0: self.factor * state[0] + u + 0.1 * w + t}

        def both(state, inputs):
            return 2 * state[0] + inputs["u"]

        def late(t, state, inputs):
            return {1: state[1] + inputs["noise"][:1]}

        if self.late is None:
            count = Event(self.period, lambda t, state, inputs: {1: state[1] + 1}, every=3)
        else:
            count = Event(self.late, late)
        events = (Event(self.period, update), count)
        outputs = {"y": both if self._feedthrough else shown(0), "n": shown(1)}
        return Pure(events, outputs, ("noise",), (0,))

    def _put(self, context, output):
        x = context.get_discrete_state(self._x).value()
        output.SetFromVector(2 * x + self._u.Eval(context))

    def _update(self, context, state):
        x = context.get_discrete_state(self._x).value()
        t = context.get_time()
        u, w = (value_or_zeros(port, context) for port in (self._u, self._w))
        state.set_value(self._x, self.factor * x + u + 0.1 * w + t)
        if self.late is None and round(t / self.period) % 3 == 0:
            state.set_value(self._n, context.get_discrete_state(self._n).value() + 1)

    def _add(self, context, state):
        drawn = value_or_zeros(self._w, context)[:1]
        state.set_value(self._n, context.get_discrete_state(self._n).value() + drawn)


LOGS = {"log_slow": 0.05, "log_mid": 0.025, "log_out": 0.1, "log_count": 0.01, "log_late": 0.03}


def ring() -> Diagram:
    """Three systems in a ring at periods whose multiples differ by rounding, one in a diagram."""
    inner = DiagramBuilder()
    mid = inner.AddNamedSystem("mid", Mixer(0.02, feedthrough=True))
    source = inner.AddNamedSystem("draws", RandomSource(RandomDistribution.kGaussian, 2, 0.02))
    inner.Connect(source.get_output_port(), mid.GetInputPort("noise"))
    inner.ExportInput(mid.GetInputPort("u"), "u")
    inner.ExportOutput(mid.GetOutputPort("y"), "y")
    inner.ExportOutput(mid.GetOutputPort("n"), "n")

    builder = DiagramBuilder()
    part = builder.AddNamedSystem("part", inner.Build())
    slow = builder.AddNamedSystem("slow", Mixer(0.05, factor=-0.5))
    fast = builder.AddNamedSystem("fast", Mixer(0.01, factor=-0.3))
    constant = builder.AddNamedSystem("constant", ConstantVectorSource([0.5, -1.0]))
    lone = builder.AddNamedSystem("lone", Mixer(0.07, late=0.03))
    kind = RandomDistribution.kUniform
    noise = builder.AddNamedSystem("more", RandomSource(kind, 2, 0.01))
    builder.Connect(noise.get_output_port(), fast.GetInputPort("noise"))
    builder.Connect(fast.GetOutputPort("y"), part.GetInputPort("u"))
    builder.Connect(part.GetOutputPort("y"), slow.GetInputPort("u"))
    builder.Connect(slow.GetOutputPort("y"), fast.GetInputPort("u"))
    draws = builder.AddNamedSystem("draws", RandomSource(RandomDistribution.kGaussian, 2, 0.07))
    builder.Connect(draws.get_output_port(), lone.GetInputPort("noise"))
    builder.Connect(constant.get_output_port(), lone.GetInputPort("u"))
    ports = {
        "log_slow": slow.GetOutputPort("y"),
        "log_mid": part.GetOutputPort("y"),
        "log_out": lone.GetOutputPort("y"),
        "log_count": part.GetOutputPort("n"),
        "log_late": lone.GetOutputPort("n"),
    }
    for name, port in ports.items():
        LogVectorOutput(port, builder, LOGS[name]).set_name(name)
    return builder.Build()


def fly(
    simulator, diagram: Diagram, times, seed: int = 5, start: float = 0.0
) -> tuple[dict, np.ndarray]:
    context = simulator.get_mutable_context()
    context.SetTime(start)
    diagram.SetRandomContext(context, RandomGenerator(seed))
    simulator.Initialize()
    for t in times:
        simulator.AdvanceTo(t)
    sinks = [s for s in diagram.GetSystems() if isinstance(s, VectorLogSink)]
    logs = {
        s.get_name(): (s.FindLog(context).sample_times().copy(), s.FindLog(context).data().copy())
        for s in sinks
    }
    state = np.concatenate(
        [
            diagram.GetSubsystemByName(name).GetMyContextFromRoot(context)
            .get_discrete_state(0).value()
            for name in ("slow", "fast", "lone")
        ]
    )  # fmt: skip
    return logs, state


@pytest.fixture(scope="module")
def diagram() -> Diagram:
    return ring()


@pytest.mark.parametrize("times", [[2.0], [0.05 * k for k in range(1, 41)], [0.031, 0.7, 2.0]])
def test_events_and_logs_are_drakes(diagram, times):
    wanted, end = fly(Simulator(diagram), diagram, times)
    found, own_end = fly(CompiledSimulator(diagram, LOGS), diagram, times)
    assert set(found) == set(LOGS)
    for name, (when, value) in wanted.items():
        np.testing.assert_array_equal(found[name][0], when, name)
        np.testing.assert_allclose(found[name][1], value, rtol=1e-12, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(own_end, end, rtol=1e-12)
    assert np.ptp(wanted["log_slow"][1]) > 1


def test_a_start_at_another_time(diagram):
    wanted = fly(Simulator(diagram), diagram, [1.7], start=0.705)
    found = fly(CompiledSimulator(diagram, LOGS), diagram, [1.7], start=0.705)
    for name, (when, value) in wanted[0].items():
        np.testing.assert_array_equal(found[0][name][0], when, name)
        np.testing.assert_allclose(found[0][name][1], value, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found[1], wanted[1], rtol=1e-12)


def test_how_far_it_steps_at_once_changes_nothing(diagram):
    once, end = fly(CompiledSimulator(diagram, LOGS), diagram, [1.3])
    steps, last = fly(CompiledSimulator(diagram, LOGS), diagram, [0.013 * k for k in range(1, 101)])
    for name in once:
        np.testing.assert_array_equal(once[name][1], steps[name][1], name)
    np.testing.assert_array_equal(end, last)


def test_seeds(diagram):
    one, two, other = (
        fly(CompiledSimulator(diagram, LOGS), diagram, [0.5], seed)[1] for seed in (5, 5, 6)
    )
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)


def test_another_context_is_another_run_in_what_is_compiled(diagram):
    """From its start, with logs of its own."""
    simulator = CompiledSimulator(diagram, LOGS)
    first = fly(simulator, diagram, [0.5])
    simulator.reset_context(diagram.CreateDefaultContext())
    again = fly(simulator, diagram, [0.5])
    np.testing.assert_array_equal(first[1], again[1])
    for name in LOGS:
        np.testing.assert_array_equal(first[0][name][0], again[0][name][0])
        np.testing.assert_array_equal(first[0][name][1], again[0][name][1])


def test_what_drake_alone_can_step_is_told():
    builder = DiagramBuilder()
    builder.AddNamedSystem("sum", Integrator(1))
    with pytest.raises(NotPureError, match="sum does not tell"):
        CompiledSimulator(builder.Build())
    with pytest.raises(NotPureError, match="period of log_"):
        CompiledSimulator(ring(), {})
    builder = DiagramBuilder()
    mixer = builder.AddSystem(Mixer(0.01))
    source = builder.AddNamedSystem("slow", RandomSource(RandomDistribution.kGaussian, 2, 0.02))
    builder.Connect(source.get_output_port(), mixer.GetInputPort("noise"))
    with pytest.raises(NotPureError, match="slow draws at another period"):
        CompiledSimulator(builder.Build())


def test_a_state_that_runs_away_is_told():
    builder = DiagramBuilder()
    builder.AddNamedSystem("bomb", Mixer(0.01, factor=1e30))
    simulator = CompiledSimulator(builder.Build())
    simulator.AdvanceTo(0.05)
    with pytest.raises(FloatingPointError, match=r"bomb: .* between t = 0.0500 s and 1.0000 s"):
        simulator.AdvanceTo(1.0)
    assert simulator.get_mutable_context().get_time() == 0.05


FAULTS = """[{sensor: imu, fault: frozen, start: 0.5, duration: 0.1},
    {sensor: depth, fault: offset, start: 0.8, size: 0.2, share: 0.7}]"""
STATION = f"{{duration: 1.5, station: {{sensing: {{dvl: {{rate: 3.0}}, faults: {FAULTS}}}}}}}"


@pytest.mark.slow
def test_the_station_in_a_harbour_flies_as_in_drake():
    """All systems of a run without a planner; the DVL's period is no multiple of the IMU's, and
    sensors fail."""
    scenario = load_scenario("trajectory_tracking_harbour", STATION)
    drake, loop = (simulate(scenario, engine=engine) for engine in ("drake", "compiled"))
    assert (drake.timing.engine, loop.timing.engine) == ("drake", "compiled")
    assert loop.outcome == drake.outcome
    for name, variable in drake.log.recording.dataset.items():
        found = loop.log.recording.dataset[name].to_numpy()
        np.testing.assert_allclose(found, variable.to_numpy(), rtol=1e-9, atol=1e-9, err_msg=name)
    assert drake.log.plans is not None
    assert loop.log.plans is not None
    np.testing.assert_allclose(loop.log.plans.X_WB, drake.log.plans.X_WB, atol=1e-9)


PLANNER = """{duration: 0.7, controller: {planner: {horizon: 20, sequences: 40, realisations: 2,
    knots: [2, 4], effective_samples: 4, shown_paths: 4}}}"""


@pytest.mark.slow
def test_a_planner_flies_as_in_drake():
    """Four calls, each from what the ones before made, in the planner's single precision."""
    scenario = load_scenario("pylon_crossing_calm", PLANNER)
    drake, loop = (simulate(scenario, engine=engine) for engine in ("drake", "compiled"))
    assert (drake.timing.engine, loop.timing.engine) == ("drake", "compiled")
    assert loop.outcome == drake.outcome
    wanted, found = drake.log.plans, loop.log.plans
    assert wanted is not None
    assert found is not None
    assert wanted.time.size == 4
    np.testing.assert_array_equal(found.time, wanted.time)
    np.testing.assert_allclose(found.X_WB, wanted.X_WB, atol=1e-5)
    np.testing.assert_allclose(found.figures, wanted.figures, rtol=1e-4)
    for name in ("X_WB", "V_WB_B", "X_WB_estimate"):
        np.testing.assert_allclose(loop.log[name], drake.log[name], atol=1e-6, err_msg=name)
    np.testing.assert_allclose(loop.log["F_Bo_B"], drake.log["F_Bo_B"], atol=1e-4)
    assert drake.timing.summary()["planner_median_ms"] is not None
    assert loop.timing.summary()["planner_median_ms"] is None  # it is not a step of its own


_TRACED = ("pylon_crossing_harbour", "station_keeping_calm")
"""With all systems, and with the fewest."""


@pytest.mark.parametrize(
    "name",
    [
        # test_every_scenario_flies has the others in Drake's loop
        pytest.param(n, marks=[pytest.mark.slow] * (n not in _TRACED))
        for n in scenario_names()
        if not n.endswith("_vehicle")
    ],
)
def test_every_shipped_scenario_is_one_loop(name):
    """All of its systems tell what they compute; tracing, not compiling, shows that it fits.

    It is long enough that the loop is taken unasked, unless a planner takes most of the time, whose
    rollouts Drake's stepping runs in threads.
    """
    scenario = load_scenario(name)
    diagram = build_diagram(scenario.station, scenario.controller, goal=scenario.goal)
    simulator = _simulator(diagram, scenario, "compiled")
    assert isinstance(simulator, CompiledSimulator)
    unasked = _simulator(diagram, scenario, "auto")
    assert isinstance(unasked, CompiledSimulator) == ("pylon" not in name)
    sizes = [jax.ShapeDtypeStruct((n,), float) for n in simulator._sizes]
    state, logged = jax.eval_shape(simulator._run, *sizes)
    assert state.shape == sizes[0].shape
    assert logged.size > 0


def test_a_controller_without_pure_functions_is_stepped_by_drake_and_can_t_be_forced():
    own = f"controller: !Own {{system: '{ROOT}/examples/own_controller.py:PidController'}}"
    text = f"{{{own}, success: !ReachGoal {{goal: [1, 0, -1.5]}}}}"
    with pytest.raises(UserError, match="drake or auto"):
        simulate(load_scenario("station_keeping_calm", text), engine="compiled")
