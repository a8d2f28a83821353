"""Reads topics of a ROS 1 bag (.bag) or a ROS 2 bag (.db3, .mcap, or their folder) as columns."""

import struct
from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ....models.config.errors import UserError
from ..log_bytes import Progress, no_progress
from ..table import numbers
from .foreign import form_by_fields
from .mavros import DEFINITIONS
from .messages import FORMS, Form

Kind = Literal["ros1", "mcap", "sqlite3", "folder", "packed"]
METADATA = "metadata.yaml"
"""In the folder of every ROS 2 bag."""
_MAGIC: dict[bytes, Kind] = {
    b"#ROSBAG V": "ros1",
    b"\x89MCAP": "mcap",
    b"SQLite format 3\0": "sqlite3",
}
_PACKED = (b"\x1f\x8b", b"\xfd7zXZ", b"\x28\xb5\x2f\xfd", b"PK\x03\x04", b"BZh")
"""Magic of gzip, xz, zstd, zip and bzip2."""
_STORAGE = (".db3", ".mcap")
_REPAIR = {
    "ros1": "`rosbag reindex`",
    "mcap": "`mcap recover`",
    "sqlite3": "`ros2 bag reindex`",
    "folder": "`ros2 bag reindex`",
}
_PUBLISHED, _SHOWN = "", 12
LOOKED_AT = 200
"""First messages of a topic, by which a map is proposed."""
_NANOSECONDS = 1_000_000_000
_LATEST_NS = 1 << 62


def bag_kind(path: Path) -> Kind | None:
    """What kind of bag a path holds by its content; None if none."""
    if path.is_dir():
        inside = (path / METADATA).is_file() or any(p.suffix in _STORAGE for p in path.iterdir())
        return "folder" if inside else None
    try:
        with path.open("rb") as handle:
            head = handle.read(16)
    except OSError:
        return None
    if head.startswith(_PACKED) and {".bag", *_STORAGE} & {s.lower() for s in path.suffixes}:
        return "packed"
    return next((kind for magic, kind in _MAGIC.items() if head.startswith(magic)), None)


@dataclass(frozen=True)
class Column:
    """Messages of one topic, in the order of the bag.

    Attributes:
        received: when each was recorded (ns since the epoch).
        stamps: time in each header (ns), None without one or where all are zero.
        form: what its numbers are.
        x: numbers of each (k, n), see `form`.
        text: word of each.
        frame: `frame_id` of the headers; `child` likewise `child_frame_id`.
        broken: number of messages that could not be read.
        others: messages in other frames, which are left out, by their frames.
    """

    topic: str
    type: str
    form: Form
    received: np.ndarray
    stamps: np.ndarray | None
    x: np.ndarray
    text: tuple[str, ...] = ()
    frame: str = ""
    child: str = ""
    broken: int = 0
    others: Mapping[str, int] = field(default_factory=dict)


@dataclass
class _Rows:
    """Messages of one topic while they are read."""

    form: Form
    received: list[int] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)
    x: list[tuple[float, ...]] = field(default_factory=list)
    text: list[str] = field(default_factory=list)
    frames: list[tuple[str, str]] = field(default_factory=list)
    broken: int = 0

    def add(self, message: Any, received: int) -> None:
        """Take the numbers of one message; those of another length become NaN."""
        x = tuple(map(float, self.form.numbers(message)))
        if self.x and len(x) != len(self.x[0]):
            x = (np.nan,) * len(self.x[0])
        header = getattr(message, "header", None)
        frame, child = getattr(header, "frame_id", ""), getattr(message, "child_frame_id", "")
        stamp = 0 if header is None else header.stamp.sec * _NANOSECONDS + header.stamp.nanosec
        at, text = min(max(int(received), -_LATEST_NS), _LATEST_NS), str(self.form.text(message))
        self.frames.append((str(frame), str(child)))  # all or none, whatever a message lacks
        self.x.append(x)
        self.received.append(at)
        self.stamps.append(int(stamp))
        self.text.append(text)

    def column(self, topic: str, type_: str) -> Column:
        """The rows as arrays, of the frames that are usual in the first ones."""
        first = Counter(one for one in self.frames[:LOOKED_AT] if any(one))
        counts = Counter(one for one in self.frames if any(one)) if first else first
        usual = max(first, key=lambda one: first[one], default=("", ""))
        kept = np.array([one == usual or not any(one) for one in self.frames], bool)
        stamps, received = np.array(self.stamps, np.int64), np.array(self.received, np.int64)
        stamps, received = stamps[kept], received[kept]
        return Column(
            topic,
            type_,
            self.form,
            received,
            _filled(stamps, received) if stamps.any() else None,
            numbers(np.array(self.x, float).reshape(len(self.x), -1).T[:, kept]),
            tuple(text for text, one in zip(self.text, kept.tolist(), strict=True) if one),
            *usual,
            self.broken,
            {" to ".join(filter(None, one)): n for one, n in counts.items() if one != usual},
        )


