"""The starting model of training: a preset with drift and diffusion fitted to the data."""

from dataclasses import replace
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models.config.errors import UserError
from ...models.dynamics import Dynamics
from ...models.effects.extended import Extended, core, with_core
from ...models.euclidean import create_spinn
from ...models.integrate import cast
from ...models.rigid_body import FossenDynamics
from ...models.spinn import Spinn
from ...models.vehicles.vehicle import Vehicle
from ..config import TrainingConfig
from ..data.windows import Windows
from ..losses.base import Batch
from ..losses.matching import SquaredError
from ..predict import predict, predict_drift
from .drift import fit_drift
from .fit import Progress
from .likelihood import fit_innovations
from .one_step_errors import mass_at_rest
from .pretrain import fit_potential, pretrain

Model = TypeVar("Model", bound=Dynamics)

NORMAL_QUARTILE = 0.6744897501960817


def estimate_diffusion(
    dynamics: Dynamics, windows: Windows, horizon_s: float = 0.5, substeps: int = 1
) -> Float[np.ndarray, "6"]:
    """First estimate of b (N√s, N·m√s) from the prediction error of M ξ after `horizon_s`.

    With it motions drawn from `dynamics` deviate from the noise-free motion as far as the data do,
    by the median absolute deviation on each axis, which accounts for the decay of deviations by
    drag. b includes model bias and sensor noise, so it tends to be too large. It is at least 1e-3
    of the value that accelerates by 1 in a second. No motions are drawn for a distance-aware
    diffusion: there b_i² h = Var[(M (ξ̂ - ξ))_i], which is too small by the effect of drag.
    """
    steps = int(np.clip(round(horizon_s / windows.dt), 1, windows.steps))
    pieces = windows.thin(256).subdivide(steps).thin(1024)
    batch = Batch.of(pieces)
    start = batch.X[0], batch.V[0], batch.F, windows.dt
    given = {"substeps": substeps, "commands": batch.commands, "rise": batch.rise}
    M = mass_at_rest(dynamics, batch.V.dtype)
    floor = 1e-3 * np.diag(M)

    def spread(difference: Float[Array, "6 W"]) -> Float[np.ndarray, "6"]:
        miss = np.abs(M @ np.asarray(difference, np.float64))
        miss = miss[:, np.isfinite(miss).all(axis=0)]
        return np.median(miss, axis=1) / NORMAL_QUARTILE if miss.size else np.zeros(6)

    _, V = eqx.filter_jit(predict_drift)(dynamics, *start, **given)
    missed = spread(batch.V[-1] - V[-1])
    b = np.maximum(missed / (steps * windows.dt) ** 0.5, floor)
    own = core(dynamics)
    if isinstance(own, Spinn) and own.config.diffusion != "network":
        return b
    for _ in range(2):
        model = with_diffusion(dynamics, b)
        _, Vs = eqx.filter_jit(predict)(model, *start, jax.random.key(0), 1, **given)
        drawn = spread(Vs[-1, :, 0] - V[-1])
        b = np.maximum(b * np.clip(missed / np.maximum(drawn, 1e-12), 0.25, 4.0), floor)
    return b


def with_diffusion(model: Model, b: Float[np.ndarray, "6"]) -> Model:
    """The model with another b (a SPINN: as the scale of its diffusion network)."""
    scale = _scale_of(model)
    return eqx.tree_at(_scale_of, model, jnp.asarray(b, scale.dtype))


def without_growth(model: Model) -> Model:
    """The model with the b that it has at rest, for users that estimate a constant one."""
    own, plain = core(model), None
    if isinstance(own, Spinn) and own.scales.growth is not None:
        config = replace(own.config, growing=False)
        plain = replace(own, config=config, scales=replace(own.scales, growth=None))
    elif isinstance(own, FossenDynamics) and own.growth is not None:
        plain = own.with_constants(growth=None)
    changed: Any = model if plain is None else with_core(model, plain)
    return changed


def diffusion_scale(model: Dynamics) -> Float[np.ndarray, "6"]:
    """What `with_diffusion` sets."""
    return np.asarray(_scale_of(model), float)


def _scale_of(model: Dynamics) -> Any:
    found = core(model)
    return found.scales.diffusion if isinstance(found, Spinn) else found.diffusion  # pyright: ignore[reportAttributeAccessIssue]


