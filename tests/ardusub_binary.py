"""A real ArduSub that flies our plant, where SPINNDRIFT_ARDUSUB names its binary."""

import os
import socket
import subprocess
import threading
from pathlib import Path

from spinndrift.models.config.errors import UserError
from spinndrift.sims.scenarios.scenario import Scenario
from spinndrift.sims.vehicle.json_backend import JsonBackend, open_physics
from spinndrift.systems.mavlink.link import Link
from spinndrift.systems.mavlink.transport import Connection

BINARY = os.environ.get("SPINNDRIFT_ARDUSUB", "")
_TCP, _PHYSICS = 5760, 9002  # ports of instance 0; each instance is 10 further
_INSTANCES = range(40, 100)
_HOME = "51.48,0,0,0"
"""Where magnetic north is true north within 2°: before it has a position ArduSub knows no other.
Its altitude is that of the water."""


def free_instance() -> int:
    """An instance whose ports no one uses."""
    for instance in _INSTANCES:
        with socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
            try:
                tcp.bind(("127.0.0.1", _TCP + 10 * instance))
                udp.bind(("127.0.0.1", _PHYSICS + 10 * instance))
            except OSError:
                continue
            return instance
    raise OSError("no free ports")


class ArduSub:
    """The autopilot's process, its physics in a thread, and a link to it; closes all three."""

    def __init__(self, scenario: Scenario, folder: Path, lines: str = ""):
        """Start; `lines` are further parameters."""
        self.folder, self._instance = folder, free_instance()
        address = f"udpin:127.0.0.1:{_PHYSICS + 10 * self._instance}"
        self._datagrams = open_physics(address)
        self.backend = JsonBackend(scenario, self._datagrams, record=False)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.backend.run, args=(self._stop,), daemon=True)
        self._thread.start()
        own = "".join(f"{k} {v:g}\n" for k, v in self.backend.physics.parameters().items())
        (folder / "vehicle.parm").write_text(own + lines)
        self.start()

    def start(self) -> None:
        """Start the autopilot and connect."""
        command = [BINARY, "--model", "JSON:127.0.0.1", "--speedup", "1", "-I"]
        command += [str(self._instance), "--home", _HOME]
        command += ["--defaults", "vehicle.parm"]
        with (self.folder / "ardusub.log").open("a") as log:
            self._process = subprocess.Popen(command, cwd=self.folder, stdout=log, stderr=log)
        tcp = Connection.parse(f"tcp:127.0.0.1:{_TCP + 10 * self._instance}")
        for _ in range(100):  # until it listens
            try:
                self.link = Link(tcp)
                return
            except UserError:
                self._stop.wait(0.1)
        raise TimeoutError(f"{BINARY} does not listen on {tcp}")

    def stop(self) -> None:
        """End the autopilot, and leave the physics as it is."""
        self.link.close()
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        self.stop()
        self._stop.set()
        self._thread.join()
        self._datagrams.close()
