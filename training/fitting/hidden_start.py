"""The start of training on a recording that lacks channels of the state."""

import logging
from collections.abc import Callable
from dataclasses import dataclass

from ...models.config.errors import UserError
from ...models.dynamics import Dynamics
from ...models.effects.extended import Extended, core
from ...models.integrate import cast
from ...models.recordings.store import Recording
from ...models.rigid_body import FossenDynamics
from ...models.spinn import Spinn
from ...models.vehicles.vehicle import Vehicle
from ..config import TrainingConfig
from ..data.windows import Windows, make_windows, windowing
from ..diagnosis.coefficients import fit_coefficients
from ..smoothing.complete import Completed, complete, not_completed_by
from ..smoothing.fitted import Told, completed_as_it_is, told_by
from ..smoothing.levels import Belief, Levels
from .start import with_diffusion, without_growth

_log = logging.getLogger(__name__)
_ROUNDS = 4
"""Gauss-Newton steps where levels of noise are known already."""
_FIT = 0.9
"""Share of the time that the fit of the coefficients takes, roughly."""


@dataclass(frozen=True)
class HiddenStart:
    """A model that states are inferred with, and completions of all parts.

    Attributes:
        vehicle: whose preset the learned model is compared with.
        config: settings of training.
        last: what is held out.
        model: the preset (or a given Fossen model) with all coefficients fitted, or the given model
            with effects or SPINN; with the noise that the data have under it.
        levels: of that noise.
        told: what the data tell of each coefficient, if they were fitted.
        preset: the preset with the diffusion that the data have under it.
    """

    vehicle: Vehicle
    config: TrainingConfig
    last: Recording
    model: Dynamics
    levels: Levels
    told: tuple[Told, ...]
    preset: FossenDynamics

    @classmethod
    def of(
        cls,
        recording: Recording,
        vehicle: Vehicle,
        config: TrainingConfig,
        given: Dynamics | None,
        progress: Callable[[float], None] = lambda fraction: None,
    ) -> "HiddenStart":
        """Fit to what is not held out.

        Raises:
            UserError: the method or the given model needs all channels.
        """
        lacking = "; ".join("/".join(names) for names in recording.missing.values())
        if config.model.coordinates != "group" or config.model.diffusion != "network":
            raise UserError(
                f"recording: {lacking} was not recorded, and this method needs pose and twist; "
                "choose one on the group (fdm-geodesic+mse), or record with a DVL"
            )
        if given is not None and (why := not_completed_by(given)):
            raise UserError(f"recording: {lacking} was not recorded. --model: {why}")
        w = config.windows
        rest, last = recording.split(w.held_out, w.by, w.gap_s)
        noise = completed_as_it_is(rest, vehicle, vehicle.dynamics()).levels
        preset = vehicle.dynamics(noise.diffusion)
        if given is None or isinstance(given, FossenDynamics):
            model, fitted = _fitted(rest, vehicle, given, lambda f: progress(_FIT * f)), True
        else:
            model, fitted = given, False
        progress(_FIT)
        levels = completed_as_it_is(rest, vehicle, model).levels
        told = told_by(rest, vehicle, model, vehicle.dynamics(), levels) if fitted else ()
        if not isinstance(core(model), Spinn):
            model = with_diffusion(without_growth(model), levels.diffusion)
        return cls(vehicle, config, last, model, levels, told, preset)

    def completed(self, part: Recording) -> Completed:
        """A part completed with the model."""
        return complete(
            part,
            self.vehicle,
            self.model,
            belief=Belief.exact(),
            levels=self.levels,
            rounds=_ROUNDS,
        )

    def held_out(self, model: Dynamics) -> Windows:
        """The held-out windows, completed with the model that is judged on them."""
        w = self.config.windows
        return make_windows(
            self.last,
            self.vehicle,
            length_s=w.length_s,
            stride_s=w.length_s,
            completed=completed_as_it_is(self.last, self.vehicle, model),
            **windowing(self.model, w.normalise),
        )


def _fitted(
    recording: Recording,
    vehicle: Vehicle,
    base: Dynamics | None,
    progress: Callable[[float], None],
) -> Extended:
    """`base`, or the preset, with all coefficients fitted; without enough data as it is."""
    own = vehicle.dynamics() if base is None else base
    try:
        return cast(fit_coefficients(recording, vehicle, own, progress), own.rigid_inertia.dtype)
    except UserError as error:
        _log.warning(f"coefficients stay as they were: {error}")
    return Extended.create(own, (), vehicle.thrusters())
