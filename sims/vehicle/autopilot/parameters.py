"""Parameters of the autopilot: names, types and values of an ArduSub 4.5.6 with a DVL.

`parameters.csv` is the list that such a vehicle sent (frame VECTORED_6DOF, no GPS, a DVL as its
horizontal aid), without those of its own simulator.
"""

import csv
import math
import struct
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

from ....models.config.errors import UserError

TYPES = {"int8": 2, "int16": 4, "int32": 6, "float": 9}
"""MAV_PARAM_TYPE of each kind."""

_RANGES = {"int8": (-128, 127), "int16": (-32768, 32767), "int32": (-(2**31), 2**31 - 1)}


@lru_cache
def _shipped() -> tuple[tuple[str, float, str], ...]:
    with (Path(__file__).parent / "parameters.csv").open(encoding="utf-8", newline="") as file:
        return tuple(
            (row["name"], float(row["value"]), row["type"]) for row in csv.DictReader(file)
        )


class Parameters:
    """Values by name. They outlive a reboot, as those in a vehicle's EEPROM do."""

    def __init__(self, values: Mapping[str, float | int] | None = None):
        """Start from the shipped values, changed by `values`.

        Raises:
            UserError: there is no parameter of that name, or its value is not finite.
        """
        rows = _shipped()
        self._kinds = {name: kind for name, _, kind in rows}
        self._values = {name: _stored(value, kind) for name, value, kind in rows}
        self.names = tuple(self._values)
        self._index = {name: i for i, name in enumerate(self.names)}
        for name, value in (values or {}).items():
            if not self.set(name, value):
                reason = "is no finite number" if name in self._values else "is no parameter"
                raise UserError(
                    f"parameters: {name} {value!r} {reason} of the simulated autopilot; see "
                    "sims/vehicle/autopilot/parameters.csv for names and values"
                )

    def __len__(self) -> int:
        return len(self.names)

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def integer(self, name: str) -> int:
        """A whole number: an index, a choice or a set of bits."""
        return int(self._values[name])

    def index(self, name: str) -> int:
        """Position in the list."""
        return self._index[name]

    def type(self, name: str) -> int:
        """MAV_PARAM_TYPE."""
        return TYPES[self._kinds[name]]

    def set(self, name: str, value: float | int) -> bool:
        """Store a value in the parameter's type; False for an unknown name or no finite number."""
        if name not in self._values or not math.isfinite(value):
            return False
        self._values[name] = _stored(value, self._kinds[name])
        return True


def _stored(value: float | int, kind: str) -> float:
    if kind == "float":
        largest = struct.unpack("<f", b"\xff\xff\x7f\x7f")[0]
        return struct.unpack("<f", struct.pack("<f", max(-largest, min(largest, value))))[0]
    low, high = _RANGES[kind]
    return float(max(low, min(high, math.floor(value + 0.5))))
