"""Ways to spoil bytes, text and YAML trees; every choice comes from the generator given."""

import re
import struct
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
import yaml

T = TypeVar("T")
Rng = np.random.Generator

NUMBERS = (
    "nan", "NaN", "inf", "-inf", "1e300", "-1e300", "1e308", "1e-300", "-1", "0", "-0.0", "1", "2",
    "0.5", "1e6", "1e9", "1e18", "1e400", "4294967296", "18446744073709551616",
    "-9223372036854775809", "9" * 400, "9" * 5000, "1_000", "0x10", "0o17", "1:30", "1,5", "",
)  # fmt: skip
WORDS = (
    "", "null", "~", "true", "no", "text", "[]", "{}", "[1, 2]", "[[]]", "{a: 1}", "!Kind {}",
    "!!python/object:os.system {}", "2020-01-01", "'", '"', "# a", "a: b: c", "&a [*a]", "*b",
    "../../etc/passwd", "/", ".", "/dev/null", "nan", ".nan", ".inf", "-.inf", "ä", "\0", "\x85",
    "\u2028", "\ufeff", "🙂", "a" * 3000, "[" * 300, "%YAML 9.9", "---", "...", "\t",
)  # fmt: skip
FLOATS = (
    np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, -1.0, 1e300, -1e300, 1e-300, 3e38, 1e9, 1e5, 0.5,
    1e154,
)  # fmt: skip


def pick(rng: Rng, choices: Sequence[T]) -> T:
    """One of the choices."""
    return choices[int(rng.integers(len(choices)))]


def part(rng: Rng, size: int, most: int | None = None) -> slice:
    """A stretch of `size` things, short ones oftener than long ones."""
    if size == 0:
        return slice(0, 0)
    start = int(rng.integers(size))
    length = int(min(size - start, most or size) ** rng.random())
    return slice(start, start + max(length, 1))


# bytes


