"""Ctrl-C at a moment of one's choice.

All contexts act in the main thread alone, where Python delivers signals. If the caller ignores
Ctrl-C, as shells do for background jobs, it stays ignored.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_AGAIN = 0.05
"""Time (s) after which a lost Ctrl-C is repeated."""


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Defer Ctrl-C until the block ends: for steps that belong together, and for imports.

    Extension modules swallow an interrupt of their import or raise another error.
    """
    came: list[int] = []
    with _handled_by(lambda number, frame: came.append(number)):
        yield
    if came:
        signal.raise_signal(signal.SIGINT)


@contextmanager
def interrupts_kept() -> Iterator[None]:
    """Repeat a Ctrl-C that is lost in the block.

    Python ignores what is raised in callbacks of its garbage collector, of which JAX has one, and
    in finalizers: it only tells `sys.unraisablehook`.
    """
    before = sys.unraisablehook

    def hook(lost: "sys.UnraisableHookArgs") -> None:
        if issubclass(lost.exc_type, KeyboardInterrupt):
            threading.Timer(_AGAIN, os.kill, (os.getpid(), signal.SIGINT)).start()
        else:
            before(lost)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before


@contextmanager
def interrupt_noted() -> Iterator[threading.Event]:
    """Set the event yielded at the first Ctrl-C; a second one interrupts at once."""
    event, before = threading.Event(), signal.getsignal(signal.SIGINT)

    def note(number: int, frame: FrameType | None) -> None:
        event.set()
        signal.signal(signal.SIGINT, before)

    with _handled_by(note):
        yield event


@contextmanager
def end_noted() -> Iterator[threading.Event]:
    """Set the event yielded at Ctrl-C or SIGTERM, for what must be left in order.

    Further signals have no effect in the block.
    """
    event = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        event.set()

    with _handled_by(handle), _handled_by(handle, signal.SIGTERM):
        yield event


@contextmanager
def _handled_by(
    handler: Callable[[int, FrameType | None], object], number: int = signal.SIGINT
) -> Iterator[None]:
    before = signal.getsignal(number)
    main = threading.current_thread() is threading.main_thread()
    if not main or before is signal.SIG_IGN:
        yield
        return
    signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, signal.SIG_DFL if before is None else before)
