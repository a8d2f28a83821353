"""A heading that is off in parts of the data, as causes: kinematics show it, without a fit."""

from collections.abc import Sequence

import scipy.stats

from ....models.effects.attitude import HeadingError
from ..data.heading_steps import HeadingOff
from . import result

_MOST = 3
"""Most stretches that are named, the largest first; all are turned back."""
_EXPERIMENT = (
    "to confirm it: drive along a straight line past the place with the gyros' heading held, and "
    "compare the compass with them; look for steel, cables and currents near by"
)


def off_causes(off: Sequence[HeadingOff], labels: Sequence[str]) -> list[result.Cause]:
    """The largest stretches with a wrong heading, each a cause that acts there."""
    order = sorted(off, key=lambda one: -abs(one.offset))[:_MOST]
    return [_cause(one, labels) for one in order]


def _cause(off: HeadingOff, labels: Sequence[str]) -> result.Cause:
    away, reach = off.offset / max(off.error, 1e-12), 1.96 * off.error
    first, last = labels[off.first_run], labels[off.last_run]
    of, until = (f" of {run}" if len(labels) > 1 else "" for run in (first, last))
    if first != last:
        text = f"from {off.start:.1f} s{of} to {off.end:.1f} s{until}"
    elif off.ends:
        text = f"{off.start:.1f} to {off.end:.1f} s{of}"
    else:
        text = f"from {off.start:.1f} s{of} to its end"
    return result.Cause(
        name=HeadingError.name,
        where=HeadingError.places[0],
        parameters={
            "offset": result.Value(off.offset, "rad", (off.offset - reach, off.offset + reach))
        },
        evidence=result.Support(float(2 * scipy.stats.norm.sf(abs(away))), away**2 / 2),
        rivals=[],
        indistinguishable_from=[],
        next_experiment=_EXPERIMENT,
        when=result.When("window", first, off.start, last, off.end, text),
    )
