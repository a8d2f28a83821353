"""One clock for all topics of a bag: that of the attitude's headers.

Stamps of headers tell when something was measured, the times of the recorder only when it came in.
Where a topic's headers run on another clock (more than a second apart: a device that counts from
its boot), they are moved by the least latency; messages without a header have the recorder's time,
put on the reference clock. The least latencies of 10 s each tell whether two clocks run apart, and
steps back of the stamps begin a new part. Stamps that jitter about a steady rate are replaced by
steady times where the motion says so (`models/recordings/steady_times.py`).
"""

import numpy as np
from jaxtyping import Float

from ....models.recordings.checks.finding import Finding
from ....models.recordings.resample import continuous
from ....models.recordings.steady_times import steady_times
from ..clock import drift, epochs, in_words
from .bag import Column

_SAME_CLOCK_S = 1.0
_NS = 1e-9
Times = Float[np.ndarray, " n"]


class Clock:
    """The reference clock; times are seconds since its first stamp.

    Attributes:
        cuts: times at which a later part begins, since the stamps stepped back.
        notes: sentences on these steps.
    """

    def __init__(self, reference: Column):
        stamps = reference.received if reference.stamps is None else reference.stamps
        self.origin = int(stamps.min())
        raw = (stamps - self.origin) * _NS
        self._shift, self.cuts, steps = epochs(raw)
        self.notes = tuple(in_words(self.cuts, steps))
        self._stamps = raw + self._shift
        self._received = (reference.received - self.origin) * _NS
        order = np.argsort(self._received, kind="stable")
        self._received, self._stamps = self._received[order], self._stamps[order]
        self._shift = self._shift[order]
        self._latency = self._received - self._stamps
        self._apart = float(np.median(self._latency))
        self._drifts = bool(np.ptp(self._latency) > _SAME_CLOCK_S)
        self._line = None if self._drifts else drift(self._received, self._latency)
        self._known: dict[str, tuple[Times, list[str]]] = {}
        self._findings: dict[str, list[Finding]] = {}

    @property
    def findings(self) -> list[Finding]:
        """What is wrong with the clocks of the topics whose times were asked for."""
        return [one for found in self._findings.values() for one in found]

    def times(self, column: Column) -> tuple[Times, list[str]]:
        """When the messages of a topic were measured (s), and a sentence if its clock is moved."""
        if column.topic not in self._known:
            self._findings[column.topic] = []
            t, told = self._times(column)
            self._known[column.topic] = self._steadied(column, t), told
        return self._known[column.topic]

    def _times(self, column: Column) -> tuple[Times, list[str]]:
        received = (column.received - self.origin) * _NS
        arrived = self._arrived(received)
        if column.stamps is None:
            return arrived, []
        raw = (column.stamps - self.origin) * _NS
        shift, _, _ = epochs(raw)
        told, t = [], raw.copy()
        for value in np.unique(shift):
            part = shift == value
            t[part] += self._shift_at(float(np.median(received[part])))
            apart = float(np.median(arrived[part] - t[part]))
            if abs(apart) > _SAME_CLOCK_S:
                t[part] += float(np.min(arrived[part] - t[part]))
                told.append(
                    f"{column.topic}: its stamps are on a clock of their own, {apart:.1f} s apart; "
                    "they were moved by the least latency."
                )
        return self._run_alike(column.topic, t, received), told

    def _shift_at(self, received: float) -> float:
        """What is added to stamps of messages that came in at a time, since they stepped back."""
        at = int(np.searchsorted(self._received, received, side="right")) - 1
        return float(self._shift[max(at, 0)])

    def _run_alike(self, topic: str, t: Times, received: Times) -> Times:
        """Times by a clock that runs as the reference's."""
        if self._drifts:
            return t
        latency = received - t
        own, reference = drift(received, latency), self._line
        apart = drift(received, latency - (0.0 if reference is None else reference.at(received)))
        if own is None or apart is None:
            return t
        how = "slower" if apart.change > 0 else "faster"
        self._findings[topic].append(
            Finding(
                "clock-rate",
                topic,
                f"its clock runs {how} than that of the attitude: its stamps drift by "
                f"{abs(apart.change):.2g} s; they were corrected by the least latencies",
                "synchronise the clocks of the computers (NTP, PTP)",
            )
        )
        return t + apart.at(received) - float(np.min(self._least()))

    def _least(self) -> Times:
        """Latencies of the reference apart from its drift."""
        line = 0.0 if self._line is None else self._line.at(self._received)
        return self._latency - line

    def _steadied(self, column: Column, t: Times) -> Times:
        """Steady times where the motion says that these jitter."""
        x, part = column.x, column.form.gives.get("attitude")
        if part is not None and (np.linalg.norm(x[part], axis=0) > 0).all():
            x = x.copy()
            x[part] = continuous(x[part])
        arrival = column.stamps is None
        found = steady_times(t, x, late=arrival)
        if found is None:
            return t
        what = "times of arrival" if arrival else "stamps"
        remedy = "publish it with a header that is stamped when it is measured"
        self._findings[column.topic].append(
            Finding(
                "clock-jitter",
                column.topic,
                f"its {what} jitter by {1e3 * found.jitter:.2g} ms (rms) about steady "
                f"{found.rate:.3g} Hz, at which its numbers are smoother: steady times were taken",
                remedy if arrival else "stamp its messages when they are measured, not on arrival",
            )
        )
        return found.t

    def _arrived(self, received: Times) -> Times:
        """Times of the recorder on the reference clock."""
        if self._drifts:
            return received - np.interp(received, self._received, self._latency)
        if self._line is not None:
            return received - self._line.at(received)
        if abs(self._apart) <= _SAME_CLOCK_S:
            return received
        return received - self._apart
