"""What a log tells of its samples: attributes of a recording, which joined recordings keep."""

from collections.abc import Sequence

import xarray as xr

PERIOD = "command_period"
"""Mean time (s) between the outputs of a log."""
ESTIMATED = "states_estimated"
"""1 where the states are known to be an autopilot's estimate, as those of its logs are."""
LOW_PASS = "rates_low_pass"
"""Cutoff (Hz) of the autopilot's low-pass that the body rates went through."""


def states_estimated(dataset: xr.Dataset) -> bool:
    """Whether the states are known to be an autopilot's estimate."""
    return bool(dataset.attrs.get(ESTIMATED, 0))


def of_all(datasets: Sequence[xr.Dataset]) -> dict[str, float | int]:
    """The attributes of recordings together: the longest period, and whether all were estimated."""
    periods = [float(d.attrs[PERIOD]) for d in datasets if PERIOD in d.attrs]
    found: dict[str, float | int] = {PERIOD: max(periods)} if periods else {}
    cutoffs = {float(d.attrs.get(LOW_PASS, 0.0)) for d in datasets}
    if len(cutoffs) == 1 and max(cutoffs) > 0:
        found[LOW_PASS] = max(cutoffs)
    return found | ({ESTIMATED: 1} if all(map(states_estimated, datasets)) else {})
