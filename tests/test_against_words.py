"""What `diagnose --against` says of changes, and of its rate of false alarms."""

import json

import pytest

from spinndrift.sims.reports.against_section import add_against
from spinndrift.sims.reports.pages import Page
from spinndrift.training.diagnosis.against.baseline import Limits, Scores
from spinndrift.training.diagnosis.against.calibration import Calibration
from spinndrift.training.diagnosis.against.words import sentence_of, text_of
from spinndrift.training.diagnosis.findings.result import Against, Change, Value, schema


def value(at, unit="1", width=0.1):
    return Value(at, unit, (at - width, at + width))


@pytest.mark.parametrize(
    ("name", "where", "before", "change", "ratio", "words"),
    [
        ("thruster_gain", "3", {"gain": 0.0}, {"gain": value(-0.38)}, value(0.62),
         "thruster 3 gives 0.62 of what it gave"),
        ("thruster_gain", "3", {"gain": 0.0}, {"gain": value(-2.0)}, value(-1.0),
         "thruster 3 gives −1.00 of what it gave"),
        ("thrust_scale", "all", {"scale": 0.1}, {"scale": value(-0.2)}, value(0.82),
         "all thrusters give 0.82 of what they gave"),
        ("net_buoyancy", "all", {"force": 1.0}, {"force": value(3.1, "N")}, None,
         "buoyancy is 3.1 N more than before"),
        ("net_buoyancy", "all", {"force": 1.0}, {"force": value(-3.1, "N")}, None,
         "buoyancy is 3.1 N less than before"),
        ("quadratic_drag", "surge", {"change": 0.0}, {"change": value(80.0)}, value(1.6),
         "quadratic drag in surge is 1.60 of what it was"),
        ("dvl_misalignment", "yaw", {"angle": 0.01}, {"angle": value(-0.21, "rad")}, None,
         "dvl_misalignment (yaw): angle −0.2 rad (before: 0.01)"),
    ],
)  # fmt: skip
def test_a_change_is_told_in_the_words_of_its_user(name, where, before, change, ratio, words):
    assert text_of(name, where, before, change, ratio) == words


def limits(n, counted):
    one = Calibration(10.0, 0.005, counted, n, 0)
    return Limits(one, one)


def test_the_sentence_says_what_the_rate_rests_on():
    told = sentence_of([], {}, False, limits(6, 1 / 7), "scenario")
    assert told.startswith("Nothing has changed against the healthy runs.")
    assert "0.01 by theory; the 6 healthy scenarios" in told
    assert "no less than 0.29 by count" in told
    told = sentence_of([], {"u": value(3.0)}, True, limits(400, 0.005), "run")
    assert "no single cause explains how" in told
    assert "by a factor: u 3" in told
    assert told.endswith("0.01, counted on 400 healthy runs, each left out in turn.")


def test_either_score_is_an_alarm():
    found = limits(6, 1 / 7)
    assert not found.exceeded(Scores(10.0, 10.0))
    assert found.exceeded(Scores(10.1, 0.0))
    assert found.exceeded(Scores(0.0, 10.1))
    assert found.rate == pytest.approx(0.01)


def test_the_page_has_changes_and_what_they_rest_on(tmp_path):
    change = Change(
        "thruster_gain", "3", "thruster 3 gives 0.62 of what it gave", {"gain": 0.0},
        {"gain": value(-0.38)}, value(0.62), 1e-9,
    )  # fmt: skip
    against = Against(
        "changed", "", "runs/healthy", [change], {"p": value(2.5)}, "run", 12, 3, 0.01, 0.15,
        88.0, 10.3, 40.0, 8.1, 0,
    )  # fmt: skip
    page = Page("Diagnosis")
    add_against(page, against)
    page.write(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    for words in ("thruster 3 gives 0.62", "−0.38 (−0.48 … −0.28)", "runs/healthy", "2.5 (2.4"):
        assert words in text, words
    assert "Against" in json.dumps(schema())
