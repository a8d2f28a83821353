"""The demo from end to end, made small: the shipped log, a tiny model, half a second of flight."""

import json

from diagonal import Diagonal
from test_cli import TINY

from spinndrift.models.files.owned import MARKER
from spinndrift.sims.demo import DEMO, EMBEDDED, demo, demo_folder
from spinndrift.sims.run.estimate import nees_words
from spinndrift.sims.run.folder import RUN
from spinndrift.sims.run.loop import simulate
from spinndrift.sims.scenarios.scenario import load_scenario
from spinndrift.systems.logs.load import load_data
from spinndrift.training.fitting.run_folder import TRAINING

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
    monkeypatch.setattr("spinndrift.sims.learning.starting_model", lambda *_: start)
    flown = []

    def simulated(*given):
        flown.append(simulate(*given))
        return flown[0]

    monkeypatch.setattr("spinndrift.sims.demo.simulate", simulated)
    with demo_folder(out):
        told = demo(source, out, scenario, TINY)
    assert "preset" in told
    assert "dive:" in told
    found = json.loads((out / "summary.json").read_text())
    consistent = nees_words(found["estimate"])
    assert consistent is not None
    assert f"(3 on average for a consistent filter): {consistent}" in told
    assert set(found["held_out"]) == {"preset", "learned"}
    assert found["training"]["steps"] == TINY.steps
    report = (out / "report.html").read_text()
    for section in ("The data", "Training", "Held-out error", "The dive"):
        assert section in report
    assert f"Mean over this run: {consistent}" in report
    assert (out / "dive" / "meshcat.html").stat().st_size > 1e6
    for folder, kind in ((out, DEMO), (out / "training", TRAINING), (out / "dive", RUN)):
        assert {p.name for p in folder.iterdir() if p.is_file()} <= {*kind.files, MARKER}
        (folder / "mine").mkdir()
        (folder / "mine" / "notes.txt").write_text("mine")
    # again: the training goes on where it was, the dive is replaced, what is foreign stays
    monkeypatch.setattr("spinndrift.sims.learning.starting_model", None)
    monkeypatch.setattr("spinndrift.sims.demo.simulate", lambda *_: flown[0])
    report = (out / "dive" / "report.html").stat()
    checkpoint = (out / "training" / "checkpoint.npz").read_bytes()
    with demo_folder(out):
        demo(source, out, scenario, TINY)
    assert (out / "training" / "checkpoint.npz").read_bytes() == checkpoint
    assert (out / "dive" / "report.html").stat().st_ino != report.st_ino
    for folder in (out, out / "training", out / "dive"):
        assert (folder / "mine" / "notes.txt").read_text() == "mine"
