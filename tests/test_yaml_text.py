"""Words mean what YAML 1.2 says, and what is written is read back as the same value."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from spinndrift.models.config.errors import UserError
from spinndrift.models.config.yaml_text import Tagged, emit, line_of, parse

pytestmark = pytest.mark.smoke


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("1e-3", 0.001),
        ("1E5", 1e5),
        (".5", 0.5),
        ("5.", 5.0),
        ("-.5e2", -50.0),
        ("010", 10),
        ("0x1F", 31),
        ("0o17", 15),
        ("+3", 3),
        ("no", "no"),
        ("on", "on"),
        ("y", "y"),
        ("1:30", "1:30"),
        ("1_000", "1_000"),
        ("2026-01-02", "2026-01-02"),
        ("<<", "<<"),
        ("true", True),
        ("FALSE", False),
        ("~", None),
        ("", None),
        ("null", None),
        (".inf", math.inf),
        ("'1e-3'", "1e-3"),
    ],
)
def test_words_follow_the_core_schema(word, value):
    read = parse(f"key: {word}", "text")[0]["key"]
    assert read == value
    assert type(read) is type(value)


def test_tags_are_kept():
    text = "a: !Kind {x: 1}\nb: !Alone\nc: !List [1, 2]\nd: [!Deep {e: !Er {f: 2}}]"
    assert parse(text, "text")[0] == {
        "a": Tagged("Kind", {"x": 1}),
        "b": Tagged("Alone", {}),
        "c": Tagged("List", [1, 2]),
        "d": [Tagged("Deep", {"e": Tagged("Er", {"f": 2})})],
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: 2\na: 3\n", r"file.yaml:3: key `a` stands here and in line 1"),
        ("x: !Kind\n  a: 1\n  a: 2\n", r"file.yaml:3: key `a`"),
        ("a: [1, 2\n", r"file.yaml:2: "),
        ("a: 1\n---\nb: 2\n", r"file.yaml:2: .*single document"),
        ("? [1, 2]\n: 3\n", r"file.yaml:1: a key must be a plain word"),
        ("a: !!python/object:os.system {}\n", r"file.yaml:1: could not determine a constructor"),
        ("a: *nowhere\n", r"file.yaml:1: found undefined alias"),
        ("a: \x00\n", r"file.yaml: this is no YAML text"),
    ],
)
def test_faults_name_file_and_line(text, message):
    with pytest.raises(UserError, match=message):
        parse(text, "file.yaml")


def test_line_of_finds_the_deepest_known_part():
    node = parse("a:\n  - 1\n  - b:\n      c: 2\n", "text")[1]
    assert line_of(node, ("a", 1, "b", "c")) == 4
    assert line_of(node, ("a", 1, "b", "missing")) == 3
    assert line_of(node, ("a", 7)) == 1


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    # text of any printable characters, and words that some YAML takes for something else
    | st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs", "Zl", "Zp")))
    | st.sampled_from(["no", "1e-3", "1:30", "~", "=", "<<", "010", "0o7", ".inf", "2026-01-02"]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.text("abcxyz01", min_size=1), inner, max_size=3)
        | st.builds(
            Tagged, st.sampled_from(["Kind", "Other"]), st.dictionaries(st.just("k"), inner)
        )
    ),
    max_leaves=8,
)


@given(plain)
def test_what_is_written_is_read_back(value):
    assert parse(emit({"top": value}), "text")[0] == {"top": value}


def test_not_finite_is_not_written():
    with pytest.raises(ValueError, match="finite"):
        emit({"a": [math.nan]})


@pytest.mark.parametrize("text", ['name: "a\\0b"', '"a\\0b": 1', 'files: [one.csv, "\\x00"]'])
def test_a_null_character_is_refused_where_it_stands(text):
    with pytest.raises(UserError, match=r"my\.yaml:1: a text holds a null character"):
        parse(text, "my.yaml")
