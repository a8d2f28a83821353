"""The start of training on a recording that lacks channels of the state."""

from dataclasses import dataclass

from ...models.config.errors import UserError
from ...models.dynamics import Dynamics
from ...models.effects.extended import Extended
from ...models.recordings.store import Recording
from ...models.rigid_body import FossenDynamics
from ...models.spinn import Spinn
from ...models.vehicles.vehicle import Vehicle
from ..config import TrainingConfig
from ..data.windows import Windows, make_windows
from ..smoothing.complete import Completed, complete
from ..smoothing.fitted import Fitted, completed_as_it_is, fit_hidden


@dataclass(frozen=True)
class HiddenStart:
    """Constants fitted with the hidden states integrated out, and completions of all parts.

    Attributes:
        vehicle: whose preset is the start.
        config: settings of training.
        last: what is held out.
        fitted: the fitted model.
        preset: the preset with the diffusion that the data have under it.
    """

    vehicle: Vehicle
    config: TrainingConfig
    last: Recording
    fitted: Fitted
    preset: FossenDynamics

    @classmethod
    def of(
        cls, recording: Recording, vehicle: Vehicle, config: TrainingConfig, given: Dynamics | None
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
        if isinstance(given, Extended | Spinn):
            raise UserError(
                f"recording: {lacking} was not recorded, and training then starts from a preset "
                "or a Fossen model; leave out --model, or record with a DVL"
            )
        w = config.windows
        rest, last = recording.split(w.held_out, w.by, w.gap_s)
        reference = vehicle.dynamics() if given is None else given
        assert isinstance(reference, FossenDynamics)
        as_it_is = completed_as_it_is(rest, vehicle, vehicle.dynamics())
        preset = vehicle.dynamics(as_it_is.levels.diffusion)
        return cls(vehicle, config, last, fit_hidden(rest, vehicle, reference), preset)

    def completed(self, part: Recording) -> Completed:
        """A part completed with the fitted model."""
        f = self.fitted
        return complete(
            part, self.vehicle, f.model, belief=f.belief, levels=f.levels, rounds=_ROUNDS
        )

    def held_out(self, model: Dynamics) -> Windows:
        """The held-out windows, completed with the model that is judged on them."""
        w = self.config.windows
        return make_windows(
            self.last,
            self.vehicle,
            length_s=w.length_s,
            stride_s=w.length_s,
            normalise=w.normalise,
            completed=completed_as_it_is(self.last, self.vehicle, model),
        )


_ROUNDS = 4
"""Gauss-Newton steps where coefficients and levels of noise are known already."""
