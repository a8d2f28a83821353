"""Threads that the computer runs before all others: of the loop, the link and the guard.

They need little time, but at once. On a busy computer a thread of usual priority may wait for a
second, and guards stop the vehicle before that.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_LEAST = 1  # already before every thread of usual priority


@contextmanager
def urgent() -> Iterator[bool]:
    """Run the calling thread with a real-time priority (SCHED_FIFO); yields whether it may.

    Linux allows it to root and to users with `ulimit -r` above 0. Threads and processes that are
    started inside have the usual priority.

    Example:
        >>> with urgent() as allowed:
        ...     print(type(allowed).__name__)
        bool
    """
    before = _take()
    try:
        yield before is not None
    finally:
        if before is not None:  # without a privilege, what is reset on a fork stays so
            policy, priority = before
            with suppress(OSError):
                os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, priority)


def _take() -> tuple[int, os.sched_param] | None:
    """Policy and priority that the thread had; None if it keeps them."""
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        given = os.sched_param(max(_LEAST, before[1].sched_priority))
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, given)
    except (OSError, AttributeError):  # not allowed, or not Linux
        return None
    return before
