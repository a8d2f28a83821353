"""A velocity reading of a DVL, in the instrument's axes."""

from collections.abc import Iterable
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float


class DvlReading(NamedTuple):
    """One measurement.

    The instrument's axes are x forward, y right, z down, unless it was told of another mount.
    """

    velocity: Float[np.ndarray, "3"]
    """Over the bed (m/s); zero if not valid."""
    valid: bool
    altitude: float
    """Distance to the bed (m), NaN if unknown."""
    figure_of_merit: float
    """Standard deviation as the instrument claims it (m/s), NaN if unknown."""
    stamp: float
    """Time of validity on the instrument's clock (s)."""
    latency: float | None
    """From the time of validity to sending (s), if the instrument says it."""


@runtime_checkable
class Decoder(Protocol):
    """Readings from the bytes of a stream."""

    damaged: int
    """Packets or lines that could not be read."""

    def readings(self, data: bytes) -> Iterable[DvlReading]:
        """The readings that end within `data`, which continues what was given before."""
        ...
