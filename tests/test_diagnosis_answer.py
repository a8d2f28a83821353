"""What a diagnosis tells a user to act on: order, words, units, and the file read back."""

import json
from dataclasses import replace

import numpy as np
import pytest
from test_demo_diagnosis import told

from spinndrift.models.config.errors import UserError
from spinndrift.sims.reports.diagnosis_answer import add_answer, gain_words, valued
from spinndrift.sims.reports.pages import Page
from spinndrift.training.diagnosis.findings.reported import unit
from spinndrift.training.diagnosis.findings.result import (
    AxisResidual,
    Cause,
    Interval,
    ModelGain,
    Ratio,
    Refitted,
    Support,
    Value,
)
from spinndrift.training.diagnosis.findings.stored import read_diagnosis


def value(v, of="1", half=0.01):
    return Value(v, of, (v - half, v + half))


def gain(position, won):
    one, flat = Interval(won, (won - 1, won + 1)), {"4": Interval(position, (0.0, 1.0))}
    share = {"50 %": flat, "90 %": flat}
    return ModelGain(one, one, flat, flat, flat, flat, share)


CAUSE = Cause(
    "thruster_gain", "3", {"gain": value(-0.45)}, Support(1e-9, 41.0), [], ["thrust_scale"],
    "to distinguish it from thrust_scale: push one thruster after the other",
)  # fmt: skip
RATIOS = [
    Ratio("inertia", "heave", 1.62, value(1.0)),
    Ratio("linear_drag", "surge", 0.2, Value(0.0, "1/s", (-0.01, 0.01))),
    Ratio("half_thrust", "yaw", 14.0, value(48.0, "rad/s²")),
    Ratio("restoring", "roll", 6.0, value(6.05, "rad/s²")),
]
NOISE = AxisResidual(1.0, 0.0, 0.0)
SAID = replace(
    told(),
    causes=[CAUSE],
    ratios=RATIOS,
    refitted=[Refitted("linear_drag", "surge", "change", 4.0, value(0.0, "N·s/m"))],
    left=["forecasts over 4 s leave their bands"],
    gain={"base": gain(1.0, 0.0), "extended": gain(0.1, 12 * np.log(4))},
    residual=dict.fromkeys("abcdefghijkl", NOISE),
)


def page():
    return add_answer(Page("A diagnosis"), SAID).html()


def test_what_a_user_acts_on_comes_first_and_in_order():
    html = page()
    order = ["What is wrong", "thrust at half command in yaw", "inertia in heave",
             "linear drag in surge", "thruster gain", "What to check", "leave their bands",
             "What to fly next", "push one thruster", "What it gains"]  # fmt: skip
    # the navigation names the sections before
    at = [html.index(part, html.index("<h2>What is wrong")) for part in order]
    assert at == sorted(at)
    assert "3.4 of yours" in html
    assert "righting moment" not in html.split("<details>")[0], "1 % is no practical size"


def test_fitted_coefficients_and_evidence_are_closed():
    html = page()
    folds = html.split("<details>")
    assert len(folds) == 4
    assert [f.split("</summary>")[0] for f in folds[1:]] == [
        "<summary>All coefficients over inertia",
        "<summary>All fitted coefficients",
        "<summary>Evidence for the causes",
    ]
    outside = folds[0] + "".join(f.split("</details>")[1] for f in folds[1:])
    assert "nats" not in outside


def test_a_gain_is_told_as_errors_of_forecasts():
    told_ = gain_words(SAID)
    assert "position from 1 to 0.1 m" in told_
    # log(4) nats on each of 12 channels: errors and bands of a quarter
    assert "shrink to 25 % of what they were" in told_


def test_units_are_those_of_the_quantity_and_none_is_no_unit():
    assert valued(value(-0.45)) == "−0.45 (−0.46 … −0.44)"
    assert valued(value(48.0, "rad/s²")).endswith(") rad/s²")
    assert value(2.0).with_unit == "2"
    assert value(2.0, "N").with_unit == "2 N"
    assert unit("m", "pitch_from_surge") == "m"
    assert unit("N·s/m", "sway_from_yaw") == "N·s/rad"


def test_a_diagnosis_is_read_as_it_was_written(tmp_path):
    path = tmp_path / "diagnosis.json"
    SAID.save(path)
    assert read_diagnosis(path) == SAID
    data = json.loads(path.read_text())
    del data["data"]["findings"]  # older files lack them
    path.write_text(json.dumps(data))
    assert read_diagnosis(path) == SAID
    data["threshold"] = None
    path.write_text(json.dumps(data))
    assert np.isnan(read_diagnosis(path).threshold)
    for broken in ({**data, "version": 1}, {**data, "verdict": "perhaps"}, {"version": 4}, []):
        path.write_text(json.dumps(broken))
        with pytest.raises(UserError, match=r"diagnosis.json: is no diagnosis.json of this"):
            read_diagnosis(path)
