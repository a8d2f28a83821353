"""`spinndrift check`: blind cases are what they say, judgements and tables follow their rules."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hidden.blind import Blind, told
from hidden.draw import draw
from hidden.effects import CAUSES, FAMILY
from hidden.effects_body import Proximity
from hidden.episode import APART, PARTS, draw_episode
from hidden.scenarios import Plan

from spinndrift.models.config.errors import UserError
from spinndrift.models.effects import KINDS, Extended, Library
from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.diagnosis_benchmark import run as running
from spinndrift.sims.diagnosis_benchmark.cases import (
    Case,
    HiddenCause,
    Part,
    Truth,
    find_cases,
    read_oracle,
)
from spinndrift.sims.diagnosis_benchmark.judging import Judgement, compare, gain_of
from spinndrift.sims.diagnosis_benchmark.pages import write_page
from spinndrift.sims.diagnosis_benchmark.tables import interval, share, tables
from spinndrift.sims.reports.marked_page import BEGIN, END
from spinndrift.training.diagnosis.findings import result

pytestmark = pytest.mark.whole

VEHICLE = load_vehicle("bluerov2_heavy")
PLAN = Plan(scenarios=2, runs=1, seconds=2.0, h=0.01)
LIBRARY = Library(
    [k.neutral(thrusters=8) for k in KINDS.values() if not k.absorber and k.family != "disturbance"]
)
MEANS = [
    name
    for name in CAUSES
    if name not in ("current_varying", "waves") and not name.startswith("disturbance")
]
FIRST = {FAMILY[name]: name for name in reversed(MEANS)}.values()
"""One cause of each family; `make slow` takes all."""
LEAST = {"load_droop": 0.95, "drag_coupling": 0.95, "clock_offset": 0.95}
"""Share of the gain where the published definition is an approximation of the simulator's."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("blind")


def in_library(effect):
    """θ of an effect from what `truth.yaml` says of it."""
    answer = told(effect)
    values = dict(answer["parameters"])
    if answer["name"] == "tether":
        k = effect.stiffness
        arm = dict(zip(("arm_x", "arm_y", "arm_z"), effect.attachment, strict=True))
        values |= {"pull_up": k * effect.anchor[2], **arm}
    if answer["name"] == "payload":
        values["height"] = effect.position[2]
    if answer["name"] == "drag_coupling":
        lever = values["quadratic"] / VEHICLE.quadratic_damping[effect.axis]
        values["linear"] = lever * VEHICLE.linear_damping[effect.axis]
    if answer["name"] == "dvl_lever_arm":
        places = {axis: {"offset": getattr(effect, axis)} for axis in "xyz"}
    else:
        places = {answer["where"]: values}
    theta = np.zeros(LIBRARY.size)
    for where, own in places.items():
        for name, value in own.items():
            theta[LIBRARY.index(answer["name"], where, name)] = value
    return theta


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.slow] * (n not in FIRST)) for n in MEANS],
)
def test_truths_in_published_definitions_are_what_was_simulated(folder, name):
    """A model with the parameters that truth.yaml tells forecasts what the true model does."""
    case = draw(31, names=(name,), plan=PLAN)
    if isinstance(case.effects[0], Proximity):
        pytest.skip("its place can't be told from its drag, so no parameter is published")
    Blind(name, "single", case).write(folder / name)
    found = find_cases(folder, [name])[0]
    theta = jnp.asarray(in_library(case.effects[0]))
    plain = Extended.create(VEHICLE.dynamics(), LIBRARY.filled(0 * theta), VEHICLE.thrusters())
    gain = gain_of(found, plain, plain.with_effects(LIBRARY.filled(theta)), VEHICLE)
    assert gain["all"] > LEAST.get(name, 0.99), gain


def test_a_case_reads_as_it_was_written(folder):
    case = draw(5, "pair", plan=replace(PLAN, scenarios=2, seconds=1.5))
    Blind("pair-5", "pair", case).write(folder / "pair-5")
    found = find_cases(folder, ["pair-*"])[0]
    assert [c.name for c in found.truth.causes] == [e.cause for e in case.effects]
    assert found.truth.verdict == case.answer()["verdict"]
    assert found.has_oracle
    fresh = read_csv(found.folder / "fresh")
    for run, (X, _) in zip(fresh.trajectories(), read_oracle(found.folder / "oracle"), strict=True):
        np.testing.assert_allclose(X[:, 0], run.X_WB[0], atol=1e-8)
        assert 0 < np.abs(X[4:, 20] - run.X_WB[20, 4:]).max() < 0.2


