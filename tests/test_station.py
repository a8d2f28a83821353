"""The station, the controllers that plug into it, and the closed loop."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import MonteCarloSimulation, Simulator
from pydrake.systems.framework import BasicVector, LeafSystem, System

from helpers import ROOT
from spinndrift.models.config.errors import UserError
from spinndrift.models.config.typed_yaml import dump, loads
from spinndrift.models.disturbances import GaussMarkovCurrent
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.systems.closed_loop import build_diagram, logged, seeded
from spinndrift.systems.compiled.jit import VectorFunction
from spinndrift.systems.compiled.pure import Event, Pure, shown
from spinndrift.systems.compiled.simulator import CompiledSimulator
from spinndrift.systems.compiled.structure import structure
from spinndrift.systems.controllers.health_gate import HealthGate
from spinndrift.systems.controllers.kinds import MppiImpedance, Own, Tracking, TrackReference
from spinndrift.systems.estimation.config import EkfConfig
from spinndrift.systems.mavlink.config import Mavlink
from spinndrift.systems.planning.mppi_config import MppiConfig
from spinndrift.systems.planning.obstacles import BoxHull, Cylinders, Pylon
from spinndrift.systems.planning.paths import HoldPose, PoseConfig
from spinndrift.systems.planning.tasks import PylonCrossing
from spinndrift.systems.station.config import Sensing, StationConfig
from spinndrift.systems.station.ports import CHEATS, station_ports
from spinndrift.systems.station.simulated import make_station

START = PoseConfig((0.0, 0.0, -1.5))
HARBOUR = StationConfig(disturbance_set="harbour", seed=3)
HOLD = TrackReference(HoldPose(START))
PID = f"{ROOT / 'examples' / 'own_controller.py'}:PidController"


def ports(system: System) -> tuple[dict[str, int], dict[str, int]]:
    inputs = [system.get_input_port(i) for i in range(system.num_input_ports())]
    outputs = [system.get_output_port(i) for i in range(system.num_output_ports())]
    return (
        {p.get_name(): p.size() for p in inputs},
        {p.get_name(): p.size() for p in outputs},
    )


def run(station, controller, seconds):
    return fly(build_diagram(station, controller), seconds, station.seed)


def fly(diagram, seconds, seed):
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    seeded(diagram, context, seed)
    simulator.AdvanceTo(seconds)
    return logged(diagram, context)


@pytest.fixture(scope="module")
def diagram():
    """Holds a pose in the harbour; compiled once for all tests."""
    return build_diagram(HARBOUR, HOLD)


@pytest.fixture(scope="module")
def harbour_hold(diagram):
    return fly(diagram, 12.0, HARBOUR.seed)


def test_the_simulated_station_has_the_ports_of_the_hardware_and_its_cheats():
    inputs, outputs = station_ports(hardware=True)
    more = station_ports()[1]
    assert set(more) - set(outputs) == {
        "X_WB_cheat",
        "V_WB_B_cheat",
        "F_disturbance_cheat",
        "flow_cheat",
    }
    assert ports(make_station(StationConfig())) == (inputs, more)


@pytest.mark.parametrize("vehicle", ["bluerov2", "bluerov2_heavy"])
@pytest.mark.parametrize("estimate", ["own", "autopilot"])
def test_a_vehicles_station_has_the_ports_of_the_simulated_one_less_the_cheats(vehicle, estimate):
    config = StationConfig(vehicle)
    link = Mavlink("udpin:127.0.0.1:0", estimate=estimate)
    simulated, real = ports(make_station(config)), ports(make_station(config, True, link=link))
    cheats = {port.name for port in CHEATS}
    assert real[0] == simulated[0]
    assert real[1] == {name: n for name, n in simulated[1].items() if name not in cheats}
    assert real == station_ports(config, hardware=True)
    assert len(cheats) == 4


def test_it_holds_a_pose_in_the_harbour(harbour_hold):
    X = harbour_hold["X_WB_cheat"]
    late = X.time > 6.0
    error = np.linalg.norm(X.value[late, 4:] - np.array(START.position), axis=1)
    assert np.max(error) < 0.35
    assert np.max(np.abs(harbour_hold["flow_cheat"].value[:, :3])) > 0.1


def test_the_observer_sees_the_currents_push():
    """Steady state: in a current alone the observer says its drag, D v + D^f v², in W."""
    current = GaussMarkovCurrent(mean_speed=0.3, std_speed=0.0, direction=0.7, std_direction=0.0)
    bias = run(StationConfig(disturbances=(current,)), HOLD, 12.0)["F_bias_Bo_W"]
    drag = load_vehicle("bluerov2_heavy").dynamics().drag_wrench
    v = 0.3 * np.array([np.cos(0.7), np.sin(0.7), 0.0])
    expected = drag(jnp.asarray([*v, 0.0, 0.0, 0.0]))
    push = bias.value[bias.time > 8.0].mean(axis=0)
    np.testing.assert_allclose(push[:2], -expected[:2], rtol=0.15)


def keys(diagram):
    """The keys of all compiled functions of the diagram's systems."""
    found, waiting = [], [diagram]
    for system in waiting:
        waiting += system.GetSystems() if hasattr(system, "GetSystems") else []
        parts = [f for _, f in sorted(vars(system).items()) if isinstance(f, VectorFunction)]
        found += [(system.get_name(), structure(f._function)) for f in parts]
    return found


