"""Which vehicles a bag holds: topics that differ in one part of their names alone."""

from collections.abc import Sequence
from dataclasses import dataclass

_Place = tuple[int, tuple[str, ...]]


@dataclass(frozen=True)
class Vehicles:
    """Names that stand at one place of the topics' names, one for each vehicle.

    Attributes:
        place: index of the part of a topic's name, and the parts before it.
        names: of the vehicles, sorted.
    """

    place: _Place
    names: tuple[str, ...]

    def among(self, topic: str, name: str) -> bool:
        """Whether a topic is of the named vehicle, or of none."""
        index, before = self.place
        parts = _parts(topic)
        if len(parts) <= index or parts[:index] != before:
            return True
        return parts[index] == name or parts[index] not in self.names


def vehicles_of(poses: Sequence[str], commands: Sequence[str]) -> Vehicles | None:
    """The vehicles, if several have the same topics of poses and the same of commands."""
    driven = _variants(commands)
    for place, names in _variants(poses).items():
        both = names & driven.get(place, set())
        if len(both) > 1:
            return Vehicles(place, tuple(sorted(both)))
    return None


def _parts(topic: str) -> tuple[str, ...]:
    return tuple(topic.strip("/").split("/"))


def _variants(topics: Sequence[str]) -> dict[_Place, set[str]]:
    """Names at each place that make the same topic but for this name."""
    alike: dict[tuple[_Place, tuple[str, ...]], set[str]] = {}
    for topic in topics:
        parts = _parts(topic)
        for i, name in enumerate(parts[:-1]):
            key = (i, parts[:i]), parts[i + 1 :]
            alike.setdefault(key, set()).add(name)
    found: dict[_Place, set[str]] = {}
    for (place, _), names in alike.items():
        if len(names) > 1:
            found.setdefault(place, set()).update(names)
    return found
