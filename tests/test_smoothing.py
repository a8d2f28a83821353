"""States that were not recorded: errors as large as claimed, under a right and a wrong model."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import se3
from spinndrift.models.config.errors import UserError
from spinndrift.models.effects.extended import Extended
from spinndrift.models.effects.load import Payload
from spinndrift.models.effects.thrust import ThrustCurve
from spinndrift.models.effects.water import CurrentSteady
from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.data.generate import GenerateConfig, generate
from spinndrift.training.data.windows import make_windows
from spinndrift.training.evaluation.evaluate import evaluate
from spinndrift.training.losses.base import Batch
from spinndrift.training.smoothing.complete import complete
from spinndrift.training.smoothing.levels import Belief
from spinndrift.training.smoothing.states import Scaled

FINE, EVERY = 100.0, 5
"""Rate of the simulation (Hz), and samples of it per sample of the recording."""
B = 0.5
"""Diffusion of the simulated forces (N√s); a tenth of it for moments (N·m√s)."""
TURNED = ("surge-forward", "sway-left", "yaw-left")


def simulated(vehicle, seed=3, duration=6.0, noise=0.05):
    """A run that goes through maneuvers one after the other, with an accelerometer; and the truth.

    Each maneuver is simulated by itself from a moving start; the force is that of the change of
    velocity in W over 20 ms.
    """
    config = GenerateConfig(
        maneuvers=TURNED,
        trajectories=1,
        duration=duration,
        rate=FINE,
        substeps=2,
        start_spread=(0.3, 0.3, 0.1, 0.1, 0.1, 0.2),
        seed=seed,
        diffusion=(B,) * 3 + (B / 10,) * 3,
    )
    rng = np.random.default_rng(seed)
    runs, truth = [], []
    for run in generate(config, vehicle).trajectories():
        X, V = run.X_WB.T, run.V_WB_B.T
        v_W = np.asarray(se3.rotate(jnp.asarray(X), jnp.asarray(V[:3])))
        force = np.zeros_like(v_W)
        force[:, 1:-1] = (v_W[:, 2:] - v_W[:, :-2]) * FINE / 2
        force[:, 0], force[:, -1] = force[:, 1], force[:, -2]
        force[2] += 9.80665
        force = np.asarray(se3.rotate_inverse(jnp.asarray(X), jnp.asarray(force))).T
        force = force + rng.normal(0, noise, force.shape) + rng.normal(0, 0.05, 3)
        part = slice(None, None, EVERY)
        seen_X, seen_V = run.X_WB[part].copy(), run.V_WB_B[part].copy()
        truth.append(seen_V.copy())
        seen_V[:, 3:] += rng.normal(0, 2e-3, (len(seen_V), 3))
        seen_X[:, 6] += rng.normal(0, 5e-3, len(seen_X))
        seen_X[:, 4:6], seen_V[:, :3] = np.nan, np.nan
        commands = {name: values[part] for name, values in run.commands.items()}
        climb = v_W[2, part] + rng.normal(0, 5e-3, len(seen_X))
        sensors = {"imu_specific_force": force[part], "vertical_velocity": climb}
        runs.append(Trajectory(run.scenario, seen_X, seen_V, commands, sensors))
    recording = Recording.from_trajectories(runs, EVERY / FINE, vehicle=vehicle.name)
    return recording, np.stack(truth)


def errors(recording, truth, found):
    """Errors of u and v, and their mean square relative to the claimed ones."""
    error = (found.recording.dataset["V_WB_B"].to_numpy()[:, 0] - truth)[..., :2]
    normal = error / found.deviation[:, 0, :, 3:5]
    return np.sqrt((error**2).mean()), (normal**2).mean()


@pytest.mark.slow
def test_hidden_velocities_under_the_true_model_have_the_claimed_errors():
    true = load_vehicle("bluerov2_heavy")
    recording, truth = simulated(true)
    found = complete(recording, true, true.dynamics(), belief=Belief(np.full(22, 1e-3)))
    assert found.recording.missing == {}
    assert not found.observed[..., 3:6].any()
    assert found.observed[..., [2, 6, 7, 8]].all()
    size, normal = errors(recording, truth, found)
    assert size < 0.05
    assert 0.5 < normal < 2
    # the diffusion that the data were simulated with, on the axes whose motion is measured
    np.testing.assert_allclose(found.levels.white[3:], B / 10, rtol=0.25)


@pytest.mark.slow
def test_hidden_velocities_under_a_wrong_model_are_not_claimed_to_be_exact():
    """Drag and mass are 1.5 times the truth's."""
    true = load_vehicle("bluerov2_heavy")
    recording, truth = simulated(true)
    drag = tuple(1.5 * d for d in true.quadratic_damping)
    wrong = replace(true, mass=1.5 * true.mass, quadratic_damping=drag).dynamics()
    found = complete(recording, true, wrong)
    size, normal = errors(recording, truth, found)
    assert size < 0.05
    assert 0.5 < normal < 2
    # yaw's drag, from the turn at a constant command, whose velocity is measured
    np.testing.assert_allclose(found.scales[17], -np.log(1.5), atol=0.02)


