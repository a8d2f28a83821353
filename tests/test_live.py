"""The live page shows what is logged, to whoever asks, and nobody can make the loop wait."""

import json
import re
import socket
import time
import urllib.error
import urllib.request
from typing import Any

import numpy as np
import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.sims import cli
from spinndrift.sims.run.flight_log import Entry
from spinndrift.sims.run.live import LivePage, guard_rows
from spinndrift.sims.run.loop import simulate
from spinndrift.sims.scenarios.criteria import Outcome
from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.systems.mavlink.safety import SafetyConfig


def fetched(page: LivePage, name: str = "") -> str:
    with urllib.request.urlopen(page.address + name, timeout=10.0) as answer:
        return answer.read().decode()


def test_the_page_needs_nothing_from_elsewhere_and_its_state_is_json():
    with LivePage("0") as page:
        assert page.address.startswith("http://127.0.0.1:")
        text = fetched(page)
        assert "state.json" in text
        linked = re.findall(r"(?:src|href|import|url)\s*[=(]", text)
        assert not linked, "all is in the page"
        page.begin(load_scenario("pylon_crossing_vehicle"))
        page.show(1.5, lambda: {"X_WB": np.array([1.0, 0, 0, 0, np.nan, 2, -3])})
        page.end(Outcome("guard", 1.6, "Stopped at 1.6 s: the vehicle was not heard."))
        state = json.loads(fetched(page, "state.json"))
        assert state["X_WB"] == [1, 0, 0, 0, None, 2, -3]
        assert (state["t"], state["fence"], len(state["obstacles"])) == (1.5, [7, 5], 3)
        assert state["reason"] == "Stopped at 1.6 s: the vehicle was not heard."
        assert (state["ended"], state["good"]) == (True, False)
        with pytest.raises(urllib.error.HTTPError, match="404"):
            fetched(page, "../../etc/passwd")


def test_frames_are_dropped_and_slow_browsers_do_not_matter():
    looked = []
    with LivePage("0") as page:
        port = int(page.address.rstrip("/").rpartition(":")[2])
        stalled = [socket.create_connection(("127.0.0.1", port)) for _ in range(20)]
        for each in stalled:
            each.sendall(b"GET /state.json HTTP/1.1\r\n")  # and no end
        spent = []
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            begun = time.monotonic()
            page.show(begun, lambda: looked.append(1) or {"X_WB": np.zeros(7)})
            spent.append(time.monotonic() - begun)
        assert 1 <= len(looked) <= 4
        assert np.median(spent) < 1e-3
        assert json.loads(fetched(page, "state.json"))["X_WB"] == [0] * 7
        for each in stalled:
            each.close()


def test_guards_show_how_much_of_their_limits_is_used():
    safety = SafetyConfig(max_depth=4.0, min_depth=0.0, fence=(10.0, 5.0), silence=2.0)
    six, eight = np.zeros(6), np.zeros(8)
    ages = {"vehicle": 0.5, "depth": np.inf, "loop": 0.0}
    entry = Entry(1.0, 0, six, eight, eight, 14.0, 0.5, ages)
    X = np.array([1.0, 0, 0, 0, 4.0, 1.0, -3.0])
    rows = {row["name"]: row for row in guard_rows(safety, entry, X, (0.0, 2.0, 0.0))}
    assert rows["silence"]["share"] == pytest.approx(0.25)
    assert rows["depth"]["share"] == np.inf
    assert rows["depth_limits"]["share"] == pytest.approx(0.5)
    assert rows["fence x"]["share"] == pytest.approx(0.4)
    assert rows["fence y"]["share"] == pytest.approx(0.2)
    assert rows["battery"]["share"] == pytest.approx((16.8 - 14.0) / (16.8 - 13.2))
    assert "dead_man" not in rows, "there is none"


@pytest.mark.parametrize("where", ["x", "70000", "127.0.0.1:", "-1"])
def test_no_port_is_told(where: str):
    with pytest.raises(UserError, match=f"--live {where}: give a port"):
        LivePage(where)


@pytest.mark.parametrize("host", ["192.0.2.1", "a..b"])
def test_a_host_that_is_not_this_computer_is_told(host: str):
    words = f"--live {host}:7890: {host} is no address of this computer; give 7890, or 0.0.0.0"
    with pytest.raises(UserError, match=re.escape(words)):
        LivePage(f"{host}:7890")


def test_a_host_without_a_port_is_told_the_form():
    for words in ("run station_keeping_calm --live localhost", "run a.yaml --live b --quiet"):
        word = words.split()[3]
        with pytest.raises(UserError, match=f"^--live {word}: give PORT or HOST:PORT; see"):
            cli._parsed(cli._with_port(words.split()))
    with pytest.raises(UserError, match="Unrecognized options: b"):
        cli._parsed(cli._with_port(["run", "a.yaml", "b", "--live"]))


def test_a_taken_port_is_told():
    with LivePage("0") as page:
        port = page.address.rstrip("/").rpartition(":")[2]
        with pytest.raises(UserError, match=f"--live {port}: can't listen there"):
            LivePage(port)


@pytest.mark.parametrize(
    ("words", "where"),
    [
        ("run --live station_keeping_calm", "7890"),
        ("run station_keeping_calm --live", "7890"),
        ("collect station_keeping_calm --live 0 --quiet", "0"),
        ("run station_keeping_calm --live 0.0.0.0:80", "0.0.0.0:80"),
        ("run station_keeping_calm", None),
    ],
)
def test_the_option_may_leave_its_port_out(words: str, where: str | None):
    command: Any = cli._parsed(cli._with_port(words.split()))
    assert command.live == where
    assert command.scenario == "station_keeping_calm"


@pytest.mark.slow
def test_a_simulation_shows_its_log_in_real_time(monkeypatch: pytest.MonkeyPatch):
    with LivePage("0") as page:
        shown, show = [], page.show

        def watched(t, seen):
            show(t, lambda: shown.append(seen()) or shown[-1])

        monkeypatch.setattr(page, "show", watched)
        run = simulate(load_scenario("station_keeping_calm", "duration: 1.0"), live=page)
    log = run.log
    assert 3 <= len(shown) <= 6, "five a second, in real time"
    for seen in shown:
        n = round(seen["t"] / log.dt)
        np.testing.assert_array_equal(seen["X_WB"], log["X_WB_estimate"][n])
        np.testing.assert_array_equal(seen["health"], log["health"][n])
