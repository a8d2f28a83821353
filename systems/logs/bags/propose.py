"""Proposes a topic map for a bag: by types, names, rates, and the first messages of each topic."""

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ....models.config.errors import UserError
from ....models.config.yaml_text import emit
from .adjust import adjusted
from .bag import LOOKED_AT, Bag, Column
from .depths import FIRST_BAROMETER, unit_of
from .messages import COMMANDS, NUMBERS, PRESSURE, Quantity
from .mounting import is_tf, read_mounts
from .seen import Seen
from .singles import NUMBERED, singles
from .topics import Topic, TopicMap, frames_of
from .vehicles import vehicles_of

_COMMANDS_LOOKED_AT = 5000
_SHOWN = 12
_ORDERED = re.compile(
    r"cmd|command|setpoint|desired|target|reference|goal|planned|waypoint|trajectory|initial|error"
    r"|teleop|joy",
    re.I,
)
"""Names of topics that say what shall be, not what is."""
_USUAL = re.compile(r"odom", re.I)
"""In the names of topics of the vehicle's own estimate (REP 105), before fixes of a GPS."""
_FASTER = 3.0
_GLOBAL = re.compile(r"/global_position/(local|raw/[^/]+)$")
"""mavros' topics of a GPS: without one they stand still, or hold the climb alone."""
_CAMERA = re.compile(r"camera|(^|/)cam\d|zed|realsense|optical", re.I)
_MOVING: tuple[Quantity, ...] = ("attitude", "position", "velocity")
_IN_NEWTON = "{}: its numbers are taken as forces of the thrusters in N."
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


def inspect(bag: Bag) -> list[Seen]:
    """The topics of known types that hold messages, with the first of each.

    Raises:
        UserError: the bag holds none.
    """
    known = [t for t in sorted(bag.topics) if t in bag.forms and bag.counts[t]]
    if lacking := bag.lacking():
        bag.note(f"{lacking[0].upper()}{lacking[1:]}.")
    found = []
    for topic in known:
        try:
            columns = _looked_at(bag, topic)
        except UserError:
            bag.note(
                f"{topic}: its messages can't be read as {bag.topics[topic]} (their definition is "
                "missing or another one); it was left out."
            )
            continue
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


def _looked_at(bag: Bag, topic: str) -> dict[str, Column]:
    """The first messages of a topic; more of commands and pressures, and if the vehicle rests."""
    kind = bag.topics[topic]
    if not (kind.endswith("MultiArray") or kind in (*NUMBERS, PRESSURE)):
        found = bag.read([topic], most=LOOKED_AT)
        resting = {q for q in _MOVING for one in found.values() if _rests(one, q)}
        if not resting or bag.counts[topic] <= LOOKED_AT:
            return found
    return bag.read([topic], most=_COMMANDS_LOOKED_AT)


def _rests(column: Column, quantity: Quantity) -> bool:
    return quantity in column.form.gives and Seen(column, 0.0, 0).still(quantity)


def listed(bag: Bag) -> str:
    """The topics of a bag, in words."""
    names = [f"{t} {kind} ×{bag.counts[t]}" for t, kind in sorted(bag.topics.items())]
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    lacking = f"; {bag.lacking()}" if bag.undefined else ""
    return ((", ".join(names[:_SHOWN]) + more) or "it has no topics") + lacking