def test_what_was_recorded_is_kept():
    vehicle = load_vehicle("bluerov2_heavy")
    recording, _ = simulated(vehicle)
    found = complete(recording, vehicle, vehicle.dynamics(), rounds=1).recording.dataset
    for name, columns in (("X_WB", [0, 1, 2, 3, 6]), ("V_WB_B", [3, 4, 5])):
        kept, before = (d[name].to_numpy()[..., columns] for d in (found, recording.dataset))
        np.testing.assert_array_equal(kept, before)


def with_effects(model):
    """The model with a payload, a current and a thrust curve of its own."""
    effects = (
        Payload.of(mass=1.0, weight=4.0, moment_x=0.3, moment_y=0.1, height=0.2),
        CurrentSteady.of(east=0.2, north=-0.1),
        ThrustCurve.of(exponent=0.2, gain=-0.1),
    )
    return Extended.create(model, effects, load_vehicle("bluerov2_heavy").thrusters())


@pytest.mark.parametrize("made", [lambda model: model, with_effects])
def test_scales_of_the_smoother_are_those_of_a_model_with_other_constants(made):
    model = load_vehicle("bluerov2_heavy").dynamics()
    rng = np.random.default_rng(0)
    scales = rng.normal(0, 0.3, 22)
    mass, linear, quadratic = np.exp(scales[:18].reshape(3, 6))
    M, D, Df = (np.diag(np.asarray(o.matrix())) for o in model.coefficients(jnp.zeros(6))[:3])
    lift = scales[18] * 0.01 * 9.80665 * float(model.displaced_mass)
    buoyancy = float(model.buoyancy) + lift
    weighed = np.asarray(model.p_BoBcm_B * model.weight)
    lever = np.asarray(model.p_BoCb_B * model.buoyancy) - weighed
    lever = lever + scales[19:] * np.linalg.norm(lever[1:])
    other = model.with_constants(
        added_mass=np.diag(mass * M) - np.asarray(model.rigid_inertia),
        linear_drag=np.diag(linear * D),
        quadratic_drag=np.diag(quadratic * Df),
        buoyancy=buoyancy,
        p_BoCb_B=(lever + weighed) / buoyancy,
    )
    X = se3.exp(jnp.asarray(rng.normal(0, 0.5, 6)))
    V, level = jnp.asarray(rng.normal(0, 0.5, 6)), jnp.asarray(rng.normal(0, 10, 8))
    own, other = made(model), made(other)
    drive = level[:6]
    if isinstance(own, Extended):
        drive = jnp.append(level, 1.0)
        expected = other.drift(other.inertia(), X, V, level, jnp.ones(1))
    else:
        expected = other.acceleration(X, V, drive)
    found = Scaled.of(own).acceleration(X, V, drive, jnp.asarray(scales))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_windows_of_hidden_channels_judge_what_was_recorded():
    """A prediction that is wrong in u, v, x and y alone has no error; one wrong in yaw has."""
    vehicle = load_vehicle("bluerov2_heavy")
    recording, _ = simulated(vehicle)
    found = complete(recording, vehicle, vehicle.dynamics(), rounds=1)
    windows = make_windows(recording, vehicle, length_s=1.0, completed=found)
    assert windows.hidden is not None
    np.testing.assert_array_equal(windows.hidden.seen[0, :, 0], [0, 0, 1, 0, 0, 1, 1, 1, 1])
    spread = windows.hidden.spread[..., 0]
    covariance = np.asarray(found.causal_cov[0, 0, 0], np.float32)
    np.testing.assert_allclose(spread @ spread.T, covariance, atol=1e-6)
    batch = Batch.of(windows)
    X, V = batch.X[1:, :, None], batch.V[1:, :, None]
    shown = batch.shown(X.at[:, 4:6].add(1.0), V.at[:, :2].add(1.0).at[:, 5].add(0.5))
    np.testing.assert_allclose(shown[0], X)
    np.testing.assert_allclose(shown[1][:, :5], V[:, :5])
    np.testing.assert_allclose(shown[1][:, 5], V[:, 5] + 0.5)
    physics = vehicle.dynamics(np.ones(6), dtype=np.float32)
    judged = evaluate({"preset": physics}, windows, samples=19).dataset["rmse_axis"]
    measured = np.isfinite(judged.sel(model="preset")).all("horizon")
    axes = measured["axis"].to_numpy()[measured.to_numpy()]
    assert set(axes) == {"z", "roll", "pitch", "yaw", "w", "p", "q", "r"}


def test_a_recording_with_hidden_channels_is_completed_before_it_is_cut():
    vehicle = load_vehicle("bluerov2_heavy")
    recording, _ = simulated(vehicle)
    with pytest.raises(UserError, match="u/v/w is missing"):
        make_windows(recording, vehicle, length_s=1.0)
