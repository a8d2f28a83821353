"""A scenario's vehicle as the physics of a real ArduSub, in lock-step."""

import threading
from collections.abc import Callable
from dataclasses import replace
from math import ceil

import numpy as np

from ...models.config.errors import UserError
from ...systems.mavlink.transport import Connection, Datagrams
from ...systems.station.config import StationConfig
from ..scenarios.scenario import Scenario
from .autopilot.navigation import rotated
from .json_protocol import Frames, Servos, servos, state_line
from .physics import Physics, mean_specific_force
from .truth import TruthLog

ADDRESS = "udpin:127.0.0.1:9002"
"""Where ArduPilot looks for its physics."""
_LOOP = (
    400.0  # Hz: ArduSub's main loop (SCHED_LOOP_RATE), which the physics must not be slower than
)
_LONGEST = 0.1  # s: ArduPilot does not take a step of that length or more
_WAIT = 0.1  # s between looks at the end of the run


def lock_step(config: StationConfig) -> StationConfig:
    """The same station with a whole fraction of its period that ArduSub's main loop can follow."""
    parts = ceil(config.period * _LOOP - 1e-9)
    if parts <= 1:
        return config
    substeps = ceil(config.substeps / parts)
    return replace(config, period=config.period / parts, substeps=substeps)


def open_physics(text: str) -> Datagrams:
    """Open the port at which the autopilot is awaited.

    Raises:
        UserError: the text is no `udpin` connection, or the port can't be opened.
    """
    connection = Connection.parse(text, "--connection")
    if connection.kind != "udpin":
        raise UserError(
            f"--connection: `{text}` can't be where an ArduPilot finds its physics; give "
            f"udpin:HOST:PORT, by default {ADDRESS}"
        )
    return connection.open_datagrams()


class JsonBackend:
    """Answers each packet of servo outputs with the state after a step of the plant.

    The autopilot sets the pace: without its packets the plant's time stands still. It sees the
    truth, to which ArduPilot adds the errors of its own simulated sensors.

    The vehicle stays where it is when the autopilot boots anew; the time that the autopilot is told
    begins at 0 s then, as its own clock does.
    """

    def __init__(
        self,
        scenario: Scenario,
        datagrams: Datagrams,
        say: Callable[[str], None] = lambda text: None,
        record: bool = True,
    ):
        """Build the plant; this compiles. `say` takes sentences, `record` is whether to log.

        Raises:
            UserError: the scenario names what can't be read.
        """
        self.physics = Physics(lock_step(scenario.station))
        self.frames = Frames()
        self.restarts = self.repeated = self.foreign = 0
        self.truth = TruthLog(self.physics, scenario.log.rate, self._seen)
        self._datagrams, self._say, self._record = datagrams, say, record
        self._peer: tuple | None = None
        self._booted = 0.0
        self._us = self.physics.driving(())
        self._line = b""

    def run(self, stop: threading.Event, duration: float | None = None) -> None:
        """Serve until `stop` is set, or the plant's time reaches `duration` (s)."""
        while not stop.is_set() and (duration is None or self.physics.time < duration - 1e-9):
            # of packets that waited together only the newest is answered: the autopilot repeats
            # one without an answer, and takes every answer for that to its newest packet
            newest: tuple[Servos, tuple] | None = None
            for data, peer in self._datagrams.receive(_WAIT):
                packet = servos(data)
                if packet is None:
                    self.foreign += 1
                else:
                    newest = packet, peer
            if newest is not None:
                self._datagrams.send(self.answer(newest[0]), newest[1])
                self._met(newest[1])

    def summary(self) -> str:
        """A sentence on the connection until now."""
        counts = {
            "packets repeated": self.repeated,
            "missed": self.frames.missed,
            "not of an autopilot": self.foreign,
            "boots after the first": self.restarts,
        }
        told = "".join(f", {count} {name}" for name, count in counts.items() if count)
        return f"{self.physics.time:.1f} s simulated{told}"

    def answer(self, packet: Servos) -> bytes:
        """The state in answer to a packet: after a step, or the last one if it is a repetition."""
        turn = self.frames.turn(packet.frame)
        if turn == "repeated":
            self.repeated += 1
            return self._line
        if turn == "restarted":
            self.restarts += 1
            self._booted = self.physics.time
            self._say("the autopilot has booted anew; the vehicle stays where it is")
        for _ in range(self._steps(packet.rate)):
            self._step(packet)
        return self._line

    def _steps(self, rate: int) -> int:
        """Periods of the plant in a step of the proposed rate: a whole number of at least one.

        ArduPilot adapts its own rate to that of the answers.
        """
        period = self.physics.config.period
        most = max(1, ceil(_LONGEST / period - 1e-9) - 1)
        return min(most, max(1, round(1 / (rate * period)))) if rate > 0 else 1

    def _step(self, packet: Servos) -> None:
        physics = self.physics
        self._us = physics.driving(packet.us)
        if self._record:
            self.truth.sample(physics.time)
        before = physics.truth()
        physics.step(packet.us)
        X, V = after = physics.truth()
        f_B = mean_specific_force(before, after, physics.config.period)
        v_W = rotated(X[:4], V[:3])
        timestamp = physics.time - self._booted
        self._line = state_line(timestamp, X, v_W, V[3:], f_B, physics.battery())

    def _seen(self) -> dict[str, np.ndarray]:
        return {"pwm": self._us, "voltage": np.array([self.physics.battery()[0]])}

    def _met(self, peer: tuple) -> None:
        if peer != self._peer:
            self._peer = peer
            self._say(f"an autopilot at {peer[0]}:{peer[1]} flies it")