def propose(bag: Bag) -> TopicMap:
    """The topic that gives each quantity, as far as the bag tells; its notes say what is not sure.

    Raises:
        UserError: the bag has no messages of known types.
    """
    seen = _of_one_vehicle(inspect(bag), bag)
    measured = [s for s in seen if not _ORDERED.search(s.topic)]
    moving = [s for s in measured if not _GLOBAL.search(s.topic)]
    chosen: dict[Quantity, Seen | None] = {"position": _best(moving, "position")}
    place = chosen["position"]
    alike = [s for s in measured if place is None or _space(s) == _space(place)]
    chosen["attitude"] = _first(alike, measured, "attitude")
    own = [s for s in (place, chosen["attitude"]) if s is not None]
    mine = [s for s in own if s in moving]
    chosen["velocity"] = _first(mine, moving, "velocity")
    chosen["rates"] = _rates(measured, own)
    chosen["acceleration"] = _best(own, "acceleration") or _best(measured, "acceleration")
    if chosen["acceleration"] is None:
        _say_accelerations(measured, bag)
    chosen["depth"] = _outside(measured) or _best(measured, "depth")
    for alone in _ALONE:
        chosen[alone] = _best(measured, alone)
    chosen["parameters"] = next((s for s in seen if "parameters" in s.column.form.gives), None)
    command, each = _driving(seen, bag)
    chosen.update(command)
    gives: dict[str, list[Quantity]] = {}
    for quantity, one in chosen.items():
        if one is not None:
            gives.setdefault(one.topic, []).append(quantity)
    found = [_topic(s, gives[s.topic]) for s in seen if s.topic in gives]
    columns = {s.topic: s.column for s in seen}
    return adjusted(TopicMap((*found, *each)), columns, bag, read_mounts(bag))


def _of_one_vehicle(seen: Sequence[Seen], bag: Bag) -> Sequence[Seen]:
    """The topics of one vehicle, and those of none, if the bag holds several."""
    poses = [s.topic for s in seen if "position" in s.column.form.gives]
    driving = [
        s.topic
        for s in seen
        if set(COMMANDS) & s.column.form.gives.keys()
        and (not s.single or NUMBERED.search(s.topic) is not None)
    ]
    found = vehicles_of(poses, driving)
    if found is None:
        return seen
    first, *others = found.names
    bag.note(
        f"The bag holds several vehicles, and this is {first}; a topic map of each gives "
        f"{', '.join(others)}."
    )
    return [s for s in seen if found.among(s.topic, first)]


def _say_accelerations(measured: Sequence[Seen], bag: Bag) -> None:
    """Note of an accelerometer that is left out."""
    for one in measured:
        part = one.column.form.gives.get("acceleration")
        if part is not None and one.column.type.endswith("/Imu"):
            size = np.median(np.linalg.norm(np.nan_to_num(one.column.x[part]), axis=0))
            if size > 0:
                bag.note(
                    f"{one.topic}: its accelerations are of {size:.3g} m/s², without gravity or in "
                    "another unit, and were left out (an entry with `scale` in a topic map)."
                )


def _outside(measured: Sequence[Seen]) -> Seen | None:
    """The barometer under the greatest absolute pressure, but that of the hull last."""

    def rank(one: Seen) -> tuple[bool, bool, float]:
        unit = unit_of(one.column.x[0])
        greatest = float(np.nanmax(one.column.x)) * (1.0 if unit is None else unit[0])
        return unit is not None, not one.topic.endswith(FIRST_BAROMETER), greatest

    pressures = [s for s in measured if s.column.type == PRESSURE and s.has("depth")]
    return max(pressures, key=rank, default=None)


def _driving(seen: Sequence[Seen], bag: Bag) -> tuple[dict[Quantity, Seen | None], list[Topic]]:
    """What drives the vehicle: a topic by its quantity, or a topic of each thruster.

    The most direct one: pulses, forces of thrusters, a wrench; numbers without a name come last.
    """
    found = {quantity: _best(seen, quantity) for quantity in COMMANDS}
    alone, sure, each = singles(seen, bag.topics)
    last = "forces" if each and sure else "wrench"
    for quantity in COMMANDS[: COMMANDS.index(last) + 1]:
        one = found[quantity]
        if one is not None:
            if quantity == "forces" and one.column.type.startswith("std_msgs"):
                bag.note(_IN_NEWTON.format(one.topic))
            return {quantity: one}, []
    if each and alone == "forces" and not sure:
        bag.note(_IN_NEWTON.format(f"{each[0][1].topic} and the like"))
    return {}, [replace(_topic(s, [alone]), thruster=k) for k, s in each]


