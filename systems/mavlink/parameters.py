"""The vehicle's parameters: read, write with a check, and borrow with a promise to give back.

ArduPilot sends every parameter as a 32-bit float of its value, whatever its type.
"""

import hashlib
import math
import os
import struct
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from platformdirs import user_state_path

from ...models.config.errors import UserError
from ...models.files.atomic import atomic_path
from .commands import VehicleRefused
from .config import OBEYED
from .dialect import mavlink
from .link import Link, Received
from .transport import Connection

_LONGEST = 16  # characters of a name
_PATIENCE = 1.0  # s without an answer before a request is repeated
_ATTEMPTS = 5


class Unanswered(VehicleRefused):
    """Neither a value nor its present one came back."""


class Parameters:
    """The parameters of a link's vehicle."""

    def __init__(self, link: Link):
        self._link = link

    def read(self, name: str) -> float | None:
        """One parameter's value, None if the vehicle has none of that name."""
        packed = name.encode()
        vehicle = self._link.find_vehicle()
        return self._asked(
            name, mavlink.MAVLink_param_request_read_message(*vehicle, packed, -1), lambda v: True
        )

    def write(self, name: str, value: float) -> None:
        """Set a parameter and see its new value.

        Raises:
            VehicleRefused: the vehicle has no such parameter, or keeps another value.
        """
        vehicle = self._link.find_vehicle()
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        message = mavlink.MAVLink_param_set_message(*vehicle, name.encode(), value, kind)
        if self._asked(name, message, lambda found: same(found, value)) is None:
            kept = self.read(name)
            sent = f"parameter {name}: {value:g} was sent, and the vehicle"
            if kept is None:
                raise Unanswered(f"{sent} does not answer, or has no such parameter")
            raise VehicleRefused(f"{sent} keeps {kept:g}")

    def read_all(
        self, progress: Callable[[float], None] = lambda share: None, timeout: float = 60.0
    ) -> dict[str, float]:
        """All parameters; those that got lost on the way are asked for by their numbers.

        Raises:
            VehicleRefused: some are missing after `timeout` (s).
        """
        vehicle, end = self._link.find_vehicle(), time.monotonic() + timeout
        found: dict[int, tuple[str, float]] = {}
        count, last = 0, time.monotonic()

        def take(received: Received) -> None:
            nonlocal count, last
            message = received.message
            if message.get_type() == "PARAM_VALUE":
                count, last = message.param_count, received.arrival
                if message.param_index < count:  # 65535 where it answers a read by name
                    found[message.param_index] = (message.param_id, message.param_value)

        with self._link.reading(take):
            self._link.send(mavlink.MAVLink_param_request_list_message(*vehicle))
            while not count or len(found) < count:
                time.sleep(0.02)
                now = time.monotonic()
                if now > end:
                    raise VehicleRefused(
                        f"parameters: {len(found)} of {count or 'unknown'} came in {timeout:g} s; "
                        "check the link's rate"
                    )
                if count:
                    progress(len(found) / count)
                if now - last < _PATIENCE:
                    continue
                last = now
                missing = [i for i in range(count) if i not in found][:50]
                for i in missing:
                    self._link.send(mavlink.MAVLink_param_request_read_message(*vehicle, b"", i))
                if not missing:
                    self._link.send(mavlink.MAVLink_param_request_list_message(*vehicle))
        return dict(found.values())

    def _asked(self, name: str, message: object, fits: Callable[[float], bool]) -> float | None:
        """Send a message until a value of that parameter fits."""
        if len(name) > _LONGEST:
            raise UserError(f"parameter {name}: a name has at most {_LONGEST} characters")
        value: list[float] = []
        came = threading.Event()

        def take(received: Received) -> None:
            found = received.message
            named = found.get_type() == "PARAM_VALUE" and found.param_id == name
            if named and fits(found.param_value):
                value.append(found.param_value)
                came.set()

        with self._link.reading(take):
            for _ in range(_ATTEMPTS):
                self._link.send(message)
                if came.wait(_PATIENCE / 2):
                    return value[-1]
        return None


