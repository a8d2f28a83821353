"""An effect from outside the package is known, simulated and found in data by its name."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import se3
from spinndrift.models.config.errors import UserError
from spinndrift.models.effects import KINDS, Effect, Extended, Parameter, register
from spinndrift.models.effects.base import axes_only
from spinndrift.models.effects.effect_config import EffectConfig
from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.pipeline import DiagnoseConfig, diagnose

VEHICLE = load_vehicle("bluerov2_heavy")
DT, STEPS, RUNS, PARTS = 0.1, 120, 6, 8
TRUE = 6.0
RECORD = np.repeat([2e-3, 1e-3, 3e-3, 1e-3], 3)


class RollFromHeave(Effect):
    """K = -c |w| w: a skid on one side of the hull."""

    name: ClassVar[str] = "roll_from_heave"
    family: ClassVar = "body"
    parameters: ClassVar = (Parameter("coefficient", "N·m·s²/m²", (0.5,), -50.0, 50.0),)

    def wrench(self, X_WB, V_CB_B, plant):
        w = V_CB_B[2]
        return axes_only({3: -self.part(0, V_CB_B) * jnp.abs(w) * w}, V_CB_B)


@pytest.fixture
def few(monkeypatch):
    """The own effect and few others, so that little is compiled."""
    kept = ("linear_drag", "quadratic_drag", "net_buoyancy", "thrust_scale", "current_steady")
    for name in set(KINDS) - set(kept):
        if not KINDS[name].random:
            monkeypatch.delitem(KINDS, name)
    monkeypatch.setitem(KINDS, RollFromHeave.name, RollFromHeave)
    monkeypatch.delitem(KINDS, RollFromHeave.name)
    assert register(RollFromHeave) is RollFromHeave


def recording():
    """Runs of a vehicle with the effect, under random steps of the wrench, in noise."""
    base = VEHICLE.dynamics(np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1]))
    effect = EffectConfig("roll_from_heave", parameters={"coefficient": TRUE}).build()
    model = Extended.create(base, (effect,), VEHICLE.thrusters())
    rng = np.random.default_rng(1)
    sizes = np.array([30, 30, 40, 1, 1, 3.0])[:, None]
    F = np.repeat(rng.uniform(-1, 1, (STEPS // 10, 6, RUNS)), 10, axis=0) * sizes
    u = jnp.repeat(jnp.einsum("ni,tir->tnr", model.inverse, jnp.asarray(F)), PARTS, axis=0)
    w = jax.random.normal(jax.random.key(0), (len(u), model.noise_size, RUNS))
    X0 = jnp.zeros((7, RUNS)).at[0].set(1).at[6].set(-5)
    X, V = model.rollout(X0, jnp.zeros((6, RUNS)), u, DT / PARTS, w)
    X, V = (a[PARTS - 1 :: PARTS].swapaxes(0, 1) for a in (X, V))
    shown = jnp.asarray(RECORD[:, None, None] * rng.standard_normal((12, STEPS, RUNS)))
    X, V = (np.asarray(a).swapaxes(0, 1) for a in (se3.retract(X, shown[:6]), V + shown[6:]))
    runs = [
        Trajectory(f"run_{r // 2}", X[:-1, :, r], V[:-1, :, r], {"F_Bo_B": F[1:, :, r]}, {})
        for r in range(RUNS)
    ]
    return Recording.from_trajectories(runs, DT, vehicle="bluerov2_heavy")


@pytest.mark.slow
def test_an_own_effect_is_found_by_its_name(few):
    finding = diagnose(recording(), VEHICLE, config=DiagnoseConfig(refit="none"))
    (cause,) = finding.diagnosis.causes
    assert (cause.name, cause.where) == ("roll_from_heave", "all")
    low, high = cause.parameters["coefficient"].interval95
    assert low < TRUE < high
    assert high - low < TRUE / 2


def test_names_are_given_once(few):
    with pytest.raises(UserError, match="roll_from_heave"):
        register(RollFromHeave)
