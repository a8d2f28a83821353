"""`spinndrift vehicle`: a simulated vehicle behind a MAVLink server."""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from ...models.config.checks import SECONDS, SEED, Within
from ...models.config.errors import UserError
from ...models.files.interrupts import end_noted, interrupts_held
from ..progress import console, tell_code

if TYPE_CHECKING:
    from ..scenarios.scenario import Scenario
    from ..vehicle.truth import TruthLog

_SPEED = Within(0.01, 20.0)
_CONNECTIONS = ("udpout:127.0.0.1:14550", "tcpin:127.0.0.1:5760")


@dataclass(frozen=True)
class Vehicle:
    """Serve a scenario's vehicle over MAVLink: its plant, sensors and an autopilot like ArduSub.

    SCENARIO is the path of a YAML file, or the name of a shipped scenario; its station is the
    vehicle and its water, its controller takes no part. The autopilot behaves as ArduSub 4.5 on the
    messages that matter for control: parameters, modes MANUAL, STABILIZE, ALT_HOLD and others,
    arming, MANUAL_CONTROL, overrides, pass-through, motor test, failsafes, streams. Ground stations
    and companion programs connect as to a vehicle.

    Faults of the links, a leak, reboots and parameters are settings of the scenario's block
    vehicle_server. With --backend ardupilot-json the plant is the physics of a real ArduSub, which
    is started with --model JSON:127.0.0.1 and sets the pace.

    With --out a folder is written: scenario.yaml and truth.nc, a Recording of the true motion, and,
    at the start, ArduSub's parameters for the vehicle, vehicle.parm. Ends after --duration or at
    Ctrl-C.
    """

    EXAMPLES: ClassVar = (
        "spinndrift vehicle pylon_crossing_calm --connection tcpin:127.0.0.1:5760",
        "spinndrift vehicle station_keeping_harbour --connection udpout:127.0.0.1:14550 "
        "--out runs/served",
        "spinndrift vehicle station_keeping_calm --scenario-text "
        "'vehicle_server: {faults: {loss: 0.01, jitter: 0.03}}'",
        "spinndrift vehicle station_keeping_calm --backend ardupilot-json",
    )

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    """Name of a shipped scenario, or a YAML file."""
    backend: Literal["mavlink", "ardupilot-json"] = "mavlink"
    """What is served: a vehicle to ground stations, or the physics of a real ArduSub."""
    connection: tuple[str, ...] = ()
    """Where to serve: udpout:HOST:PORT sends to a ground station that listens, udpin:HOST:PORT
    answers whoever sends, tcpin:HOST:PORT takes one client at a time, tcp:HOST:PORT connects to a
    router that listens, serial:DEVICE:BAUD takes a serial line; port 0 of udpin and tcpin takes a
    free one. By default udpout:127.0.0.1:14550 and tcpin:127.0.0.1:5760, for an ArduSub
    udpin:127.0.0.1:9002."""
    seed: Annotated[int | None, SEED] = None
    """Seed of everything random; by default that of the scenario."""
    scenario_text: str = ""
    """YAML that overrides the scenario."""
    speed: Annotated[float | None, _SPEED] = None
    """Simulated time per wall time, 1 by default; a real ArduSub has its own, --speedup."""
    duration: Annotated[float | None, SECONDS] = None
    """Simulated time after which to end (s); by default never."""
    out: Path | None = None
    """Folder to write, which must be new, empty or that of a call that was interrupted; nothing is
    written by default."""
    quiet: Annotated[bool, FlagCreatePairsOff, arg(help="Print nothing.")] = False

    def run(self) -> None:
        """Serve, then write."""
        with interrupts_held():
            from ...models.files.owned import run_folder
            from ..scenarios.scenario import load_scenario
            from ..vehicle.write import VEHICLE, write_vehicle

        scenario = load_scenario(self.scenario, self.scenario_text)
        tell_code(self.scenario, scenario.code)
        scenario = scenario.with_changes(seed=self.seed)
        serve = self._serve if self.backend == "mavlink" else self._fly
        with ExitStack() as held, end_noted() as stop:
            out = held.enter_context(run_folder(self.out, VEHICLE, new=True)) if self.out else None
            truth = serve(scenario, held, stop)
            if out is not None:
                write_vehicle(truth, scenario, out)
                self._say(f"wrote {out}")

    def _serve(self, scenario: "Scenario", held: ExitStack, stop: Event) -> "TruthLog":
        """Serve a simulated autopilot over MAVLink."""
        with interrupts_held():
            from ..vehicle.server import Server, open_all
            from ..vehicle.simulation import Simulation

        connections = self.connection or _CONNECTIONS
        transports = open_all(connections)
        for transport in transports:
            held.callback(transport.close)
        simulation = Simulation(scenario, len(transports), record=self.out is not None)
        server = Server(simulation, transports, scenario.seed, self.speed or 1.0)
        for text, transport in zip(connections, transports, strict=True):
            self._say(f"serving {_where(text, transport.port)}")
        server.run(stop, self.duration)
        if server.behind > 0:
            self._say(f"{server.behind:.1f} s behind the clock in all: this machine is busy")
        return simulation.truth

    def _fly(self, scenario: "Scenario", held: ExitStack, stop: Event) -> "TruthLog":
        """Be the physics of a real ArduSub."""
        with interrupts_held():
            from ..vehicle.json_backend import ADDRESS, JsonBackend, open_physics
            from ..vehicle.write import write_parameters

        if self.speed is not None:
            raise UserError(
                "--speed: with --backend ardupilot-json the autopilot sets the pace; give it "
                "--speedup instead"
            )
        if len(self.connection) > 1:
            raise UserError("--connection: a plant has one autopilot; give one udpin:HOST:PORT")
        text = self.connection[0] if self.connection else ADDRESS
        datagrams = open_physics(text)
        held.callback(datagrams.close)
        backend = JsonBackend(scenario, datagrams, self._say, record=self.out is not None)
        own = scenario.vehicle_server
        if own is not None:
            self._say("vehicle_server of the scenario is not used: ArduSub has its own settings")
        self._say(f"serving {_where(text, datagrams.port)}")
        wanted = backend.physics.parameters()
        listed = ", ".join(f"{k} {v:g}" for k, v in wanted.items())
        self._say(f"its parameters for this vehicle: {listed}")
        if self.out is not None:
            self._say(f"start ArduSub with --defaults {write_parameters(wanted, self.out)}")
        backend.run(stop, self.duration)
        self._say(backend.summary())
        return backend.truth

    def _say(self, text: str) -> None:
        if not self.quiet:
            console().print(text, markup=False, soft_wrap=True)


def _where(connection: str, port: int) -> str:
    """A connection with the port that it took."""
    return f"{connection.rpartition(':')[0]}:{port}" if port else connection
