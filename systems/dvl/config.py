"""DVLs that are read directly, by kind."""

from dataclasses import dataclass
from functools import partial

from ..mavlink.transport import Connection
from . import nucleus, water_linked
from .stream import DvlStream


@dataclass(frozen=True)
class WaterLinkedDvl:
    """A Water Linked A50 or A125.

    Attributes:
        connection: tcp:HOST:PORT of its JSON protocol.
    """

    connection: str = f"tcp:192.168.2.95:{water_linked.PORT}"

    def __post_init__(self) -> None:
        """Check the connection."""
        Connection.parse(self.connection, f"{type(self).__name__}.connection")

    def open(self) -> DvlStream:
        """Connect.

        Raises:
            UserError: it can't be reached.
        """
        return DvlStream(Connection.parse(self.connection), water_linked.WaterLinked())


@dataclass(frozen=True)
class NucleusDvl:
    """A Nortek Nucleus.

    Attributes:
        connection: tcp:HOST:PORT of its stream.
        password: that it asks for on TCP.
    """

    connection: str = f"tcp:192.168.2.201:{nucleus.PORT}"
    password: str = nucleus.PASSWORD

    def __post_init__(self) -> None:
        """Check the connection."""
        Connection.parse(self.connection, f"{type(self).__name__}.connection")

    def open(self) -> DvlStream:
        """Connect and start its measurement.

        Raises:
            UserError: it can't be reached.
        """
        connection, password = Connection.parse(self.connection), self.password
        login = partial(nucleus.start, password=password)
        return DvlStream(connection, nucleus.Nucleus(), login)


DvlKind = WaterLinkedDvl | NucleusDvl
"""The kinds that a scenario can name by a tag."""
