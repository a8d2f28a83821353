"""One thing wrong with the data: a word, a place, what it is, and the remedy."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

import xarray as xr

from ...config.errors import UserError

Severity = Literal["severe", "cut", "note"]
_ATTRIBUTE = "findings"

WORDS: dict[str, tuple[Severity, str]] = {
    "not-a-submarine": ("severe", "the log is of another kind of vehicle or autopilot"),
    "frame-contradiction": ("severe", "the log's frame and its outputs contradict each other"),
    "frame-without-preset": ("severe", "no preset has the thrusters of the log's frame"),
    "motion-contradiction": ("severe", "streams fit each other only in another unit or sign"),
    "wrong-frame": ("severe", "axes of a topic contradict the motion"),
    "no-commands": ("severe", "no command ever differs from zero"),
    "no-answer": ("severe", "the commands are large, and the motion answers none of them"),
    "columns-exchanged": ("severe", "columns of commands stand in another order"),
    "axis-reversed": ("severe", "a command acts against its sign"),
    "thruster-reversed": ("severe", "a thruster pushes the other way"),
    "thruster-exchanged": ("severe", "two thrusters' columns are exchanged"),
    "heading-wrong": ("severe", "the recorded heading is off by more than 45°"),
    "plane-mirrored": ("severe", "x and y look exchanged, or one of them has the other sign"),
    "length-unit": ("severe", "positions and velocities are all in another unit of length"),
    "output-held": ("severe", "an output stands still while the motion says that it was driven"),
    "commands-held": ("cut", "all commands stand still while the motion shows varying forces"),
    "velocity-held": ("cut", "velocity stands still at a value while the vehicle moves"),
    "velocity-impossible": ("cut", "velocities that no underwater vehicle has"),
    "attitude-held": ("cut", "attitude or rates stand still while the rest of the motion goes on"),
    "pose-flicker": ("cut", "single poses lie elsewhere than those before and after"),
    "sensor-left-out": ("cut", "readings of a sensor can't be right"),
    "dead-reckoning": ("cut", "the aid of the horizontal estimate stopped"),
    "messages-unreadable": ("cut", "messages of a bag can't be read"),
    "frame-changes": ("cut", "messages of a topic are in another frame than the others"),
    "output-direction": ("cut", "a thruster's direction or output was changed in mid-log"),
    "clock-order": ("cut", "times of records of a log run back or jump"),
    "output-reversed": ("note", "an output is turned by SERVOn_REVERSED"),
    "thruster-dead": ("note", "a thruster has no effect"),
    "axis-silent": ("note", "an axis does not answer its command"),
    "heading-offset": ("note", "the recorded heading is off by 10° to 45°"),
    "length-doubtful": ("note", "another unit of length, or another vehicle than its file says"),
    "command-lag": ("note", "motion and commands are shifted in time"),
    "velocity-dead-zone": ("note", "a DVL shows zero, or its last value, at small speeds"),
    "velocity-lag": ("note", "velocities and poses are shifted in time"),
    "clock-rate": ("note", "two clocks run apart: the vehicle's and the logger's, or a topic's"),
    "clock-jitter": ("note", "stamps jitter about a steady rate, and steady times were taken"),
    "armed-unknown": ("note", "the log does not tell when the vehicle was armed"),
    "no-voltage": ("note", "battery messages without a voltage"),
    "unlisted-file": ("note", "a CSV file beside `recording.yaml` is not listed in it"),
}  # fmt: skip
"""Severity and meaning of every word. `severe` stops a command unless it is accepted by name; a
`cut` was left out or separated; a `note` changes nothing."""


@dataclass(frozen=True)
class Finding:
    """One finding; `place` names file, stretch, seconds or column.

    Raises:
        ValueError: the word is not in `WORDS`.
    """

    word: str
    place: str
    text: str
    remedy: str = ""

    def __post_init__(self) -> None:
        if self.word not in WORDS:
            raise ValueError(f"word: {self.word} is not in WORDS")

    @property
    def severity(self) -> Severity:
        """`severe`, `cut` or `note`."""
        return WORDS[self.word][0]

    def __str__(self) -> str:
        place = f" ({self.place})" if self.place else ""
        remedy = f" {self.remedy[0].upper()}{self.remedy[1:]}." if self.remedy else ""
        return f"{self.word}{place}: {self.text}.{remedy}"


def check_accepted(words: Iterable[str]) -> None:
    """Check the words of `--accept`.

    Raises:
        UserError: a word is not that of a severe finding.
    """
    severe = [word for word, (severity, _) in WORDS.items() if severity == "severe"]
    for word in words:
        if word not in severe:
            raise UserError(f"--accept {word}: give words of {', '.join(severe)}")


def enforce(source: str, findings: Sequence[Finding], accept: Iterable[str] = ()) -> None:
    """Stop at severe findings that are not accepted.

    Raises:
        UserError: with one line for each, naming `source`, place, remedy and word.
    """
    accepted = set(accept)
    severe = [f for f in findings if f.severity == "severe" and f.word not in accepted]
    if severe:
        told = [
            f"{f'{f.place}: ' if f.place else ''}{f.text}; {f.remedy}, or accept it with "
            f"--accept {f.word}"
            for f in severe
        ]
        raise UserError(f"{source}: " + "\n  also: ".join(told))


def findings_of(dataset: xr.Dataset) -> tuple[Finding, ...]:
    """The findings kept with a recording.

    Raises:
        UserError: they are damaged.
    """
    text = dataset.attrs.get(_ATTRIBUTE, "")
    try:
        rows = json.loads(text) if text else []
        return tuple(Finding(**{key: str(value) for key, value in row.items()}) for row in rows)
    except (TypeError, ValueError, AttributeError) as error:
        raise UserError(
            f"{_ATTRIBUTE}: damaged in this recording; import the source anew"
        ) from error


def with_findings(dataset: xr.Dataset, findings: Sequence[Finding]) -> xr.Dataset:
    """The dataset with these findings, and no others, kept as text."""
    rows = [asdict(f) for f in dict.fromkeys(findings)]
    return dataset.assign_attrs({_ATTRIBUTE: json.dumps(rows) if rows else ""})
