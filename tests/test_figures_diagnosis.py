import numpy as np
import pytest
from matplotlib.figure import Figure

from spinndrift.sims.reports.diagnosis_answer import probability
from spinndrift.sims.reports.diagnosis_report import _noise
from spinndrift.sims.reports.figures import scaled
from spinndrift.sims.reports.figures_diagnosis import horizon_figure, panel_top
from spinndrift.training.diagnosis.findings.result import (
    DataSummary,
    Diagnosis,
    Interval,
    ModelGain,
)


def gain(*position):
    table = {
        h: Interval(v, (0.8 * v, 1.2 * v)) for h, v in zip(("0.5", "1"), position, strict=True)
    }
    flat = {h: Interval(0.1, (0.05, 0.2)) for h in table}
    one = Interval(1.0, (0.5, 1.5))
    return ModelGain(one, one, flat, table, flat, flat, {"50 %": flat})


def test_a_panel_shows_belief_and_causes_and_notes_what_is_beyond():
    gains = {
        "base": gain(0.1, 0.2), "refitted": gain(0.1, 0.4), "extended": gain(0.05, 0.1),
        "black_box": gain(0.5, np.nan),
    }  # fmt: skip
    data = DataSummary([], 0, 0.0, 0.05, "pwm", [], [], {})
    told = Diagnosis(4, "adequate", "", [], [], [], {}, gains, "run", data, 0, 0.0, 0.01)
    first, *others = horizon_figure(told).axes
    assert 0.4 < first.get_ylim()[1] < 0.5
    assert [t.get_text() for t in first.texts] == ["↑ black box: diverged"]
    assert all(not ax.texts for ax in others)


@pytest.mark.parametrize(
    ("largest", "top"),
    [
        ({"base": 1.0, "extended": 0.5, "black_box": 2.0}, 2.0),
        ({"base": 1.0, "extended": 0.5, "black_box": 1e5}, 1.0),
        ({"base": 1e5, "extended": 0.5, "black_box": 1e5}, 5.0),
        ({"base": np.nan, "extended": 0.5}, 0.5),
        ({"base": np.inf, "black_box": np.nan}, 1.0),
    ],
)
def test_how_high_a_panel_reaches(largest, top):
    errors = {name: np.array([0.01, value]) for name, value in largest.items()}
    assert panel_top(errors) == pytest.approx(1.15 * top)


@pytest.mark.parametrize("values", [(0.95, 1.02, 1.1), (0.4, 2.5), (0.9, 4000.0), (1.3, 6.6)])
def test_axes_have_numbers_to_read(values):
    figure = Figure()
    ax = figure.subplots()
    ax.plot(values)
    scaled(ax, np.array(values))
    figure.draw_without_rendering()
    low, high = ax.get_ylim()
    ticks = [*ax.yaxis.get_major_ticks(), *ax.yaxis.get_minor_ticks()]
    read = [t for t in ticks if t.label1.get_text() and low <= t.get_loc() <= high]
    assert len(read) >= 2


def test_noise_has_units_and_a_p_value_that_underflows_a_bound():
    assert _noise("velocity_m_s") == "of velocities / (m/s)"
    assert _noise("diffusion_yaw") == "of the disturbance, yaw / N·m√s"
    assert probability(0.0) == "< 1e−300"
    assert probability(0.0123) == "0.012"
