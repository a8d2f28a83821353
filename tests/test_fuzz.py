"""Mutated inputs of every kind are read or refused by a `UserError`, in words for a user.

`make fuzz N=100000` tries more of them.
"""

from collections import Counter

import pytest
from fuzz.harness import Kind, judge
from fuzz.kinds import KINDS

from spinndrift.models.config.errors import UserError

pytestmark = pytest.mark.whole

COUNT = 60
FRAMES = 60
"""Inputs of twenty frames each."""
BAGS = 30
"""A bag is written anew for each input."""


@pytest.mark.parametrize("name", KINDS)
def test_what_is_spoiled_is_read_or_refused(name, tmp_path):
    fates, wrong = Counter[str](), []
    count = {"bag": BAGS, "mavlink": FRAMES}.get(name, COUNT)
    for number in range(count):
        verdict = judge(KINDS[name], number, tmp_path)
        fates[verdict.fate] += 1
        if not verdict.sound:
            wrong.append(f"{name} {number}: {verdict.fate}\n{verdict.told}")
    assert not wrong, "\n\n".join(wrong[:5])
    # inputs that are all refused, or all read, would try little
    if KINDS[name].refuses:
        assert min(fates["read"], fates["refused"]) >= count / 50, fates


@pytest.mark.parametrize(
    ("raised", "fate"),
    [
        (None, "read"),
        (UserError("in.txt: line 3 has no number; give one"), "refused"),
        (UserError("line 3 has no number"), "words: no file named"),
        (UserError("in.txt: found <class 'str'>"), "words: <class "),
        (ValueError("no"), "ValueError at tests/test_fuzz.py"),
        (MemoryError(), "MemoryError at tests/test_fuzz.py"),
    ],
)
def test_verdicts(raised, fate, tmp_path):
    def read(path):
        if raised is not None:
            raise raised

    kind = Kind("any", lambda rng, folder: folder / "in.txt", read)
    assert judge(kind, 0, tmp_path).fate.startswith(fate)


def test_a_reader_without_end_is_noticed(tmp_path):
    def read(path):
        while True:
            pass

    kind = Kind("any", lambda rng, folder: folder / "in.txt", read)
    assert judge(kind, 0, tmp_path, limit=0.2).fate == "longer than 0.2 s"


def test_a_number_makes_the_same_input_again(tmp_path):
    for name, kind in KINDS.items():
        made = []
        for part in ("a", "b"):
            folder = tmp_path / name / part
            folder.mkdir(parents=True)
            for number in (3, 5):
                judge(kind, number, folder)
            made.append({p.relative_to(folder): p.read_bytes() for p in folder.rglob("*.*")})
        assert made[0]
        assert made[0] == made[1]
