"""Every example runs as a script and does what it says."""

import re
import runpy

import pytest

from helpers import ROOT, load_example

pytestmark = pytest.mark.whole


def test_own_controller_holds_station_in_the_harbour(capsys):
    runpy.run_path(str(ROOT / "examples" / "own_controller.py"), run_name="__main__")
    out = capsys.readouterr().out
    found = re.search(r"largest error ([\d.]+) m, after 20 s ([\d.]+) m", out)
    assert found, out
    assert float(found[1]) < 0.5
    assert float(found[2]) < 0.3


def test_own_filter_steers_a_figure(capsys):
    """Without a filter's smoothing: a DVL of a few mm/s drifts by cm in half a figure."""
    off = load_example("own_filter").main(8.0)
    assert "after 8 s the estimate is" in capsys.readouterr().out
    assert 0 < off < 0.3


@pytest.mark.slow
def test_own_task_comes_into_its_circle_and_stays(capsys):
    """The radius is 0.5 m; from 1.5 m, slow as speed costs, it is inside well before the end."""
    distance = load_example("own_task").main(8.0)
    assert f"from 1.50 m to {distance:.2f} m" in capsys.readouterr().out
    assert distance < 0.5
