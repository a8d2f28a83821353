"""Sentences of the learning report follow from the numbers beside them."""

import numpy as np
import pytest

from spinndrift.models.se3 import AXES
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.reports.demo_report import compared, task_words
from spinndrift.sims.reports.figures_learning import learning_figure, stretches
from spinndrift.sims.reports.learning_report import scale_words, taken_words
from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.training.fitting.fit import TrainingResult

MODEL = load_vehicle("bluerov2_heavy").dynamics()
STEPS = np.arange(200)


def validated(values):
    """Metrics of 200 steps with a validation after each 50."""
    validation = np.full(200, np.nan)
    validation[49::50] = values
    return {"step": STEPS, "loss": np.ones(200), "validation": validation}


def result(values, best_step, refits=()):
    """A training that took `best_step`; its model is not looked at."""
    return TrainingResult(MODEL, MODEL, 200, best_step, validated(values), (), 1.0, False, refits)


def ring(found):
    """Step and loss that the figure rings."""
    figure = learning_figure(found.metrics, found.refits, found.best_step)
    lines = [line for line in figure.axes[0].lines if line.get_label() == "taken"]
    return [(np.asarray(line.get_xdata())[0], np.asarray(line.get_ydata())[0]) for line in lines]


def test_the_step_taken_is_the_lowest_of_its_stretch_and_ringed():
    """Losses before a refit are of another scale: the lowest of all may not be the best."""
    found = result([0.1, 0.2, 0.5, 0.6], 150, (120,))
    assert taken_words(found, 4) == (
        "Step 150 is used; it has the lowest loss on 4 validation windows since bandwidths were "
        "refitted at step 120."
    )
    assert ring(found) == [(150.0, 0.5)]
    figure = learning_figure(found.metrics, found.refits, found.best_step)
    drawn = [line for line in figure.axes[0].lines if str(line.get_label()).endswith("validation")]
    assert [np.asarray(line.get_xdata()).tolist() for line in drawn] == [[50, 100], [150, 200]]


@pytest.mark.parametrize(
    ("best", "refits", "windows", "words"),
    [
        (200, (), 0, "too few data for validation windows; the last step, 200, is used."),
        (0, (), 4, "On 4 validation windows no step was better than the starting model"),
        (100, (), 1, "Step 100 is used; it has the lowest loss on 1 validation window."),
        (
            100,
            (120,),
            4,
            "also with the bandwidths refitted at step 120",
        ),
    ],
)
def test_why_a_step_was_taken(best, refits, windows, words):
    assert words in taken_words(result([0.4, 0.3, 0.5, 0.6], best, refits), windows)


def test_a_start_that_is_taken_has_no_ring():
    assert ring(result([0.4, 0.3, 0.5, 0.6], 0)) == []


def test_stretches_part_all_steps():
    parts = stretches(STEPS, (60, 120))
    assert [int(part.sum()) for part in parts] == [60, 60, 80]
    assert np.sum(parts, axis=0).tolist() == [1] * 200
    assert len(stretches(STEPS, (500,))) == 1


def rows(mass, drag):
    """The table of coefficients of a model with so many times the preset's."""
    return [(axis, 10.0, 10.0 * mass, 2.0, 2.0 * drag, 4.0, 4.0 * drag, 1.0, 1.0) for axis in AXES]


@pytest.mark.parametrize(
    ("mass", "drag", "words"),
    [
        (1.3, 1.2, "overestimates thrust appears as too much mass"),
        (0.8, 0.5, "underestimates thrust appears as too little mass"),
    ],
)
def test_what_is_said_of_thrust_is_what_the_table_shows(mass, drag, words):
    told = scale_words(rows(mass, drag))
    assert f"mass is {mass:.2f} times" in told
    assert f"{drag:.2f} times the preset's" in told
    assert words in told
    assert "thrust" not in scale_words(rows(mass, 2 - drag))


def test_errors_are_told_with_their_sizes():
    overall = {"learned": {"rmse_position": 0.238}, "preset": {"rmse_position": 0.61}}
    assert compared(overall, "position", "m") == (
        "position error 0.24 m, 39 % of the preset's 0.61 m"
    )


def test_the_dive_is_told_as_its_scenario_has_it():
    assert task_words(
        load_scenario("pylon_crossing_calm", "controller: {planner: {period: 0.5}}")
    ) == ("from (0, 0, -1.5) m to (4.5, -2, -1.5) m, with 2 plans a second")