def _filled(stamps: np.ndarray, received: np.ndarray) -> np.ndarray:
    """The stamps, with those that are zero (never set) by the recorder's time less the latency."""
    unset = stamps == 0
    if not unset.any():
        return stamps
    latency = np.median((received - stamps)[~unset].astype(float))
    return np.where(unset, received - int(latency), stamps)


class Bag:
    """An open bag; `open_bag` makes it."""

    def __init__(self, path: Path, kind: Kind, reader: Any, broken: tuple[type[Exception], ...]):
        self.path, self.kind = path, kind
        self._reader, self._broken = reader, broken
        self._stores: dict[str, Any] = {}
        self.notes: list[str] = []
        self.topics: dict[str, str] = {}
        """Type of each topic, in the names of ROS 2; the first one if a topic has several."""
        self.counts: dict[str, int] = {}
        named = (one for one in reader.connections if isinstance(one.topic, str))
        for one in named:
            if self.topics.setdefault(one.topic, one.msgtype) == one.msgtype:
                self.counts[one.topic] = self.counts.get(one.topic, 0) + one.msgcount
        self.undefined: list[str] = []
        """Topics of types that are neither in the bag nor published with ROS."""
        self.forms: dict[str, Form] = {}
        """What the messages of each topic give, of those that are read."""
        for one in reader.connections:
            if (form := self._form(one)) is not None:
                self.forms.setdefault(one.topic, form)

    def lacking(self) -> str:
        """What is not read for want of a definition, and the remedy, in words; empty if nothing."""
        if not self.undefined:
            return ""
        several = ", ".join(f"{t} {self.topics[t]}" for t in sorted(self.undefined)[:_SHOWN])
        return (
            f"no definition of {several} is in the bag, so it is not read; record as MCAP, or "
            "convert the bag (`ros2 bag convert`) where its package is installed"
        )

    def _form(self, connection: Any) -> Form | None:
        if connection.msgtype != self.topics.get(connection.topic):
            return None
        if connection.msgtype in FORMS:
            return FORMS[connection.msgtype]
        try:
            _, found = self._store_of(connection).fielddefs[connection.msgtype]
        except self._broken:
            if self.counts.get(connection.topic) and connection.topic not in self.undefined:
                self.undefined.append(connection.topic)
            return None
        return form_by_fields(connection.msgtype, {name: _type_of(told) for name, told in found})

    def read(
        self, wanted: Sequence[str], progress: Progress = no_progress, most: int | None = None
    ) -> dict[str, Column]:
        """The columns of some topics that are in the bag; of each at most `most` messages.

        What precedes a damaged place is kept, and `notes` says so.

        Raises:
            UserError: no message of a topic can be read.
        """
        types = {topic: self.topics[topic] for topic in wanted}
        rows = {topic: _Rows(self.forms[topic]) for topic in types}
        chosen = self._connections(types)
        groups = [chosen] if most is None else [[c] for c in chosen]
        total, done = max(sum(c.msgcount for c in chosen), 1), 0
        for group in (g for g in groups if g):
            for connection, received, raw in self._messages(group):
                if connection.topic not in rows:
                    continue  # the index of a damaged file tells other topics than its data
                into = rows[connection.topic]
                if most is not None and len(into.x) + into.broken >= most:
                    break
                try:
                    into.add(self._decoded(connection, raw), received)
                except self._broken:
                    into.broken += 1
                done += 1
                if done % 1000 == 0:
                    progress(min(0.8 * done / total, 0.8))
        for topic, into in rows.items():
            if into.broken and not into.x:
                raise UserError(
                    f"{topic}: none of its messages can be read as {types[topic]} (its definition "
                    "is missing or another one); record with definitions (MCAP), or leave the "
                    "topic out of the topic map"
                )
        return {topic: into.column(topic, types[topic]) for topic, into in rows.items() if into.x}

    def decoded(self, topics: Sequence[str], most: int) -> Iterator[Any]:
        """Messages of some topics as they are, of each publisher at most `most`."""
        for connection in self._connections(topics):
            for _, (one, _, raw) in zip(range(most), self._messages([connection]), strict=False):
                with suppress(*self._broken):
                    yield self._decoded(one, raw)

    def _connections(self, topics: Container[str]) -> list[Any]:
        return [
            c
            for c in self._reader.connections
            if c.topic in topics and c.msgtype == self.topics[c.topic] and c.msgcount
        ]

    def note(self, sentence: str) -> None:
        """Add a sentence for the report, once."""
        if sentence not in self.notes:
            self.notes.append(sentence)

    def _messages(self, connections: Sequence[Any]) -> Iterator[tuple[Any, int, bytes]]:
        try:
            yield from self._reader.messages(connections=connections)
        except self._broken:
            self.note("The bag is damaged; what precedes the damage was read.")

    def _decoded(self, connection: Any, raw: bytes) -> Any:
        type_, store = connection.msgtype, self._store_of(connection)
        if self.kind == "ros1":
            return store.deserialize_ros1(raw, type_)
        return store.deserialize_cdr(raw, type_)

    def _store_of(self, connection: Any) -> Any:
        if connection.msgtype not in self._stores:
            self._stores[connection.msgtype] = self._store(connection)
        return self._stores[connection.msgtype]

    def _store(self, connection: Any) -> Any:
        """The definitions for one type: the bag's own, else the published ones."""
        from rosbags.interfaces import MessageDefinitionFormat
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        definition = connection.msgdef
        if definition.format == MessageDefinitionFormat.MSG and definition.data:
            store = get_typestore(Stores.EMPTY)
            with suppress(*self._broken):  # the published definition may do
                store.register(get_types_from_msg(definition.data, connection.msgtype))
                store.get_msgdef(connection.msgtype)
                return store
        if not definition.data:
            self.note(
                "The bag holds no definitions of its messages, as before ROS 2 Iron: those of "
                "ROS 2 Humble and mavros are assumed."
            )
        if _PUBLISHED in self._stores:
            return self._stores[_PUBLISHED]
        store = get_typestore(Stores.ROS1_NOETIC if self.kind == "ros1" else Stores.ROS2_HUMBLE)
        types = {}
        for name, text in DEFINITIONS.items():
            if self.kind != "ros1" or "rcl_interfaces" not in text:
                types.update(get_types_from_msg(text, name))
        store.register(types)
        self._stores[_PUBLISHED] = store
        return store


