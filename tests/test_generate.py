"""Simulated data: maneuvers within the thrusters' limits, seeds, the law of the noise."""

import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.models.disturbances import GaussMarkovCurrent, OrnsteinUhlenbeckWrench
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.data.generate import GenerateConfig, generate
from spinndrift.training.data.maneuvers import MANEUVERS, maneuver_wrench

pytestmark = pytest.mark.whole

VEHICLE = load_vehicle("bluerov2_heavy")
SHORT = GenerateConfig(trajectories=2, duration=1.0, substeps=4)


@pytest.fixture(scope="module")
def recording():
    return generate(SHORT, VEHICLE)


def test_ten_maneuvers_along_and_about_the_right_axes():
    assert len(MANEUVERS) == 10
    thrusters = VEHICLE.thrusters()
    low, high = (np.asarray(limit) for limit in thrusters.force_limits())
    for name, direction in MANEUVERS.items():
        wrench, forces = maneuver_wrench(name, thrusters, 1.0)
        assert ((low - 1e-9 <= forces) & (forces <= high + 1e-9)).all()
        np.testing.assert_allclose(thrusters.wrench(jnp.asarray(forces)), wrench, atol=1e-9)
        assert np.array_equal(np.sign(np.round(wrench, 6)), np.sign(direction))
        near = np.minimum(forces - low, high - forces).min()
        assert near < 1e-6  # full effort: some thruster is at its limit
        half, _ = maneuver_wrench(name, thrusters, 0.5)
        np.testing.assert_allclose(half, wrench / 2, atol=1e-6 * np.abs(wrench).max())


def test_the_recording_is_what_was_asked_for(recording):
    assert recording.scenarios == tuple(MANEUVERS)
    assert recording.mask.shape == (10, 2, 21)
    assert recording.dt == pytest.approx(0.05)
    assert recording.vehicle == "bluerov2_heavy"
    X = recording.dataset["X_WB"].to_numpy()
    np.testing.assert_allclose(
        X[:, :, 0], np.array([1, 0, 0, 0, 0, 0, -5.0]) + np.zeros((10, 2, 7))
    )
    u = recording.dataset["V_WB_B"].sel(twist_component="u").to_numpy()[:, :, -1]
    assert (u[0] > 0.1).all()
    assert (u[1] < -0.1).all()


def test_equal_seeds_equal_bits(recording):
    again = generate(SHORT, VEHICLE)
    other = generate(GenerateConfig(trajectories=2, duration=1.0, substeps=4, seed=1), VEHICLE)
    assert again.dataset.identical(recording.dataset)
    assert not np.array_equal(other.dataset["V_WB_B"], recording.dataset["V_WB_B"])


def test_the_noise_has_the_models_diffusion():
    """From rest and unforced, Var(M ξ)_i grows as b_i² t while drag is small."""
    b = (2.0, 1.0, 0.5, 0.02, 0.03, 0.01)
    config = GenerateConfig(
        maneuvers=("surge-forward",), trajectories=4000, duration=0.05, effort=1e-9, diffusion=b
    )
    V = generate(config, VEHICLE).dataset["V_WB_B"].to_numpy()[0, :, -1]
    momentum = V @ np.asarray(VEHICLE.dynamics().mass.matrix())
    found = momentum.std(axis=0) / 0.05**0.5
    # 4000 samples: 1.1 % standard error; drag takes about 1 % within 0.05 s
    np.testing.assert_allclose(found, b, rtol=0.06)


def test_disturbances_push_and_carry():
    still = GenerateConfig(
        maneuvers=("surge-forward",),
        trajectories=3,
        duration=2.0,
        effort=1e-9,
        substeps=4,
        diffusion=(0.0,) * 6,
    )
    at_rest = generate(still, VEHICLE).dataset["V_WB_B"].to_numpy()
    assert np.abs(at_rest[..., 0]).max() < 1e-3
    current = GaussMarkovCurrent(mean_speed=0.3, std_speed=0.0, std_direction=0.0)
    carried = generate(still, VEHICLE, (current,)).dataset["V_WB_B"].to_numpy()
    assert (carried[0, :, -1, 0] > 0.02).all()
    assert (carried[0, :, -1, 0] < 0.3).all()
    pushed = generate(still, VEHICLE, (OrnsteinUhlenbeckWrench(),)).dataset["V_WB_B"].to_numpy()
    assert pushed[0, :, -1, 0].std() > 0.01  # each trajectory its own


def test_wrong_settings_are_named():
    with pytest.raises(UserError, match="surge-forward"):
        generate(GenerateConfig(maneuvers=("loop",)), VEHICLE)
    with pytest.raises(UserError, match="effort"):
        GenerateConfig(effort=0.0)
