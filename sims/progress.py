"""Progress on the terminal: a bar with an estimate, silent for work of under two seconds."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

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


class Update(Protocol):
    """Called with the finished fraction in [0, 1] and a short remark."""

    def __call__(self, fraction: float, remark: str = "", /) -> None: ...


_SHOW_AFTER = 2.0  # s


def console() -> Console:
    """The console for progress and summaries: standard error, so that output can be piped."""
    return Console(file=sys.stderr, highlight=False)


@contextmanager
def progress_bar(what: str, shown: Console | None = None) -> Iterator[Update]:
    """Yield a function that moves a bar labelled `what`; the bar appears after two seconds.

    Without a terminal, one line is printed each ten per cent instead, so that logs stay short.
    """
    out = console() if shown is None else shown
    started = time.monotonic()
    bar = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[remark]}"),
        console=out,
        transient=False,
    )
    task = bar.add_task(what, total=1.0, remark="")
    state = {"running": False, "tenth": 0}

    def update(fraction: float, remark: str = "", /) -> None:
        fraction = min(max(fraction, 0.0), 1.0)
        elapsed = time.monotonic() - started
        if elapsed < _SHOW_AFTER:
            return
        if out.is_terminal:
            if not state["running"]:
                bar.start()
                state["running"] = True
            bar.update(task, completed=fraction, remark=remark)
        elif int(10 * fraction) > state["tenth"]:
            state["tenth"] = int(10 * fraction)
            left = elapsed * (1 - fraction) / fraction
            out.print(f"{what}: {fraction:.0%}, about {left:.0f} s left {remark}".rstrip())

    try:
        yield update
        if state["running"]:
            bar.update(task, completed=1.0)
    finally:
        if state["running"]:
            bar.stop()
