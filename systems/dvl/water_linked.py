"""Water Linked A50 and A125: JSON lines on TCP port 16171.

Source: Water Linked, "DVL A50/A125 TCP JSON API", versions json_v2 to json_v3.2. Reports of dead
reckoning and answers to commands are skipped, and so are velocities relative to the water.
"""

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from .reading import DvlReading

PORT = 16171
_LONGEST = 65536  # bytes of a line; a report has some 1500


class WaterLinked:
    """Decodes the stream of one connection."""

    def __init__(self):
        self.damaged = 0
        self._rest = b""

    def readings(self, data: bytes) -> Iterable[DvlReading]:
        """As `reading.Decoder`."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > _LONGEST:
            self._rest, self.damaged = b"", self.damaged + 1
        for line in lines:
            if not line.strip():
                continue
            try:
                report = json.loads(line)
                found = _reading(report) if isinstance(report, dict) else None
            except (ValueError, TypeError, KeyError, RecursionError):
                self.damaged += 1
                continue
            if found is not None:
                yield found


def _reading(report: Mapping[str, Any]) -> DvlReading | None:
    """The reading of a velocity report; None for other reports.

    Raises:
        KeyError, TypeError, ValueError: a field is missing or not a number.
    """
    if report.get("type", "velocity") != "velocity" or "vx" not in report:
        return None
    if report.get("tracking_mode", "bottom") != "bottom":
        return None
    velocity = np.array([float(report[name]) for name in ("vx", "vy", "vz")])
    valid = report["velocity_valid"] is True and bool(np.isfinite(velocity).all())
    altitude, merit = float(report["altitude"]), float(report["fom"])
    seen, sent = report.get("time_of_validity"), report.get("time_of_transmission")
    latency = None
    if seen is None:  # json_v2 has no times
        seen = math.nan
    elif sent is not None:
        latency = (float(sent) - float(seen)) * 1e-6
        if not 0 <= latency < 10:
            raise ValueError("the report was sent before it was valid")
    return DvlReading(
        velocity if valid else np.zeros(3),
        valid,
        altitude if altitude > 0 else math.nan,
        merit,
        float(seen) * 1e-6,
        latency,
    )
