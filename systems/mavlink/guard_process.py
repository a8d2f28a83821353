"""A process of its own that stops the thrusters when the one that commands them dies or hangs.

The autopilot's failsafes do not stop thrusters 7 and 8 in pass-through, and a killed process can't
stop anything. The guard reads a beat from its standard input. When the pipe closes without the word
of release, or no beat comes in time, it ends the commanding process, connects to the vehicle,
sends neutral, disarms, and gives borrowed parameters back.

So does one that is told to, by a process that could not stop the thrusters and has other things to
write.

It is started before arming and imports neither JAX nor Drake, so that it acts at once.
"""

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from ...models.config.errors import UserError
from . import commands
from .dialect import Message, mavlink
from .link import Link, Peer
from .parameters import Borrowed, Parameters
from .transport import Connection
from .urgent import urgent

_BEAT, _BUSY, _PILOT, _RELEASE, _LEAVE = b".", b"w", b"p", b"!", b"?"
_PATIENCE = {_BEAT: 1.0, _BUSY: 30.0, _PILOT: 30.0}  # s without a word, after the last one
_NEUTRAL_FOR, _PERIOD = 1.0, 0.05  # s of neutral messages, s between them
_READY_IN = 30.0  # s: a loaded machine starts an interpreter slowly
_READY = b"ready\n"
_TRIES = 20  # of connecting, a second apart: the former client's port has to become free
_CHANNELS = 8
_UNABLE = "could not stop them"
_AT_WORK: list[subprocess.Popen] = []
"""Guards to which a vehicle was left."""


class Guard:
    """The commanding process' handle of the guard.

    After a `beat` the next word has to come within a second; `busy` allows half a minute, for what
    comes before and after the loop. Call `release` only when the thrusters have been stopped: a
    process that ends without it is followed by the guard's rescue.
    """

    def __init__(self, connection: Connection, system: int, borrowed: Path | None = None):
        """Start the guard; `borrowed` is the file of parameters to give back.

        Raises:
            UserError: it did not start.
        """
        words = [str(connection), str(system), str(os.getpid()), str(borrowed or "")]
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C in the terminal is not for it
        )
        assert self._process.stdout is not None
        ready = select.select([self._process.stdout], [], [], _READY_IN)[0]
        if not ready or self._process.stdout.readline() != _READY:
            self._process.kill()
            raise UserError("the guard process did not start; without it there is no pass-through")

    def beat(self) -> None:
        """Say that the loop runs; at least twice a second.

        Raises:
            UserError: the guard is gone.
        """
        self._say(_BEAT)

    def busy(self) -> None:
        """Say that the loop does not run, and that work goes on: arming, stopping.

        Raises:
            UserError: the guard is gone.
        """
        self._say(_BUSY)

    def _say(self, word: bytes) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(word)
            self._process.stdin.flush()
        except OSError as error:
            raise UserError("the guard process has ended; the dive can't go on") from error

    def pilot(self) -> None:
        """Say that a pilot steers: from now on a rescue only gives parameters back.

        Raises:
            UserError: the guard is gone.
        """
        self._say(_PILOT)

    def leave(self) -> None:
        """Leave the vehicle to the guard, which stops it if it can be reached, and ends.

        The commanding process goes on; it must have closed its link.
        """
        with suppress(UserError):
            self._say(_LEAVE)
        _AT_WORK.append(self._process)

    def release(self) -> None:
        """Say that the thrusters are stopped; the guard ends."""
        if self._process.stdin is not None and not self._process.stdin.closed:
            with suppress(OSError):
                self._process.stdin.write(_RELEASE)
                self._process.stdin.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(5.0)
        if self._process.stdout is not None:
            self._process.stdout.close()


def all_neutral(vehicle: Peer) -> list[Message]:
    """Overrides and sticks at rest: one of them is what the vehicle follows."""
    pulses = {f"chan{k}_raw": 1500 for k in range(1, _CHANNELS + 1)}
    return [
        mavlink.MAVLink_rc_channels_override_message(vehicle.system, vehicle.component, **pulses),
        mavlink.MAVLink_manual_control_message(vehicle.system, 0, 0, 500, 0, 0),
    ]


def stop_thrusters(link: Link, borrowed: Path | None, leave: bool = False) -> list[str]:
    """Send neutral for a second, disarm, give parameters back; what did not work, in words.

    With `leave` a pilot steers: parameters are given back, and nothing else is done.
    """
    vehicle, failed = link.find_vehicle(), []
    end = time.monotonic() + _NEUTRAL_FOR
    while not leave and time.monotonic() < end:
        for message in all_neutral(vehicle):
            link.send(message)
        time.sleep(_PERIOD)
    disarm = () if leave else (lambda: commands.disarm(link),)
    for act in (*disarm, lambda: _give_back(link, borrowed)):
        try:
            act()
        except UserError as error:
            failed.append(str(error))
    return failed


def _give_back(link: Link, borrowed: Path | None) -> Mapping[str, float]:
    return {} if borrowed is None else Borrowed(Parameters(link), borrowed).give_back()


def _watch() -> tuple[str, bool]:
    """Wait for the release; what happened if the words end without it, and if a pilot steers."""
    last, steered = _BUSY, False
    while True:
        if not select.select([sys.stdin.buffer], [], [], _PATIENCE[last])[0]:
            return f"hung for {_PATIENCE[last]:g} s", steered
        read = os.read(sys.stdin.fileno(), 4096)
        steered = steered or _PILOT in read
        if _RELEASE in read:
            return "", steered
        if _LEAVE in read:
            return _UNABLE, steered
        if not read:
            return "died", steered
        last = read[-1:]


def _tell(*sentences: str) -> None:
    sys.stderr.write("".join(f"spinndrift guard: {sentence}\n" for sentence in sentences))


@urgent()
def main(arguments: list[str]) -> int:
    """Guard; the exit status is 0 after a release, 1 after a rescue, 2 if that failed."""
    where, system, parent, file = arguments
    connection, borrowed = Connection.parse(where), Path(file) if file else None
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.stdout.buffer.write(_READY)
    sys.stdout.flush()
    ended, steered = _watch()
    if not ended:
        return 0
    if ended != _UNABLE and os.getppid() == int(parent):  # it hangs, and holds the connection
        os.kill(int(parent), signal.SIGKILL)
    for _ in range(_TRIES):
        try:
            with Link(connection, system=int(system)) as link:
                failed = stop_thrusters(link, borrowed, steered)
            done = "parameters given back" if steered else "thrusters stopped"
            _tell(f"the commanding process {ended}: {done}", *failed)
            return 2 if failed else 1
        except UserError as error:
            _tell(str(error))
            time.sleep(1.0)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
