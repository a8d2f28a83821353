"""An exported run holds the numbers of its log, in messages that Foxglove's schemas describe."""

import json
import sys

import numpy as np
import pytest
from motion import smooth_motion
from run_example import GOAL, example_log

from helpers import ROOT
from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.store import Recording
from spinndrift.sims.cli import main
from spinndrift.sims.export import foxglove as fox
from spinndrift.sims.export.content import write_recording
from spinndrift.sims.export.layout import layout_text
from spinndrift.sims.export.mcap_file import mcap_file
from spinndrift.systems.logs.load import import_log

DURATION, DT = 4.0, 0.05
PUBLISHED = {
    "foxglove.FrameTransforms": {"transforms"},
    "foxglove.PoseInFrame": {"timestamp", "frame_id", "pose"},
    "foxglove.PosesInFrame": {"timestamp", "frame_id", "poses"},
    "foxglove.SceneUpdate": {"deletions", "entities"},
    "foxglove.Log": {"timestamp", "level", "message", "name", "file", "line"},
}
"""Fields of each message by Foxglove's documentation."""


def no_constant(word):
    raise AssertionError(f"{word} is no JSON")


def read(path):
    """Messages by topic: time (s), schema's name, content; every one is of its schema."""
    from mcap.reader import make_reader

    found = {}
    with path.open("rb") as handle:
        for schema, channel, message in make_reader(handle).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            content = json.loads(message.data, parse_constant=no_constant)
            check(content, json.loads(schema.data), channel.topic)
            found.setdefault(channel.topic, []).append(
                (message.log_time * 1e-9, schema.name, content)
            )
    return found


