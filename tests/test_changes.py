"""Causes that act in a part of the data: which, when and how much; constant ones stay constant."""

from dataclasses import replace

import numpy as np
import pytest
from hidden.draw import Case
from hidden.effects_actuation import ThrusterGain
from hidden.effects_body import NetBuoyancy
from hidden.effects_measurement import HeadingError
from hidden.episode import Episode, session, within
from hidden.scenarios import Plan
from hidden.write import change, write_folder

from spinndrift.models.effects import KINDS, Library
from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.changes.accept import with_changes
from spinndrift.training.diagnosis.changes.scan import Scan
from spinndrift.training.diagnosis.changes.session import Session, Span
from spinndrift.training.diagnosis.filter.innovations import predict
from spinndrift.training.diagnosis.filter.varying import Part, VaryingLibrary, parts_of
from spinndrift.training.diagnosis.findings.result import When
from spinndrift.training.diagnosis.pipeline import DiagnoseConfig, Diagnoser, diagnose
from spinndrift.training.diagnosis.selection.search import Search
from spinndrift.training.diagnosis.selection.state import Selection

pytestmark = pytest.mark.whole

VEHICLE = load_vehicle("bluerov2_heavy")
PLAN = Plan(scenarios=5, runs=2, seconds=8.0)
RUNS = 10
APART = 60.0
"""Time between the starts of two runs of a session (s)."""
WHEN = When("window", "a", 0.0, "a", 1.0, "0.0 to 1.0 s")


def recorded(tmp_path, *effects, ordered=False):
    """A recording with hidden effects; with times of day if the order of runs is known."""
    runs = Case(4, effects, PLAN).logged()
    if ordered:
        runs = [change(r, t=r.columns["t"] + APART * k) for k, r in enumerate(runs)]
    write_folder(tmp_path / "data", runs, rate=PLAN.rate)
    return read_csv(tmp_path / "data")


def problem_of(recording):
    return Diagnoser(recording, VEHICLE).problem


def started(recording):
    problem = problem_of(recording)
    return Selection.start(problem, problem.evaluate(problem.believed))


def found(tmp_path, *effects, ordered=False):
    """The selection with constant causes, then with those in parts."""
    search, state = Search(most=2), started(recorded(tmp_path, *effects, ordered=ordered))
    return with_changes(search.run(state), search)


@pytest.mark.slow
def test_a_diagnosis_says_when_a_thruster_was_fouled(tmp_path):
    fouled = Episode(ThrusterGain(3, 0.4), within(RUNS, 7, 3.1, 6.4))
    d = diagnose(recorded(tmp_path, fouled), VEHICLE, config=DiagnoseConfig(refit="none")).diagnosis
    assert [(c.name, c.where) for c in d.causes] == [("thruster_gain", "3")]
    (cause,) = d.causes
    when, gain = cause.when, cause.parameters["gain"]
    assert when is not None
    assert when.kind == "window"
    assert when.first_run == when.last_run
    assert when.start == pytest.approx(3.1, abs=0.3)
    assert when.end == pytest.approx(6.4, abs=0.3)
    assert abs(gain.value + 0.6) < 3 * (gain.interval95[1] - gain.interval95[0]) / 3.92
    assert when.text in d.sentence
    assert d.verdict == "explained"


@pytest.mark.slow
def test_a_thruster_that_is_fouled_for_seconds_is_found_in_its_part(tmp_path):
    fouled = Episode(ThrusterGain(3, 0.4), within(RUNS, 7, 3.1, 6.4))
    state = found(tmp_path, ThrusterGain(5, 0.7), fouled)
    assert state.hypotheses == [("thruster_gain", "5"), ("thruster_gain#1", "3")]
    (part,) = parts_of(state.problem.library)
    assert part.when.first_run == part.when.last_run
    assert part.when.start == pytest.approx(3.1, abs=0.3)
    assert part.when.end == pytest.approx(6.4, abs=0.3)
    assert part.final == 0.0
    (left,) = state.problem.library.used(state.current.theta)  # it has ended, the other lasts
    assert np.flatnonzero(np.asarray(left.values)).tolist() == [4]


