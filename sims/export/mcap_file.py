"""Writes an MCAP file of JSON messages."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from ...models.config.errors import UserError
from ...models.files.atomic import atomic_path
from .foxglove import SCHEMAS, Message, nanoseconds

_MAGIC, _MADE_BY = b"\x89MCAP0\r\n", "spinndrift"
_HEAD = 256


class Channels:
    """Topics of an open file, each registered with its schema at its first message."""

    def __init__(self, writer: Any):
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._topics: dict[str, int] = {}
        self._sequence: dict[str, int] = {}

    def add(self, topic: str, schema: str, t: float, message: Message) -> None:
        """Write one message; `schema` names one of `foxglove.SCHEMAS` or of `define`."""
        if topic not in self._topics:
            if schema not in self._schemas:
                self.define(schema, SCHEMAS[schema])
            self._topics[topic] = self._writer.register_channel(
                topic, "json", self._schemas[schema]
            )
        at = nanoseconds(t)
        data = json.dumps(message, allow_nan=False, separators=(",", ":")).encode()
        number = self._sequence[topic] = self._sequence.get(topic, -1) + 1
        self._writer.add_message(self._topics[topic], at, data, at, number)

    def define(self, name: str, schema: Message) -> None:
        """Register a schema, once for a name."""
        if name not in self._schemas:
            text = json.dumps(schema).encode()
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", text)


@contextmanager
def mcap_file(path: Path) -> Iterator[Channels]:
    """Open an MCAP file that appears whole at the block's end.

    Raises:
        UserError: the package `mcap` is missing, or the disk is full.
    """
    writer_of = checked_package(path)
    with atomic_path(path) as partial, partial.open("wb") as handle:
        writer = writer_of(handle)
        writer.start(profile="", library=f"{_MADE_BY} {metadata.version('spinndrift')}")
        yield Channels(writer)
        writer.finish()


def checked_package(path: Path) -> Any:
    """The writer of the package `mcap`.

    Raises:
        UserError: it is not installed.
    """
    try:
        from mcap.writer import Writer
    except ImportError as error:
        raise UserError(
            f"{path}: MCAP files are written by the package mcap, which is not installed; "
            "install spinndrift[ros]"
        ) from error
    return Writer


def is_ours(path: Path) -> bool:
    """Whether a file is an MCAP file whose header names this package as its writer."""
    with path.open("rb") as handle:
        head = handle.read(_HEAD)
    return head.startswith(_MAGIC) and _MADE_BY.encode() in head
