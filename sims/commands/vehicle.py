"""`spinndrift vehicle`: a simulated vehicle behind a MAVLink server."""

import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import FlagCreatePairsOff, Positional, arg

from ...models.config.checks import SECONDS, SEED, Within
from ...models.files.interrupts import interrupts_held
from ..progress import console, tell_code

_SPEED = Within(0.01, 20.0)


@dataclass(frozen=True)
class Vehicle:
    """Serve a scenario's vehicle over MAVLink: its plant, sensors and an autopilot like ArduSub.

    SCENARIO is the path of a YAML file, or the name of a shipped scenario; its station is the
    vehicle and its water, its controller takes no part. The autopilot behaves as ArduSub 4.5 on the
    messages that matter for control: parameters, modes MANUAL, STABILIZE, ALT_HOLD and others,
    arming, MANUAL_CONTROL, overrides, pass-through, motor test, failsafes, streams. Ground stations
    and companion programs connect as to a vehicle.

    Faults of the links, a leak, reboots and parameters are settings of the scenario's block
    vehicle_server. With --out a folder is written: scenario.yaml and truth.nc, a Recording of the
    true motion. Ends after --duration or at Ctrl-C.
    """

    EXAMPLES: ClassVar = (
        "spinndrift vehicle pylon_crossing_calm --connection tcpin:127.0.0.1:5760",
        "spinndrift vehicle station_keeping_harbour --connection udpout:127.0.0.1:14550 "
        "--out runs/served",
        "spinndrift vehicle station_keeping_calm --scenario-text "
        "'vehicle_server: {faults: {loss: 0.01, jitter: 0.03}}'",
    )

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    """Name of a shipped scenario, or a YAML file."""
    connection: tuple[str, ...] = ("udpout:127.0.0.1:14550", "tcpin:127.0.0.1:5760")
    """Where to serve: udpout:HOST:PORT sends to a ground station that listens, udpin:HOST:PORT
    answers whoever sends, tcpin:HOST:PORT takes one client at a time; port 0 takes a free one."""
    seed: Annotated[int | None, SEED] = None
    """Seed of everything random; by default that of the scenario."""
    scenario_text: str = ""
    """YAML that overrides the scenario."""
    speed: Annotated[float, _SPEED] = 1.0
    """Simulated time per wall time."""
    duration: Annotated[float | None, SECONDS] = None
    """Simulated time after which to end (s); by default never."""
    out: Path | None = None
    """Folder to write, which must not exist yet; nothing is written by default."""
    quiet: Annotated[bool, FlagCreatePairsOff, arg(help="Print nothing.")] = False

    def run(self) -> None:
        """Serve, then write."""
        with interrupts_held():
            from ...models.files.owned import run_folder
            from ..scenarios.scenario import load_scenario
            from ..vehicle.server import Server, open_all
            from ..vehicle.simulation import Simulation
            from ..vehicle.write import VEHICLE, write_vehicle

        scenario = load_scenario(self.scenario, self.scenario_text)
        tell_code(self.scenario, scenario.code)
        scenario = scenario.with_changes(seed=self.seed)
        with ExitStack() as held, _stopped() as stop:
            out = held.enter_context(run_folder(self.out, VEHICLE, new=True)) if self.out else None
            transports = open_all(self.connection)
            for transport in transports:
                held.callback(transport.close)
            simulation = Simulation(scenario, len(transports))
            server = Server(simulation, transports, scenario.seed, self.speed)
            for text, transport in zip(self.connection, transports, strict=True):
                self._say(f"serving {_where(text, transport.port)}")
            server.run(stop, self.duration)
            if out is not None:
                write_vehicle(simulation, scenario, out)
                self._say(f"wrote {out}")
            if server.behind > 0:
                self._say(f"{server.behind:.1f} s behind the clock in all: this machine is busy")

    def _say(self, text: str) -> None:
        if not self.quiet:
            console().print(text, markup=False, soft_wrap=True)


def _where(connection: str, port: int) -> str:
    """A connection with the port that it took."""
    return f"{connection.rpartition(':')[0]}:{port}" if port else connection


@contextmanager
def _stopped() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C and SIGTERM set, in the main thread."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    former = {
        number: signal.signal(number, lambda *_: event.set())
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield event
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