def same(a: float, b: float) -> bool:
    """Whether two values are equal as 32-bit floats."""
    return struct.pack("<f", a) == struct.pack("<f", b) or math.isclose(a, b, rel_tol=1e-6)


def save_parameters(path: str | os.PathLike[str], values: Mapping[str, float]) -> None:
    """Write `NAME,VALUE` lines, atomically; ground stations read this form."""
    lines = "".join(f"{name},{value:.9g}\n" for name, value in sorted(values.items()))
    with atomic_path(path) as partial:
        partial.write_text(lines)


def load_parameters(path: str | os.PathLike[str]) -> dict[str, float]:
    """Read what `save_parameters`, MAVProxy or QGroundControl wrote.

    Lines have a name and a value, separated by a comma or blanks; in QGroundControl's files the
    vehicle and component come before them and the type after. `#` starts a comment.

    Raises:
        UserError: the file is missing, or a line is not a parameter.
    """
    try:
        lines = Path(path).read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: can't be read as parameters: {error}") from error
    values = {}
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        named = words[2:4] if len(words) == 5 else words
        try:
            name, value = named
            values[name] = float(value)
        except ValueError as error:
            raise UserError(f"{path}:{number}: `{line.strip()}` is no NAME,VALUE") from error
    return values


class Borrowed:
    """Parameters that are changed for a while and given back, also after a crash.

    The former values are in a file before the first one is changed. The file is removed when all
    are back; one that is left over tells of a process that died in between, and `give_back`
    restores from it.
    """

    def __init__(self, parameters: Parameters, path: Path):
        """`path` is the file of former values of this vehicle."""
        self._parameters, self.path = parameters, path

    @property
    def left_over(self) -> bool:
        """Whether values wait to be given back."""
        return self.path.exists()

    def borrow(
        self, values: Mapping[str, float], each: Callable[[], object] = lambda: None
    ) -> None:
        """Save the present values, then set the new ones, first the id that the vehicle obeys.

        `each` is called after each.

        Raises:
            VehicleRefused: a parameter can't be read or set; those already changed are given back.
            UserError: values of a former run have not been given back.
        """
        if self.left_over:
            raise UserError(
                f"{self.path}: holds values that were not given back; restore them first"
            )
        former = {}
        for name in values:
            found = self._parameters.read(name)
            if found is None:
                raise VehicleRefused(f"parameter {name}: the vehicle has none of that name")
            former[name] = found
        self.path.parent.mkdir(parents=True, exist_ok=True)
        save_parameters(self.path, former)
        try:
            for name in sorted(values, key=lambda name: name not in OBEYED):
                self._parameters.write(name, values[name])
                each()
        except BaseException:
            self.give_back()
            raise

    def give_back(self) -> dict[str, float]:
        """Write the former values, check them, remove the file; what was restored.

        The id that the vehicle obeys comes last: until then it hears our neutral commands.

        Raises:
            VehicleRefused: a value can't be restored; the file stays, and the rest is restored,
                unless the vehicle does not answer.
        """
        if not self.left_over:
            return {}
        former, refused = load_parameters(self.path), []
        for name in sorted(former, key=lambda name: name in OBEYED):
            try:
                self._parameters.write(name, former[name])
            except VehicleRefused as error:
                refused.append(str(error))
                if isinstance(error, Unanswered):
                    break
        if refused:
            raise VehicleRefused(f"{'; '.join(refused)}; {self.path} keeps the former values")
        self.path.unlink()
        return former


def borrowed_file(connection: Connection, serial_number: str = "") -> Path:
    """The file of a vehicle's borrowed parameters, by its serial number.

    A vehicle is found again behind another connection, and another one behind the same connection
    does not get its values. One without a number is known by its connection.
    """
    key = serial_number or str(connection)
    name = hashlib.sha256(key.encode()).hexdigest()[:16]
    return user_state_path("spinndrift") / f"borrowed-{name}.param"