@pytest.mark.slow
def test_a_slow_leak_is_a_drift_of_the_buoyancy_over_the_session(tmp_path):
    course = session(RUNS, APART, lambda s: s / (APART * (RUNS - 1) + 8.0))
    state = found(tmp_path, Episode(NetBuoyancy(force=-4.0), course), ordered=True)
    assert state.hypotheses == [("net_buoyancy#1", "all")]
    (part,) = parts_of(state.problem.library)
    assert part.when.kind == "drift"
    assert part.final == 1.0
    (row,) = state.problem.library.at(*state.hypotheses[0])
    error = state.current.evidence.fit([row]).errors[0]
    assert abs(state.current.theta[row] + 4.0) < 3 * error < 2.0
    (last,) = state.problem.library.used(state.current.theta)  # what remains after the session
    assert float(np.asarray(last.values).min()) == pytest.approx(state.current.theta[row])


@pytest.mark.slow
def test_a_compass_that_turns_between_two_runs_is_found_from_there_on(tmp_path):
    course = session(RUNS, APART, lambda s: (s > 5.5 * APART) * 1.0)
    state = found(tmp_path, Episode(HeadingError(constant=0.1), course), ordered=True)
    assert state.hypotheses == [("heading_error#1", "all")]
    (part,) = parts_of(state.problem.library)
    assert part.when.kind == "onwards"
    assert part.when.start < 1.5
    started_at = state.problem.data.started
    assert started_at is not None
    assert np.array_equal(part.envelope[0] > 0, started_at > 5.5 * APART)
    offset = state.problem.library.index("heading_error#1", "all", "offset")
    assert state.current.theta[offset] == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize(
    "effects",
    [
        pytest.param((), id="nothing", marks=pytest.mark.slow),
        pytest.param((ThrusterGain(3, 0.7),), id="constant", marks=pytest.mark.slow),
    ],
)
def test_what_does_not_change_is_not_found_in_parts(tmp_path, effects):
    state = found(tmp_path, *effects, ordered=True)
    assert state.hypotheses == [("thruster_gain", "3")] * len(effects)


@pytest.mark.slow
def test_an_envelope_of_one_is_the_effect_itself_and_of_zero_none(tmp_path):
    problem = started(recorded(tmp_path)).problem
    data = problem.data
    M, R = data.weight.shape[0] + 1, data.weight.shape[1]
    for name, where, value in (("thruster_gain", "3", -0.4), ("dvl_scale", "all", 0.1)):
        every_other = np.broadcast_to(np.arange(R) % 2.0, (M, R))
        envelopes = np.ones((M, R)), np.zeros((M, R)), every_other
        errors = []
        for envelope in envelopes:
            own = problem.with_part(Part(f"{name}#1", where, envelope, 0.0, WHEN))
            theta = own.believed.copy()
            theta[own.library.at(f"{name}#1", where)] = value
            errors.append(own.errors(theta))
        constant = problem.believed.copy()
        constant[problem.library.at(name, where)] = value
        expected = problem.errors(constant), problem.errors(problem.believed)
        for error, truth in zip(errors, expected, strict=False):
            np.testing.assert_allclose(error, truth, atol=1e-12)
        odd = np.arange(R) % 2 == 1
        np.testing.assert_allclose(errors[2][..., odd], expected[0][..., odd], atol=1e-12)
        np.testing.assert_allclose(errors[2][..., ~odd], expected[1][..., ~odd], atol=1e-12)


@pytest.mark.slow
def test_sensitivities_to_a_part_are_those_of_differences(tmp_path):
    problem = started(recorded(tmp_path)).problem
    M, R = problem.data.weight.shape[0] + 1, problem.data.weight.shape[1]
    envelope = np.zeros((M, R))
    envelope[40:90, 2] = 1.0
    problem = problem.with_part(Part("net_buoyancy#1", "all", envelope, 0.0, WHEN))
    (row,) = problem.library.at("net_buoyancy#1", "all")
    at = problem.evaluate(problem.believed, [row])
    moved = problem.believed.copy()
    moved[row] = 0.1
    away = problem.evaluate(moved, [row], at.kalman)
    # the loss is quadratic: its difference is that of the products
    total, size = at.evidence.total, 0.1
    predicted = size * total[0, 1] + size**2 * total[1, 1] / 2
    assert away.loss - at.loss == pytest.approx(predicted, rel=0.02, abs=0.02)
    V = predict(problem.model, problem.library, moved, problem.data).V
    still = predict(problem.model, problem.library, problem.believed, problem.data).V
    changed = np.abs(np.asarray(V) - np.asarray(still)).max(axis=1) > 1e-9
    assert np.array_equal(changed, envelope[:-1] > 0)


