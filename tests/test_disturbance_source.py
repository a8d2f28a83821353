import jax.numpy as jnp
import numpy as np
import pytest
from diagrams import add_randomness, check_reproducible, connect, read, run
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder

from spinndrift.models import se3
from spinndrift.models.disturbances import (
    Combined,
    GaussMarkovCurrent,
    JonswapWaves,
    OrnsteinUhlenbeckWrench,
    WhiteWrench,
)
from spinndrift.models.rigid_body import FossenDynamics, spatial_inertia
from spinndrift.systems.plant.disturbance_source import DisturbanceSource
from spinndrift.systems.plant.learned_plant import LearnedPlant

SEA = Combined((GaussMarkovCurrent(), JonswapWaves(), WhiteWrench(), OrnsteinUhlenbeckWrench()))
STEADY = GaussMarkovCurrent(mean_speed=0.3, std_speed=0.0, std_direction=0.0)


def vehicle() -> FossenDynamics:
    return FossenDynamics(
        rigid_inertia=spatial_inertia(11.5, np.zeros(3), np.diag([0.26, 0.23, 0.37])),
        added_mass=np.diag([5.5, 12.7, 14.6, 0.12, 0.12, 0.12]),
        linear_drag=np.diag([14.0, 16.2, 15.2, 0.7, 0.7, 0.7]),
        quadratic_drag=np.diag([18.0, 22.0, 37.0, 1.5, 1.5, 1.5]),
        weight=112.8,
        buoyancy=112.8,
        p_BoBcm_B=np.zeros(3),
        p_BoCb_B=np.array([0, 0, 0.02]),
    )


def at_sea(disturbance) -> Diagram:
    builder = DiagramBuilder()
    plant = builder.AddSystem(LearnedPlant(vehicle(), X0_WB=[1, 0, 0, 0, 0, 0, -1]))
    source = builder.AddSystem(DisturbanceSource(disturbance))
    connect(builder, plant, source, "X_WB", "V_WB_B")
    connect(builder, source, plant, "F_disturbance_Bo_B", "flow_W")
    add_randomness(builder, source)
    for system, name in ((plant, "state"), (source, "F_disturbance_Bo_B"), (source, "flow_W")):
        builder.ExportOutput(system.GetOutputPort(name))
    return builder.Build()


def test_outputs_are_those_of_the_model_at_their_time():
    period, steps = 0.02, 7
    X0 = np.array([1.0, 0, 0, 0, 1, 2, -1])
    V = np.array([0.3, -0.2, 0.1, 0.2, 0.1, -0.3])
    rng = np.random.default_rng(0)
    start, noise = rng.standard_normal(SEA.initial_noise_size), rng.standard_normal(SEA.noise_size)
    source = DisturbanceSource(SEA, period)
    simulator = Simulator(source)
    values = {"X_WB": X0, "V_WB_B": V, "noise": noise, "initial_noise": start}
    for name, value in values.items():
        source.GetInputPort(name).FixValue(simulator.get_mutable_context(), value)

    def shown() -> np.ndarray:
        names = "F_disturbance_Bo_B", "flow_W"
        context = simulator.get_context()
        return np.concatenate([read(source, name, context) for name in names])

    def expected(state, X, t) -> np.ndarray:
        flow = SEA.flow(state, X, t)
        return np.concatenate([SEA.wrench(state, X, jnp.asarray(V), t, flow), *flow])

    def ahead(X) -> jnp.ndarray:
        return se3.retract(X, jnp.asarray(V) * period)

    X, w = jnp.asarray(X0), jnp.asarray(noise)
    state = SEA.advance(SEA.initial(jnp.asarray(start)), X, jnp.asarray(V), 0.0, period, w)
    simulator.Initialize()
    np.testing.assert_allclose(shown(), expected(state, X, 0.0), rtol=1e-9, atol=1e-12)
    for n in range(1, steps + 1):
        # Just before the update at n · period, which is when other systems read.
        simulator.AdvanceTo((n - 0.5) * period)
        state = SEA.advance(state, ahead(X), jnp.asarray(V), n * period, period, w)
        np.testing.assert_allclose(
            shown(), expected(state, ahead(X), n * period), rtol=1e-9, atol=1e-12
        )


def test_the_start_is_drawn_from_the_initial_noise():
    diagram = at_sea(JonswapWaves(significant_height=0.3))
    first, second = (run(diagram, seed, [0.0])[0, -6:] for seed in (1, 2))
    assert np.any(first != 0)
    assert np.all(first[[0, 2, 3, 5]] != second[[0, 2, 3, 5]])  # the waves travel along x


def test_a_steady_current_carries_the_vehicle_along():
    final = run(at_sea(STEADY), 0, [20.0])[0]
    R = se3.rotation_matrix(jnp.asarray(final[:7]))
    np.testing.assert_allclose(R @ final[7:10], [0.3, 0, 0], atol=1e-3)
    np.testing.assert_allclose(final[-6:], [0.3, 0, 0, 0, 0, 0], atol=1e-12)


def test_still_water_has_no_state_and_does_nothing():
    final = run(at_sea(Combined()), 0, [0.1])[0]
    np.testing.assert_array_equal(final[13:], np.zeros(12))


def test_the_wrench_has_the_variance_of_the_model():
    diagram = at_sea(OrnsteinUhlenbeckWrench(std=(3.0,) * 3 + (0.2,) * 3, time_constant=(0.1,) * 6))
    wrenches = run(diagram, 3, np.arange(0, 40, 0.2))[:, 13:19]
    np.testing.assert_allclose(wrenches.std(axis=0), [3] * 3 + [0.2] * 3, rtol=0.2)
    assert np.all(np.abs(wrenches.mean(axis=0)) < 0.3 * wrenches.std(axis=0))


def test_a_period_of_zero_is_refused():
    with pytest.raises(ValueError, match="period"):
        DisturbanceSource(SEA, 0.0)


def test_same_seed_same_bits():
    check_reproducible(lambda: at_sea(SEA))
