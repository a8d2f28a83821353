import jax.numpy as jnp
import numpy as np
import pytest
from diagrams import add_randomness, check_reproducible, read
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RotationalInertia, SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from thruster_examples import prompt_thrusters

from spinndrift.models import integrate, se3
from spinndrift.models.rigid_body import FossenDynamics, spatial_inertia
from spinndrift.systems.plant.learned_plant import LearnedPlant

MASS, COM = 11.5, np.array([0.03, -0.02, 0.05])
INERTIA = np.diag([0.26, 0.23, 0.37])
ZERO = np.zeros((6, 6))


def rigid_body(com: np.ndarray = COM) -> FossenDynamics:
    """A body in empty space: no added mass, drag, weight or buoyancy."""
    return FossenDynamics(
        rigid_inertia=spatial_inertia(MASS, com, INERTIA),
        added_mass=ZERO,
        linear_drag=ZERO,
        quadratic_drag=ZERO,
        weight=0.0,
        buoyancy=0.0,
        p_BoBcm_B=com,
        p_BoCb_B=np.zeros(3),
    )


def vehicle(diffusion: float = 0.0, symmetric: bool = False) -> FossenDynamics:
    """Like a BlueROV2; `symmetric` leaves nothing that turns it when it moves forward."""
    lever = 0.0 if symmetric else 0.02
    return FossenDynamics(
        rigid_inertia=spatial_inertia(11.5, np.zeros(3), INERTIA),
        added_mass=np.diag([5.5, 12.7, 14.6, 0.12, 0.12, 0.12]),
        linear_drag=np.diag([4.0, 6.2, 5.2, 0.07, 0.07, 0.07]),
        quadratic_drag=np.diag([18.0, 22.0, 37.0, 1.5, 1.5, 1.5]),
        weight=112.8,
        buoyancy=112.8,
        p_BoBcm_B=np.zeros(3),
        p_BoCb_B=np.array([0, 0, lever]),
        diffusion=np.full(6, diffusion),
    )


def advance(plant: LearnedPlant, end: float, **inputs: np.ndarray) -> tuple[np.ndarray, ...]:
    """X_WB, V_WB_B and A_WB_B at `end` under constant inputs."""
    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    for name, value in inputs.items():
        plant.GetInputPort(name).FixValue(context, value)
    simulator.AdvanceTo(end)
    return tuple(read(plant, n, context) for n in ("X_WB", "V_WB_B", "A_WB_B"))


class Driven:
    """A body in empty space, its thrusters commanded to a wrench, with one context."""

    def __init__(self, **settings: float):
        self.thrusters = prompt_thrusters(**settings)
        self.plant = LearnedPlant(rigid_body(np.zeros(3)), thrusters=self.thrusters)

    def __call__(self, F: np.ndarray, end: float, **inputs: np.ndarray) -> np.ndarray:
        """The thrusters' wrench at `end`."""
        pwm = np.asarray(self.thrusters.pwm(self.thrusters.allocate(jnp.asarray(F))))
        simulator = Simulator(self.plant)
        context = simulator.get_mutable_context()
        for name, value in ({"pwm": pwm} | inputs).items():
            self.plant.GetInputPort(name).FixValue(context, value)
        simulator.AdvanceTo(end)
        self.loaded = read(self.plant, "voltage_loaded", context)
        self.V = read(self.plant, "V_WB_B", context)
        force = read(self.plant, "thruster_force", context)
        return np.asarray(self.thrusters.wrench(jnp.asarray(force)))