def _type_of(told: Any) -> str:
    """Type of a field in words: a base type's or a message's name, with [] if it is an array."""
    from rosbags.interfaces import Nodetype

    kind, inner = told
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return f"{_type_of(inner[0])}[]"
    return str(inner if kind == Nodetype.NAME else inner[0])


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag of any kind.

    Raises:
        UserError: the path holds no bag, it is damaged or was not closed, its messages are not of
            ROS, or the package `rosbags` is missing.
    """
    kind = bag_kind(path)
    if kind is None:
        raise UserError(f"{path}: no ROS bag; give a .bag, .db3 or .mcap file, or the bag's folder")
    if kind == "packed":
        raise UserError(
            f"{path}: a packed bag; unpack it, or give the folder of a bag of compressed files"
        )
    if kind == "folder" and not (path / METADATA).is_file():
        raise UserError(
            f"{path}: has no {METADATA}, so the bag was not closed after recording; repair it with "
            f"{_REPAIR[kind]}, or give one of its files"
        )
    reader, broken = _reader(path, kind)
    try:
        reader.open()
    except broken as error:
        said = " ".join(str(error).split())
        if "not supported" in said or "rofile" in said:  # the profile of an MCAP file
            raise UserError(
                f"{path}: holds messages in another encoding than ROS's, or a form of bag that is "
                "not read; give a bag of `rosbag record` or `ros2 bag record`"
            ) from error
        raise UserError(
            f"{path}: the bag is damaged, or was not closed after recording; repair it with "
            f"{_REPAIR[kind]}, or copy it again"
        ) from error
    try:
        try:
            bag = Bag(path, kind, reader, broken)
        except broken as error:
            raise UserError(
                f"{path}: the bag's list of topics is damaged; repair it with {_REPAIR[kind]}"
            ) from error
        yield bag
    finally:
        with suppress(*broken):  # nothing was written
            reader.close()


def _reader(path: Path, kind: Kind) -> tuple[Any, tuple[type[Exception], ...]]:
    """A reader that is not yet open, and all that it may raise for a damaged file."""
    try:
        import apsw
        from rosbags import rosbag1, rosbag2
        from rosbags.rosbag2.storage_mcap import McapReader
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
        from rosbags.serde import SerdeError
        from rosbags.typesys import TypesysError
    except ImportError as error:
        raise UserError(
            f"{path}: ROS bags are read by the package rosbags, which is not installed; "
            "install spinndrift[ros]"
        ) from error
    broken = (
        rosbag1.ReaderError, rosbag2.ReaderError, SerdeError, TypesysError, apsw.Error,
        ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, MemoryError,
        OSError, RuntimeError, SyntaxError, TypeError, ValueError, struct.error, *_packers(),
    )  # fmt: skip
    readers: Mapping[Kind, Any] = {
        "ros1": rosbag1.Reader,
        "mcap": McapReader,
        "sqlite3": Sqlite3Reader,
        "folder": rosbag2.Reader,
    }
    return readers[kind](path), broken


def _packers() -> Iterator[type[Exception]]:
    """Errors of the packers that are no built-in ones."""
    import importlib

    for name, error in (("backports.zstd", "ZstdError"), ("compression.zstd", "ZstdError")):
        try:
            yield getattr(importlib.import_module(name), error)
        except ImportError:
            continue