def test_what_is_equal_in_two_diagrams_has_equal_keys(diagram):
    """So it is traced once: filter, controller and observer whatever the water is."""
    calm = keys(build_diagram(replace(HARBOUR, disturbances=()), HOLD))
    assert keys(build_diagram(HARBOUR, HOLD)) == keys(diagram)
    assert len(calm) > 10
    assert all(key is not None for _, key in calm)
    shared = {name for name, key in calm if key in {other for _, other in keys(diagram)}}
    assert {"ekf", "impedance", "observer"} <= shared


def test_every_signal_is_logged_at_its_rate(harbour_hold):
    _, outputs = station_ports()
    for name, size in {**outputs, "F_Bo_B": 6, "plan": 400}.items():
        signal = harbour_hold[name]
        if name != "plan":
            assert signal.value.shape[1] == size
        assert signal.value.shape[0] == signal.time.size
        assert np.all(np.isfinite(signal.value))
    np.testing.assert_allclose(np.diff(harbour_hold["X_WB"].time), 0.05, atol=1e-9)
    np.testing.assert_allclose(np.diff(harbour_hold["plan"].time), 0.2, atol=1e-9)


def test_a_row_has_the_truth_and_the_estimate_of_one_time():
    """A row that mixes times by a period of 10 ms is 4 mm off, at 0.4 m/s or more; half of that
    tells it from what a bias of 0.1 m/s² does in 0.2 s of inertial navigation.
    """
    exact = (1e-5, 1e-5, 1e-5)
    sure = EkfConfig(position_std=exact, attitude_std=exact, velocity_std=exact)
    moving = StationConfig(sensing=Sensing(ekf=sure), start_twist=(0.5, 0.0, 0.0, 0.0, 0.0, 0.0))
    diagram = build_diagram(moving, HOLD)
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    seeded(diagram, context, 1)
    simulator.AdvanceTo(0.25)
    logs = logged(diagram, context)
    np.testing.assert_array_equal(logs["X_WB"].time, logs["X_WB_cheat"].time)
    np.testing.assert_array_equal(logs["X_WB"].time, 0.05 * np.arange(5))
    truth = logs["X_WB_cheat"].value[:, 4:]
    assert truth[-1, 0] > 0.08
    np.testing.assert_allclose(logs["X_WB"].value[:, 4:], truth, atol=2e-3)


def test_equal_seeds_give_equal_runs_bit_for_bit(diagram, harbour_hold):
    other = fly(diagram, 1.0, HARBOUR.seed + 1)
    again = fly(diagram, 1.0, HARBOUR.seed)
    for name, signal in again.items():
        n = signal.time.size - 1  # the first run goes on at its last time
        np.testing.assert_array_equal(signal.value[:n], harbour_hold[name].value[:n])
    assert not np.array_equal(other["X_WB_cheat"].value, again["X_WB_cheat"].value)


def test_it_runs_in_drakes_monte_carlo_simulation(diagram):
    station: Any = diagram.GetSubsystemByName("station")

    def output(system, root):
        context = station.GetMyContextFromRoot(root)
        return float(station.GetOutputPort("X_WB_cheat").Eval(context)[4])

    samples = MonteCarloSimulation(
        lambda generator: Simulator(diagram),
        output,
        0.3,
        3,
        RandomGenerator(1),
    )
    values = [sample.output for sample in samples]
    assert len(set(values)) == 3