def check(value, schema, place):
    """Whether a value is as a JSON schema of objects, arrays, numbers and texts says."""
    kinds = {
        "object": dict, "array": list, "string": str, "boolean": bool, "integer": int,
        "number": (int, float),
    }  # fmt: skip
    assert isinstance(value, kinds[schema["type"]]), place
    if schema["type"] == "object":
        assert set(schema.get("required", ())) <= set(value), place
        for name, inner in value.items():
            assert name in schema["properties"], f"{place}.{name}"
            check(inner, schema["properties"][name], f"{place}.{name}")
    if schema["type"] == "array":
        for inner in value:
            check(inner, schema["items"], f"{place}[]")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A folder as `spinndrift run` writes it, exported."""
    folder = tmp_path_factory.mktemp("run")
    example_log(DURATION, DT).save(folder / "log.nc")
    scenario = ROOT / "sims" / "scenarios" / "pylon_crossing_calm.yaml"
    (folder / "scenario.yaml").write_text(scenario.read_text())
    told = {"outcome": {"success": True, "words": "The goal was reached."}}
    (folder / "metrics.json").write_text(json.dumps(told))
    main(["export", str(folder), str(folder / "run.mcap"), "--layout", str(folder / "layout.json")])
    return folder


@pytest.fixture(scope="module")
def topics(run):
    return read(run / "run.mcap")


def test_schemas_have_the_published_fields():
    for name, fields in PUBLISHED.items():
        assert set(fox.SCHEMAS[name]["properties"]) == fields
        assert fox.SCHEMAS[name]["title"] == name


def test_frames_and_states_are_those_of_the_log(topics):
    log = example_log(DURATION, DT)
    assert len(topics["/tf"]) == log.time.size
    for (t, _, message), X, own in zip(topics["/tf"], log["X_WB"], log.time, strict=True):
        assert t == pytest.approx(own, abs=1e-9)
        body = next(m for m in message["transforms"] if m["child_frame_id"] == "body")
        assert body["parent_frame_id"] == "world"
        assert [body["translation"][c] for c in "xyz"] == X[4:].tolist()
        assert [body["rotation"][c] for c in "wxyz"] == X[:4].tolist()
        assert body["timestamp"]["sec"] + 1e-9 * body["timestamp"]["nsec"] == pytest.approx(own)
    for topic, pose, twist in (
        ("/state", "X_WB", "V_WB_B"),
        ("/estimate/state", "X_WB_estimate", "V_WB_B_estimate"),
    ):
        rows = [[m[c] for c in "xyzuvwpqr"] for _, _, m in topics[topic]]
        expected = np.concatenate([log[pose][:, 4:], log[twist]], axis=1)
        np.testing.assert_array_equal(rows, expected)
    yaw = [m["yaw"] for _, _, m in topics["/state"]]
    np.testing.assert_allclose(yaw, 2 * np.arctan2(log["X_WB"][:, 3], log["X_WB"][:, 0]), atol=1e-9)
    nis = [[m[c] for c in log.fused] for _, _, m in topics["/estimate/nis"]]
    np.testing.assert_array_equal(nis, log["nis"])
    F = [[m[c] for c in "XYZKMN"] for _, _, m in topics["/command/wrench"]]
    np.testing.assert_array_equal(F, log["F_Bo_B"])


def test_a_setpoint_is_shown_only_while_there_is_a_plan(topics):
    assert len(topics["/setpoint/pose"]) == len(topics["/state"]) - 1  # none at time 0


def test_plans_with_their_samples(topics):
    plans = example_log(DURATION, DT).plans
    assert plans is not None
    assert plans.weights is not None
    assert [t for t, _, _ in topics["/plan"]] == pytest.approx(plans.time.tolist(), abs=1e-9)
    for k, (_, _, message) in enumerate(topics["/plan"]):
        assert len(message["poses"]) == plans.X_WB.shape[1]
        last = message["poses"][-1]["position"]
        assert [last[c] for c in "xyz"] == plans.X_WB[k, -1, 4:].tolist()
    _, name, update = topics["/plan/scene"][0]
    assert name == "foxglove.SceneUpdate"
    (sampled,) = (e for e in update["entities"] if e["id"] == "samples")
    opacity = [line["color"]["a"] for line in sampled["lines"]]
    assert len(opacity) == plans.weights.shape[1]
    assert opacity == sorted(opacity, reverse=True)  # the heaviest first
    start = plans.X_WB[0, 0, 4:]
    for line in sampled["lines"]:
        assert [line["points"][0][c] for c in "xyz"] == start.tolist()


def test_the_scene_of_the_scenario(topics):
    ((t, _, update),) = topics["/scene"]
    entities = {e["id"]: e for e in update["entities"]}
    assert t == 0
    assert entities["vehicle"]["frame_id"] == "body"
    assert entities["estimate"]["frame_id"] == "estimate"
    assert sum(len(e["cylinders"]) for e in entities.values()) > 0
    assert len(entities["goal"]["spheres"]) == 1
    assert np.isfinite(GOAL).all()


def test_the_log_tells_notes_health_and_outcome(topics):
    said = [(message["level"], message["message"]) for _, _, message in topics["/log"]]
    assert (2, "example") in said
    assert (3, "estimator degraded") in said
    assert said[-1] == (2, "The goal was reached.")


def test_the_layout_shows_topics_that_are_there(run, topics):
    layout = json.loads((run / "layout.json").read_text())
    assert layout == json.loads(layout_text())

    def panels(part):
        return [part] if isinstance(part, str) else panels(part["first"]) + panels(part["second"])

    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
    paths = [p["value"] for c in layout["configById"].values() for p in c.get("paths", ())]
    assert paths
    for path in paths:
        topic, _, field = path.partition(".")
        assert any(field in message for _, _, message in topics[topic]), path
    shown = layout["configById"]["3D!scene"]["topics"]
    assert set(shown) <= set(topics)
    assert layout["configById"]["RosOut!log"]["topicToRender"] in topics


def _recording(starts, lacking=False):
    runs = []
    for k, start in enumerate(starts):
        X, V, _ = smooth_motion(0.1 * np.arange(30) + k)
        if lacking:
            X[4:6], V[:2] = np.nan, np.nan
        commands = {"pwm": np.full((30, 8), 1550.0)}
        runs.append(Trajectory(f"run {k}", X.T, V.T, commands, start=start))
    return Recording.from_trajectories(runs, 0.1, notes=["A note."])


@pytest.mark.parametrize(
    ("starts", "shown"),
    [
        ((10.0, 20.0), (0.0, 10.0)),  # their own times
        ((20.0, 10.0), (0.0, 10.0)),  # in their order
        ((0.0, 0.0), (0.0, 3.9)),  # one after another, a second apart
    ],
)
def test_several_runs_follow_one_another(starts, shown, tmp_path):
    with mcap_file(tmp_path / "a.mcap") as into:
        write_recording(into, _recording(starts))
    found = read(tmp_path / "a.mcap")
    assert [t for t, _, _ in found["/scene"]] == pytest.approx(shown)
    times = [t for t, _, _ in found["/tf"]]
    assert len(times) == 60
    assert np.all(np.diff(times) > 0)
    names = [m["message"] for _, _, m in found["/log"]]
    assert names[0] == "A note."
    assert sorted(names[1:]) == ["run 0", "run 1"]


def test_what_is_unknown_is_left_out(tmp_path):
    with mcap_file(tmp_path / "a.mcap") as into:
        write_recording(into, _recording((0.0,), lacking=True))
    found = read(tmp_path / "a.mcap")
    assert set(found["/state"][0][2]) == {"z", "roll", "pitch", "yaw", "w", "p", "q", "r"}
    assert found["/pose"][0][2]["pose"]["position"]["x"] == 0
    assert "/estimate/state" not in found
    assert [e["frame_id"] for e in found["/scene"][0][2]["entities"]] == ["body"]


def _fails(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        main(["export", *map(str, arguments)])
    assert end.value.code == 2
    return " ".join(capsys.readouterr().err.split())


def test_outputs_are_checked_before_anything_is_read(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    _recording((0.0,)).save("a.nc")
    assert "ending in .mcap" in _fails(capsys, "a.nc", "a.bag")
    told = _fails(capsys, "a.nc", "a.mcap", "--layout", "l.txt")
    assert "--layout l.txt: give a name ending in .json" in told
    (tmp_path / "own.mcap").write_bytes(b"\x89MCAP0\r\nof another program")
    assert "is no MCAP file of spinndrift" in _fails(capsys, "a.nc", "own.mcap")
    assert (tmp_path / "own.mcap").read_bytes().endswith(b"another program")
    (tmp_path / "mine.json").write_text('{"globalVariables": {}}')
    assert "no layout of spinndrift" in _fails(capsys, "a.nc", "a.mcap", "--layout", "mine.json")
    assert not (tmp_path / "a.mcap").exists()
    told = _fails(capsys, "a.nc", "a.mcap", "--scenario", "x")
    assert "--scenario x: is not here; the recording has run 0" in told
    main(["export", "a.nc", "a.mcap"])
    before = (tmp_path / "a.mcap").read_bytes()
    main(["export", "a.nc", "a.mcap"])  # one's own may be replaced
    assert (tmp_path / "a.mcap").read_bytes() == before
    with pytest.raises(UserError, match="another encoding than ROS's"):
        import_log(tmp_path / "a.mcap")


def test_the_extra_is_named_where_it_is_missing(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "mcap"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mcap", None)
    with (
        pytest.raises(UserError, match=r"install spinndrift\[ros\]"),
        mcap_file(tmp_path / "a.mcap"),
    ):
        pass
    assert not list(tmp_path.iterdir())