def test_folders_without_a_case_and_wrong_answers_are_refused(tmp_path):
    with pytest.raises(UserError, match="holds no case"):
        find_cases(tmp_path)
    (tmp_path / "one").mkdir()
    truth = tmp_path / "one" / "truth.yaml"
    truth.write_text("kind: single\nverdict: explained\ncauses: [{name: gremlins}]\n")
    with pytest.raises(UserError, match="gremlins"):
        find_cases(tmp_path)
    truth.write_text("kind: single\nverdict: explained\n"
                     "causes: [{name: thruster_lag, parameters: {tau: 0.1}}]\n")  # fmt: skip
    with pytest.raises(UserError, match="time_constant"):
        find_cases(tmp_path)
    truth.write_text("kind: 'null'\nverdict: adequate\n")
    assert find_cases(tmp_path)[0].truth.called == "null"
    with pytest.raises(UserError, match="fits none"):
        find_cases(tmp_path, ["lag*"])


def diagnosis(*causes, problems=()):
    data = result.DataSummary([], 1, 1.0, 0.05, "pwm", list(problems), ["sway was not driven"], {})
    return result.Diagnosis(
        result.VERSION, "explained" if causes else "adequate", "", list(causes), [], [], {}, {},
        "scenario", data, 1, 8.0, 0.01,
    )  # fmt: skip


def cause(name, where="all", **parameters):
    values = {k: result.Value(v, "1", (v - 1.96 * s, v + 1.96 * s)) for k, (v, s) in
              parameters.items()}  # fmt: skip
    return result.Cause(name, where, values, result.Support(0.0, 100.0), [], [], "")


def test_judgements_follow_the_rules():
    lag = HiddenCause("thruster_lag", "all", {"time_constant": 0.1}, 0.0, ("actuation_delay",))
    truth = Truth("single", "explained", causes=(lag,))
    right = compare(truth, diagnosis(cause("thruster_lag", time_constant=(0.103, 0.001))))
    assert right["first_right"]
    assert right["z"]["thruster_lag.time_constant"] == pytest.approx(3, rel=1e-3)
    assert right["ratio"]["thruster_lag.time_constant"] == pytest.approx(1.03)
    twin = compare(truth, diagnosis(cause("actuation_delay"), cause("lift", "heave")))
    assert (twin["first_right"], twin["place_right"], twin["spurious"]) == (True, None, 1)
    assert (twin["recalled"], twin["z"]) == (1, {})
    alike = replace(cause("lift", "heave"), indistinguishable_from=["thruster_lag"])
    told = compare(truth, diagnosis(alike))
    assert (told["first_right"], told["declared"]) == (False, True)
    assert not compare(truth, diagnosis(cause("lift", "heave")))["declared"]
    loose = Truth("single", "explained", causes=(replace(lag, tolerance=0.05),))
    within = compare(loose, diagnosis(cause("thruster_lag", time_constant=(0.103, 0.001))))
    assert within["z"]["thruster_lag.time_constant"] == 0
    null = Truth("null", "adequate")
    assert compare(null, diagnosis())["first_right"]
    assert not compare(null, diagnosis(cause("lift", "heave")))["verdict_right"]
    fault = Truth("fault", "adequate", problems=("stuck",), limits=("sway",))
    assert compare(fault, diagnosis(problems=["u is stuck"]))["told"]
    assert not compare(fault, diagnosis())["told"]


def test_the_part_in_which_a_cause_acts_is_judged_by_run_and_times():
    hidden = HiddenCause("thruster_gain", when=Part("window", "yaw, run 2", 3.1, 6.4))
    truth = Truth("part", "explained", causes=(hidden,))

    def said(kind, run, start, end):
        when = result.When(kind, run, start, run, end, "")
        return compare(truth, diagnosis(replace(cause("thruster_gain", "3"), when=when)))

    assert said("window", "yaw, run 2", 3.4, 6.0)["when_right"]
    assert not said("window", "yaw, run 2", 3.4, 5.8)["when_right"]
    assert not said("window", "yaw, run 1", 3.1, 6.4)["when_right"]
    assert not said("onwards", "yaw, run 2", 3.1, 6.4)["when_right"]
    always = compare(truth, diagnosis(cause("thruster_gain", "3")))
    assert (always["first_right"], always["when_right"]) == (True, False)
    constant = Truth("single", "explained", causes=(replace(hidden, when=None),))
    assert compare(constant, diagnosis(cause("thruster_gain", "3")))["when_right"]


