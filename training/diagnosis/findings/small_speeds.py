"""Small speeds that the DVL lost, as a cause: the records show it, and no fit is needed."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from ....models.effects.base import Effect
from ....models.effects.dvl import DvlDeadZone
from ....models.recordings.checks.small_speeds import DeadZone
from . import result

_EXPERIMENT = (
    "to measure it better: drift and creep at speeds around the width, with positions from another "
    "instrument; look for a threshold in the settings of the DVL and of its driver"
)


def zone_causes(
    zones: Sequence[DeadZone], believed: Sequence[Effect]
) -> tuple[list[result.Cause], tuple[Effect, ...]]:
    """The dead zones as one cause and its effect; none where the model has the effect already."""
    if not zones or any(e.name == DvlDeadZone.name for e in believed):
        return [], ()
    parameters: dict[str, result.Value] = {}
    values = np.zeros(len(DvlDeadZone.places))
    for number, zone in enumerate(zones):
        name = "width" if number == 0 else f"width_{zone.where}"
        parameters[name] = result.Value(zone.width, "m/s", zone.interval95)
        values[DvlDeadZone.index(zone.where, "width")] = zone.width
    best = max(zones, key=lambda zone: float(zone.gain.sum()))
    cause = result.Cause(
        name=DvlDeadZone.name,
        where=", ".join(zone.where for zone in zones),
        parameters=parameters,
        evidence=result.Support(best.chance, float(best.gain.sum())),
        rivals=[],
        indistinguishable_from=[],
        next_experiment=_EXPERIMENT,
    )
    return [cause], (DvlDeadZone(jnp.asarray(values)),)
