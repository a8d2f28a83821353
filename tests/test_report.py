"""Report and replay are each one file that needs nothing else."""

import re

import numpy as np
import pytest
from run_example import GOAL, example_log

from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.reports import figures_path, figures_time
from spinndrift.sims.reports.figures_path import Scene
from spinndrift.sims.reports.meshcat_replay import write_replay
from spinndrift.sims.reports.run_report import run_page
from spinndrift.sims.run.metrics import clearance, metrics
from spinndrift.sims.scenarios.criteria import FollowPath, Outcome, ReachGoal
from spinndrift.systems.planning.mppi import FIGURES
from spinndrift.systems.planning.obstacles import Pylon

pytestmark = pytest.mark.whole

VEHICLE = load_vehicle("bluerov2_heavy")
PYLONS = (Pylon(1.5, -1.2, 0.4, name="near pylon"), Pylon(3.0, 0.2, 0.4))
SCENE = Scene(VEHICLE.size, PYLONS, GOAL, water_depth=5.0)


def test_report_of_a_crossing():
    log = example_log(8.0)
    outcome = Outcome("goal", 8.0, "The vehicle reached the goal after 8.0 s.")
    values = metrics(log, outcome, ReachGoal(), VEHICLE, PYLONS, np.array(GOAL))
    html = run_page(
        log,
        values,
        SCENE,
        title="Crossing",
        scenario_text="name: crossing\nseed: 3\n",
        limits=np.array([100.0, 100, 150, 15, 15, 20]),
        clearance=clearance(log, VEHICLE, PYLONS),
        replay="meshcat.html",
    ).html()
    assert "The vehicle reached the goal after 8.0 s." in html
    assert 'class="verdict good"' in html
    for title in ("Path", "Planning", "Tracking", "Estimate", "Commands", "Disturbances"):
        assert f"<h2>{title}</h2>" in html
    assert "the chance constraint allows, 5 %. Every plan satisfies it." in html
    assert "seed: 3" in html
    assert "NEES, the squared error normalised by the estimated covariance, is 3 on average" in html
    assert "Estimator health: good 75 %, degraded (dvl) 25 %." in html
    assert 'href="meshcat.html"' in html
    assert html.count("<img ") == html.count('src="data:image/') == 9
    assert len(html) < 5e6
    assert not re.search(r'(src|href)="https?:', html)


def test_report_of_a_run_that_ended_at_once():
    log = example_log(0.1, planned=False)
    outcome = Outcome("interrupted", 0.1, "The run was interrupted after 0.1 s.")
    values = metrics(log, outcome, FollowPath(), VEHICLE)
    html = run_page(log, values, Scene(VEHICLE.size), title="Short").html()
    assert 'class="verdict bad"' in html
    assert "<h2>Planning</h2>" not in html


def test_a_chance_constraint_that_could_not_hold_is_told():
    log = example_log(4.0)
    log.recording.dataset["planner_figures"][3:5, FIGURES.index("collision_probability")] = 0.2
    outcome = Outcome("no progress", 4.0, "The vehicle made no progress.")
    values = metrics(log, outcome, ReachGoal(), VEHICLE, PYLONS, np.array(GOAL))
    assert values["planner"]["plans_beyond_allowed"] == 2
    html = run_page(log, values, SCENE, title="Crossing").html()
    assert "In 2 of 19 plans no sampled sequence satisfied it" in html
    assert "the risk was up to 20 %" in html
    drawn = figures_time.planner_figure(log)
    assert drawn is not None
    allowed = [line for line in drawn.axes[1].lines if line.get_label() == "allowed"]
    assert [np.asarray(line.get_ydata())[0] for line in allowed] == [5.0]


def test_figures_do_not_change_matplotlib():
    import matplotlib

    before = dict(matplotlib.rcParams)
    figures_path.path_figure(example_log(1.0), SCENE)
    assert dict(matplotlib.rcParams) == before


def test_pictures_keep_the_proportions_of_space():
    figure = figures_path.path_figure(example_log(4.0), SCENE)
    above, side = figure.axes
    for ax in (above, side):
        assert ax.get_aspect() == 1.0
    x, y = above.get_xlim(), above.get_ylim()
    for pylon in PYLONS:
        assert x[0] < pylon.x < x[1]
        assert y[0] < pylon.y < y[1]
    assert x[0] < GOAL[0] < x[1]


def test_no_samples_no_picture_of_them():
    log = example_log(1.0, planned=False)
    assert figures_path.samples_figure(log, SCENE) is None
    assert figures_time.planner_figure(log) is None
    assert figures_time.progress_figure(log, None, None) is None


def test_replay_is_one_file(tmp_path, caplog):
    path = write_replay(tmp_path / "meshcat.html", example_log(2.0), SCENE, VEHICLE)
    text = path.read_text(encoding="utf-8")
    assert len(text) > 1e6
    assert not re.search(r'<script[^>]* src=|<link[^>]* href="http', text)
    assert [item.name for item in tmp_path.iterdir()] == ["meshcat.html"]
    assert not caplog.records


@pytest.mark.parametrize("duration", [0.05, 0.2])
def test_replay_of_hardly_anything(tmp_path, duration):
    write_replay(tmp_path / "m.html", example_log(duration, planned=False), SCENE, VEHICLE)
