"""Effects of an extended model act in the plant, in rollouts and in the planner."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diagrams import add_randomness, read
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput
from thruster_examples import prompt_thrusters

from spinndrift.models import integrate, se3
from spinndrift.models.config import typed_yaml as yaml
from spinndrift.models.effects.extended import Extended
from spinndrift.models.effects.library import kind
from spinndrift.models.effects.unknown import Unknown
from spinndrift.models.rigid_body import FossenDynamics
from spinndrift.systems.compiled.simulator import CompiledSimulator
from spinndrift.systems.planning.mppi_config import MppiConfig
from spinndrift.systems.planning.mppi_core import MppiPlanner
from spinndrift.systems.planning.paths import PoseConfig
from spinndrift.systems.planning.rollouts import Situation
from spinndrift.systems.planning.tasks import StationKeeping
from spinndrift.systems.plant.learned_plant import LearnedPlant
from spinndrift.systems.plant.wrench_limits import BoxLimits
from spinndrift.systems.station.config import StationConfig

MASS, PUSH, TAU, DELAY = 20.0, 10.0, 0.2, 0.13
LAG = kind("thruster_lag").of(time_constant=TAU)
LATE = kind("actuation_delay").of(delay=DELAY)
SURGE = np.array([PUSH, 0, 0, 0, 0, 0])
BODY = FossenDynamics(
    rigid_inertia=np.diag([MASS, MASS, MASS, 1.0, 1.0, 1.0]),
    added_mass=np.zeros((6, 6)),
    linear_drag=np.zeros((6, 6)),
    quadratic_drag=np.zeros((6, 6)),
    weight=0.0,
    buoyancy=0.0,
    p_BoBcm_B=np.zeros(3),
    p_BoCb_B=np.zeros(3),
)
BEHIND = {"lag": lambda t: t - TAU * (1 - np.exp(-t / TAU)), "delay": lambda t: max(t - DELAY, 0.0)}
EFFECT = {"lag": LAG, "delay": LATE}


def extended(*effects, thrusters=None, body=BODY) -> Extended:
    return Extended.create(body, effects, thrusters or prompt_thrusters())


def fly(plant: LearnedPlant, end: float, **inputs: np.ndarray) -> dict[str, np.ndarray]:
    """Twist, and what instruments have of pose and twist, at `end` under constant inputs."""
    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    for name, value in inputs.items():
        plant.GetInputPort(name).FixValue(context, value)
    simulator.AdvanceTo(end)
    return {n: read(plant, n, context) for n in ("V_WB_B", "X_WB", "X_WB_seen", "V_WB_B_seen")}


@pytest.mark.parametrize("name", BEHIND)
@pytest.mark.parametrize("by", ["wrench", "pwm"])
def test_commands_arrive_late(name, by):
    """Free of drag, the impulse of a step command tells what is behind; by PWM likewise."""
    end = 0.4
    if by == "wrench":
        plant, inputs = LearnedPlant(extended(EFFECT[name]), 0.01, 2), {"F_Bo_B": SURGE}
    else:
        own = 0.5 if name == "lag" else 0.0  # the effect's lag stands in place of the thrusters'
        thrusters = prompt_thrusters(time_constant=own)
        plant = LearnedPlant(extended(EFFECT[name]), 0.05, 2, thrusters=thrusters)
        force = thrusters.allocate(jnp.asarray(SURGE))
        inputs = {"pwm": np.asarray(thrusters.pwm(force))}
    V = fly(plant, end, **inputs)["V_WB_B"]
    expected = PUSH / MASS * BEHIND[name](end)
    np.testing.assert_allclose(V[0], expected, rtol=1e-9 if by == "wrench" else 1e-3)


@pytest.mark.parametrize("name", BEHIND)
def test_rollouts_remember(name):
    """A wrench that has been there for ever acts at once; what is added to it comes late."""
    count, dt = 12, 0.05
    F = np.repeat(SURGE[None], count, 0)
    F[4:, 0] *= 3
    zero = jnp.zeros(6)
    _, V = integrate.rollout(
        extended(EFFECT[name]), se3.identity(jnp.float64), zero, jnp.asarray(F), dt, substeps=3
    )
    more = 2 * PUSH / MASS * BEHIND[name]((count - 4) * dt)
    np.testing.assert_allclose(V[-1, 0], PUSH / MASS * count * dt + more, rtol=1e-9)


def test_one_command_serves_many_states_that_remember():
    """Rollouts of a batch under one wrench are those of each state alone."""
    memory = Unknown.neutral(kind="memory", acts_on="surge", numbers=(0.5, 0.3))
    memory = eqx.tree_at(lambda e: e.values, memory, jnp.array([-2.0, -3.0, 1.0]))
    model, rng = extended(LAG, LATE, memory), np.random.default_rng(0)
    F = jnp.asarray(rng.normal(size=(8, 6)))
    V = jnp.asarray(rng.normal(size=(6, 3)))
    X = jnp.broadcast_to(se3.identity(jnp.float64)[:, None], (7, 3))
    together = integrate.rollout(model, X, V, F, 0.05, substeps=2)[1]
    alone = [integrate.rollout(model, X[:, i], V[:, i], F, 0.05, substeps=2)[1] for i in range(3)]
    np.testing.assert_allclose(together, np.stack(alone, axis=-1), rtol=1e-10, atol=1e-12)


def test_thrust_effects_act_on_thrusters_alone():
    """A scale of the thrust leaves disturbances as they are; one dead thruster is that one."""
    doubled = LearnedPlant(extended(kind("thrust_scale").of(scale=1.0)), 0.1)
    V = fly(doubled, 0.1, F_Bo_B=SURGE, F_disturbance_Bo_B=SURGE)["V_WB_B"]
    np.testing.assert_allclose(V[0], 3 * PUSH / MASS * 0.1, rtol=1e-12)

    thrusters = prompt_thrusters()
    dead = kind("thruster_gain").of("3", gain=-1.0)
    plant = LearnedPlant(extended(dead), 0.1, 1, thrusters=thrusters)
    force = np.array([5.0, -3.0, 8.0, 2.0, -6.0, 4.0, 7.0, 3.0])
    V = fly(plant, 0.1, pwm=np.asarray(thrusters.pwm(jnp.asarray(force))))["V_WB_B"]
    force[2] = 0
    wrench = np.asarray(thrusters.wrench(jnp.asarray(force)))
    np.testing.assert_allclose(V, wrench / np.diag(BODY.rigid_inertia) * 0.1, atol=2e-3)


def test_a_scenario_has_effects_by_name():
    """As settings they are the effects themselves, beside those that a model brings along."""
    settings = yaml.loads(
        StationConfig,
        """