def begun_with(config: TrainingConfig, model: Dynamics | None) -> TrainingConfig:
    """The settings with the architecture of a learned model that training continues from.

    Raises:
        UserError: the model is of a kind that the method does not train.
    """
    own = None if model is None else core(model)
    if model is None or not isinstance(own, Spinn):
        if isinstance(model, Extended) and config.model.coordinates != "group":
            raise UserError(
                "model: effects act on SE(3); choose a method on the group, not a Euclidean one"
            )
        return config
    for name in ("stochastic", "coordinates", "diffusion"):
        have, want = getattr(own.config, name), getattr(config.model, name)
        if have != want:
            raise UserError(
                f"model: its {name} is {have!r}, the method wants {want!r}; choose the method "
                "that it was trained with, or start from a preset"
            )
    return replace(config, model=own.config)


def starting_model(
    config: TrainingConfig,
    vehicle: Vehicle,
    windows: Windows,
    progress: Progress | None = None,
    given: Dynamics | None = None,
    validation: Windows | None = None,
    inferred: bool = False,
) -> Dynamics:
    """A SPINN at the vehicle's preset, its drift fitted to short pieces, b to the residuals.

    A `given` Fossen model replaces the preset. Its effects are kept, with a SPINN as their base;
    the windows then need commands (`make_windows`). A learned model is returned as it is. A given
    model may already be as good as the data allow: the fit of the drift is kept only if it predicts
    `validation` windows better. If the windows have states `inferred` with the given model
    (`HiddenStart`), neither it nor its b is fitted again.

    A function of its arguments alone, so that a resumed run starts from the same bits.
    """
    dtype = jnp.dtype(windows.X.dtype)
    if isinstance(given, Extended):
        given = given.for_steps_of(windows.dt)
    given = None if given is None else cast(given, dtype)
    reference = vehicle.dynamics(dtype=dtype) if given is None else core(given)
    if given is not None and isinstance(reference, Spinn):
        return given
    if not isinstance(reference, FossenDynamics):
        raise UserError(f"model: training starts from no {type(reference).__name__}")
    reference = without_growth(reference)  # calibration finds it anew at the end
    model_key, pretrain_key = jax.random.split(jax.random.key(config.seed))
    spinn = create_spinn(config.model, reference, model_key, dtype)
    spinn = pretrain(spinn, reference, config.pretrain, pretrain_key)[0]
    if given is not None and config.model.coordinates == "group" and config.pretrain.steps:
        spinn = fit_potential(spinn, reference, config.pretrain, pretrain_key)
    effects = given if isinstance(given, Extended) else None
    if inferred:
        assert given is not None
        model = spinn if effects is None else effects.with_base(spinn)
        b = diffusion_scale(given)
        return with_diffusion(model, b) if config.model.stochastic else model
    substeps = config.objective.substeps
    # effects may have memory, which a fit to one-step innovations does not model
    fitted = None if effects else fit_innovations(config.drift, spinn, windows, substeps)
    spinn = spinn if fitted is None else fitted.apply(spinn)
    model = spinn if effects is None else effects.with_base(spinn)
    if fitted is None:
        found = fit_drift(config.drift, model, windows, substeps, progress)
        if given is None or validation is None:
            model = found
        else:
            model = _nearer(model, found, validation, substeps)
    if not config.model.stochastic:
        return model
    if fitted is not None and config.model.diffusion == "network":
        return with_diffusion(model, fitted.diffusion)
    return with_diffusion(model, estimate_diffusion(model, windows, substeps=substeps))


def _nearer(first: Model, second: Model, windows: Windows, substeps: int) -> Model:
    """The model whose noise-free motion is closer to the windows, in units of `first`'s errors."""
    batch = Batch.of(windows.thin(256))
    unit = SquaredError.build("typical", substeps, first, windows)

    @eqx.filter_jit
    def miss(model: Model) -> Array:
        X, V = predict_drift(
            model, batch.X[0], batch.V[0], batch.F, windows.dt, substeps=substeps,
            commands=batch.commands, rise=batch.rise,
        )  # fmt: skip
        return unit(X[:, :, None], V[:, :, None], batch)

    return second if float(miss(second)) < float(miss(first)) else first
