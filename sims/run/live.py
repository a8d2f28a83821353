"""A page that shows a run while it goes on, served on this computer.

The loop hands over what it logs; the page is made and sent in other threads, and what comes while
a browser is slow is skipped.
"""

import json
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, Diagram

from ...models.config.errors import UserError
from ...systems.mavlink.refusals import no_local
from ...systems.mavlink.safety import AGED, SafetyConfig
from ..scenarios.criteria import Outcome
from ..scenarios.scenario import Scenario
from .flight_log import ORDERS, Entry, Journal
from .log import without_horizontal
from .signals import PlanTap

_PAGE = Path(__file__).with_name("live.html")
_PERIOD = 0.2  # s between the states that are taken in
_FULL = 4.2 / 3.3 - 1  # a full lithium cell above one at the least voltage, as a share of that
_FORESEEN = ("goal", "duration", "finished")
"""Ends of a run that are not shown as an alarm."""


class LivePage:
    """The newest state of a run, and the server that sends it.

    Attributes:
        address: of the page.
    """

    def __init__(self, where: str):
        """Listen at a PORT of this computer, or at HOST:PORT; port 0 takes a free one.

        Raises:
            UserError: that is no port, or it is taken, or the host is not this computer.
        """
        host, _, port = where.rpartition(":")
        if not port.isdecimal() or int(port) > 65535:
            raise UserError(f"--live {where}: give a port of 0 to 65535, or HOST:PORT")
        self._state: dict[str, Any] = {"reason": "", "said": []}
        self._seen = -math.inf
        page = self

        class Handler(BaseHTTPRequestHandler):
            timeout = 5.0  # s: a browser that stops reading is left

            def do_GET(self) -> None:
                page._answer(self)

            def log_message(self, format: str, *args: Any) -> None:
                """Nothing on the terminal."""

        try:
            self._server = ThreadingHTTPServer((host or "127.0.0.1", int(port)), Handler)
        except (OSError, UnicodeError) as error:
            if no_local(error):
                raise UserError(
                    f"--live {where}: {host} is no address of this computer; give {port}, or "
                    f"0.0.0.0:{port} to show the page to other computers"
                ) from error
            raise UserError(
                f"--live {where}: can't listen there ({error}); give another port, or 0 "
                "for a free one"
            ) from error
        self._server.daemon_threads = True
        self.address = f"http://{host or '127.0.0.1'}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True
        )

    def __enter__(self) -> "LivePage":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def begin(self, scenario: Scenario) -> None:
        """Show where the scenario takes place."""
        station, link = scenario.station, scenario.vehicle_link
        self._put(
            scenario=scenario.name,
            vehicle=station.vehicle,
            where=link.connection if link else "simulation",
            start=station.start.position,
            size=station.load_vehicle().size,
            obstacles=[[p.x, p.y, p.diameter / 2, p.name] for p in station.obstacles],
            goal=None if scenario.goal is None else scenario.goal.tolist(),
            fence=link.safety.fence if link and scenario.positioned else None,
            sensors=["imu", *station.sensing.fused],
            duration=scenario.duration,
        )

    def say(self, text: str) -> None:
        """Show a sentence on what is done."""
        self._put(said=[*self._state["said"], text][-40:])

    def show(self, t: float, seen: Callable[[], Mapping[str, Any]]) -> None:
        """Take in what is seen at time t (s), unless the state before is too young; never waits."""
        now = time.monotonic()
        if now - self._seen >= _PERIOD:
            self._seen = now
            self._put(**{"t": t, **seen()})

    def end(self, outcome: Outcome) -> None:
        """Show why the run has ended."""
        self._put(reason=outcome.sentence, ended=True, good=outcome.reason in _FORESEEN)

    def _put(self, **new: Any) -> None:
        self._state = {**self._state, **new}  # one assignment: a reader has the old or the new one

    def _answer(self, request: BaseHTTPRequestHandler) -> None:
        name = request.path.partition("?")[0]
        if name == "/":
            kind, body = "text/html; charset=utf-8", _PAGE.read_bytes()
        elif name == "/state.json":
            kind, body = "application/json", json.dumps(_plain(self._state)).encode()
        else:
            request.send_error(HTTPStatus.NOT_FOUND)
            return
        try:
            request.send_response(HTTPStatus.OK)
            request.send_header("Content-Type", kind)
            request.send_header("Content-Length", str(len(body)))
            request.send_header("Cache-Control", "no-store")
            request.end_headers()
            request.wfile.write(body)
        except OSError:
            request.close_connection = True  # the browser has gone


