"""The demo from end to end, made small: the shipped log, a tiny model, half a second of flight."""

import json

import pytest
from diagonal import Diagonal
from test_cli import TINY
from test_demo_diagnosis import finding, told
from test_diagnosis_answer import CAUSE, gain

from spinndrift.models.files.owned import MARKER
from spinndrift.sims import demo_diagnosis
from spinndrift.sims.demo import DEMO, EMBEDDED, demo, demo_folder
from spinndrift.sims.diagnosis_folder import DIAGNOSIS
from spinndrift.sims.reports import diagnosis_report, pages
from spinndrift.sims.reports.pages import Page
from spinndrift.sims.run.estimate import nees_words
from spinndrift.sims.run.folder import RUN
from spinndrift.sims.run.loop import simulate
from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.systems.logs.load import load_data
from spinndrift.training.fitting.run_folder import TRAINING

pytestmark = pytest.mark.whole

SECTIONS = (
    "What is wrong", "What to check", "What to fly next", "What it gains", "Held-out error",
    "The dive", "Training", "The data", "Checks of the data",
)  # fmt: skip
GAIN = gain(1.0, 0.0)
SMALL = """
duration: 0.5
controller: !MppiImpedance
  planner: {sequences: 8, realisations: 2, horizon: 10, knots: [2], effective_samples: 2.0,
    shown_paths: 4}
"""


def test_demo_tells_the_whole_story(tmp_path, monkeypatch):
    source = tmp_path / "short.nc"
    load_data(EMBEDDED).cut(0.0, 12.0).save(source)
    out = tmp_path / "demo"
    scenario = load_scenario("pylon_crossing_calm", SMALL)
    # test_cli has the fitted start of networks; this one compiles fast
    start = Diagonal.of(mass=20.0, drag=20.0, diffusion=1.0)
    given = []

    def begin(*arguments):
        given.append(arguments[4])
        return given[0].with_base(start)

    monkeypatch.setattr("spinndrift.sims.learning.starting_model", begin)
    # test_calibrate has this
    monkeypatch.setattr("spinndrift.sims.learning.calibrated", lambda model, *_: model)
    # test_demo_diagnosis has what other diagnoses lead to
    explained = finding(told(gain={"base": GAIN, "refitted": GAIN}, causes=[CAUSE]))
    monkeypatch.setattr(demo_diagnosis.pipeline, "diagnose", lambda *_, **__: explained)
    monkeypatch.setattr(diagnosis_report, "diagnosis_page", lambda *_: Page("Diagnosis"))
    flown = []

    def simulated(*given):
        flown.append(simulate(*given))
        return flown[0]

    monkeypatch.setattr("spinndrift.sims.demo.simulate", simulated)
    with demo_folder(out):
        said = demo(source, out, scenario, TINY)
    assert "the preset: It is explained." in said
    assert "dive:" in said
    found = json.loads((out / "summary.json").read_text())
    consistent = nees_words(found["estimate"])
    assert consistent is not None
    assert f"(3 on average for a consistent filter): {consistent}" in said
    assert found["diagnosis"] == {
        "verdict": "explained",
        "sentence": "It is explained.",
        "causes": [{"name": CAUSE.name, "where": CAUSE.where}],
    }
    assert found["learned_from"] == "extended"
    assert list(found["held_out"]) == ["preset", "extended", "learned"]
    assert [e.name for e in given[0].effects] == ["linear_drag"]
    assert found["training"]["steps"] == TINY.steps
    report = (out / "report.html").read_text()
    at = [report.index(f"<h2>{title}") for title in SECTIONS]
    assert at == sorted(at)
    assert f"Mean over this run: {consistent}" in report
    assert (out / "dive" / "meshcat.html").stat().st_size > 1e6
    kinds = {"": DEMO, "diagnosis": DIAGNOSIS, "training": TRAINING, "dive": RUN}
    for name, kind in kinds.items():
        folder = out / name
        assert {p.name for p in folder.iterdir() if p.is_file()} <= {*kind.files, MARKER}
        (folder / "mine").mkdir()
        (folder / "mine" / "notes.txt").write_text("mine")
    # again: the diagnosis is kept, the training goes on where it was, the dive is replaced, what
    # is foreign stays
    monkeypatch.setattr("spinndrift.sims.learning.starting_model", None)
    monkeypatch.setattr(demo_diagnosis.pipeline, "diagnose", None)
    monkeypatch.setattr("spinndrift.sims.demo.simulate", lambda *_: flown[0])
    monkeypatch.setattr(pages, "_plot", lambda *_: "data:,")  # as they were drawn above
    report = (out / "dive" / "report.html").stat()
    checkpoint = (out / "training" / "checkpoint.npz").read_bytes()
    with demo_folder(out):
        demo(source, out, scenario, TINY)
    assert (out / "training" / "checkpoint.npz").read_bytes() == checkpoint
    assert (out / "dive" / "report.html").stat().st_ino != report.st_ino
    for name in kinds:
        assert (out / name / "mine" / "notes.txt").read_text() == "mine"