def flipped(rng: Rng, data: bytes) -> bytes:
    """Some bits turned over."""
    if not data:
        return data
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        changed[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def cut(rng: Rng, data: bytes) -> bytes:
    """The beginning alone."""
    return data[: int(rng.integers(len(data) + 1))]


def without(rng: Rng, data: bytes) -> bytes:
    """A stretch is gone."""
    gone = part(rng, len(data))
    return data[: gone.start] + data[gone.stop :]


def doubled(rng: Rng, data: bytes) -> bytes:
    """A stretch stands twice."""
    twice = part(rng, len(data), 4096)
    return data[: twice.stop] + data[twice] + data[twice.stop :]


def exchanged(rng: Rng, data: bytes) -> bytes:
    """Two stretches have changed places."""
    cuts = sorted(int(c) for c in rng.integers(len(data) + 1, size=4))
    a, b, c, d = cuts
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def overwritten(rng: Rng, data: bytes) -> bytes:
    """A stretch of zeros, ones or noise."""
    where = part(rng, len(data), 64)
    size = where.stop - where.start
    fill = pick(rng, (b"\0" * size, b"\xff" * size, rng.bytes(size)))
    return data[: where.start] + fill + data[where.stop :]


def special(rng: Rng, data: bytes) -> bytes:
    """A number of some width and order that readers seldom meet."""
    code = pick(rng, ["<f", ">f", "<d", ">d", "<h", "<H", "<i", "<I", "<q", "<Q", ">I", ">Q"])
    packed = packed_special(rng, code)
    if len(data) < len(packed):
        return data
    at = int(rng.integers(len(data) - len(packed) + 1))
    return data[:at] + packed + data[at + len(packed) :]


def packed_special(rng: Rng, code: str) -> bytes:
    """A number that readers seldom meet, in the form of a `struct` code."""
    if code[-1] in "fd":
        value = np.array([pick(rng, FLOATS)])
        with np.errstate(over="ignore", under="ignore"):
            return value.astype(
                code[:-1].replace("=", "<") + ("f4" if code[-1] == "f" else "f8")
            ).tobytes()
    bits = 8 * struct.calcsize(code)
    high = 2**bits - 1 if code[-1].isupper() else 2 ** (bits - 1) - 1
    low = 0 if code[-1].isupper() else -(2 ** (bits - 1))
    values = [v for v in (low, high, 0, 1, -1, 2, high - 1, high // 2) if low <= v <= high]
    return struct.pack(code, pick(rng, values))


BYTES: tuple[Callable[[Rng, bytes], bytes], ...] = (
    flipped, flipped, cut, without, doubled, exchanged, overwritten, special,
)  # fmt: skip


def bytes_spoiled(rng: Rng, data: bytes) -> bytes:
    """One of the ways above."""
    return pick(rng, BYTES)(rng, data)


# text

_TOKEN = re.compile(r"[-+]?\d[\w.+-]*|[A-Za-z_]\w*|[^\w\s]")


def text_spoiled(rng: Rng, text: str) -> str:
    """Lines or tokens replaced, moved, doubled or gone."""
    if rng.random() < 0.5:
        return _lines_spoiled(rng, text)
    tokens = [m.span() for m in _TOKEN.finditer(text)]
    if not tokens:
        return text + pick(rng, WORDS)
    (a, b), (c, d) = pick(rng, tokens), pick(rng, tokens)
    match int(rng.integers(4)):
        case 0:
            return text[:a] + pick(rng, NUMBERS) + text[b:]
        case 1:
            return text[:a] + pick(rng, WORDS) + text[b:]
        case 2:
            return text[:a] + text[b:]
    return text[:a] + text[c:d] + text[b:]


def _lines_spoiled(rng: Rng, text: str) -> str:
    lines = text.split("\n")
    i, j = (int(k) for k in rng.integers(len(lines), size=2))
    match int(rng.integers(6)):
        case 0:
            del lines[i]
        case 1:
            lines.insert(j, lines[i])
        case 2:
            lines[i], lines[j] = lines[j], lines[i]
        case 3:
            lines[i] = pick(rng, ("  ", "\t", "- ", "# ", "\r", ";")) + lines[i]
        case 4:
            lines.insert(i, pick(rng, WORDS))
        case _:
            lines[i] = lines[i][: int(rng.integers(len(lines[i]) + 1))]
    return "\n".join(lines)


def encoded(rng: Rng, text: str) -> bytes:
    """Text as bytes, seldom in another encoding or with other line ends."""
    form = rng.random()
    if form < 0.9:
        return text.encode("utf-8", "surrogatepass")
    if form < 0.94:
        text = text.replace("\n", pick(rng, ("\r\n", "\r", "\n\n", "\x85", "\u2028")))
        return text.encode()
    code = pick(rng, ("utf-8-sig", "utf-16", "utf-16-le", "utf-32", "latin-1", "cp037"))
    return text.encode(code, "replace")


# YAML


def yaml_spoiled(rng: Rng, text: str) -> str:
    """The document with some nodes of its tree replaced, renamed, moved, doubled or gone."""
    root = yaml.compose(text, yaml.SafeLoader)
    if root is None:
        return pick(rng, WORDS)
    for _ in range(int(rng.integers(1, 4))):
        root = _node_spoiled(rng, root)
    return str(yaml.serialize(root, allow_unicode=True))


def _nodes(root: yaml.Node) -> list[tuple[yaml.Node, int, int]]:
    """Places of all values: (parent, index, 1 in a mapping)."""
    found: list[tuple[yaml.Node, int, int]] = []
    if isinstance(root, yaml.MappingNode):
        for i, (_, value) in enumerate(root.value):
            found += [(root, i, 1), *_nodes(value)]
    elif isinstance(root, yaml.SequenceNode):
        for i, value in enumerate(root.value):
            found += [(root, i, 0), *_nodes(value)]
    return found


def _scalar(value: str, tag: str = "tag:yaml.org,2002:str") -> yaml.ScalarNode:
    plain = yaml.ScalarNode(tag, value, style=None)
    plain.tag = yaml.SafeLoader("").resolve(yaml.ScalarNode, value, (True, False))
    return plain


def _node_spoiled(rng: Rng, root: yaml.Node) -> yaml.Node:
    places = _nodes(root)
    if not places:
        return _scalar(pick(rng, NUMBERS))
    parent, i, keyed = pick(rng, places)
    value = parent.value[i][1] if keyed else parent.value[i]

    def put(new: yaml.Node) -> None:
        parent.value[i] = (parent.value[i][0], new) if keyed else new

    match int(rng.integers(10)):
        case 0 | 1 | 2:
            put(_scalar(pick(rng, (*NUMBERS, ".nan", ".inf", "-.inf"))))
        case 3:
            put(_scalar(pick(rng, WORDS)))
        case 4:
            del parent.value[i]
        case 5:
            parent.value.insert(i, parent.value[i])
        case 6 if keyed and isinstance(parent.value[i][0].value, str):
            key = parent.value[i][0]
            name = pick(rng, (*WORDS, key.value + "s", key.value[:-1]))
            parent.value[i] = (_scalar(name), value)
        case 7:
            other, j, other_keyed = pick(rng, places)
            if j < len(other.value):
                new = other.value[j][1] if other_keyed else other.value[j]
                if all(new is not node for node in (parent, root)) and parent not in [
                    p for p, _, _ in _nodes(new)
                ]:
                    put(new)
        case 8:
            wrap = pick(rng, (yaml.SequenceNode, yaml.MappingNode))
            if wrap is yaml.SequenceNode:
                put(wrap("tag:yaml.org,2002:seq", [value] * int(rng.integers(4))))
            else:
                put(wrap("tag:yaml.org,2002:map", [(_scalar("a"), value)]))
        case _:
            tags = [v.tag for p, k, m in places if (v := _at(p, k, m)).tag.startswith("!")]
            value.tag = pick(rng, (*tags, "!Other", "!", "tag:yaml.org,2002:str", "!!int"))
    return root


def _at(parent: yaml.Node, i: int, keyed: int) -> yaml.Node:
    if i >= len(parent.value):
        return parent
    return parent.value[i][1] if keyed else parent.value[i]
