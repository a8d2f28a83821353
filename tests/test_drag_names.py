"""Powers of the drag: the one that data left out tell apart is named, else both are listed."""

import numpy as np
import pytest
from hidden.draw import Case
from hidden.effects_body import CubicDrag, QuadraticDrag
from hidden.scenarios import Plan
from hidden.vehicle import AXES, Vehicle

from spinndrift.models.effects import KINDS, Library
from spinndrift.models.recordings.csv import read_csv
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.training.diagnosis.findings.experiments import experiments
from spinndrift.training.diagnosis.pipeline import Diagnoser
from spinndrift.training.diagnosis.selection.hypotheses import Fit
from spinndrift.training.diagnosis.selection.model_selection import choose
from spinndrift.training.diagnosis.selection.search import Search
from spinndrift.training.diagnosis.selection.state import Selection

VEHICLE = load_vehicle("bluerov2_heavy")
LIBRARY = Library([KINDS[n].neutral() for n in ("quadratic_drag", "cubic_drag")])
QUADRATIC, CUBIC = ("quadratic_drag", "yaw"), ("cubic_drag", "yaw")
SIZES = {CubicDrag: 0.5, QuadraticDrag: 0.3}
"""Realistic sizes, as shares of the believed quadratic coefficient."""


def problem_of(tmp_path, kind, axis, loop, seed=100):
    effect = kind(axis, SIZES[kind] * float(Vehicle().quadratic[axis]))
    plan = Plan(scenarios=10, runs=1, seconds=8.0, loop=loop)
    Case(seed + axis, (effect,), plan).write(tmp_path / "data")
    return Diagnoser(read_csv(tmp_path / "data"), VEHICLE).problem


def fit(hypothesis, heldout):
    rows = tuple(LIBRARY.at(*hypothesis))
    return Fit(rows, np.full(1, 2.0), {}, np.full(1, 0.1), sum(heldout), np.array(heldout), 1e-9)


@pytest.mark.parametrize(
    ("won", "named", "listed"),
    [
        (np.full(10, 5.0), CUBIC, ()),  # 1 % of the gain, but the same in every run
        (np.full(10, 0.5), QUADRATIC, (CUBIC,)),  # below 10 nats
        (np.array([60.0, -40.0] * 5), QUADRATIC, (CUBIC,)),  # 100 nats, runs contradict each other
        (np.full(10, -5.0), QUADRATIC, ()),
    ],
)
def test_of_two_powers_with_one_parameter_each_the_data_decide(won, named, listed):
    """A share of the gain is no measure of that: a larger effect would hide the power more."""
    fits = {QUADRATIC: fit(QUADRATIC, np.full(10, 500.0)), CUBIC: fit(CUBIC, 500.0 + won)}
    choice = choose(LIBRARY, np.zeros(LIBRARY.size), fits, 8.0, 0.01)
    assert choice is not None
    assert (choice.hypothesis, choice.ties) == (named, listed)


@pytest.mark.parametrize("kind", [pytest.param(CubicDrag, marks=pytest.mark.slow), QuadraticDrag])
def test_the_hidden_power_of_yaw_is_chosen_in_closed_loop(tmp_path, kind):
    """At 0.85 rad/s, v³ wins 69 nats of 3477 over v|v|: less than 2 %, but 6 standard errors."""
    problem = problem_of(tmp_path, kind, AXES.index("yaw"), "closed")
    names = [(name, axis) for name in ("quadratic_drag", "cubic_drag") for axis in AXES]
    rows = [i for h in names for i in problem.library.at(*h)]
    seen = problem.evaluate(problem.believed, rows)
    fits = {h: seen.evidence.fit(problem.library.at(*h)) for h in names}
    choice = choose(problem.library, problem.believed, fits, 8.0, 0.01)
    assert choice is not None
    assert (choice.hypothesis, choice.ties) == ((kind.cause, "yaw"), ())


@pytest.mark.slow
@pytest.mark.parametrize("kind", [CubicDrag, QuadraticDrag])
@pytest.mark.parametrize(
    ("loop", "axis"), [("closed", "surge"), ("closed", "pitch"), ("open", "yaw")]
)
def test_the_hidden_power_is_named(tmp_path, kind, loop, axis):
    problem = problem_of(tmp_path, kind, AXES.index(axis), loop)
    found = Search(most=1).run(Selection.start(problem, problem.evaluate(problem.believed)))
    assert found.hypotheses == [(kind.cause, axis)]


@pytest.mark.slow
def test_powers_that_slow_motion_hides_are_both_listed_with_an_experiment(tmp_path):
    """In heave, below 0.5 m/s, v³ wins 2 nats, with a standard error of 2."""
    problem = problem_of(tmp_path, CubicDrag, AXES.index("heave"), "open")
    found = Search(most=1).run(Selection.start(problem, problem.evaluate(problem.believed)))
    (choice,) = found.accepted
    assert choice.hypothesis == ("quadratic_drag", "heave")
    assert choice.ties[0] == ("cubic_drag", "heave")
    rows = problem.library.at(*choice.hypothesis)
    final = problem.evaluate(found.current.theta, rows)
    told = experiments(problem, final, found.accepted, [])[choice.hypothesis].text
    assert told.startswith("to distinguish it from cubic_drag")
    assert "no maneuver" not in told
