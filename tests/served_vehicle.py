"""A vehicle served in a thread of the test's own process."""

import threading

from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.sims.vehicle.plant import Plant
from spinndrift.sims.vehicle.server import Server, open_all
from spinndrift.sims.vehicle.simulation import Simulation

LIMIT = 60.0  # s of wall time for anything with a server, on a busy machine


class Served:
    """A server in a thread of its own, on free ports.

    `text` overrides the scenario; a plant that was made for another server may be given.
    """

    def __init__(
        self,
        *connections: str,
        text: str = "",
        plant: Plant | None = None,
        speed: float = 1.0,
        record: bool = True,
    ):
        scenario = load_scenario("station_keeping_calm", text)
        self.transports = open_all(connections)
        self.ports = [transport.port for transport in self.transports]
        if plant is not None:
            plant.restart()
        self.simulation = Simulation(scenario, len(self.transports), record, plant)
        self.server = Server(self.simulation, self.transports, speed=speed)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.server.run, args=(self._stop,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join(LIMIT)
        self.server.close()