def test_gains_of_parts_are_those_of_least_squares(tmp_path):
    problem = problem_of(recorded(tmp_path))
    steps = Session.of(problem.data)
    rng = np.random.default_rng(1)
    z = rng.standard_normal((6, 12 * len(steps.run)))
    scan = Scan(z, steps, {("a", "all"): [1, 2], ("b", "all"): [3]}, [4, 5], np.full(6, 1e-9))
    own = scan.of(("a", "all"))
    envelope = np.repeat(steps.envelope(own.span), 12)

    def loss(rows):
        J = np.stack(rows, axis=1)
        rest = z[0] - J @ np.linalg.lstsq(J, z[0], rcond=None)[0]
        return rest @ rest / 2

    free = [z[4], z[5]]
    with_own = [*free, envelope * z[1], envelope * z[2]]
    assert own.gain == pytest.approx(loss(free) - loss(with_own), abs=1e-5)
    for a, b in ((0, 5), (3, 9)):  # no window of a run wins more
        window = np.repeat(steps.envelope(Span("window", *steps.edges[[a, b]].tolist())), 12)
        rows = [*free, window * z[1], window * z[2]]
        assert loss(free) - loss(rows) <= own.gain + 1e-6
    after = scan.with_change(own).of(("b", "all"))
    inside = np.repeat(steps.envelope(after.span), 12)
    gained = loss(with_own) - loss([*with_own, inside * z[3]])
    assert after.gain == pytest.approx(gained, abs=1e-5)


def test_what_acts_in_most_of_a_session_is_repeated_beside_a_constant_that_is_free(tmp_path):
    problem = problem_of(recorded(tmp_path, ordered=True))
    steps = Session.of(problem.data)
    rng = np.random.default_rng(2)
    z = rng.standard_normal((2, 12 * len(steps.run)))
    scan = Scan(z, steps, {("a", "all"): [1]}, [1], np.full(2, 1e-9))
    acting = np.repeat(steps.envelope(Span("onwards", int(steps.edges[20]), len(steps.run))), 12)
    moved = replace(scan, z=np.stack([z[0] + 0.2 * acting * z[1], z[1]]))
    change = moved.of(("a", "all"))
    assert change.span.kind == "onwards"
    assert abs(change.span.first - steps.edges[20]) < 2 * np.diff(steps.edges).max()
    assert change.repeated > 0.8 * change.gain > 40
    knock = np.zeros_like(acting)
    knock[12 * steps.edges[30] : 12 * steps.edges[31]] = 1.0
    one = replace(scan, z=np.stack([z[0] + 2.0 * knock * z[1], z[1]])).of(("a", "all"))
    assert one.repeated < 0.5 * one.gain


def test_a_session_has_the_order_of_its_times_and_its_parts_lie_within_runs_without(tmp_path):
    known = Session.of(problem_of(recorded(tmp_path / "a", ordered=True)).data)
    assert known.ordered
    assert np.all(np.diff(known.clock) > 0)
    assert known.clock[-1] > 8 * APART
    unknown = Session.of(problem_of(recorded(tmp_path / "b")).data)
    assert not unknown.ordered
    assert len(unknown.labels) == RUNS
    runs = Case(4, (), PLAN).logged()
    runs = [change(r, t=r.columns["t"] + 0.01 * k) for k, r in enumerate(runs)]  # they overlap
    write_folder(tmp_path / "c", runs, rate=PLAN.rate)
    assert not Session.of(problem_of(read_csv(tmp_path / "c")).data).ordered
    edges = unknown.edges.tolist()
    for a, b in unknown.pairs:
        span = Span("window", edges[a], edges[b])
        assert len(np.unique(unknown.run[span.first : span.last])) == 1
    blocks = np.diff(unknown.edges)
    assert blocks.min() >= 8
    assert blocks.sum() == len(unknown.run)


def test_parts_have_names_of_their_own_and_are_no_causes_to_search():
    effects = [KINDS["net_buoyancy"].neutral(), KINDS["payload"].neutral()]
    part = Part("net_buoyancy#1", "all", np.ones((3, 1)), 0.5, WHEN)
    library, plain = VaryingLibrary(effects, [part]), Library(effects)
    assert library.hypotheses() == plain.hypotheses()
    assert library.entries[: plain.size] == plain.entries
    theta = np.zeros(library.size)
    theta[library.at("net_buoyancy#1", "all")] = -2.0
    (left,) = library.used(theta)
    assert float(np.asarray(left.values).min()) == -1.0
    assert not replace(part, final=0.0).final
    assert not Library(effects).used(np.zeros(plain.size))
