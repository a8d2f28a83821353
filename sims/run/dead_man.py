"""The dead-man key: any key of the terminal, pressed again and again while all is well."""

import os
import select
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ...models.config.errors import UserError

_WAIT = 0.1  # s


@contextmanager
def dead_man_key() -> Iterator[Callable[[], float]]:
    """Yield the time since a key was pressed, or since the block began (s).

    Raises:
        UserError: there is no terminal.
    """
    if not sys.stdin.isatty():
        raise UserError(
            "vehicle_link.safety.dead_man: there is no terminal whose keys could be pressed; run "
            "it in one, or give dead_man: 0"
        )
    import termios  # not on every system
    import tty

    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    pressed, ended = [time.monotonic()], threading.Event()

    def watch() -> None:
        while not ended.is_set():
            if select.select([descriptor], [], [], _WAIT)[0] and os.read(descriptor, 64):
                pressed[0] = time.monotonic()

    tty.setcbreak(descriptor)
    thread = threading.Thread(target=watch, name="dead man", daemon=True)
    thread.start()
    try:
        yield lambda: time.monotonic() - pressed[0]
    finally:
        ended.set()
        thread.join()
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
