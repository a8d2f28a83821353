"""Progress: silent for short work, lines in a log, a bar on a terminal."""

import io
import time

import pytest
from rich.console import Console

from spinndrift.sims import progress
from spinndrift.sims.progress import progress_bar


@pytest.fixture
def soon(monkeypatch):
    monkeypatch.setattr(progress, "_SHOW_AFTER", 0.05)


def played(terminal, wait):
    out = io.StringIO()
    with progress_bar("work", Console(file=out, force_terminal=terminal, width=100)) as update:
        time.sleep(wait)
        for k in range(1, 101):
            update(k / 100, f"step {k}")
    return out.getvalue()


def test_short_work_is_silent():
    assert played(False, 0.0) == ""
    assert played(True, 0.0) == ""


def test_a_log_gets_one_line_each_ten_per_cent(soon):
    lines = played(False, 0.2).splitlines()
    assert len(lines) == 10
    assert "s left" in lines[4]
    assert "100%" in lines[-1]


def test_work_that_begins_again_counts_anew(soon):
    out = io.StringIO()
    with progress_bar("work", Console(file=out, width=100)) as update:
        time.sleep(0.2)
        for k in range(1, 101):
            update(k / 100)
        update(0.0, "once more")
        for k in range(1, 101):
            update(k / 100)
    lines = out.getvalue().splitlines()
    assert lines.index("work: once more") == 10
    assert len(lines) == 21


def test_what_starts_is_told_once_however_often_it_is_reported(soon):
    out = io.StringIO()
    with progress_bar("work", Console(file=out, width=100)) as update:
        time.sleep(0.2)
        for _ in range(5):
            update(0.0, "compiling")
        update(0.0, "warming up")
        update(0.5)
        update(0.0, "compiling")
    lines = out.getvalue().splitlines()
    assert [line for line in lines if "%" not in line] == [
        "work: compiling",
        "work: warming up",
        "work: compiling",
    ]


def test_what_started_before_the_first_line_is_told_with_it(soon):
    out = io.StringIO()
    with progress_bar("work", Console(file=out, width=100)) as update:
        update(0.0, "reading")
        update(0.0, "compiling")
        time.sleep(0.2)
        update(0.0, "compiling")
        update(0.5)
    assert [line for line in out.getvalue().splitlines() if "%" not in line] == ["work: compiling"]


def test_a_terminal_gets_a_bar(soon):
    told = played(True, 0.3)
    assert "work" in told
    assert "100%" in told


def test_an_error_inside_passes_through(soon):
    def stopped():
        with progress_bar("work", Console(file=io.StringIO())):
            time.sleep(0.1)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped()
