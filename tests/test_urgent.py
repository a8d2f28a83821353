"""The threads of loop and link go before others, where the system allows that."""

import os
import threading

import pytest

from spinndrift.systems.mavlink.urgent import urgent

pytestmark = pytest.mark.skipif(
    not hasattr(os, "sched_setscheduler"), reason="priorities of threads are Linux' alone"
)


def policy() -> int:
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK


def policy_of_a_thread() -> int:
    found: list[int] = []
    thread = threading.Thread(target=lambda: found.append(policy()))
    thread.start()
    thread.join()
    return found[0]


def test_only_the_calling_thread_is_urgent_and_only_inside():
    usual = policy()
    with urgent() as allowed:
        if not allowed:
            pytest.skip("a real-time priority is not allowed here")
        assert policy() == os.SCHED_FIFO
        assert policy_of_a_thread() == usual
        with urgent() as again:  # a loop that starts another one
            assert again
        assert policy() == os.SCHED_FIFO
    assert policy() == usual


def test_what_is_not_allowed_changes_nothing(monkeypatch):
    def refused(*_):
        raise PermissionError("Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refused)
    usual = policy()
    with urgent() as allowed:
        assert not allowed
        assert policy() == usual
    assert policy() == usual
