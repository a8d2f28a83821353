"""Comparison of a learned law with the true one: motions of every scenario, and the diffusion."""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float

from ...models.config.errors import UserError
from ...models.dynamics import Dynamics
from ...models.se3 import AXES, XYZ
from ...models.vehicles.vehicle import load_vehicle
from ...training.data.maneuvers import maneuver_wrench
from ...training.evaluation.law_metrics import LawSamples, compare_laws
from ...training.predict import predict
from ..progress import Update
from .config import Regime, StudyConfig

_SHOWN_TIMES = 20
_VELOCITIES = 512


def sample_law(
    model: Dynamics,
    F_Bo_B: Float[np.ndarray, "T 6"],
    dt: float,
    key: Array,
    samples: int,
    substeps: int,
) -> LawSamples:
    """Motions from rest at the identity; a deterministic model has one."""
    dtype = model.rigid_inertia.dtype
    X_0 = jnp.zeros((7, 1), dtype).at[0].set(1)
    drawn = samples if model.stochastic else 0
    X, V = _predict(
        model,
        X_0,
        jnp.zeros((6, 1), dtype),
        jnp.asarray(F_Bo_B, dtype)[:, :, None],
        dt,
        key,
        drawn,
        substeps=substeps,
        with_path_of_drift=not model.stochastic,
    )
    return LawSamples(np.asarray(X)[..., 0], np.asarray(V)[..., 0])


_predict = eqx.filter_jit(predict)


def true_model(study: StudyConfig) -> Dynamics:
    """The law to be learned."""
    vehicle = load_vehicle(study.truth.vehicle)
    return vehicle.dynamics(np.asarray(study.truth.diffusion), jnp.result_type(float))


def _scenarios(
    study: StudyConfig, regime: Regime, seed: int
) -> Iterator[tuple[str, Float[np.ndarray, "T 6"], Array]]:
    """Name, wrenches and key of every scenario."""
    config = study.regime(regime)
    thrusters = load_vehicle(study.truth.vehicle).thrusters()
    steps = round(config.duration * config.rate)
    for number, name in enumerate(config.maneuvers):
        wrench, _ = maneuver_wrench(name, thrusters, config.effort)
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(2**31 + seed), number), steps)
        yield name, np.tile(wrench, (steps, 1)), key


def judge(
    model: Dynamics,
    study: StudyConfig,
    regime: Regime,
    seed: int,
    substeps: int,
    progress: Update = lambda fraction, remark="", /: None,
) -> tuple[xr.Dataset, dict[str, dict[str, float]]]:
    """Metrics of every scenario (`training.evaluation.law_metrics`), and the two diffusions."""
    truth, config = true_model(study), study.regime(regime)
    dt, count = 1 / config.rate, study.evaluation.samples
    parts: list[xr.Dataset] = []
    velocities = []
    for number, (name, F, key) in enumerate(_scenarios(study, regime, seed)):
        progress(number / len(config.maneuvers), f"judging {name}")
        keys = jax.random.split(key, 4)
        drawn = [
            sample_law(m, F, dt, k, count, n)
            for m, k, n in zip(
                (truth, truth, model, model),
                keys,
                (study.truth.substeps, study.truth.substeps, substeps, substeps),
                strict=True,
            )
        ]
        parts.append(
            compare_laws(
                drawn[2],
                drawn[0],
                drawn[1],
                dt,
                other_predicted=drawn[3],
                times=study.evaluation.times,
                metric=study.evaluation.metric,
            ).expand_dims(scenario=[name])
        )
        velocities.append(np.moveaxis(drawn[0].V, 1, 0).reshape(6, -1))
    everywhere = np.concatenate(velocities, axis=1)
    chosen = np.random.default_rng(seed).choice(everywhere.shape[1], _VELOCITIES)
    return xr.concat(parts, dim="scenario"), diffusions(model, truth, everywhere[:, chosen])


def diffusions(
    model: Dynamics, truth: Dynamics, V_WB_B: Float[np.ndarray, "6 N"]
) -> dict[str, dict[str, float]]:
    """Diffusion by axis, learned, true and their ratio: medians over these velocities.

    `b_<axis>` is b itself (N√s, N·m√s), if the model has a diagonal one; `noise_<axis>` is the norm
    of the axis' row of M⁻¹ b (m/s/√s and rad/s/√s), which the motion determines directly.
    """
    found = {}
    sides = [_diffusion(m, jnp.asarray(V_WB_B, m.rigid_inertia.dtype)) for m in (model, truth)]
    for name in sides[1]:
        for i, axis in enumerate(AXES):
            learned, true = (float(np.median(side[name][i])) for side in sides)
            found[f"{name}_{axis}"] = {"learned": learned, "true": true, "ratio": learned / true}
    return found


@eqx.filter_jit
def _diffusion(model: Dynamics, V: Float[Array, "6 N"]) -> dict[str, Float[Array, "6 N"]]:
    zero = jnp.zeros_like(V)
    if not model.stochastic:
        return {"b": zero, "noise": zero}
    _, b = model.mass_and_diffusion(V)
    columns = [model.noise_acceleration(V, zero.at[i].set(1)) for i in range(6)]
    noise = jnp.sqrt(sum(c * c for c in columns))
    return {"b": jnp.broadcast_to(b.reshape(6, -1), V.shape), "noise": noise}


def shown_motions(
    model: Dynamics, study: StudyConfig, regime: Regime, seed: int, substeps: int
) -> xr.Dataset | None:
    """Positions over time from the true and the learned law, for figures; None without scenario.

    `position` (scenario, law, sample, time, axis) in m; a deterministic law's path is repeated.
    """
    truth, config = true_model(study), study.regime(regime)
    steps = round(config.duration * config.rate)
    index = np.unique(np.linspace(0, steps, _SHOWN_TIMES + 1).round().astype(int)[1:] - 1)
    count = study.evaluation.shown_samples
    names, rows = [], []
    for name, F, key in _scenarios(study, regime, seed):
        if name not in study.evaluation.shown:
            continue
        names.append(name)
        both = []
        for m, n, k in (
            (truth, study.truth.substeps, 10),
            (model, substeps, 11),
        ):
            drawn = sample_law(m, F, 1 / config.rate, jax.random.fold_in(key, k), count, n)
            path = np.moveaxis(drawn.X[index, 4:], 2, 0).astype(np.float32)
            both.append(np.resize(path, (count, *path.shape[1:])))
        rows.append(both)
    if not names:
        return None
    return xr.Dataset(
        {"position": (("scenario", "law", "sample", "time", "axis"), np.asarray(rows))},
        coords={
            "scenario": names,
            "law": ["true", "learned"],
            "time": ("time", (index + 1) / config.rate, {"units": "s"}),
            "axis": list(XYZ),
        },
        attrs={"units": "m"},
    )


def check_vehicles(study: StudyConfig) -> None:
    """Check that the vehicles can be loaded and that the belief is not the truth.

    Raises:
        UserError: with field and remedy.
    """
    load_vehicle(study.truth.vehicle)
    load_vehicle(study.belief)
    if study.truth.vehicle == study.belief:
        raise UserError(
            f"StudyConfig.belief: is the true vehicle '{study.belief}'; name another preset, or "
            "there is nothing to learn"
        )
