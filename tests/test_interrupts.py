"""Ctrl-C at a moment of one's choice."""

import ast
import gc
import signal
import sys
import threading
import time

import pytest

from helpers import module_files
from spinndrift.models.files.interrupts import interrupt_noted, interrupts_held, interrupts_kept


def press() -> None:
    signal.raise_signal(signal.SIGINT)


@pytest.mark.usefixtures("interruptible")
def test_a_held_interrupt_comes_after_the_block():
    done = []

    def work():
        with interrupts_held():
            press()
            done.append("block")
        done.append("after")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["block"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_that_a_callback_of_the_garbage_collector_loses_comes_again():
    presses = []

    def callback(phase: str, info: dict[str, int]) -> None:
        if not presses:
            presses.append(phase)
            press()  # as if it came while JAX's own callback runs

    def work() -> None:
        with interrupts_kept():
            gc.collect()
            presses.append("lost")  # else this line is not reached
            time.sleep(30.0)

    before, start = sys.unraisablehook, time.monotonic()
    gc.callbacks.append(callback)
    try:
        with pytest.raises(KeyboardInterrupt):
            work()
    finally:
        gc.callbacks.remove(callback)
    assert presses == ["start", "lost"]
    assert time.monotonic() - start < 15.0
    assert sys.unraisablehook is before


@pytest.mark.usefixtures("interruptible")
def test_the_first_interrupt_is_noted_and_the_second_interrupts():
    with interrupt_noted() as noted:
        assert not noted.is_set()
        press()
        assert noted.is_set()
        with pytest.raises(KeyboardInterrupt):
            press()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_that_the_caller_ignores_stays_ignored():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with interrupts_held(), interrupt_noted() as noted:
        press()
        assert not noted.is_set()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


@pytest.mark.usefixtures("interruptible")
def test_another_thread_changes_no_handler():
    found = []

    def work():
        with interrupts_held(), interrupt_noted():
            found.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [signal.default_int_handler]


def test_commands_import_with_interrupts_held():
    bare, held = [], 0
    for name, path in module_files("sims").items():
        if not name.startswith("spinndrift.sims.commands."):
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for function in (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)):
            inside = {
                one
                for block in ast.walk(function)
                if isinstance(block, ast.With)
                and ast.unparse(block.items[0].context_expr) == "interrupts_held()"
                for one in ast.walk(block)
            }
            held += len(inside) > 0
            bare += [
                f"{path.name}:{n.lineno}"
                for n in ast.walk(function)
                if isinstance(n, ast.Import | ast.ImportFrom) and n not in inside
            ]
    assert not bare
    assert held > 10
