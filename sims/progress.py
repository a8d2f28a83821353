"""Progress on the terminal: a bar with the remaining time, shown after two seconds."""

import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Protocol, runtime_checkable

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


@runtime_checkable
class Update(Protocol):
    """Called with the finished fraction in [0, 1] and a short remark."""

    def __call__(self, fraction: float, remark: str = "", /) -> None: ...


_SHOW_AFTER = 2.0  # s


def console() -> Console:
    """The console for progress and summaries: standard error, so that output can be piped."""
    return Console(file=sys.stderr, highlight=False)


def tell_code(scenario: str, code: Iterable[str]) -> None:
    """Print which user code a scenario runs, because a scenario file can name any code."""
    for part in code:
        console().print(f"{scenario} runs the code of {part}", markup=False, soft_wrap=True)


@contextmanager
def progress_bar(what: str, shown: Console | None = None) -> Iterator[Update]:
    """Yield a function that moves a bar labelled `what`; the bar appears after two seconds.

    Without a terminal, one line is printed for each ten per cent instead, to keep logs short.
    """
    out = console() if shown is None else shown
    watch = _Terminal(what, out) if out.is_terminal else _Lines(what, out)
    timer = threading.Timer(_SHOW_AFTER, watch.show)
    timer.daemon = True
    timer.start()
    try:
        yield watch.update
        watch.update(1.0)
    finally:
        timer.cancel()
        watch.close()


class _Terminal:
    """A bar that redraws itself, also while nothing is reported (during compilation, say)."""

    def __init__(self, what: str, out: Console):
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[remark]}"),
            console=out,
        )
        self._task = self._bar.add_task(what, total=1.0, remark="")
        self._lock = threading.Lock()
        self._open, self._started = True, False

    def show(self) -> None:
        with self._lock:
            if self._open:
                self._bar.start()
                self._started = True

    def update(self, fraction: float, remark: str = "", /) -> None:
        self._bar.update(self._task, completed=min(max(fraction, 0.0), 1.0), remark=remark)

    def close(self) -> None:
        with self._lock:
            self._open = False
            if self._started:
                self._bar.stop()


class _Lines:
    """A line for each ten per cent; the remaining time is extrapolated from the first report on."""

    def __init__(self, what: str, out: Console):
        self._what, self._out = what, out
        self._shown, self._tenth = False, 0
        self._first: tuple[float, float] | None = None
        self._starting = ""  # the remark printed since work started
        self._pending = ""  # the one to print once lines are shown

    def show(self) -> None:
        self._shown = True
        self._start(self._pending)

    def _start(self, remark: str) -> None:
        if remark and remark != self._starting:
            self._out.print(f"{self._what}: {remark}")
            self._starting = remark
        self._pending = ""

    def update(self, fraction: float, remark: str = "", /) -> None:
        fraction, now = min(max(fraction, 0.0), 1.0), time.monotonic()
        if fraction <= 0:  # work starts or restarts
            self._tenth, self._first = 0, None
            if self._shown:
                self._start(remark)
            else:
                self._pending = remark
            return
        self._starting = self._pending = ""
        if self._first is None:
            self._first = (now, fraction)
        if not self._shown or int(10 * fraction) <= self._tenth:
            return
        self._tenth = int(10 * fraction)
        since, at = self._first
        if fraction > at and fraction < 1:
            left = (now - since) * (1 - fraction) / (fraction - at)
            remark = f"about {left:.0f} s left {remark}"
        self._out.print(f"{self._what}: {fraction:.0%} {remark}".rstrip())

    def close(self) -> None:
        self._shown = False