@contextmanager
def live_page(
    where: str | None, scenario: Scenario, say: Callable[[str], None]
) -> Iterator[LivePage | None]:
    """Serve a page of a scenario where an option says; nothing without one."""
    if where is None:
        yield None
        return
    with LivePage(where) as page:
        page.begin(scenario)
        say(f"live page at {page.address}")
        yield page


def guard_rows(
    safety: SafetyConfig, entry: Entry, X_WB: np.ndarray, start: tuple[float, ...]
) -> list[dict[str, Any]]:
    """Name, value and limits of the guards that have such, from an entry of the journal."""
    rows = [
        {"name": name, "value": entry.ages[age], "limit": f"{getattr(safety, field):g} s",
         "share": entry.ages[age] / getattr(safety, field)}
        for name, (age, field, _) in AGED.items()
        if age in entry.ages and getattr(safety, field) > 0
    ]  # fmt: skip
    depth, low, high = -float(X_WB[6]), safety.min_depth, safety.max_depth
    middle, half = (low + high) / 2, (high - low) / 2
    rows.append(
        {"name": "depth_limits", "value": depth, "limit": f"{low:g} to {high:g} m",
         "share": abs(depth - middle) / half}
    )  # fmt: skip
    for axis, name in enumerate("xy"):
        away, side = abs(float(X_WB[4 + axis]) - start[axis]), safety.fence[axis]
        if math.isnan(away):  # off
            continue
        rows.append({"name": f"fence {name}", "value": away, "limit": f"{side:g} m",
                     "share": away / side})  # fmt: skip
    if safety.min_voltage > 0:
        rows.append(
            {"name": "battery", "value": entry.voltage, "limit": f"{safety.min_voltage:g} V",
             "share": 1 - (entry.voltage / safety.min_voltage - 1) / _FULL}
        )  # fmt: skip
    return rows


def flight_view(
    scenario: Scenario,
    journal: Journal,
    tap: PlanTap,
    t: float,
    seen: list[np.ndarray],
    words: str,
) -> dict[str, Any]:
    """The row of a flight's log at time t (s); `seen` are pose, twist and health."""
    if not scenario.positioned:
        (X,), (V,), _ = without_horizontal(seen[0][None], seen[1][None])
        seen = [X, V, *seen[2:]]
    view, link = _estimate_view(tap, seen, words), scenario.vehicle_link
    entry = journal.before(t)
    if entry is None or link is None:
        return view | {"F_Bo_B": np.zeros(6), "order": "", "tripped": ""}
    return view | {
        "F_Bo_B": entry.F_Bo_B,
        "pwm": entry.shown,
        "voltage": entry.voltage,
        **journal.vehicle(),
        "order": ORDERS[entry.order],
        "tripped": journal.tripped,
        "reason": journal.reason,
        "guards": guard_rows(link.safety, entry, seen[0], scenario.station.start.position),
    }


def simulation_view(diagram: Diagram, context: Context, tap: PlanTap, words: str) -> dict[str, Any]:
    """The newest row of a simulation's log; pose and twist are the estimate."""
    times, seen = zip(
        *(_find_log(diagram, name, context).newest() for name in ("X_WB", "V_WB_B", "health")),
        strict=True,
    )
    F = _find_log(diagram, "F_acting", context).data()[:, -1].copy()
    return _estimate_view(tap, list(seen), words) | {"F_Bo_B": F, "t": times[0]}


def _find_log(diagram: Diagram, name: str, context: Context) -> Any:
    """The rows of a closed loop's log."""
    log: Any = diagram.GetSubsystemByName(f"log_{name}")
    return log.FindLog(context)


def _estimate_view(tap: PlanTap, seen: list[np.ndarray], words: str) -> dict[str, Any]:
    found = dict(zip(("X_WB", "V_WB_B", "health"), seen, strict=True))
    return found | {"plan": _newest_plan(tap), "words": words}


def _newest_plan(tap: PlanTap) -> np.ndarray | None:
    """Positions of the newest plan that a tap has kept, which the log gets."""
    if tap.source is None or not tap.kept or not tap.kept[-1]["valid"]:
        return None
    stop = 1 + 13 * (tap.source.layout.horizon + 1)
    return tap.kept[-1]["plan"][1:stop].reshape(-1, 13)[:, 4:7]


def _plain(value: Any) -> Any:
    """As JSON, which has no NaN: null."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | tuple | list):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