def free_body_in_drake(X0: np.ndarray, V0: np.ndarray, end: float) -> np.ndarray:
    """Pose of Drake's MultibodyPlant free body at `end`, with an accurate integrator."""
    plant = MultibodyPlant(0.0)
    inertia = RotationalInertia(*np.diag(INERTIA)).ShiftFromCenterOfMass(MASS, -COM)
    M = SpatialInertia(MASS, COM, UnitInertia().SetFromRotationalInertia(inertia, MASS))
    body = plant.AddRigidBody("vehicle", M)
    plant.mutable_gravity_field().set_gravity_vector([0, 0, 0])
    plant.Finalize()
    simulator = Simulator(plant)
    simulator.get_mutable_integrator().set_target_accuracy(1e-10)
    context = simulator.get_mutable_context()
    R = np.asarray(se3.rotation_matrix(jnp.asarray(X0)))
    plant.SetFreeBodyPose(context, body, RigidTransform(RotationMatrix(R), X0[4:]))
    V = SpatialVelocity(w=R @ V0[3:], v=R @ V0[:3])
    plant.SetFreeBodySpatialVelocity(context, body, V)
    simulator.AdvanceTo(end)
    return np.asarray(plant.EvalBodyPoseInWorld(context, body).GetAsMatrix4(), float)


def test_converges_with_order_one_to_drakes_free_body():
    X0 = np.asarray(se3.from_position_rpy(jnp.array([1.0, 2, -3]), jnp.array([0.3, -0.4, 1.2])))
    V0 = np.array([0.5, -0.2, 0.3, 0.6, -0.9, 0.7])
    end = 2.0
    truth = se3.from_matrix(jnp.asarray(free_body_in_drake(X0, V0, end)))

    def error(substeps: int) -> np.ndarray:
        X, _, _ = advance(LearnedPlant(rigid_body(), 0.02, substeps, X0, V0), end)
        return np.asarray(se3.local(truth, jnp.asarray(X)))

    coarse, fine = error(2), error(4)
    assert np.linalg.norm(fine) < 0.02
    # The leading error halves with the step, so twice the fine result minus the coarse one is
    # correct to second order.
    np.testing.assert_allclose(coarse, 2 * fine, atol=0.02 * np.linalg.norm(coarse))
    assert np.linalg.norm(2 * fine - coarse) < 0.02 * np.linalg.norm(fine)


