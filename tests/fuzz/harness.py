"""One mutated input: made from its number, read, and judged."""

import re
import signal
import time
import traceback
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from spinndrift.models.config.errors import UserError

from .mutate import Rng

FOREIGN = re.compile(
    r"allow_pickle|unsafe|<class |Traceback|object at 0x|NoneType|ndarray|site-packages|errno"
)
"""What no sentence for a user says: names of Python's types, another library's advice."""

_PLACE = re.compile(r"(--[\w-]+|/\S*)[: ]|vehicle `")
"""How a refusal begins: with the option, the file or the vehicle that is at fault."""


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        name: as options and folders have it.
        spoil: writes a spoiled input into a folder; returns the path to read.
        read: reads it as the commands do.
        refuses: whether some inputs are refused; what is on a link is not.
    """

    name: str
    spoil: Callable[[Rng, Path], Path]
    read: Callable[[Path], Any]
    refuses: bool = True


@dataclass(frozen=True)
class Verdict:
    """What became of one input: `read`, `refused`, or what went wrong and where."""

    fate: str
    seconds: float
    told: str = ""

    @property
    def sound(self) -> bool:
        """Whether the input was read, or refused in words."""
        return self.fate in ("read", "refused")


class TooSlow(BaseException):
    """The time limit of one input; no reader catches it."""


def rng_of(kind: str, number: int) -> Rng:
    """The generator that makes input `number` of a kind."""
    return np.random.default_rng([zlib.crc32(kind.encode()), number])


def judge(kind: Kind, number: int, folder: Path, limit: float = 20.0) -> Verdict:
    """Make one input, read it within `limit` (s), and say what became of it."""
    path = kind.spoil(rng_of(kind.name, number), folder)
    began = time.perf_counter()
    try:
        with _limited(limit):
            kind.read(path)
        fate, told = "read", ""
    except UserError as error:
        fate, told = "refused", str(error)
        if trouble := _trouble(told, path):
            fate, told = trouble, told + "\n" + traceback.format_exc()
    except TooSlow:
        fate, told = f"longer than {limit:g} s", traceback.format_exc()
    except Exception as error:  # noqa: BLE001 - whatever it is, it is a find
        fate, told = _signature(error), traceback.format_exc()
    return Verdict(fate, time.perf_counter() - began, told)


def _trouble(told: str, path: Path) -> str:
    """What is wrong with the words of a refusal; empty if nothing."""
    own = told.replace(str(path), "")
    if found := FOREIGN.search(own):
        return f"words: {found[0]}"
    if path.name not in told and not _PLACE.match(told):
        return "words: no file named"
    if len(own) > 6000:
        return "words: too many"
    return ""


def _signature(error: BaseException) -> str:
    """Kind of an exception, and the innermost line of this package that it passed."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if "/spinndrift/" in f.filename and "/tests/" not in f.filename]
    last = own[-1] if own else frames[-1]
    place = "/".join(last.filename.rsplit("/spinndrift/", 1)[-1].rsplit("/", 2)[-2:])
    return f"{type(error).__name__} at {place}:{last.lineno}"


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    def stop(number: int, frame: FrameType | None) -> None:
        raise TooSlow

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
