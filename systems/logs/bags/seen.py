"""A topic of a bag with its first messages, and which quantities they may hold."""

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .bag import Column
from .messages import COMMANDS, NUMBERS, Quantity

_GRAVITY, _APART = 9.81, 5.0
_PULSES_US = (800.0, 2200.0)
_STICKS = "mavros_msgs/msg/OverrideRCIn"
_NAMES: dict[Quantity, re.Pattern[str]] = {
    "depth": re.compile(
        r"^(?!.*(bottom|seabed|sonar|ping|echo|camera|(max|min)_?depth|depth_?(max|min|limit)))"
        r".*depth",
        re.I,
    ),
    "height": re.compile(r"rel_alt|height", re.I),
    "voltage": re.compile(
        r"volt|^(?!.*(percent|temp|curr|remain|charge|level|soc)).*battery", re.I
    ),
    "pwm": re.compile(r"pwm|servo|rc/out|pulse|motor", re.I),
    "forces": re.compile(r"thrust|force|motor", re.I),
    "wrench": re.compile(r"wrench|tau|effort", re.I),
}
"""What a bare number or array is, by the name of its topic; an altitude is not one."""
_VECTORS: dict[Quantity, re.Pattern[str]] = {
    "velocity": re.compile(r"^(?!.*(ang|gyro|imu|mag|rot|wind)).*(vel|dvl$)", re.I),
    "position": re.compile(r"pos|usbl|mocap|odom", re.I),
}
"""What a bare vector or point is, likewise; the rest by a map alone."""
_BARE = ("std_msgs",)
_VECTOR = ("geometry_msgs/msg/Vector3", "geometry_msgs/msg/Point")
_ELSEWHERE = re.compile(
    r"sensor|(^|[/_])ft|disturb|perturb|debug|damping|restoring|added|contact|bumper|buoy|current"
    r"|thruster\w*/\d",
    re.I,
)
"""In the names of wrenches that no command gives, or that act on a part of the vehicle."""
_RELATIVE = re.compile(r"camera|optical|marker|(^|[_/])tag|sonar", re.I)
"""In the frame of a pose that is none in a world."""
_WATER = re.compile(r"hydrodynamics|(ocean|water|sea)_?current", re.I)
"""In the names of velocities of the water."""


@dataclass(frozen=True)
class Seen:
    """A topic with the first of its messages."""

    column: Column
    rate: float
    count: int

    @property
    def topic(self) -> str:
        """Its name."""
        return self.column.topic

    @property
    def single(self) -> bool:
        """Whether its messages are single numbers."""
        return self.column.type in NUMBERS

    @property
    def only_height(self) -> bool:
        """Whether it is a pose that holds z alone, as made of a depth: x and y are always 0."""
        if self.column.type.endswith("Odometry") or "position" not in self.column.form.gives:
            return False
        x, y, z = self.column.x[self.column.form.gives["position"]]
        return not np.nan_to_num([x, y]).any() and bool(np.ptp(z) > 0)

    def still(self, quantity: Quantity) -> bool:
        """Whether its numbers never change, as those of a field that nobody fills."""
        x = self.column.x[self.column.form.gives[quantity]]
        return bool(np.all(x == x[:, :1]))

    def _elsewhere(self, quantity: Quantity) -> bool:
        """Whether the names say that it is not of this vehicle's body in a world."""
        if quantity == "wrench":
            return _ELSEWHERE.search(self.topic) is not None
        if quantity == "velocity":
            return _WATER.search(self.topic) is not None
        relative = quantity == "position" or (
            quantity == "attitude" and not self.column.type.endswith("/Imu")
        )
        return relative and (
            _RELATIVE.search(self.column.frame) is not None
            or (quantity == "position" and self.only_height)
            or (quantity == "attitude" and self.only_height and self.still(quantity))
        )

    def _named_vector(self, quantity: Quantity) -> bool:
        named = _VECTORS.get(quantity)
        return named is not None and named.search(self.topic) is not None

    def has(self, quantity: Quantity) -> bool:
        """Whether its messages may hold a quantity, and do."""
        form = self.column.form
        if quantity not in form.gives or self.count < 2 or self._elsewhere(quantity):
            return False
        if (quantity, self.column.type) == ("pwm", _STICKS):  # only a pass-through's, by a map
            return False
        x = self.column.x[form.gives[quantity]]
        if not x.size or not np.isfinite(x).any():
            return False
        if quantity in COMMANDS and self.single:  # one thruster's: `singles`
            return False
        if quantity == "height" and "position" in form.gives:
            return self.only_height
        if self.column.type.startswith(_VECTOR) and not self._named_vector(quantity):
            return False
        bare = self.single or self.column.type.startswith(_BARE)
        test: Callable[[np.ndarray], bool] | None = _TESTS.get(quantity)
        if test is not None and (bare or quantity not in COMMANDS) and not test(x):
            return False
        named = _NAMES.get(quantity)
        if not bare or named is None or named.search(self.topic):
            return True
        return quantity == "pwm" and are_pulses(x)


def are_pulses(x: np.ndarray) -> bool:
    """Whether numbers are pulse widths in µs; 0 is no pulse."""
    known = x[np.isfinite(x) & (x != 0)]
    return known.size > 0 and bool(np.all((known > _PULSES_US[0]) & (known < _PULSES_US[1])))


def are_normal(x: np.ndarray) -> bool:
    """Whether numbers are likely parts of full thrust, not N: within ±1 but not all zero."""
    known = np.abs(x[np.isfinite(x)])
    return known.size > 0 and 0 < float(known.max()) <= 1


def _is_turned(q: np.ndarray) -> bool:
    return bool(np.any(np.abs(np.linalg.norm(q, axis=0) - 1) < 0.1))


def _has_gravity(a: np.ndarray) -> bool:
    """Whether accelerations are specific forces: those without gravity are not."""
    sizes = np.linalg.norm(a[:, np.isfinite(a).all(axis=0)], axis=0)
    return sizes.size > 0 and abs(float(np.median(sizes)) - _GRAVITY) < _APART


_TESTS: dict[Quantity, Callable[[np.ndarray], bool]] = {
    "attitude": _is_turned,
    "acceleration": _has_gravity,
    "pwm": are_pulses,
    "wrench": lambda x: x.shape[0] == 6,
    "forces": lambda x: x.shape[0] > 1 and not are_pulses(x) and not are_normal(x),
    "rates": lambda x: bool(np.any(x != 0)),
}
