"""One clock for all topics of a bag: that of the attitude's headers.

Stamps of headers tell when something was measured, the times of the recorder only when it came in.
Where a topic's headers run on another clock (more than a second apart: a device that counts from
its boot), they are moved by the least latency; messages without a header have the recorder's time,
put on the reference clock.
"""

import numpy as np
from jaxtyping import Float

from .bag import Column

_SAME_CLOCK_S = 1.0
_NS = 1e-9


class Clock:
    """The reference clock; times are seconds since its first stamp."""

    def __init__(self, reference: Column):
        stamps = reference.received if reference.stamps is None else reference.stamps
        self.origin = int(stamps.min())
        self._stamps = (stamps - self.origin) * _NS
        self._received = (reference.received - self.origin) * _NS
        self._apart = float(np.median(self._received - self._stamps))
        order = np.argsort(self._received, kind="stable")
        self._received, self._stamps = self._received[order], self._stamps[order]
        self._drifts = bool(np.ptp(self._received - self._stamps) > _SAME_CLOCK_S)

    def times(self, column: Column) -> tuple[Float[np.ndarray, " n"], list[str]]:
        """When the messages of a topic were measured (s), and a sentence if its clock is moved."""
        arrived = self._arrived((column.received - self.origin) * _NS)
        if column.stamps is None:
            return arrived, []
        t = (column.stamps - self.origin) * _NS
        apart = float(np.median(arrived - t))
        if abs(apart) <= _SAME_CLOCK_S:
            return t, []
        shift = float(np.min(arrived - t))
        return t + shift, [
            f"{column.topic}: its stamps are on a clock of their own, {apart:.1f} s apart; they "
            "were moved by the least latency."
        ]

    def _arrived(self, received: np.ndarray) -> np.ndarray:
        """Times of the recorder on the reference clock."""
        if abs(self._apart) <= _SAME_CLOCK_S and not self._drifts:
            return received
        if not self._drifts:
            return received - self._apart
        return received - np.interp(received, self._received, self._received - self._stamps)
