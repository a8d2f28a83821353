"""Proposes a topic map for a bag: by types, names, rates, and the first messages of each topic."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ....models.config.errors import UserError
from ....models.config.yaml_text import emit
from .bag import Bag, Column
from .messages import COMMANDS, FORMS, NUMBERS, PRESSURE, Quantity
from .topics import Topic, TopicMap, frames_of

_LOOKED_AT, _COMMANDS_LOOKED_AT = 200, 5000
_SHOWN = 12
_ORDERED = re.compile(r"cmd|command|setpoint|desired|target|reference|goal|planned", re.I)
"""Names of topics that say what shall be, not what is."""
_GRAVITY, _APART = 9.81, 5.0
_PULSES_US = (800.0, 2200.0)
_USUAL = re.compile(r"odom", re.I)
"""In the names of topics of the vehicle's own estimate (REP 105), before fixes of a GPS."""
_FASTER = 3.0
FIRST_BAROMETER = "/imu/static_pressure"
"""End of mavros' topic of SCALED_PRESSURE: on a BlueROV2 the barometer in the hull."""
_GLOBAL = re.compile(r"/global_position/(local|raw/[^/]+)$")
"""mavros' topics of a GPS: without one they stand still, or hold the climb alone."""
_NUMBERED = re.compile(r"(?:thrust|motor|propeller)\D*(\d+)", re.I)
"""In the name of a topic that drives one thruster."""
_STICKS = "mavros_msgs/msg/OverrideRCIn"
_NAMES: dict[Quantity, re.Pattern[str]] = {
    "depth": re.compile(r"depth", re.I),
    "height": re.compile(r"rel_alt|altitude|height", re.I),
    "voltage": re.compile(r"volt|battery", re.I),
    "pwm": re.compile(r"pwm|servo|rc/out|pulse|motor", re.I),
    "forces": re.compile(r"thrust|force|motor", re.I),
    "wrench": re.compile(r"wrench|tau|effort", re.I),
}
"""What a bare number or array is, by the name of its topic."""
_FRAMED = {"attitude", "position", "velocity", "rates", "acceleration", "wrench"}
"""Quantities with axes."""
_ALONE: tuple[Quantity, ...] = ("height", "voltage", "rc", "state", "aiding")
"""Quantities that depend on no other's topic."""
_FIRST: dict[Quantity, tuple[str, ...]] = {
    "position": ("Odometry", "PoseWithCovariance", "Pose"),
    "velocity": ("Odometry", "Twist"),
    "depth": ("FluidPressure", "Float"),
    "voltage": ("BatteryState", "Float"),
    "pwm": ("RCOut", "UInt16MultiArray"),
    "rc": ("RCIn", "OverrideRCIn", "ManualControl"),
}
"""Types in the order in which they are preferred."""


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

    def has(self, quantity: Quantity) -> bool:
        """Whether its messages may hold a quantity, and do."""
        form = FORMS[self.column.type]
        if quantity not in form.gives or self.count < 2:
            return False
        if (quantity, self.column.type) == ("pwm", _STICKS):  # only a pass-through's, by a map
            return False
        x = self.column.x[form.gives[quantity]]
        if not x.size or not np.isfinite(x).any():
            return False
        if quantity in COMMANDS and self.column.type in NUMBERS:  # one thruster's: `_singles`
            return False
        bare = self.column.type.startswith("std_msgs")
        test: Callable[[np.ndarray], bool] | None = _TESTS.get(quantity)
        if test is not None and (bare or quantity not in COMMANDS) and not test(x):
            return False
        named = _NAMES.get(quantity)
        if not bare or named is None or named.search(self.topic):
            return True
        return quantity == "pwm" and _are_pulses(x)


def _are_pulses(x: np.ndarray) -> bool:
    """Whether numbers are pulse widths in µs; 0 is no pulse."""
    known = x[np.isfinite(x) & (x != 0)]
    return known.size > 0 and bool(np.all((known > _PULSES_US[0]) & (known < _PULSES_US[1])))


def _are_normal(x: np.ndarray) -> bool:
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
    "pwm": _are_pulses,
    "wrench": lambda x: x.shape[0] == 6,
    "forces": lambda x: x.shape[0] > 1 and not _are_pulses(x) and not _are_normal(x),
    "rates": lambda x: bool(np.any(x != 0)),
}


def inspect(bag: Bag) -> list[Seen]:
    """The topics of known types that hold messages, with the first of each.

    Raises:
        UserError: the bag holds none.
    """
    known = [t for t, kind in sorted(bag.topics.items()) if kind in FORMS and bag.counts[t]]
    found = []
    for topic in known:
        try:
            array = bag.topics[topic].endswith("MultiArray") or bag.topics[topic] in NUMBERS
            columns = bag.read([topic], most=_COMMANDS_LOOKED_AT if array else _LOOKED_AT)
        except UserError:
            continue  # its messages can't be read, so it gives nothing
        for one in columns.values():
            spans = np.diff(np.sort(one.received if one.stamps is None else one.stamps)) * 1e-9
            step = float(np.median(spans)) if spans.size else 0.0
            found.append(Seen(one, 1 / step if step > 0 else 0.0, bag.counts[topic]))
    if not found:
        raise UserError(
            f"no topic with messages of a type that is read ({listed(bag)}); "
            "record odometry or Imu, and what drives the thrusters"
        )
    return found


def listed(bag: Bag) -> str:
    """The topics of a bag, in words."""
    names = [f"{t} {kind} ×{bag.counts[t]}" for t, kind in sorted(bag.topics.items())]
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return (", ".join(names[:_SHOWN]) + more) or "it has no topics"


