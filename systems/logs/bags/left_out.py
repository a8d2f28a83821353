"""Messages of a bag that are not taken: unreadable ones, and those of other frames."""

from collections.abc import Mapping

from ....models.recordings.checks.finding import Finding
from .bag import Column


def left_out(columns: Mapping[str, Column]) -> list[Finding]:
    """A finding for each topic of which messages were left out."""
    found = [
        Finding(
            "messages-unreadable",
            topic,
            f"{one.broken} of its messages can't be read and were left out",
            "copy the bag again",
        )
        for topic, one in columns.items()
        if one.broken
    ]
    return found + [
        Finding(
            "frame-changes",
            topic,
            f"{n} of its messages are in {frame}, not in {one.frame or one.child} as the others, "
            "and were left out",
            "record a topic of its own for each frame, or give the parts as bags of their own",
        )
        for topic, one in columns.items()
        for frame, n in one.others.items()
    ]