@pytest.mark.slow
def test_the_planner_crosses_between_pylons_and_keeps_clear():
    """A short crossing in the harbour; `sims` flies the long one over many seeds."""
    pylons = (Pylon(1.0, -0.1), Pylon(1.0, 1.4), Pylon(1.0, -1.6))
    station = StationConfig(disturbance_set="harbour", obstacles=pylons, seed=2)
    planner = MppiConfig(horizon=40, dt=0.1, sequences=120, realisations=4, shown_paths=8)
    logs = run(station, MppiImpedance(PylonCrossing(PoseConfig((2.0, -0.2, -1.5))), planner), 9.0)
    X = logs["X_WB_cheat"].value
    hull = BoxHull.create(load_vehicle(station.vehicle).size)
    clearance = jax.jit(lambda X: hull.clearance(X, Cylinders.create(pylons)))(jnp.asarray(X.T))
    assert np.min(clearance) > 0
    assert np.linalg.norm(X[-1, 4:] - np.array([2.0, -0.2, -1.5])) < 0.5
    assert logs["samples"].value.shape[1] == 1 + (3 * 40 + 1) * 8
    assert np.all(logs["figures"].value[1:, -1] == 1)


def test_a_controller_of_ones_own_plugs_in_with_its_parameters():
    own: Any = Own(PID, {"x": 0.2, "z": -1.4}).build(StationConfig(vehicle="bluerov2_heavy_ng"))
    np.testing.assert_array_equal(own.goal, [0.2, 0.0, -1.4])
    mass = load_vehicle("bluerov2_heavy_ng")
    np.testing.assert_allclose(own.P, 2 * (mass.mass + np.array(mass.added_mass[:3])))


WITHIN = """
import numpy as np
from pydrake.systems.framework import LeafSystem

class Told(LeafSystem):
    def __init__(self, vehicle, obstacles, goal, station, nested=None):
        super().__init__()
        self.told = vehicle, obstacles, goal, station, nested
        self.DeclareVectorInputPort("X_WB", 7)
        self.DeclareVectorInputPort("V_WB_B", 6)
        self.DeclareVectorOutputPort("F_Bo_B", 6, lambda context, output: None)

class Asks(LeafSystem):
    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("X_WB", 7)
        self.DeclareVectorInputPort("V_WB_B", 6)
        self.DeclareVectorInputPort("health", 5)
        self.DeclareVectorOutputPort("F_Bo_B", 6, self.show, {self.GetInputPort("health").ticket()})

    def show(self, context, output):
        output.SetFromVector([*self.GetInputPort("health").Eval(context), 0.0])

class Fails(LeafSystem):
    def __init__(self):
        raise RuntimeError("no link")

class Still(LeafSystem):
    def __init__(self, X0_WB, dvl, size=6):
        super().__init__()
        self.rate, X, V = dvl.rate, self.DeclareDiscreteState(7), self.DeclareDiscreteState(size)
        self.start = X0_WB
        self.DeclareVectorInputPort("depth", 3)
        self.DeclareVectorInputPort("pwm", 8)
        self.DeclareStateOutputPort("X_WB", X)
        self.DeclareStateOutputPort("V_WB_B", V)
        self.DeclarePeriodicDiscreteUpdateEvent(0.05, 0.0, self.update)

    def update(self, context, state):
        X = np.array(self.start)
        X[6] = -self.GetInputPort("depth").Eval(context)[0]
        X[4] = self.GetInputPort("pwm").Eval(context)[0]
        state.set_value(0, X)
"""


@pytest.fixture(name="own", scope="module")
def _own(tmp_path_factory):
    path = tmp_path_factory.mktemp("own") / "within.py"
    path.write_text(WITHIN)
    return path


