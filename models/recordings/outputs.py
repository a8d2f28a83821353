"""Which output of the autopilot (n of SERVOn) drives each thruster of a recording."""

from collections.abc import Sequence

import numpy as np
import xarray as xr

OUTPUTS = "thruster_outputs"
"""Attribute of a dataset: one whole number for each thruster, 0 where no output drives it."""
_LAST = 32
"""ArduPilot has SERVO1 to SERVO32."""


def outputs_of(dataset: xr.Dataset) -> tuple[int, ...]:
    """The output of each thruster; empty if the recording does not tell."""
    return tuple(int(n) for n in np.ravel(dataset.attrs.get(OUTPUTS, ())))


def with_outputs(dataset: xr.Dataset, outputs: Sequence[int]) -> xr.Dataset:
    """The dataset with these outputs; without any if there is none to tell."""
    if not outputs:
        kept = dataset.copy(deep=False)
        kept.attrs.pop(OUTPUTS, None)
        return kept
    return dataset.assign_attrs({OUTPUTS: np.asarray(outputs, np.int64)})


def common_outputs(datasets: Sequence[xr.Dataset]) -> tuple[int, ...]:
    """The outputs that all datasets have; none if they differ."""
    found = {outputs_of(dataset) for dataset in datasets}
    return found.pop() if len(found) == 1 else ()


def check_outputs(dataset: xr.Dataset) -> None:
    """Refuse outputs that are no numbers of outputs, or another number of them than thrusters.

    Raises:
        ValueError: with one sentence naming the attribute and the remedy.
    """
    if OUTPUTS not in dataset.attrs:
        return
    given = np.atleast_1d(np.asarray(dataset.attrs[OUTPUTS]))
    if given.ndim != 1 or given.dtype.kind not in "iu" or ((given < 0) | (given > _LAST)).any():
        raise ValueError(
            f"{OUTPUTS}: must be whole numbers from 0 (no output) to {_LAST}, one for each "
            f"thruster, got {str(dataset.attrs[OUTPUTS])[:60]}"
        )
    count = dataset.sizes.get("thruster", given.size)
    if given.size != count:
        raise ValueError(
            f"{OUTPUTS}: {given.size} outputs for {count} thrusters; give one for each, 0 for none"
        )


def in_words(thruster: int, outputs: Sequence[int]) -> str:
    """A thruster (from 1) with its output where that is known: "thruster 5 (output 3)"."""
    output = outputs[thruster - 1] if thruster <= len(outputs) else 0
    return f"thruster {thruster} (output {output})" if output else f"thruster {thruster}"