@pytest.mark.parametrize("name", PARTS)
def test_cases_with_a_cause_in_a_part_of_a_session_say_which(folder, name):
    rng = np.random.default_rng(3)
    effect, when = draw_episode(name, PLAN, rng)
    case = draw(7, "null", plan=PLAN)
    blind = Blind(f"part-{name}-0", "part", replace(case, effects=(effect,)), when=when)
    blind.write(folder / blind.name)
    (found,) = find_cases(folder, [blind.name])
    (hidden,) = found.truth.causes
    recording, runs = found.read(), PLAN.scenarios * PLAN.runs
    assert (found.truth.called, hidden.name) == (name, effect.cause)
    assert hidden.when is not None
    assert hidden.when.kind == when.kind
    assert hidden.when.run == recording.scenarios[when.run - 1]
    assert np.allclose(np.diff([run.start for run in recording.trajectories()]), APART)

    def strength(run, t):
        return effect.strength(t)[run - 1]

    assert strength(runs, PLAN.seconds) == pytest.approx(float(when.kind != "window"))
    begins = [strength(when.run, when.start + t) for t in (-0.01, 0.01)]
    assert when.kind == "drift" or begins == [0, 1]


def test_intervals_are_those_of_clopper_and_pearson():
    """Closed forms at the ends; the published interval of 4 in 20."""
    low, high = interval(0, 20)
    assert (low, high) == (0, pytest.approx(1 - 0.025 ** (1 / 20)))
    low, high = interval(20, 20)
    assert (low, high) == (pytest.approx(0.025 ** (1 / 20)), 1)
    assert interval(4, 20) == (pytest.approx(0.0573, abs=1e-4), pytest.approx(0.4366, abs=1e-4))
    assert share(0, 0) == "–"


def test_cases_are_judged_once_and_the_page_keeps_its_own_words(tmp_path, monkeypatch):
    cases = [Case(tmp_path / f"null-{i}", Truth("null", "adequate")) for i in range(2)]
    cases.append(Case(tmp_path / "lag", Truth("single", "explained", "thruster_lag")))
    calls = []

    class Finding:
        diagnosis = diagnosis()

    def judge(case, alpha, progress):
        calls.append(case.name)
        if len(calls) == 2:
            raise KeyboardInterrupt
        progress(0.5, "half")
        single = case.truth.kind == "single"
        return Judgement(
            case.name, case.truth.kind, case.truth.called, 1.0, "usual", "adequate", not single,
            ["thruster_lag"] * single, [], not single, not single, None, True, 0, 0, seconds=2.0,
        ), Finding()  # fmt: skip

    monkeypatch.setattr(running, "judge", judge)
    seen = []
    with pytest.raises(KeyboardInterrupt):
        running.run_cases(cases, tmp_path / "out", 0.01, lambda f, r="": seen.append(f))
    rows, _ = running.run_cases(cases, tmp_path / "out", 0.01, lambda f, r="": seen.append(f))
    assert calls == ["null-0", "null-1", "null-1", "lag"]
    assert seen[-1] == 1
    with pytest.raises(UserError, match="name another --out"):
        running.run_cases(cases, tmp_path / "out", 0.05, lambda f, r="": None)
    page = tmp_path / "page.md"
    page.write_text(f"# Mine\n\n{BEGIN}\nstale\n{END}\n\nThe end.\n")
    write_page(page, rows, cases)
    text = page.read_text()
    assert text.startswith("# Mine")
    assert text.endswith("The end.\n")
    assert "stale" not in text
    assert "| false alarms | 0 of 2 (0.00 to 0.84) |" in text
    assert "| thruster_lag | 0 of 1 | adequate |" in text
    assert "| usual | 2 of 2 (0.16 to 1.00) | 0 of 1 (0.00 to 0.97) | 2 of 3" in text
    assert len(tables(rows)) == 3

    def broken(case, alpha, progress):
        if case.name == "null-0":
            raise ZeroDivisionError("once")
        return judge(case, alpha, progress)

    monkeypatch.setattr(running, "judge", broken)
    rows, failed = running.run_cases(cases, tmp_path / "other", 0.01, lambda f, r="": None)
    assert [row["case"] for row in rows] == ["null-1", "lag"]
    assert [(str(f.task), f.reason) for f in failed] == [("null-0", "ZeroDivisionError: once")]
    (tmp_path / "out" / "lag" / "judged.json").write_text(json.dumps([1]))
    with pytest.raises(UserError, match="no judgement"):
        running.run_cases(cases, tmp_path / "out", 0.01, lambda f, r="": None)