effects:
- {name: thruster_lag, parameters: {time_constant: 0.3}}
- {name: thruster_gain, where: "3", parameters: {gain: -0.5}}
- {name: proximity, where: bottom, parameters: {gain: 1.5}, options: {floor: -6.0}}
""",
        "station",
    )
    again = yaml.loads(StationConfig, yaml.dump(settings), "station")
    assert again == settings
    model = settings.dynamics()
    assert isinstance(model, Extended)
    by_hand = (
        kind("thruster_lag").of(time_constant=0.3),
        kind("thruster_gain").of("3", gain=-0.5),
        kind("proximity").of("bottom", gain=1.5, options={"floor": -6.0}),
    )
    expected = extended(*by_hand).effects
    assert [e.name for e in model.effects] == [e.name for e in expected]
    for mine, theirs in zip(*map(jax.tree.leaves, (model.effects, expected)), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_random_states_live_in_the_plant():
    """A coloured push starts in its stationary law and goes on by its own, of given Gaussians."""
    sigma, tau, h = 2.0, 0.5, 0.1
    colour = kind("disturbance_colour").of("sway", std=sigma, time_constant=tau)
    plant = LearnedPlant(extended(colour), h, 1)
    port = plant.GetInputPort("noise")
    assert port.size() == 12
    noise = np.zeros(12)
    noise[7] = 1.5  # six of b dW, then one for each axis of the push
    V = fly(plant, h, noise=noise)["V_WB_B"]
    first = sigma * 1.5
    np.testing.assert_allclose(V, [0, first / MASS * h, 0, 0, 0, 0], rtol=1e-12, atol=1e-15)
    V = fly(plant, 2 * h, noise=noise)["V_WB_B"]
    decay = np.exp(-h / tau)
    second = decay * first + sigma * np.sqrt(1 - decay**2) * 1.5
    np.testing.assert_allclose(V[1], (first + second) / MASS * h, rtol=1e-12)


def test_instruments_show_what_effects_on_them_make_of_the_state():
    plant = LearnedPlant(extended(kind("dvl_scale").of(scale=0.1)), 0.1)
    seen = fly(plant, 0.5, F_Bo_B=SURGE)
    np.testing.assert_allclose(seen["V_WB_B_seen"][0], 1.1 * seen["V_WB_B"][0], rtol=1e-12)
    np.testing.assert_allclose(seen["X_WB_seen"], seen["X_WB"], rtol=1e-12)
    plain = fly(LearnedPlant(BODY, 0.1), 0.5, F_Bo_B=SURGE)
    np.testing.assert_array_equal(plain["V_WB_B_seen"], plain["V_WB_B"])


def test_a_plant_with_effects_steps_in_one_compiled_loop_as_in_drake():
    effects = (
        LAG,
        kind("disturbance_colour").of("surge", std=2.0, time_constant=0.5),
        kind("gyro_bias").of("z", bias=0.02),
    )
    found = []
    for make in (Simulator, CompiledSimulator):
        builder = DiagramBuilder()
        plant = builder.AddNamedSystem("plant", LearnedPlant(extended(*effects), 0.05, 2))
        add_randomness(builder, plant, period=0.05)
        log = LogVectorOutput(plant.GetOutputPort("V_WB_B_seen"), builder, 0.05)
        log.set_name("log")
        diagram = builder.Build()
        simulator = make(diagram) if make is Simulator else make(diagram, {"log": 0.05})
        context = simulator.get_mutable_context()
        diagram.SetRandomContext(context, RandomGenerator(3))
        simulator.Initialize()
        simulator.AdvanceTo(2.0)
        found.append(log.FindLog(context).data().copy())
    assert np.abs(found[0][:3]).max() > 1e-3
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9, atol=1e-12)


def test_the_planner_knows_that_commands_come_late():
    """Within the delay a sequence's motion is that of the wrench before it."""
    config = MppiConfig(horizon=10, dt=0.1, substeps=1, sequences=20, realisations=1)
    planner = MppiPlanner(
        extended(kind("actuation_delay").of(delay=0.2)),
        BoxLimits(jnp.full(6, 40.0)),
        StationKeeping(at=PoseConfig()).build(StationConfig()),
        config,
    )
    X, V = se3.identity(jnp.float32), jnp.zeros(6, jnp.float32)
    F = jnp.zeros((10, 6, 1), jnp.float32).at[:, 0].set(-4.0)
    before = jnp.asarray(SURGE, jnp.float32)
    times, hold = planner.times(jnp.zeros(1)), jnp.zeros((10, 6), jnp.float32)
    roll = jax.jit(
        lambda F, before: planner.rollouts(
            F, Situation(X, V, V, before, times, hold, None), lambda X, V, F: (V[0],)
        )
    )
    speed = np.asarray(roll(F, before).states[0])[:, 0]
    expected = np.cumsum(np.repeat([PUSH, -4.0], [2, 8])) / MASS * 0.1
    np.testing.assert_allclose(speed, expected, rtol=1e-4, atol=1e-6)