def test_takes_the_steps_of_a_rollout():
    dynamics, substeps, steps, period = vehicle(diffusion=0.5), 3, 40, 0.02
    F, push = np.array([10.0, -4, 3, 0.3, 0.2, -0.4]), np.array([1.0, 2, 0, 0, -0.1, 0.1])
    noise = np.random.default_rng(0).standard_normal(6 * substeps)
    X0 = np.array([1.0, 0, 0, 0, 0, 0, -2])
    plant = LearnedPlant(dynamics, period, substeps, X0)
    X, V, A = advance(plant, steps * period, F_Bo_B=F, F_disturbance_Bo_B=push, noise=noise)
    dW = np.sqrt(period / substeps) * noise.reshape(substeps, 6)
    Xs, Vs = integrate.rollout(
        dynamics,
        jnp.asarray(X0),
        jnp.zeros(6),
        jnp.broadcast_to(jnp.asarray(F + push), (steps, 6)),
        period,
        jnp.broadcast_to(jnp.asarray(dW), (steps, substeps, 6)),
    )
    np.testing.assert_allclose(X, Xs[-1], rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(V, Vs[-1], rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(A, (Vs[-1] - Vs[-2]) / period, rtol=1e-9, atol=1e-9)


def test_still_water_is_the_same_as_no_water_port():
    F = np.array([10.0, -4, 3, 0.3, 0.2, -0.4])
    plant = LearnedPlant(vehicle())
    without = advance(plant, 0.5, F_Bo_B=F)
    still = advance(plant, 0.5, F_Bo_B=F, flow_W=np.zeros(6))
    for a, b in zip(without, still, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


def test_a_uniform_current_carries_the_vehicle_as_seen_from_the_water():
    current, end = np.array([0.4, 0.0, 0.0]), 1.0
    F = np.array([15.0, 0, 0, 0, 0, 0])
    still, V_still, _ = advance(LearnedPlant(vehicle(symmetric=True)), end, F_Bo_B=F)
    V0 = np.concatenate([current, np.zeros(3)])
    plant = LearnedPlant(vehicle(symmetric=True), V0_WB_B=V0)
    moving, V, _ = advance(plant, end, F_Bo_B=F, flow_W=np.concatenate([current, np.zeros(3)]))
    np.testing.assert_allclose(moving[4:] - end * current, still[4:], atol=1e-12)
    np.testing.assert_allclose(V[:3] - current, V_still[:3], atol=1e-12)


def test_a_turning_vehicle_in_a_current_converges_to_the_one_in_still_water():
    current, end = np.array([0.3, -0.2, 0.1]), 1.0
    F = np.array([5.0, 3, -2, 0.2, 0.3, 0.8])
    flow = np.concatenate([current, np.zeros(3)])

    def difference(substeps: int) -> float:
        still, _, _ = advance(LearnedPlant(vehicle(), 0.02, substeps), end, F_Bo_B=F)
        plant = LearnedPlant(
            vehicle(), 0.02, substeps, V0_WB_B=np.concatenate([current, 0 * current])
        )
        moving, _, _ = advance(plant, end, F_Bo_B=F, flow_W=flow)
        moving = np.concatenate([moving[:4], moving[4:] - end * current])
        return float(jnp.linalg.norm(se3.local(jnp.asarray(still), jnp.asarray(moving))))

    coarse, fine = difference(1), difference(2)
    assert fine < 0.02
    assert 1.7 < coarse / fine < 2.3  # a difference of discretisation alone, of order one


@pytest.fixture(name="prompt", scope="module")
def _prompt() -> Driven:
    return Driven()


@pytest.fixture(name="slow", scope="module")
def _slow() -> Driven:
    return Driven(time_constant=0.15)


def test_prompt_thrusters_push_from_the_first_period_on(prompt):
    F = np.array([20.0, 0, 5, 0, 0, 0])
    for periods in (1, 20):
        np.testing.assert_allclose(prompt(F, 0.01 * periods - 0.005), F, atol=1e-9)
        np.testing.assert_allclose(prompt.V, 0.01 * periods * F / MASS, atol=1e-9)


def test_the_wrench_of_the_port_comes_on_top_of_the_thrusters(prompt):
    F, more = np.array([20.0, 0, 5, 0, 0, 0]), np.array([-3.0, 2, 0, 0, 0, 0])
    prompt(F, 0.195, F_Bo_B=more)
    np.testing.assert_allclose(prompt.V, 0.2 * (F + more) / MASS, atol=1e-9)


def test_a_step_is_followed_with_the_time_constant(slow):
    F = np.array([20.0, 0, 5, 0, 0, 1])
    for time in (0.15, 0.45):
        # An update at t covers [t, t + period): half a period later the state is that of its end.
        got = slow(F, time - 0.005)
        np.testing.assert_allclose(got, (1 - np.exp(-time / 0.15)) * F, rtol=1e-9, atol=1e-9)


def test_the_body_gets_the_impulse_of_forces_that_lag(slow):
    F, time, lag = np.array([20.0, 0, 5, 0, 0, 0]), 0.45, 0.15
    slow(F, time - 0.005)
    impulse = (time - lag * (1 - np.exp(-time / lag))) * F
    # The trapezoidal rule is off by h² / 12 of what the slope F / τ (1 - e) changed.
    bound = 0.01**2 / 12 * F[0] / lag
    np.testing.assert_allclose(MASS * slow.V, impulse, atol=bound)


def test_a_low_battery_gives_less(prompt):
    F = np.array([40.0, 0, 0, 0, 0, 0])
    full = prompt(F, 0.02, voltage=np.array([16.0]))
    low = prompt(F, 0.02, voltage=np.array([12.0]))
    assert 0.5 * full[0] < low[0] < 0.9 * full[0]


def test_the_voltage_sags_under_load():
    driven = Driven(resistance=0.02)
    weak = driven(np.array([60.0, 0, 0, 0, 0, 0]), 0.02)
    assert 12 < driven.loaded[0] < 15.9
    assert weak[0] < 60
    driven(np.zeros(6), 0.02)
    np.testing.assert_allclose(driven.loaded, [16.0])


def test_a_start_from_rest_takes_its_pause():
    driven = Driven(start_delay=0.1)
    F = np.array([20.0, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(driven(F, 0.085), np.zeros(6))
    np.testing.assert_array_equal(driven.V, np.zeros(6))
    np.testing.assert_allclose(driven(F, 0.125), F, atol=1e-9)


def test_without_commands_the_thrusters_stand_still():
    plant = LearnedPlant(vehicle(), thrusters=prompt_thrusters())
    F = np.array([10.0, -4, 3, 0.3, 0.2, -0.4])
    for a, b in zip(
        advance(plant, 0.1, F_Bo_B=F), advance(LearnedPlant(vehicle()), 0.1, F_Bo_B=F), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


def test_quaternion_stays_unit_and_states_agree():
    plant = LearnedPlant(vehicle(), 0.05, 1, V0_WB_B=np.array([0, 0, 0, 2.0, -1.0, 1.5]))
    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    plant.GetInputPort("F_Bo_B").FixValue(context, np.array([0, 0, 0, 2.0, 1.0, 3.0]))
    simulator.AdvanceTo(100.0)
    X, V, state = (read(plant, n, context) for n in ("X_WB", "V_WB_B", "state"))
    assert np.linalg.norm(V[3:]) > 1
    assert abs(np.linalg.norm(X[:4]) - 1) < 4e-16
    np.testing.assert_array_equal(state, np.concatenate([X, V]))


def test_time_and_place_of_a_divergence_are_told():
    plant = LearnedPlant(vehicle(), period=1.0, substeps=1, V0_WB_B=np.full(6, 50.0))
    plant.set_name("rover")
    simulator = Simulator(plant)
    with pytest.raises(FloatingPointError, match=r"rover: .* t = \d.*diverged.*X_WB = \["):
        simulator.AdvanceTo(100.0)


def test_an_input_that_is_not_a_number_is_named():
    plant = LearnedPlant(vehicle())
    simulator = Simulator(plant)
    plant.GetInputPort("F_Bo_B").FixValue(simulator.get_mutable_context(), np.full(6, np.nan))
    with pytest.raises(FloatingPointError, match=r"t = 0\.0000 s; its F_Bo_B already"):
        simulator.AdvanceTo(0.1)
    plant = LearnedPlant(vehicle(), thrusters=prompt_thrusters())
    for name in ("pwm", "voltage"):
        simulator = Simulator(plant)
        port = plant.GetInputPort(name)
        port.FixValue(simulator.get_mutable_context(), np.full(port.size(), np.nan))
        with pytest.raises(FloatingPointError, match=rf"t = 0\.0000 s; its {name} already"):
            simulator.AdvanceTo(0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"period": 0.0}, "period"),
        ({"substeps": 0}, "substeps"),
        ({"X0_WB": np.zeros(7)}, "quaternion"),
        ({"X0_WB": np.zeros(6)}, "7"),
        ({"V0_WB_B": np.full(6, np.inf)}, "finite"),
    ],
)
def test_impossible_settings_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        LearnedPlant(vehicle(), **arguments)


def test_set_state_writes_the_context_only():
    plant = LearnedPlant(vehicle())
    context, other = plant.CreateDefaultContext(), plant.CreateDefaultContext()
    plant.set_state(context, np.array([0.0, 1, 0, 0, 1, 2, 3]), np.arange(6.0))
    np.testing.assert_array_equal(read(plant, "state", context), [0, 1, 0, 0, 1, 2, 3, *range(6)])
    np.testing.assert_array_equal(read(plant, "V_WB_B", other), np.zeros(6))


@pytest.mark.slow
def test_same_seed_same_bits():
    def build():
        builder = DiagramBuilder()
        plant = builder.AddSystem(LearnedPlant(vehicle(diffusion=0.5)))
        add_randomness(builder, plant)
        builder.ExportOutput(plant.GetOutputPort("state"))
        return builder.Build()

    check_reproducible(build)