def _rates(measured: Sequence[Seen], own: Sequence[Seen]) -> Seen | None:
    """Rates of the estimate, or of a much faster gyro, as from telemetry."""
    mine = next((s for s in reversed(own) if s.has("rates")), None)
    gyro = _best([s for s in measured if s.column.type == "sensor_msgs/msg/Imu"], "rates")
    if mine is None:
        return gyro or _best(measured, "rates")
    return gyro if gyro is not None and gyro.rate > _FASTER * mine.rate else mine


def _first(some: Sequence[Seen], all_: Sequence[Seen], quantity: Quantity) -> Seen | None:
    """The best of some, unless there is none or its numbers never change and others' do."""
    one, other = _best(some, quantity), _best(all_, quantity)
    if one is None or (other is not None and one.still(quantity) > other.still(quantity)):
        return other
    return one


def _space(seen: Seen) -> str:
    return seen.topic.strip("/").split("/")[0]


def _best(seen: Sequence[Seen], quantity: Quantity) -> Seen | None:
    """The topic of the preferred type, of a usual name, with the highest rate.

    Before all, one whose numbers change; of instruments not that of a camera.
    """
    order = _FIRST.get(quantity, ())

    def rank(one: Seen) -> tuple[bool, bool, int, bool, int]:
        name = one.column.type.rsplit("/", 1)[-1]
        place = next((i for i, start in enumerate(order) if name.startswith(start)), len(order))
        unusual = quantity in ("position", "velocity") and _USUAL.search(one.topic) is None
        still = quantity in _MOVING and one.still(quantity)
        camera = quantity in _FRAMED and _CAMERA.search(one.topic) is not None
        return still, camera, place, unusual, -round(one.rate)

    return min((s for s in seen if s.has(quantity)), key=rank, default=None)


def _topic(seen: Seen, gives: Sequence[Quantity]) -> Topic:
    column = seen.column
    frame, expressed = frames_of(column.type, column.frame, column.child)
    return Topic(column.topic, tuple(gives), column.type, frame, expressed)


def written(bag: Bag, proposed: TopicMap) -> str:
    """A proposal as YAML, with the topics that are not used as comments."""
    used = {one.topic for one in proposed.topics}
    rest = [
        f"# {topic}: {kind}, {bag.counts[topic]} messages{_use(bag, topic)}"
        for topic, kind in sorted(bag.topics.items())
        if topic not in used
    ]
    head = f"# Topic map of {bag.path.name} (docs/recording.md)\n"
    head += "".join(f"# {' '.join(sentence.split())}\n" for sentence in bag.notes)
    tail = "# not used:\n" + "\n".join(rest) + "\n" if rest else ""
    return head + emit({"topics": [_told(one) for one in proposed.topics]}) + tail


def _use(bag: Bag, topic: str) -> str:
    """What a topic that gives no quantity may give."""
    if is_tf(bag.topics[topic]):
        return ", the mountings"
    form = bag.forms.get(topic)
    return ", not read" if form is None else f", may give {', '.join(form.gives)}"


def _told(one: Topic) -> dict[str, Any]:
    """The fields of a topic that matter for what it gives."""
    told: dict[str, Any] = {"topic": one.topic, "type": one.type, "gives": list(one.gives)}
    if _FRAMED & set(one.gives):
        told["frame"] = one.frame
    if {"velocity", "rates"} & set(one.gives):
        told["expressed"] = one.expressed
    for name in ("xyz", "rpy"):
        if (value := getattr(one, name)) is not None:
            told[name] = list(value)
    told |= {"scale": one.scale} if one.scale != 1.0 else {}
    told |= {"offset": one.offset} if one.offset else {}
    driven = {"thruster": one.thruster} if one.thruster else {}
    return {**told, "delay": one.delay, **driven}