def test_a_controller_of_ones_own_is_told_its_task(own):
    nested = {"gains": {"P": [1.0, 2.0], "on": True}, "modes": [{"name": "a"}, None]}
    text = dump(Own(f"{own}:Told", {"nested": nested}))
    controller = loads(Own, text)
    assert controller.parameters == {"nested": nested}
    station = StationConfig(obstacles=(Pylon(1.0, 2.0),))
    diagram = build_diagram(station, controller, goal=np.array([1.0, 0.0, -2.0]))
    built: Any = diagram.GetSubsystemByName("controller")
    told = built.told
    np.testing.assert_array_equal(told[2], [1.0, 0.0, -2.0])
    assert told[:2] == (station.load_vehicle(), station.obstacles)
    assert told[3:] == (station, nested)
    with pytest.raises(UserError, match="Told takes `goal`, of which there is none here"):
        build_diagram(station, controller)
    with pytest.raises(UserError, match=r"parameters.*finite"):
        loads(Own, "{system: a.py:A, parameters: {a: [{b: .nan}]}}")


def test_a_filter_of_ones_own_takes_the_place_of_the_stations(own):
    text = f"sensing: {{filter: !OwnFilter {{system: '{own}:Still'}}}}"
    station = loads(StationConfig, text)
    assert loads(StationConfig, dump(station)) == station
    own_filter = station.sensing.filter
    assert own_filter is not None
    logs = run(station, HOLD, 0.3)
    X = logs["X_WB"].value
    assert np.ptp(X[1:, 6]) > 0  # the depth sensor's noise
    np.testing.assert_allclose(X[1:, 6], -1.5, atol=0.3)
    assert X[-1, 4] > 1000  # µs
    assert np.isnan(logs["covariance"].value).all()
    # the same system, given by hand
    made = make_station(StationConfig(), estimator=own_filter.make(
        {"X0_WB": lambda: np.eye(7)[0], "dvl": lambda: station.sensing.dvl}
    ))  # fmt: skip
    assert ports(made) == station_ports()
    wide = replace(own_filter, parameters={"size": 5})
    with pytest.raises(UserError, match="filter Still needs the output port `V_WB_B` of size 6"):
        make_station(StationConfig(sensing=Sensing(filter=wide)))


class Playback(LeafSystem):
    """A station that shows a motion it was given, whatever it is told to do."""

    def __init__(self, size: int = 7):
        super().__init__()
        self.DeclareVectorInputPort("F_Bo_B", 6)
        nothing = {self.nothing_ticket()}
        for name, width in (("X_WB", size), ("V_WB_B", 6)):
            show = lambda context, out, n=width: out.SetFromVector(np.eye(n)[0])  # noqa: E731
            self.DeclareVectorOutputPort(name, width, show, nothing)


def test_another_system_can_stand_in_for_the_station():
    diagram = build_diagram(StationConfig(), HOLD, stand_in=Playback())
    logs = fly(diagram, 0.3, 0)
    assert set(logs) == {"X_WB", "V_WB_B", "F_Bo_B", "F_bias_Bo_W", "plan"}
    np.testing.assert_array_equal(logs["X_WB"].value, np.tile(np.eye(7)[0], (6, 1)))
    assert logs["F_Bo_B"].value[-1, 2] < -5  # down to the pose that is to be held
    with pytest.raises(UserError, match="station Playback needs the output port `X_WB` of size 7"):
        build_diagram(StationConfig(), HOLD, stand_in=Playback(6))
    built = build_diagram(StationConfig(), HOLD, stand_in=make_station(StationConfig()))
    assert built.HasSubsystemNamed("station")


