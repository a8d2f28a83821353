"""A configuration is what its dataclass says, or one clear line names file, field and remedy."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Optional

import equinox as eqx
import numpy as np
import pytest
from jaxtyping import Float

from spinndrift.models.config.errors import UserError
from spinndrift.models.config.typed_yaml import dump, load, loads

pytestmark = pytest.mark.smoke


@dataclass(frozen=True)
class Gusts:
    force: float
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def __post_init__(self):
        if self.force < 0:
            raise ValueError("force must be positive")


class Calm(eqx.Module):
    level: float = 0.0


@dataclass(frozen=True)
class Inner:
    count: int = 3
    factor: float = 1.5


@dataclass
class Wave:
    count: int = 3


@dataclass
class Everything:
    name: str
    disturbances: list[Gusts | Calm] = field(default_factory=list)
    inner: Inner = field(default_factory=Inner)
    perhaps: Optional[Inner] = None  # noqa: UP045  both spellings are understood
    maybe: float | None = None
    kind: Literal["fast", "slow"] = "fast"
    file: Path | None = None
    flag: bool = True
    many: tuple[Inner, ...] = ()
    table: dict[str, Inner] = field(default_factory=dict)
    matrix: Float[np.ndarray, "2 3"] = field(default_factory=lambda: np.zeros((2, 3)))
    free: np.ndarray = field(default_factory=lambda: np.zeros(0))
    either: float | tuple[float, ...] = 1.0
    one: Gusts | Calm | None = None
    hidden: int = field(default=7, init=False)


FULL = """
name: '1e-3'
disturbances: [!Gusts {force: 1e-3}, !Calm {}, !Gusts {force: 2, axis: [0, 1, 0]}]
inner: {count: 4}
perhaps: {factor: 2}
maybe: 3
kind: slow
file: runs/no
flag: false
many: [{count: 1}, {count: 2}]
table: {a: {count: 9}}
matrix: [[1, 2, 3], [4, 5, 6.5]]
free: [1, 2]
either: [1, 2]
one: !Calm {level: 2}
"""


def equal(a, b):
    assert np.array_equal(a.matrix, b.matrix)
    assert np.array_equal(a.free, b.free)
    names = [name for name in vars(a) if name not in ("matrix", "free")]
    return all(getattr(a, name) == getattr(b, name) for name in names)


def test_every_kind_of_field_is_read():
    read = loads(Everything, FULL)
    assert read.disturbances == [Gusts(1e-3), Calm(), Gusts(2.0, (0.0, 1.0, 0.0))]
    assert read.inner == Inner(4)
    assert read.perhaps == Inner(factor=2.0)
    assert read.maybe == 3.0
    assert isinstance(read.maybe, float)
    assert (read.name, read.kind, read.file, read.flag) == ("1e-3", "slow", Path("runs/no"), False)
    assert read.many == (Inner(1), Inner(2))
    assert read.table == {"a": Inner(9)}
    assert read.matrix.dtype == float
    assert read.matrix[1, 2] == 6.5
    assert read.either == (1.0, 2.0)
    assert read.one == Calm(2.0)


@pytest.mark.parametrize("text", [FULL, "name: a"])
def test_dump_round_trips_and_writes_defaults_out(text):
    read = loads(Everything, text)
    written = dump(read)
    assert equal(loads(Everything, written), read)
    assert dump(loads(Everything, written)) == written
    assert "factor: 1.5" in written
    assert "hidden" not in written


def test_drake_reads_the_same_text():
    common_yaml = pytest.importorskip("pydrake.common.yaml")

    @dataclass
    class Current:
        speed: float = 0.0

    @dataclass
    class Shared:
        values: list[float] = field(default_factory=list)
        kinds: list[Wave | Current] = field(default_factory=list)

    ours = loads(Shared, "values: [1, 2e-3]\nkinds: [!Current {speed: 2.0}, !Wave {count: 2}]")
    assert ours.kinds == [Current(2.0), Wave(2)]
    assert common_yaml.yaml_load_typed(schema=Shared, data=dump(ours)) == ours


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name: 3", "1: name: found `3` (a number); write text"),
        ("nam: a", "1: nam: is no key of this part; did you mean `name`?"),
        ("inner: {x: 1}\nname: a", "1: inner.x: is no key of this part; known are count, factor"),
        ("flag: true", "name: is missing; write text"),
        ("", "holds nothing; write a mapping with name"),
        ("[1]", "1: found a list of 1; write a mapping with name, disturbances"),
        ("name: a\nflag: no", "2: flag: found `no` (text); write true or false"),
        ("name: a\nflag: 1", "2: flag: found `1` (a number); write true or false"),
        ("name: a\nmaybe: true", "2: maybe: found `true` (a boolean); write a number"),
        ("name: a\nmaybe: x", "maybe: found `x` (text); write a number, or null for none"),
        ("name: a\nmaybe: 1_0", "2: maybe: found `1_0` (text); write a number"),
        ("name: a\nmaybe: .nan", "2: maybe: found `nan` (a number); write a finite number"),
        (
            "name: a\nmaybe: -1e300",
            "2: maybe: found `-1e+300` (a number); write a number of at most",
        ),
        ("name: a\nmaybe: 1e999", "2: maybe: found `inf` (a number); write a finite number"),
        (f"name: a\nmaybe: 1{'0' * 400}", "2: maybe: found `1000"),
        ("name: a\ninner: {count: 2.0}", "2: inner.count: found `2.0` (a number); write a whole"),
        ("name: a\ninner:", "2: inner: found nothing; write a mapping with count, factor"),
        (f"name: a\nflag: {'x' * 99}", f"2: flag: found `{'x' * 60}…` (text); write true or"),
        (f"name: a\n{'x' * 99}: 1", f"2: {'x' * 60}…: is no key of this part"),
        (f"name: a\nmany: {{{'x' * 99}: 1}}", f"2: many: found a mapping with {'x' * 60}…; write"),
        ("name: a\nkind: quick", "2: kind: found `quick` (text); write one of fast, slow"),
        ("name: a\nmany: {count: 1}", "2: many: found a mapping with count; write a list"),
        ("name: a\nmany: [{count: a}]", "2: many[0].count: found `a` (text); write a whole number"),
        ("name: a\ntable: [1]", "2: table: found a list of 1; write a mapping"),
        ("name: a\ntable: {b: {c: 1}}", "2: table.b.c: is no key"),
        ("name: a\nmatrix: [[1, 2], [3, 4]]", "2: matrix: found numbers of shape (2, 2); write"),
        ("name: a\nmatrix: [[1, 2], [3]]", "2: matrix: found rows of unequal length; write"),
        ("name: a\nfree: [1, .inf]", "2: free: found `inf` (a number); write a finite number"),
        ("name: a\nfree: abc", "2: free: found `abc` (text); write a list of numbers"),
        ("name: a\neither: x", "2: either: found `x` (text); write one of a number, a list"),
        ("name: a\none: {force: 2}", "2: one: found a mapping with force; write one of !Gusts"),
        ("name: a\none: !Storm {}", "2: one: found `!Storm`; write one of !Gusts {…}, !Calm {…}"),
        ("name: a\ninner: !Calm {}", "2: inner: found `!Calm`; write a mapping"),
        ("name: a\nname: b", "2: key `name` stands here and in line 1"),
    ],
)
def test_faults_name_line_field_and_remedy(text, message):
    with pytest.raises(UserError) as caught:
        loads(Everything, text, "some.yaml")
    assert str(caught.value).startswith("some.yaml:")
    assert message in str(caught.value)


def test_all_faults_are_told_at_once_each_in_its_line():
    text = """name: a
disturbances:
  - !Calm {}
  - !Gusts {force: -2}
  - !Gusts {force: a, axis: [1, 2]}
many:
  - {count: 1}
  - {count: 1.5}
"""
    with pytest.raises(UserError) as caught:
        loads(Everything, text, "f.yaml")
    assert str(caught.value).splitlines() == [
        "f.yaml:4: disturbances[1]: force must be positive",
        "f.yaml:5: disturbances[2].force: found `a` (text); write a number",
        "f.yaml:5: disturbances[2].axis: found a list of 2; write a list of 3",
        "f.yaml:8: many[1].count: found `1.5` (a number); write a whole number",
    ]


def test_files_are_named(tmp_path):
    with pytest.raises(UserError, match=r"none\.yaml: there is no such file"):
        load(Everything, tmp_path / "none.yaml")
    path = tmp_path / "broken.yaml"
    path.write_bytes(b"name: \xff\xfe")
    with pytest.raises(UserError, match=r"broken\.yaml: can't be read as UTF-8"):
        load(Everything, path)
    path.write_text("name: good", encoding="utf-8")
    assert load(Everything, path).name == "good"
