"""Thrusters with a topic each: which topics, in which order, and what their numbers are."""

import re
from collections.abc import Iterable, Sequence

import numpy as np

from .messages import Quantity
from .seen import Seen, are_normal, are_pulses

NUMBERED = re.compile(r"(?:thrust|motor|propeller|servo|esc)\D*(\d+)", re.I)
"""In the name of a topic that drives one thruster."""
_FORCE = re.compile(r"thrust|force|effort", re.I)
_SPEED = re.compile(r"input|rpm|vel|speed|rate|omega|rotor|state|temp|current|volt|power", re.I)
"""After the number: what is a force, and what is none. `input` is a rotor's speed in the UUV
simulator, whose `thrust` is the force."""


def singles(
    seen: Sequence[Seen], topics: Iterable[str]
) -> tuple[Quantity, bool, list[tuple[int, Seen]]]:
    """What drives the thrusters, one topic each: the quantity, whether its name or size says so,
    and thruster (from 1) and topic.

    Topics whose names differ in the number alone belong together. Among several such groups forces
    by name come first, then pulses, then unnamed numbers. Numbers within ±1 throughout are parts of
    full thrust, not N, and are left to the user. `topics` are all of the bag, with messages or not:
    a thruster without any keeps its number.
    """
    groups: dict[tuple[str, str], dict[int, Seen]] = {}
    for one in seen:
        if one.single and (key := _key(one.topic)) is not None:
            groups.setdefault((key[0], key[2]), {})[key[1]] = one
    usable = {
        key: group
        for key, group in groups.items()
        if len(group) > 1 and _rank(key, group) is not None
    }
    if not usable:
        return "forces", False, []
    best = min(usable, key=lambda key: (_rank(key, usable[key]), -len(usable[key]), key))
    group = usable[best]
    numbers = [key[1] for t in topics if (key := _key(t)) and (key[0], key[2]) == best]
    first = min(numbers)
    rank = _rank(best, group)
    quantity: Quantity = "pwm" if rank == 1 else "forces"
    return quantity, rank != 2, [(n - first + 1, one) for n, one in sorted(group.items())]


def _key(topic: str) -> tuple[str, int, str] | None:
    """The name before the number, the number, and the name after it."""
    match = NUMBERED.search(topic)
    if match is None or len(match[1]) > 3:
        return None
    return topic[: match.start(1)], int(match[1]), topic[match.end(1) :]


def _rank(key: tuple[str, str], group: dict[int, Seen]) -> int | None:
    """0 for forces by name, 1 for pulses, 2 for other numbers; None if they are no commands."""
    numbers = np.concatenate([one.column.x.ravel() for one in group.values()])
    if all(are_pulses(one.column.x) for one in group.values()):
        return 1
    if are_normal(numbers):
        return None
    if _FORCE.search(key[1]):
        return 0
    return None if _SPEED.search(key[1]) else 2