class Flickers(LeafSystem):
    """A station 0.2 m off the pose to be held, whose estimate is lost from 0.2 s to 0.4 s."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("F_Bo_B", 6)
        for name, value in (("X_WB", [1, 0, 0, 0, -0.2, 0, -1.5]), ("V_WB_B", [0] * 6)):
            vector = BasicVector([float(x) for x in value])
            self.DeclareStateOutputPort(name, self.DeclareDiscreteState(vector))
        self.DeclareStateOutputPort("health", self.DeclareDiscreteState(5))
        self.DeclarePeriodicDiscreteUpdateEvent(0.1, 0.0, self._update)

    def _update(self, context, state):
        state.set_value(2, np.full(5, 2.0 * (0.15 < context.get_time() < 0.35)))

    def pure(self) -> Pure:
        def update(t, state, inputs):
            return {2: jnp.where((t > 0.15) & (t < 0.35), jnp.full(5, 2.0), jnp.zeros(5))}

        names = ("X_WB", "V_WB_B", "health")
        return Pure((Event(0.1, update),), {name: shown(i) for i, name in enumerate(names)})


@pytest.mark.parametrize("make", [Simulator, CompiledSimulator])
def test_nothing_is_asked_for_while_the_estimate_is_lost(make):
    diagram = build_diagram(StationConfig(), HOLD, stand_in=Flickers())
    simulator = make(diagram)
    simulator.AdvanceTo(1.0)
    logs = logged(diagram, simulator.get_mutable_context())
    t, F = logs["F_Bo_B"].time, logs["F_Bo_B"].value
    lost = (t > 0.22) & (t < 0.39)
    np.testing.assert_array_equal(F[lost], 0)
    before, after = (F[:, 0][part] for part in ((t > 0.01) & (t < 0.19), t > 0.42))
    assert min(before.min(), after.min()) > 5  # N, back to its place
    assert np.isfinite(logs["F_bias_Bo_W"].value).all()


def test_a_controller_of_ones_own_is_told_the_health_if_it_asks(own):
    logs = fly(build_diagram(StationConfig(), Own(f"{own}:Asks"), stand_in=Flickers()), 0.6, 0)
    np.testing.assert_array_equal(logs["F_Bo_B"].value[:, :5], logs["health"].value)
    assert np.ptp(logs["health"].value) == 2
    quiet = build_diagram(StationConfig(), Own(f"{own}:Asks"), stand_in=Playback())
    assert not logged(quiet, quiet.CreateDefaultContext())["F_Bo_B"].value.size


def test_a_gate_takes_what_is_not_finite_for_lost():
    gate = HealthGate()
    context = gate.CreateDefaultContext()
    gate.GetInputPort("X_WB").FixValue(context, np.eye(7)[0])
    gate.GetInputPort("V_WB_B").FixValue(context, np.ones(6))
    read = lambda: gate.GetOutputPort("V_WB_B").Eval(context)  # noqa: E731
    np.testing.assert_array_equal(read(), 1)
    for state, passes in ((0.0, True), (1.0, True), (2.0, False), (np.nan, False)):
        gate.GetInputPort("health").FixValue(context, [state, 0, 0, 0, 0])
        assert np.isfinite(read()).all() == passes


def test_wrong_controllers_are_refused_with_a_remedy(tmp_path, own):
    (tmp_path / "wrong.py").write_text(
        "from pydrake.systems.primitives import PassThrough\n"
        "class Wrong(PassThrough):\n"
        "    def __init__(self):\n"
        "        super().__init__(3)\n"
        "number = 3\n"
    )
    cases = {
        "nowhere": "file.py:ClassName",
        "nowhere.py:A": "no file",
        "no_such_module:A": "no module",
        f"{tmp_path / 'wrong.py'}:number": "no Drake system",
        f"{own}:Fails": r"Fails failed with RuntimeError: no link \(.*within.py, line 26\)",
        f"{tmp_path / 'wrong.py'}:Wrong": "`X_WB` of size 7",
    }
    for system, message in cases.items():
        with pytest.raises(UserError, match=message):
            build_diagram(StationConfig(), Own(system))
    with pytest.raises(UserError, match="colour"):
        build_diagram(StationConfig(), Own(PID, {"colour": "red"}))


def test_configurations_come_back_from_yaml():
    text = """
    vehicle: bluerov2_heavy
    disturbance_set: calm
    disturbances:
      - !GaussMarkovCurrent {mean_speed: 0.3}
    obstacles: [{x: 1.0, y: 2.0, diameter: 0.4}]
    start: {position: [0, 0, -2], rpy_deg: [0, 0, 90]}
    seed: 7
    """
    station = loads(StationConfig, text)
    assert loads(StationConfig, dump(station)) == station
    assert len(station.disturbance().members) == 2
    controller = MppiImpedance(
        PylonCrossing(PoseConfig((1.0, 0.0, -1.0))), tracking=Tracking(observer=None)
    )
    assert loads(MppiImpedance, dump(controller)) == controller
    with pytest.raises(UserError, match="disturbance"):
        loads(StationConfig, "disturbance_set: typhoon")
    with pytest.raises(UserError, match="seed"):
        loads(StationConfig, "seed: -1")
    with pytest.raises(UserError, match="voltage"):
        loads(StationConfig, "voltage: 0.0")
