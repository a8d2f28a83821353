"""Learning where u, v, x and y were not recorded: from a grey-box fit, by states inferred."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from test_smoothing import B, simulated

from spinndrift.models.config.errors import UserError
from spinndrift.models.effects.extended import Extended, core
from spinndrift.models.effects.thrust import ThrustCurve
from spinndrift.models.effects.unknown import Unknown
from spinndrift.models.integrate import cast
from spinndrift.models.recordings.store import Recording
from spinndrift.models.rigid_body import FossenDynamics
from spinndrift.models.spinn import Spinn
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.learning import Start, compare, learn, prepared
from spinndrift.training.config import TrainingConfig, WindowConfig
from spinndrift.training.fitting import hidden_start
from spinndrift.training.fitting.hidden_start import HiddenStart
from spinndrift.training.fitting.start import diffusion_scale
from spinndrift.training.losses.specific_force import ForceError

VEHICLE = load_vehicle("bluerov2_heavy")
HIGHER = 0.06
NO_CURVE = ThrustCurve.of(exponent=0.0, gain=0.0)
QUICK = TrainingConfig(
    steps=2,
    batch=4,
    validate_every=1,
    windows=WindowConfig(length_s=1.0, stride_s=0.5, gap_s=0.1),
)

pytestmark = pytest.mark.whole


@pytest.fixture(scope="module")
def recording():
    return simulated(VEHICLE, duration=24.0)[0]


@pytest.fixture(scope="module")
def wrong():
    """Quadratic drag is 2.5 times the truth's, and thrusters are `HIGHER` than the true ones."""
    drag = tuple(2.5 * d for d in VEHICLE.quadratic_damping)
    mounts = tuple(
        replace(m, position=(*m.position[:2], m.position[2] + HIGHER))
        for m in VEHICLE.propulsion.mounts
    )
    propulsion = replace(VEHICLE.propulsion, mounts=mounts)
    return replace(VEHICLE, name="wrong", quadratic_damping=drag, propulsion=propulsion)


@pytest.mark.slow
def test_states_are_inferred_and_noise_is_estimated_with_the_fitted_model(
    recording, wrong, monkeypatch
):
    """A stand-in for the fit returns the truth: a thrust curve beside other constants."""
    truth = Extended.create(VEHICLE.dynamics(), (NO_CURVE,), VEHICLE.thrusters())
    monkeypatch.setattr(hidden_start, "fit_coefficients", lambda *given: truth)
    found = HiddenStart.of(recording, wrong, QUICK, None)
    told = {t.name: t for t in found.told}
    yaw = told["quadratic drag, yaw"]
    assert yaw.learned
    assert yaw.change == pytest.approx(-np.log(2.5), abs=0.01)
    assert not told["linear drag, yaw"].learned
    np.testing.assert_allclose(diffusion_scale(found.model)[3:], B / 10, rtol=0.5)
    assert (diffusion_scale(found.preset) > diffusion_scale(found.model))[5]


@pytest.mark.slow
def test_the_specific_force_of_thruster_forces_is_that_of_their_wrench(recording):
    truth = Extended.create(VEHICLE.dynamics(), (NO_CURVE,), VEHICLE.thrusters())
    found = HiddenStart.of(recording, VEHICLE, QUICK, truth)
    windows = found.held_out(found.model)
    assert windows.commands is not None
    assert windows.hidden is not None
    models = cast(found.model, jnp.float32), VEHICLE.dynamics(dtype=jnp.float32)
    units = [force.unit for m in models if (force := ForceError.build(m, windows, 1))]
    np.testing.assert_allclose(*units, rtol=0.02)


@pytest.mark.slow
def test_coefficients_are_fitted_and_the_report_says_what_the_data_tell(recording, wrong):
    without_force = Recording(recording.dataset.drop_vars("imu_specific_force"))
    found = HiddenStart.of(without_force, wrong, QUICK, None)
    assert isinstance(found.model, Extended)
    told = {t.name: t for t in found.told}
    yaw = told["quadratic drag, yaw"]
    assert yaw.learned
    # motion tells drag relative to inertia; the axis of inertia is that of the rigid body
    assert yaw.change - told["mass, yaw"].change == pytest.approx(-np.log(2.5), abs=0.15)
    assert not told["linear drag, yaw"].learned
    assert diffusion_scale(found.model).min() > 0
    # thrust along axes whose velocity nobody knows is commanded, and turns axes that are measured
    (lever,) = (e for e in found.model.effects if e.name == "thrust_lever")
    pitch, roll = (lever.index(place, "lever") for place in ("pitch_from_surge", "roll_from_sway"))
    found_there = np.asarray(lever.values)[[pitch, roll]]
    np.testing.assert_allclose(found_there, [-HIGHER, HIGHER], atol=HIGHER / 3)


@pytest.mark.slow
def test_a_learned_model_forecasts_better_and_is_judged_again_from_its_file(
    recording, wrong, tmp_path
):
    learned = learn(recording, wrong, QUICK, tmp_path / "run")
    assert isinstance(core(learned.model), Spinn | FossenDynamics)
    errors = learned.evaluation.overall()
    assert set(errors) == {"preset", "fitted", "learned"}
    assert errors["learned"]["energy_velocity"] < 0.5 * errors["preset"]["energy_velocity"]
    begun, _ = Start.read(tmp_path / "run" / "model.spinn")
    again = compare(*prepared(recording, wrong, begun, 1.0)).overall()
    assert again["learned"]["rmse_angular_velocity"] < again["preset"]["rmse_angular_velocity"]


def test_a_model_that_remembers_the_motion_is_refused_in_words(recording):
    memory = Unknown.neutral(kind="memory", acts_on="yaw", numbers=(1.0, 0.5, 5.0))
    model = Extended.create(VEHICLE.dynamics(), (memory,), VEHICLE.thrusters())
    with pytest.raises(UserError, match="unknown remembers the motion"):
        HiddenStart.of(recording, VEHICLE, QUICK, model)