def propose(bag: Bag) -> TopicMap:
    """The topic that gives each quantity, as far as the bag tells.

    Raises:
        UserError: the bag has no messages of known types.
    """
    seen = inspect(bag)
    measured = [s for s in seen if not _ORDERED.search(s.topic)]
    moving = [s for s in measured if not _GLOBAL.search(s.topic)]
    chosen: dict[Quantity, Seen | None] = {"position": _best(moving, "position")}
    place = chosen["position"]
    alike = [s for s in measured if place is None or _space(s) == _space(place)]
    chosen["attitude"] = _best(alike, "attitude") or _best(measured, "attitude")
    own = [s for s in (place, chosen["attitude"]) if s is not None]
    mine = [s for s in own if s in moving]
    chosen["velocity"] = _best(mine, "velocity") or _best(moving, "velocity")
    chosen["rates"] = _rates(measured, own)
    chosen["acceleration"] = _best(own, "acceleration") or _best(measured, "acceleration")
    pressures = [s for s in measured if s.column.type == PRESSURE and s.has("depth")]
    outside = max(
        pressures,
        key=lambda s: (not s.topic.endswith(FIRST_BAROMETER), float(np.nanmax(s.column.x))),
        default=None,
    )
    chosen["depth"] = outside or _best(measured, "depth")
    for alone in _ALONE:
        chosen[alone] = _best(measured, alone)
    commands = {quantity: _best(seen, quantity) for quantity in COMMANDS}
    first: Quantity | None = next((q for q in COMMANDS if commands[q] is not None), None)
    if first is not None:
        chosen[first] = commands[first]
    singles = _singles(seen) if first is None else []
    chosen["parameters"] = next(
        (s for s in seen if "parameters" in FORMS[s.column.type].gives), None
    )
    gives: dict[str, list[Quantity]] = {}
    for quantity, one in chosen.items():
        if one is not None:
            gives.setdefault(one.topic, []).append(quantity)
    found = [_topic(s, gives[s.topic]) for s in seen if s.topic in gives]
    pulses = all(_are_pulses(s.column.x) for _, s in singles)
    alone: Quantity = "pwm" if pulses else "forces"
    return TopicMap((*found, *(replace(_topic(s, [alone]), thruster=k) for k, s in singles)))


def _singles(seen: Sequence[Seen]) -> list[tuple[int, Seen]]:
    """Topics that drive one thruster each, by a number in their names; thrusters from 1.

    Numbers within ±1 throughout are parts of full thrust, not N, and are left to the user.
    """
    numbered = [
        (int(match[1]), s)
        for s in seen
        if s.column.type in NUMBERS and (match := _NUMBERED.search(s.topic))
    ]
    numbered.sort(key=lambda pair: pair[0])
    alike = len({number for number, _ in numbered}) == len(numbered) > 1
    if not alike or _are_normal(np.concatenate([s.column.x for _, s in numbered], axis=1)):
        return []
    return [(k, s) for k, (_, s) in enumerate(numbered, 1)]


def _rates(measured: Sequence[Seen], own: Sequence[Seen]) -> Seen | None:
    """Rates of the estimate, or of a much faster gyro, as from telemetry."""
    mine = next((s for s in reversed(own) if s.has("rates")), None)
    gyro = _best([s for s in measured if s.column.type == "sensor_msgs/msg/Imu"], "rates")
    if mine is None:
        return gyro or _best(measured, "rates")
    return gyro if gyro is not None and gyro.rate > _FASTER * mine.rate else mine


def _space(seen: Seen) -> str:
    return seen.topic.strip("/").split("/")[0]


def _best(seen: Sequence[Seen], quantity: Quantity) -> Seen | None:
    """The topic of the preferred type, of a usual name, with the highest rate."""
    order = _FIRST.get(quantity, ())

    def rank(one: Seen) -> tuple[int, bool, int]:
        name = one.column.type.rsplit("/", 1)[-1]
        place = next((i for i, start in enumerate(order) if name.startswith(start)), len(order))
        unusual = quantity in ("position", "velocity") and _USUAL.search(one.topic) is None
        return place, unusual, -round(one.rate)

    return min((s for s in seen if s.has(quantity)), key=rank, default=None)


def _topic(seen: Seen, gives: Sequence[Quantity]) -> Topic:
    column = seen.column
    frame, expressed = frames_of(column.type, column.frame, column.child)
    return Topic(column.topic, tuple(gives), column.type, frame, expressed)


def written(bag: Bag, proposed: TopicMap) -> str:
    """A proposal as YAML, with the topics that are not used as comments."""
    used = {one.topic for one in proposed.topics}
    rest = [
        f"# {topic}: {kind}, {bag.counts[topic]} messages"
        + (f", may give {', '.join(FORMS[kind].gives)}" if kind in FORMS else ", not read")
        for topic, kind in sorted(bag.topics.items())
        if topic not in used
    ]
    head = f"# Topic map of {bag.path.name} (docs/recording.md)\n"
    tail = "# not used:\n" + "\n".join(rest) + "\n" if rest else ""
    return head + emit({"topics": [_told(one) for one in proposed.topics]}) + tail


def _told(one: Topic) -> dict[str, Any]:
    """The fields of a topic that matter for what it gives."""
    told: dict[str, Any] = {"topic": one.topic, "type": one.type, "gives": list(one.gives)}
    if _FRAMED & set(one.gives):
        told["frame"] = one.frame
    if {"velocity", "rates"} & set(one.gives):
        told["expressed"] = one.expressed
    driven = {"thruster": one.thruster} if one.thruster else {}
    return {**told, "delay": one.delay, **driven}
