"""`benchmarks/baseline.py`: what differs from a baseline is found, what is equal passes."""

import copy
import csv
import json
import sys

import pytest

from helpers import ROOT

sys.path.append(str(ROOT / "benchmarks"))

import baseline
from baseline_compare import ROUNDING, compare, same_three_digits, table

from spinndrift.training.methods import METHODS


def value(number, error=0.01):
    ends = [number - 1.96 * error, number + 1.96 * error]
    return {"value": number, "unit": "s", "interval95": ends}


RIGHT = {"verdict_right": 1, "first_right": 1, "recalled": 1, "place_right": 1, "not_spurious": 0}
CAUSE = {"name": "thruster_lag", "where": "all", "parameters": {"time_constant": value(0.1234)}}
RECORDED = {
    "losses": {"pinn": {"data": "", "loss": 0.25, "gradient_norm": 30.0}},
    "diagnosis": {
        "lag-0": {"data": "", "verdict": "explained", "right": RIGHT, "causes": [CAUSE]},
        "null-0": {"data": "", "verdict": "adequate", "right": RIGHT, "causes": []},
    },
    "demo": {
        "preset": {"rmse_position": 0.6123},
        "learned": {"rmse_position": 0.2201, "coverage_0.9": 0.76},
    },
    "mppi": {"test_mppi_call[a]": {"ratio": 2.0, "seconds": 0.06}},
}


def differ(change):
    """Rows that are not unchanged after `change` of a copy of all that was recorded."""
    now = copy.deepcopy(RECORDED)
    change(now)
    rows = [row for part in RECORDED for row in compare(part, RECORDED[part], now[part])]
    return {(r.part, r.item, r.what): r.outcome for r in rows if r.outcome != "unchanged"}


def put(part, item, key, number):
    return differ(lambda now: now[part][item].update({key: number}))


def test_equal_results_are_unchanged():
    assert differ(lambda now: None) == {}


def test_a_name_or_verdict_that_differs_is_worse_unless_more_is_right():
    def rename(now, **right):
        now["diagnosis"]["lag-0"]["causes"][0]["name"] = "actuation_delay"
        now["diagnosis"]["lag-0"]["right"].update(right)

    name, verdict = (("diagnosis", "lag-0", what) for what in ("names", "verdict"))
    assert differ(rename) == {name: "worse"}
    assert differ(lambda now: rename(now, recalled=0)) == {name: "worse"}
    assert differ(lambda now: rename(now, recalled=2)) == {name: "better"}
    assert differ(lambda now: rename(now, recalled=2, not_spurious=-1)) == {name: "worse"}
    assert put("diagnosis", "lag-0", "verdict", "unexplained") == {verdict: "worse"}


def test_a_third_digit_that_differs_is_worse():
    def set_to(number):
        def change(now):
            cause = now["diagnosis"]["lag-0"]["causes"][0]
            cause["parameters"]["time_constant"]["value"] = number

        return differ(change)

    row = ("diagnosis", "lag-0", "thruster_lag.time_constant")
    assert set_to(0.1244) == {row: "worse"}
    assert set_to(0.1236) == {}  # rounded, 0.124 after 0.123; they differ in the fourth digit
    assert set_to(-0.1234) == {row: "worse"}
    assert set_to(None) == {row: "worse"}


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e7])
def test_digits_count_from_the_first_that_is_not_zero(size):
    assert same_three_digits(9.99 * size, 9.994 * size)
    assert not same_three_digits(9.99 * size, 10.0 * size)
    assert not same_three_digits(0.0, size)
    assert same_three_digits(0.0, 0.0)


def test_a_loss_differs_beyond_rounding():
    row = ("losses", "pinn", "loss")
    assert put("losses", "pinn", "loss", 0.25 + 0.9 * ROUNDING) == {}
    assert put("losses", "pinn", "loss", 0.25 + 1.1 * ROUNDING) == {row: "worse"}
    assert put("losses", "pinn", "loss", float("nan")) == {row: "worse"}
    gradient = ("losses", "pinn", "gradient_norm")
    assert put("losses", "pinn", "gradient_norm", 30 * (1 + 0.9 * ROUNDING)) == {}
    assert put("losses", "pinn", "gradient_norm", 30 * (1 + 1.1 * ROUNDING)) == {gradient: "worse"}


