"""The demo from end to end, made small: the shipped log, a tiny model, half a second of flight."""

import json
from dataclasses import replace

from test_cli import TINY

from spinndrift.sims.demo import EMBEDDED, demo
from spinndrift.sims.scenario import load_scenario
from spinndrift.systems.mavlink.logs import load_data
from spinndrift.training.config import DriftConfig

SMALL = """
duration: 0.5
controller: !MppiImpedance
  planner: {sequences: 8, realisations: 2, horizon: 10, knots: [2], effective_samples: 2.0,
    shown_paths: 4}
"""


def test_demo_tells_the_whole_story(tmp_path):
    source = tmp_path / "short.nc"
    load_data(EMBEDDED).cut(0.0, 12.0).save(source)
    out = tmp_path / "demo"
    scenario = load_scenario("pylon_crossing_calm", SMALL)
    tiny = replace(TINY, drift=DriftConfig(iterations=0))  # test_cli has the fitted start
    told = demo(source, out, scenario, tiny)
    assert "preset" in told
    assert "dive:" in told
    found = json.loads((out / "summary.json").read_text())
    assert set(found["held_out"]) == {"preset", "learned"}
    assert found["training"]["steps"] == tiny.steps
    report = (out / "report.html").read_text()
    for section in ("The data", "Training", "Held-out error", "The dive"):
        assert section in report
    assert (out / "dive" / "meshcat.html").stat().st_size > 1e6