def test_the_demo_differs_in_the_digits_that_it_prints():
    preset, learned = (("demo", m, "position error (m)") for m in ("preset", "learned"))
    assert put("demo", "learned", "rmse_position", 0.2204) == {}
    assert put("demo", "learned", "rmse_position", 0.2212) == {learned: "worse"}
    assert put("demo", "learned", "rmse_position", 0.2188) == {learned: "better"}
    assert put("demo", "preset", "rmse_position", 0.6) == {preset: "worse"}
    band = ("demo", "learned", "inside the 90% band")
    assert put("demo", "learned", "coverage_0.9", 0.88) == {band: "better"}
    assert put("demo", "learned", "coverage_0.9", 0.5) == {band: "worse"}


def test_times_are_worse_beyond_the_factor_alone():
    row = ("mppi", "test_mppi_call[a]", "time over reference")
    assert put("mppi", "test_mppi_call[a]", "ratio", 3.9) == {}
    assert put("mppi", "test_mppi_call[a]", "ratio", 4.1) == {row: "worse"}
    assert put("mppi", "test_mppi_call[a]", "ratio", 0.9) == {row: "better"}


def test_what_is_missing_is_worse():
    assert differ(lambda now: now["diagnosis"].pop("null-0")) == {
        ("diagnosis", "null-0", "all"): "worse"
    }


def test_the_table_has_both_numbers_and_ends_with_what_is_worse():
    now = {"pinn": RECORDED["losses"]["pinn"] | {"loss": 0.26}}
    lines = table(list(compare("losses", RECORDED["losses"], now))).splitlines()
    assert lines[-2].split()[:6] == ["losses", "pinn", "loss", "0.25", "0.26", "worse"]
    assert lines[-1] == "1 unchanged, 0 better, 1 worse"


def test_every_method_is_recorded():
    assert set(baseline.METHODS) == set(METHODS)


@pytest.fixture
def training(tmp_path, monkeypatch):
    """`losses` with a training that writes its row at once; how it is told which loss."""
    told = {"loss": 0.25, "trained": []}

    def train(code, *arguments):
        if arguments[0] == "generate":
            (tmp_path / "work" / "recording.nc").write_text("recording")
            return
        out = baseline.Path(arguments[arguments.index("--out") + 1])
        out.mkdir(parents=True)
        with (out / "metrics.csv").open("w") as handle:
            rows = csv.writer(handle)
            rows.writerows([("step", "loss", "gradient_norm"), (0, told["loss"], 3.0)])
        (out / "report.html").write_text("")
        told["trained"].append(arguments[arguments.index("--method") + 1])

    monkeypatch.setattr(baseline.Code, "spinndrift", train)
    return told


def test_a_baseline_is_recorded_bit_by_bit_and_compared(tmp_path, training, capsys, monkeypatch):
    file, work = tmp_path / "before.json", tmp_path / "work"
    usual = [str(file), "--work", str(work), "--only", "losses"]

    def run(do, *more):
        code = baseline.main([do, *usual, *more])
        return code, capsys.readouterr()

    assert run("compare")[0] == 2  # nothing is recorded
    assert run("record", "--methods", "pinn")[0] == 0
    assert run("record", "--methods", "pinn", "moments")[0] == 0
    assert training["trained"] == ["pinn", "moments"]
    found = json.loads(file.read_text())
    assert list(found["parts"]["losses"]) == ["pinn", "moments"]
    code, said = run("compare")
    assert code == 0
    assert "4 unchanged, 0 better, 0 worse" in said.out
    assert training["trained"] == ["pinn", "moments"]  # of the same code what was found is kept

    monkeypatch.setattr(baseline, "surroundings", lambda: {"jax": "another"})
    training["loss"] = 0.26
    code, said = run("compare", "--methods", "pinn")
    assert code == 1
    assert "another now" in said.out
    assert training["trained"] == ["pinn", "moments", "pinn"]
    code, said = run("record")
    assert code == 2
    assert "other code" in said.err
    assert json.loads(file.read_text()) == found

    (work / "recording.nc").write_text("another")
    code, said = run("compare")
    assert code == 2
    assert "is not what pinn was recorded with" in said.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["before.json", "work"]


def test_what_is_no_checkout_is_refused(tmp_path, capsys):
    given = ["record", str(tmp_path / "x.json"), "--checkout", str(tmp_path)]
    assert baseline.main([*given, "--work", str(tmp_path / "work")]) == 2
    assert "name a checkout" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
